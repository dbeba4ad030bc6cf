import math
import os
import subprocess
import sys

import jaxtyping
import pytest
import torch
from instruction_sets import require_other
from slow import with_slow
from torch import Tensor, nn

from vlgs.fusion.attention import CrossAttention, SelfAttention
from vlgs.fusion.mlp import MLP
from vlgs.ops.attention import Token

READINGS = [(4, 1), (1, 4), (2, 3)]
"""(width, heads): the default, the other reading of Eq. 5, and a mix of both."""


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
    heads, width = m.token
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
    fuse = SelfAttention(1, 1, width=1).double()
    with torch.no_grad():
        fuse.qkv.weight.zero_()
        fuse.qkv.bias.copy_(torch.tensor([1, 0, 0, math.log(3), 8, 4], dtype=torch.float64))
        fuse.out.weight.copy_(torch.eye(2))
    color, feature = fuse(torch.tensor([[0.5]]).double(), torch.tensor([[-1.0]]).double())
    torch.testing.assert_close(color.item(), 0.5 + 5.0, rtol=1e-14, atol=0)
    torch.testing.assert_close(feature.item(), -1.0 + 6.0, rtol=1e-14, atol=0)


def batched(build, token: Token, color: Tensor, feature: Tensor, layers: list[Tensor]) -> Tensor:
    """The formula over all Gaussians, in plain PyTorch; layers as `_attend` takes them."""
    x = torch.cat([color, feature], dim=1)
    asking, answering = (x, x) if build is SelfAttention else (feature, color)
    q_weight, q_bias, kv_weight, kv_bias, out_weight, out_bias = layers
    q = (asking @ q_weight.T + q_bias).unflatten(1, (-1, *token))
    k, v = (answering @ kv_weight.T + kv_bias).unflatten(1, (2, -1, *token)).unbind(1)
    scores = torch.einsum("nihw,njhw->nijh", q, k) / token.width**0.5
    mixed = torch.einsum("nijh,njhw->nihw", scores.softmax(dim=2), v).flatten(1)
    fused = asking + mixed @ out_weight.T + out_bias
    return fused if build is SelfAttention else torch.cat([color, fused], dim=1)


SHAPES = [(3, 3, 4, 1), (3, 3, 1, 4), (1, 1, 1, 1), (3, 7, 5, 2), (2, 1, 3, 3), (3, 29, 4, 1)]
"""(color_dim, feature_dim, width, heads): those with a code of their own, odd ones, many channels."""


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("color_dim", "feature_dim", "width", "heads"), SHAPES)
@pytest.mark.parametrize("build", [SelfAttention, CrossAttention])
def test_values_and_every_gradient_equal_plain_pytorch(
    build, color_dim: int, feature_dim: int, width: int, heads: int, dtype: torch.dtype
):
    n = 2 * 2048 + 77  # three chunks, the last with a partial block
    fuse = build(color_dim, feature_dim, width, heads, init="xavier").to(dtype)
    for p in fuse.parameters():
        nn.init.normal_(p, std=0.5)
    inputs = [torch.rand(n, color_dim, dtype=dtype), torch.randn(n, feature_dim, dtype=dtype)]
    inputs = [x.requires_grad_() for x in inputs]
    fused = torch.cat(fuse(*inputs), dim=1)
    upstream = torch.randn_like(fused)
    got = torch.autograd.grad(fused, [*inputs, *fuse.parameters()], upstream)

    exact = [x.detach().double().requires_grad_() for x in (*inputs, *fuse.parameters())]
    layers = exact[2:]
    if build is SelfAttention:
        inner = fuse.out.in_features
        split = [t.split([inner, 2 * inner]) for t in layers[:2]]
        layers = [split[0][0], split[1][0], split[0][1], split[1][1], *layers[2:]]
    want = batched(build, fuse.token, exact[0], exact[1], layers)
    want_grads = torch.autograd.grad(want, exact, upstream.double())
    for place, (a, b) in enumerate(zip((fused, *got), (want, *want_grads), strict=True)):
        # Gradients of weights are sums over n terms of size 1. Theirs is relative to what such sums are like, as one may cancel: measured
        # 2e-4 of a sum that came to nearly nothing.
        least = n**0.5 if place > len(inputs) else 1e-30
        error = (a.double() - b).abs().max() / b.abs().max().clamp_min(least)
        assert error < (2e-5 if dtype == torch.float32 else 1e-13)


