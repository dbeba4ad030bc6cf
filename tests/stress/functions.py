"""Functions around the rasterizer at their singular points: cosine, SSIM, slerp, storage types, fusion (N14 to N18)."""

import math
from collections.abc import Sequence
from itertools import combinations_with_replacement

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

from tests.stress.case import Case, Verdict, bound
from tests.stress.splats import make_splats, render
from vlgs.fields.similarity import cosines
from vlgs.fusion.attention import CrossAttention, SelfAttention
from vlgs.fusion.mlp import MLP
from vlgs.geometry import quat_to_rotmat
from vlgs.losses import masked_cosine, ssim
from vlgs.ops.ssim import C1, C2, SIGMA
from vlgs.view_blend.pose import slerp


def vanishing_vectors(full: bool) -> Verdict:
    """Zero and denormal features against zero and denormal text: cosine, its gradient and that of the loss vanish (1e-20)."""
    n = 1_000_000 if full else 1000
    features = torch.zeros(n, 8)
    features[1::4] = 1e-45
    features[2::4] = 1e-38
    features[3::4] = -1e-20
    features.requires_grad_()
    text = torch.zeros(3, 8)
    text[1] = 1e-40
    values = cosines(features, text)
    values.sum().backward()
    assert features.grad is not None
    worst = {"cosine": values.detach().abs().max().item(), "gradient": _largest(features.grad)}

    render = features.detach().reshape(1, n, 8).requires_grad_()
    masked_cosine(render, torch.zeros(1, n, 8)).backward()
    assert render.grad is not None
    worst["gradient of the loss"] = _largest(render.grad)
    return bound(worst, dict.fromkeys(worst, 1e-20))


def _largest(x: Tensor) -> float:
    return x.abs().max().item() if x.isfinite().all() else math.inf


def similarity(full: bool) -> Verdict:
    """SSIM of flat, almost flat, inverted, one-pixel and sub-window images, up to 135 x 240: in [-1, 1], 1 of an image with itself to 1e-6, within 1e-5 of float64."""
    rng = torch.Generator().manual_seed(0)
    sizes = [(1, 1), (1, 40), (3, 2), (10, 10), (11, 11), (37, 29)]
    if full:
        sizes.append((135, 240))
    worst = {"beyond 1": 0.0, "self": 0.0, "float64": 0.0}
    for h, w in sizes:
        noise = torch.rand(h, w, 3, generator=rng)
        checks = (
            ((torch.arange(h)[:, None] + torch.arange(w)) % 2).float()[..., None].expand(h, w, 3)
        )
        images = [noise, 1 - noise, checks, 1 - checks, torch.full((h, w, 3), 0.7)]
        images += [images[-1] + 1e-7, torch.zeros(h, w, 3), torch.ones(h, w, 3)]
        exact = _ssim_by_definition([image.double() for image in images])
        for i, a in enumerate(images):
            worst["self"] = max(worst["self"], abs(ssim(a, a).item() - 1))
            for j, b in enumerate(images):
                value = ssim(a, b).item()
                worst["beyond 1"] = max(worst["beyond 1"], abs(value) - 1)
                worst["float64"] = max(worst["float64"], abs(value - exact[i, j].item()))
    return bound(worst, {"beyond 1": 1e-6, "self": 1e-6, "float64": 1e-5})


def _ssim_by_definition(images: Sequence[Tensor]) -> Float[Tensor, "n n"]:
    """Every image with every image: means and covariances of every window, by one two-dimensional convolution each."""
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    taps = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    window = torch.outer(taps, taps)[None, None] / taps.sum() ** 2

    def mean(x: Tensor) -> Tensor:
        return conv2d(x.permute(2, 0, 1)[:, None], window, padding=5)

    means = [mean(x) for x in images]
    variances = [mean(x * x) - m**2 for x, m in zip(images, means, strict=True)]
    values = torch.empty(len(images), len(images), dtype=torch.float64)
    for i, j in combinations_with_replacement(range(len(images)), 2):
        cov = mean(images[i] * images[j]) - means[i] * means[j]
        top = (2 * means[i] * means[j] + C1) * (2 * cov + C2)
        spread = means[i] ** 2 + means[j] ** 2 + C1
        ratio = top / (spread * (variances[i] + variances[j] + C2))
        values[i, j] = values[j, i] = ratio.mean()
    return values


