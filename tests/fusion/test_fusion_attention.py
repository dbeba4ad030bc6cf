import jaxtyping
import pytest
import torch
from torch import Tensor, nn

from vlgs.fusion.attention import CrossAttention, SelfAttention, channel_attention
from vlgs.fusion.blocks import BLOCK
from vlgs.fusion.mlp import MLP

READINGS = [(4, 1), (1, 4), (2, 3)]
"""(width, heads): the default, the other reading of Eq. attention, and a mix of both."""


def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Plain definition for one Gaussian and one head; every argument is [channels, width]."""
    scores = q @ k.T / q.shape[1] ** 0.5
    shares = scores.exp() / scores.exp().sum(dim=1, keepdim=True)
    return shares @ v


def tokens(layer: nn.Linear, x: Tensor, channels: int, heads: int, width: int) -> Tensor:
    """Output of a layer for one Gaussian as [maps, channels, heads, width]."""
    return (layer.weight @ x + layer.bias).reshape(-1, channels, heads, width)


def self_attention_by_hand(m: SelfAttention, color: Tensor, feature: Tensor) -> Tensor:
    x = torch.cat([color, feature])
    _, heads, width = m.token
    q, k, v = tokens(m.qkv, x, len(x), heads, width)
    mixed = torch.stack([attend(q[:, h], k[:, h], v[:, h]) for h in range(heads)], dim=1)
    return x + m.out.weight @ mixed.flatten() + m.out.bias


def cross_attention_by_hand(m: CrossAttention, color: Tensor, feature: Tensor) -> Tensor:
    heads, width = m.token
    (q,) = tokens(m.query, feature, len(feature), heads, width)
    k, v = tokens(m.key_value, color, len(color), heads, width)
    mixed = torch.stack([attend(q[:, h], k[:, h], v[:, h]) for h in range(heads)], dim=1)
    return torch.cat([color, feature + m.out.weight @ mixed.flatten() + m.out.bias])


@pytest.mark.parametrize(("width", "heads"), READINGS)
@pytest.mark.parametrize(
    ("build", "by_hand"),
    [(SelfAttention, self_attention_by_hand), (CrossAttention, cross_attention_by_hand)],
)
def test_equals_the_definition_one_gaussian_at_a_time(build, by_hand, width: int, heads: int):
    fuse = build(3, 2, width, heads, init="xavier").double()
    for p in fuse.parameters():
        nn.init.normal_(p)
    color, feature = torch.rand(7, 3).double(), torch.randn(7, 2).double()
    want = torch.stack([by_hand(fuse, c, f) for c, f in zip(color, feature, strict=True)])
    torch.testing.assert_close(torch.cat(fuse(color, feature), dim=1), want, rtol=1e-12, atol=1e-12)


def test_attention_of_two_channels_by_hand():
    # Scores of channel 0 are (0, ln 3), so that its shares are (1/4, 3/4); those of channel 1 are equal.
    query = torch.tensor([1.0, 0.0]).reshape(1, 2, 1, 1, 1)
    key = torch.tensor([0.0, 3.0]).log1p().mul(torch.tensor(3.0).log() / torch.tensor(4.0).log())
    value = torch.tensor([8.0, 4.0]).reshape(1, 2, 1, 1, 1)
    got = channel_attention(query, key.reshape(1, 2, 1, 1, 1), value)
    torch.testing.assert_close(got.flatten(), torch.tensor([5.0, 6.0]))


@pytest.mark.parametrize(("width", "heads"), READINGS)
def test_gradient_of_attention(width: int, heads: int):
    q, k, v = (torch.randn(2, d, heads, width, 2).double().requires_grad_() for d in (3, 2, 2))
    assert torch.autograd.gradcheck(channel_attention, (q, k, v))


@pytest.mark.parametrize("build", [SelfAttention, CrossAttention, MLP])
def test_gradient_reaches_inputs_and_every_weight(build):
    fuse = build(3, 2).double()
    names = [name for name, _ in fuse.named_parameters()]
    weights = [torch.randn_like(p).requires_grad_() for p in fuse.parameters()]
    inputs = [torch.randn(2, 3).double().requires_grad_(), torch.randn(2, 2).double()]

    def fused(color: Tensor, feature: Tensor, *weights: Tensor) -> Tensor:
        named = dict(zip(names, weights, strict=True))
        return torch.cat(torch.func.functional_call(fuse, named, (color, feature)), dim=1)

    assert torch.autograd.gradcheck(
        fused, (inputs[0], inputs[1].requires_grad_(), *weights), fast_mode=True
    )


@pytest.mark.parametrize("n", [0, 1, BLOCK, 3 * BLOCK + 1])
@pytest.mark.parametrize("build", [SelfAttention, CrossAttention, MLP])
def test_fresh_module_changes_no_bit_and_can_still_learn(build, n: int):
    fuse = build(3, 5)
    color = torch.rand(n, 3)
    feature = torch.randn(n, 5).mul(1e4).requires_grad_()
    fused = fuse(color, feature)
    assert torch.equal(fused[0], color)
    assert torch.equal(fused[1], feature)
    fused[1].square().sum().backward()
    last = [p for name, p in fuse.named_parameters() if name in ("out.weight", "mix.weight")]
    assert len(last) == 1
    assert (last[0].grad != 0).any() == (n > 0)


@pytest.mark.parametrize("build", [SelfAttention, CrossAttention])
def test_huge_inputs_stay_finite_forward_and_backward(build):
    fuse = build(3, 3, init="xavier")
    color, feature = (
        (torch.randint(0, 2, (600, 3)) * 2e4 - 1e4).requires_grad_() for _ in range(2)
    )
    fused = torch.cat(fuse(color, feature), dim=1)
    fused.sum().backward()
    grads = [color.grad, feature.grad, *(p.grad for p in fuse.parameters())]
    assert fused.isfinite().all()
    assert all(g is not None and g.isfinite().all() for g in grads)


@pytest.mark.parametrize("build", [SelfAttention, CrossAttention])
def test_gaussians_do_not_see_each_other(build):
    fuse = build(3, 3, init="xavier")
    color, feature = torch.rand(1000, 3), torch.randn(1000, 3)
    fused = torch.cat(fuse(color, feature), dim=1)

    order = torch.randperm(1000)
    permuted = torch.cat(fuse(color[order], feature[order]), dim=1)
    torch.testing.assert_close(permuted, fused[order], rtol=1e-6, atol=1e-6)

    color[700:] = 5.0
    assert torch.equal(torch.cat(fuse(color, feature), dim=1)[:700], fused[:700])


@pytest.mark.parametrize("n", [200, 5001])
@pytest.mark.parametrize(
    ("build", "feature_dim"),
    [(SelfAttention, 3), (SelfAttention, 16), (CrossAttention, 1), (MLP, 3)],
)
def test_every_bit_is_the_same_on_any_number_of_threads(build, feature_dim: int, n: int):
    fuse = build(3, feature_dim)
    for p in fuse.parameters():
        nn.init.normal_(p)
    inputs = torch.rand(n, 3), torch.randn(n, feature_dim)

    def everything() -> list[Tensor]:
        color, feature = (x.clone().requires_grad_() for x in inputs)
        fused = torch.cat(fuse(color, feature), dim=1)
        leaves = [color, feature, *fuse.parameters()]
        return [fused, *torch.autograd.grad(fused.square().mean(), leaves)]

    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(everything())
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize(("width", "heads"), [(4, 1), (1, 4)])
def test_both_readings_have_654_weights(width: int, heads: int):
    assert sum(p.numel() for p in SelfAttention(3, 3, width, heads).parameters()) == 654


def test_xavier_bounds_are_those_of_each_map_alone():
    fuse = SelfAttention(3, 3, init="xavier")
    bound = (
        6 / (6 + 24)
    ) ** 0.5  # of a 6 -> 24 and of a 24 -> 6 map; the stacked 6 -> 72 map would get 0.28
    for weight in (*fuse.qkv.weight.chunk(3), fuse.out.weight):
        assert 0.9 * bound < weight.abs().max() <= bound
    assert not torch.equal(*fuse.qkv.weight.chunk(3)[:2])


def test_cross_attention_returns_the_colour_itself():
    color, feature = torch.rand(4, 3), torch.randn(4, 3)
    fused = CrossAttention(3, 3, init="xavier")(color, feature)
    assert fused[0] is color
    assert not torch.equal(fused[1], feature)


@pytest.mark.parametrize("build", [SelfAttention, CrossAttention])
def test_bad_sizes_are_refused(build, monkeypatch: pytest.MonkeyPatch):
    # The run-time types would speak first.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match="must be positive, got \\(3, 0, 4, 1\\)"):
        build(3, 0)
    with pytest.raises(ValueError, match="must be positive"):
        build(3, 3, heads=-1)
    with pytest.raises(ValueError, match=r"<= 64.*codec=autoencoder.*got 3 \+ 512"):
        build(3, 512)
    with pytest.raises(ValueError, match="init must be 'zero' or 'xavier', got 'ones'"):
        build(3, 3, init="ones")
    with pytest.raises(ValueError, match=r"must be \(3, 8\), got \(3, 3\)"):
        build(3, 8)(torch.rand(2, 3), torch.rand(2, 3))