@pytest.mark.parametrize("token", with_slow(READINGS, READINGS[1:2]))
@pytest.mark.parametrize("build", [SelfAttention, CrossAttention])
def test_gradcheck(build, token: tuple[int, int]):
    check_gradients(build(3, 2, *token).double(), fast=False)


@pytest.mark.parametrize("build", [SelfAttention, CrossAttention, MLP])
def test_gradient_reaches_inputs_and_every_weight(build):
    check_gradients(build(3, 2).double(), fast=True)


def check_gradients(fuse: nn.Module, fast: bool) -> None:
    names = [name for name, _ in fuse.named_parameters()]
    weights = [torch.randn_like(p).requires_grad_() for p in fuse.parameters()]
    inputs = [torch.randn(2, 3).double().requires_grad_(), torch.randn(2, 2).double()]

    def fused(color: Tensor, feature: Tensor, *weights: Tensor) -> Tensor:
        named = dict(zip(names, weights, strict=True))
        return torch.cat(torch.func.functional_call(fuse, named, (color, feature)), dim=1)

    assert torch.autograd.gradcheck(
        fused, (inputs[0], inputs[1].requires_grad_(), *weights), fast_mode=fast
    )


@pytest.mark.parametrize("n", [0, 1, 16, 64, 2048, 3 * 2048 + 1])
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
    assert torch.equal(permuted, fused[order])

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


@pytest.mark.parametrize("isa", ["base", "v3", "v4"])
def test_every_instruction_set_gives_the_same_up_to_rounding(isa: str):
    require_other(isa)
    # In a process of its own: the choice is made once.
    code = """if True:
        import torch
        from vlgs.fusion.attention import SelfAttention
        fuse = SelfAttention(3, 4, init="xavier")
        with torch.no_grad():
            for i, p in enumerate(fuse.parameters()):
                p.copy_(torch.linspace(-0.5, 0.4 + 0.1 * i, p.numel()).sin().reshape(p.shape))
        color, feature = torch.linspace(0, 1, 303).reshape(101, 3), torch.linspace(-2, 2, 404).reshape(101, 4)
        color.requires_grad_()
        fused = torch.cat(fuse(color, feature), dim=1)
        grads = torch.autograd.grad(fused.square().sum(), [color, *fuse.parameters()])
        print(*(float(t.double().square().sum()) for t in (fused, *grads)))
    """
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"VLGS_ISA": isa},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    fuse = SelfAttention(3, 4, init="xavier").double()
    with torch.no_grad():
        for i, p in enumerate(fuse.parameters()):
            ramp = torch.linspace(-0.5, 0.4 + 0.1 * i, p.numel()).sin()
            p.copy_(ramp.reshape(p.shape))
    color = torch.linspace(0, 1, 303).reshape(101, 3).double().requires_grad_()
    feature = torch.linspace(-2, 2, 404).reshape(101, 4).double()
    inner = fuse.out.in_features
    (w0, w1), (b0, b1) = (t.split([inner, 2 * inner]) for t in (fuse.qkv.weight, fuse.qkv.bias))
    layers = [w0, b0, w1, b1, fuse.out.weight, fuse.out.bias]
    fused = batched(SelfAttention, fuse.token, color, feature, layers)
    grads = torch.autograd.grad(fused.square().sum(), [color, *fuse.parameters()])
    want = [float(t.detach().square().sum()) for t in (fused, *grads)]
    got = [float(word) for word in done.stdout.split()]
    assert got == pytest.approx(want, rel=1e-4)


def test_wrong_dtype_is_refused():
    with pytest.raises(ValueError, match="color must be float32 or float64 like the weights"):
        SelfAttention(3, 3)(torch.rand(2, 3).double(), torch.rand(2, 3))


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
    with pytest.raises(ValueError, match=r"<= 64.*head=autoencoder.*got 3 \+ 512"):
        build(3, 512)
    with pytest.raises(ValueError, match="init must be 'zero' or 'xavier', got 'ones'"):
        build(3, 3, init="ones")
    with pytest.raises(ValueError, match=r"must be \(3, 8\), got \(3, 3\)"):
        build(3, 8)(torch.rand(2, 3), torch.rand(2, 3))