def hostile_rotations(full: bool) -> Verdict:
    """Slerp of 10^6 pairs, equal, opposite, an ulp and 180 degrees apart: unit to 1e-6, its share of the angle to 1e-5, ends and signs as they should."""
    n = 1_000_000 if full else 7000
    rng = torch.Generator().manual_seed(1)
    q1 = torch.nn.functional.normalize(torch.randn(n, 4, generator=rng, dtype=torch.float64))
    other = torch.nn.functional.normalize(torch.randn(n, 4, generator=rng, dtype=torch.float64))
    normal = torch.nn.functional.normalize(other - (other * q1).sum(1, keepdim=True) * q1)
    edge = math.acos(0.995)
    angle = torch.stack(
        [torch.zeros(n), torch.rand(n, generator=rng) * math.pi, torch.full((n,), math.pi / 2),
         10 ** (-12 * torch.rand(n, generator=rng)), edge + 1e-6 * torch.randn(n, generator=rng)]
    )[torch.arange(n) % 5, torch.arange(n)].double()[:, None]  # fmt: skip
    q2 = angle.cos() * q1 + angle.sin() * normal
    q2 = torch.where(torch.rand(n, 1, generator=rng) < 0.2, -q2, q2)
    q2 = torch.where(torch.rand(n, 1, generator=rng) < 0.1, torch.nextafter(q1, q1 + 1), q2)
    whole = _angle(q1, q2)
    # At 180 degrees of rotation both ways round are shortest: which one is taken may depend on the sign.
    either_way = (whole - math.pi / 2).abs() < 1e-9
    worst: dict[str, float] = dict.fromkeys(("length", "share", "ends", "signs"), 0.0)
    for k in (0.0, 1e-9, 0.3, 0.5, 0.995, 1.0):
        q = slerp(q1, q2, k)
        share = (_angle(q1, q) - (1 - k) * whole).abs()
        worst["length"] = max(worst["length"], _largest(q.norm(dim=1) - 1))
        worst["share"] = max(worst["share"], _largest(share))
        turned = (quat_to_rotmat(slerp(-q1, q2, k)) - quat_to_rotmat(q))[~either_way]
        worst["signs"] = max(worst["signs"], _largest(turned))
    worst["ends"] = max(
        _largest(_angle(slerp(q1, q2, 1.0), q1)), _largest(_angle(slerp(q1, q2, 0.0), q2))
    )
    limits = {"length": 1e-6, "share": 1e-5, "ends": 1e-7, "signs": 1e-6}
    return bound(worst, limits, f"{n} pairs")


def _angle(q1: Tensor, q2: Tensor) -> Tensor:
    same, opposite = (q1 - q2).norm(dim=1), (q1 + q2).norm(dim=1)
    return 2 * torch.atan2(torch.minimum(same, opposite), torch.maximum(same, opposite))


def half_precision(full: bool) -> Verdict:
    """Nothing is stored or computed in half precision: 16-bit input is refused by name."""
    refused = []
    for dtype in (torch.float16, torch.bfloat16):
        try:
            render(make_splats(5).to(dtype))
        except (ValueError, TypeError) as error:
            refused.append("must be float32 or float64" in str(error))
    return Verdict(
        f"{sum(refused)} of 2 types refused; no 16-bit cache exists", refused == [True, True]
    )


def fusion(full: bool) -> Verdict:
    """Input of +-1e4 stays finite both ways; a fresh module changes no bit; permuting Gaussians permutes the output to 1e-6."""
    n = 100_000 if full else 600
    rng = torch.Generator().manual_seed(2)
    wrong, moved = [], 0.0
    fusions = (
        (SelfAttention, SelfAttention(3, 3, init="xavier")),
        (CrossAttention, CrossAttention(3, 3, init="xavier")),
        (MLP, MLP(3, 3, residual=False)),
    )
    for build, mixing in fusions:
        fresh = build(3, 3)
        color, feature = (
            (torch.randint(0, 2, (n, 3), generator=rng) * 2e4 - 1e4).requires_grad_() for _ in "cf"
        )
        u, v = fresh(color, feature)
        if not (torch.equal(u, color) and torch.equal(v, feature)):
            wrong.append(f"{build.__name__} is not the identity at first")
        fused = torch.cat(mixing(color, feature), 1)
        grads = torch.autograd.grad(
            fused.square().mean(), [color, feature, *mixing.parameters()], allow_unused=True
        )
        if not all(t is None or t.isfinite().all() for t in (fused, *grads)):
            wrong.append(f"{build.__name__} overflows")
        a, b = torch.rand(n, 3, generator=rng), torch.randn(n, 3, generator=rng)
        order = torch.randperm(n, generator=rng)
        straight, permuted = torch.cat(mixing(a, b), 1), torch.cat(mixing(a[order], b[order]), 1)
        moved = max(moved, _largest(permuted - straight[order]))
    verdict = bound({"permuted": moved}, {"permuted": 1e-6}, f"wrong: {', '.join(wrong) or 'none'}")
    return Verdict(verdict.measured, verdict.passed and not wrong)


FUNCTIONS = (
    Case("N14 vanishing vectors", vanishing_vectors),
    Case("N15 SSIM", similarity),
    Case("N16 slerp", hostile_rotations),
    Case("N17 half precision", half_precision),
    Case("N18 fusion", fusion),
)
