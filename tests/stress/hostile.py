"""Hostile input to the rasterizer: poison, needles, extreme scales, empty views, sizes beyond memory (N2 to N9)."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tests.fuzz_kernel import fuzz
from tests.stress.case import Case, Verdict, bound, peak_memory, relative_error
from tests.stress.splats import (
    SMOOTH,
    StressScene,
    full_screen,
    make_splats,
    render,
    render_with_gradients,
    same_bits,
    tensors_of,
)
from vlgs.ops import project
from vlgs.ops.rasterize_to_pixels import rasterize_to_pixels
from vlgs.types import Camera, ChannelGroup, RasterConfig


def poison(full: bool) -> Verdict:
    """Random hostile scenes, half of them with NaN, Inf, zeros, denormals or 1e+-38 anywhere in the input: finite or a named error."""
    report = fuzz(range(10_000 if full else 200))
    return Verdict(str(report), not report.failures)


def extreme_scales(full: bool) -> Verdict:
    """Log-scales from -25 to 15: gradients finite and within 1e-3 of float64, with denormals kept and flushed."""
    n = 10_000 if full else 300
    splats = make_splats(n, seed=3)
    rng = torch.Generator().manual_seed(4)
    splats = replace(
        splats, scales=torch.exp(torch.rand(n, 3, generator=rng) * 40 - 25),
        weights=tuple(0.9 * w * min(1.0, 40 / n) for w in splats.weights),
    )  # fmt: skip
    _, want = render_with_gradients(splats.to(torch.float64), config=SMOOTH)
    worst: dict[str, float] = {}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # flushing is a state of one thread
    try:
        for flush in (False, True):
            torch.set_flush_denormal(flush)
            _, got = render_with_gradients(splats, config=SMOOTH)
            for name, grad in got.items():
                error = relative_error(grad, want[name])
                worst[name] = max(worst.get(name, 0.0), error)
    finally:
        torch.set_flush_denormal(False)
        torch.set_num_threads(threads)
    return bound(worst, dict.fromkeys(worst, 1e-3))


def needles(full: bool) -> Verdict:
    """Covariances of condition up to 1e12: conic within 1e-4 of extended precision, determinant > 0, none culled."""
    n = 100_000 if full else 3000
    splats = make_splats(n, seed=5)
    rng = torch.Generator().manual_seed(6)
    shortest = torch.rand(n, 1, generator=rng) * 6 - 6  # decades; the longest axis is 1
    between = torch.rand(n, 1, generator=rng) * shortest
    scales = 10 ** torch.cat([torch.zeros(n, 1), between, shortest], 1)
    splats = replace(splats, scales=scales)
    config = RasterConfig()
    K = torch.tensor([[splats.focal, 0, 30.5], [0, splats.focal, 22.5], [0, 0, 1]]).double()
    camera = Camera(torch.eye(4), K, splats.width, splats.height)
    got = project.project(splats.means, splats.quats, splats.scales, camera, config)
    p, s, r = (got.ellipse[:, i].numpy().astype(np.longdouble) for i in range(3))
    xx, xy, yy = _conic(splats.means, splats.quats, splats.scales, splats.focal, config)
    error = np.stack([p * p - xx, -p * p * s - xy, p * p * s * s + r * r - yy])
    size = np.sqrt(xx**2 + 2 * xy**2 + yy**2)
    measured = {
        "conic": float((np.sqrt((error**2).sum(0)) / size).max()),
        "culled": float((got.depth == 0).sum()),
        "not positive": float(((p <= 0) | (r <= 0)).sum()),
    }
    return bound(measured, {"conic": 1e-4, "culled": 0, "not positive": 0})


def _conic(
    means: Tensor, quats: Tensor, scales: Tensor, focal: float, config: RasterConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse covariance on the image by the textbook formula, in 64 bits of mantissa."""
    m, q, s = (t.numpy().astype(np.longdouble) for t in (means, quats, scales))
    w, x, y, z = (q / np.sqrt((q * q).sum(1, keepdims=True))).T
    rotation = np.stack(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    jacobian = np.zeros((len(m), 2, 3), np.longdouble)
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = focal / m[:, 2]
    jacobian[:, :, 2] = -focal * m[:, :2] / m[:, 2:] ** 2
    factor = jacobian @ (rotation * s[:, None])
    a, c = ((factor * factor).sum(2) + config.eps2d).T
    b = (factor[:, 0] * factor[:, 1]).sum(1)
    det = a * c - b * b
    return c / det, -b / det, a / det


def near_and_far(full: bool) -> Verdict:
    """Depths at the near plane +-1e-6 and to 100, x/z to 4 half-widths, both sides of the clamp: images and gradients equal the reference's."""
    slopes = torch.linspace(-4, 4, 41 if full else 11)
    near = RasterConfig().near
    depths = torch.tensor([near * (1 - 1e-6), near * (1 + 1e-6), 0.05, 0.2, 1.0, 10.0, 100.0])
    z, x = torch.meshgrid(depths.double(), slopes.double(), indexing="ij")
    z, x = z.flatten(), x.flatten()
    n = len(z)
    worst = {"image": 0.0, "gradient": 0.0}
    for axis in (0, 1):
        splats = make_splats(n, seed=7, size=(37, 29)).to(torch.float64)
        means = torch.stack([0.01 * z, 0.01 * z, z], 1)
        half = (splats.width, splats.height)[axis] / 2 / splats.focal
        means[:, axis] = x * half * z
        size = (0.05 + 0.3 * x.abs() * half)[:, None] * z[:, None]
        splats = replace(
            splats, means=means, scales=size * torch.exp(splats.scales),
            weights=tuple(0.2 * w + 0.01 for w in splats.weights), center=(15.0, 17.0),
        )  # fmt: skip
        got, got_grads = render_with_gradients(splats, config=SMOOTH)
        want, want_grads = render_with_gradients(splats, "reference", SMOOTH)
        for a, b in zip(got.images, want.images, strict=True):
            worst["image"] = max(worst["image"], (a - b).abs().max().item())
        for name, grad in want_grads.items():
            worst["gradient"] = max(worst["gradient"], relative_error(got_grads[name], grad))
    return bound(worst, {"image": 1e-9, "gradient": 1e-8}, f"{2 * n} Gaussians")


def crops(full: bool) -> Verdict:
    """A crop rendered with an off-centre camera equals the crop of the render to 1e-6 (1e-5 in float32), Jacobian unclamped."""
    splats = make_splats(5000 if full else 200, seed=8, size=(120, 88))
    config = replace(SMOOTH, fov_margin=1e6)
    return _crop_errors(lambda corner: splats, config)


def crops_with_a_clamp(full: bool) -> Verdict:
    """With the default fov_margin the same holds of Gaussians whose centres are within the margin of the crop, and of those alone."""
    n = 5000 if full else 400
    splats = make_splats(n, seed=8, size=(120, 88))
    pixels = splats.focal * splats.means[:, :2] / splats.means[:, 2:] + torch.tensor([60.0, 44.0])
    size = torch.tensor([float(side) for side in CROP])
    slack = RasterConfig().fov_margin * size / 2

    def inside(corner: tuple[int, int]) -> StressScene:
        start = torch.tensor(corner) - slack
        return splats.rows(((pixels > start) & (pixels < start + size + 2 * slack)).all(1))

    within = _crop_errors(inside, SMOOTH)
    beyond = _crop_errors(lambda corner: splats, SMOOTH)
    return Verdict(
        f"within the margin: {within.measured}; beyond: {beyond.measured}",
        within.passed and not beyond.passed,
    )


CROP = (47, 37)


def _crop_errors(take: Callable[[tuple[int, int]], StressScene], config: RasterConfig) -> Verdict:
    """Largest difference between a crop and the render of the whole, of the Gaussians that a corner takes."""
    worst = {"float64": 0.0, "float32": 0.0}
    width, height = CROP
    for dtype, name in ((torch.float64, "float64"), (torch.float32, "float32")):
        for x, y in ((0, 0), (16, 16), (37, 5), (73, 51)):
            splats = take((x, y)).to(dtype)
            whole, _ = render(splats, config=config)
            center = (splats.width / 2 - x, splats.height / 2 - y)
            part = replace(splats, width=width, height=height, center=center)
            crop, _ = render(part, config=config)
            for a, b in zip(crop.images, whole.images, strict=True):
                error = (a - b[y : y + height, x : x + width]).abs().max().item()
                worst[name] = max(worst[name], error)
    return bound(worst, {"float64": 1e-6, "float32": 1e-5})


def full_screens_at_4k(full: bool) -> Verdict:
    """A thousand full-screen Gaussians at 3840 x 2160, forward and backward: memory within the images, lists and slots (1.5 GB)."""
    size = (3840, 2160) if full else (640, 360)
    splats = full_screen(1000 if full else 100, size)
    with peak_memory() as peak:
        out, grads = render_with_gradients(splats)
        gigabytes = peak() / 2**30
    finite = all(t.isfinite().all() for t in tensors_of(out, grads))
    verdict = bound({"GB": gigabytes}, {"GB": 1.5})
    return replace(verdict, passed=verdict.passed and finite)


def too_many_pairs(full: bool) -> Verdict:
    """More than 2^31 (Gaussian, tile) pairs: a named error, and nothing of that size allocated (50 MB)."""
    splats = full_screen(70_000, (3840, 2160))
    with peak_memory() as peak:
        try:
            render(splats)
            message = "no error"
        except ValueError as error:
            message = str(error)
        megabytes = peak() / 2**20
    verdict = bound({"MB": megabytes}, {"MB": 50}, message)
    named = "tile lists must be within memory_budget" in message
    entries = [int(word) for word in message.split() if word.isdigit()]
    return replace(verdict, passed=verdict.passed and named and max(entries) > 2**31)


def empty_views(full: bool) -> Verdict:
    """Nothing there, all behind, all off the screen, or all too faint in one group or both: exact zeros, gradients of full shape."""
    wrong = []
    for n in (0, 1, 10_000 if full else 100):
        base = make_splats(n, seed=9)
        o, w = base.weights
        faint = 0 * o + 1 / 256
        scenes = {
            "behind": replace(base, means=base.means * torch.tensor([1.0, 1.0, -1.0])),
            "aside": replace(base, means=base.means + torch.tensor([1e4, 0.0, 0.0])),
            "both faint": replace(base, weights=(faint, faint.clone())),
            "language faint": replace(base, weights=(o, faint)),
            "colour faint": replace(base, weights=(faint, w)),
        }
        for name, scene in scenes.items():
            out, grads = render_with_gradients(scene)
            empty = [
                i
                for i in (0, 1)
                if "faint" not in name or scene.weights[i] is faint or name == "both faint"
            ]
            zero = all(not out.images[i].any() and not out.alphas[i].any() for i in empty)
            zero &= all(
                not grads[f"{kind}{i}"].any() for i in empty for kind in ("weight", "values")
            )
            if len(empty) == 2:
                zero &= not out.visible.any() and not any(g.any() for g in grads.values())
            shapes = grads["means"].shape == (n, 3) and grads["values1"].shape == (n, 3)
            if not (zero and shapes):
                wrong.append(f"{name} with {n}")
    return Verdict(f"15 views, wrong: {', '.join(wrong) or 'none'}", not wrong)


def tight_bounds(full: bool) -> Verdict:
    """Against all pixels, one ellipse at a time, odd sizes, partial tiles: no contributing pixel missed, no other drawn."""
    count, batch, config = 100_000 if full else 2000, 40, RasterConfig(transmittance_min=0.0)
    missed = extra = unsure = 0
    for first in range(0, count, batch):
        dtype = torch.float32 if first // batch % 2 else torch.float64
        splats = _ellipses(batch, seed=first).to(dtype)
        K = torch.tensor([[60.0, 0, 30.3], [0, 60.0, 19.9], [0, 0, 1]]).double()
        camera = Camera(torch.eye(4), K, splats.width, splats.height)
        flat = project.project(splats.means, splats.quats, splats.scales, camera, config)
        group = ChannelGroup(torch.eye(batch, dtype=dtype), splats.weights[0])
        drawn = rasterize_to_pixels(flat, [group], camera, config).images[0] > 0
        octaves, slack = _exponents(flat, splats.width, splats.height, torch.finfo(dtype).eps)
        limit = torch.log(splats.weights[0].double() / config.alpha_min)
        inside, outside = octaves < limit - slack, octaves > limit + slack
        missed += int((inside & ~drawn).sum())
        extra += int((outside & drawn).sum())
        unsure += int((~inside & ~outside).sum())
    measured = {"missed": float(missed), "extra": float(extra)}
    note = f"{count} ellipses, {unsure} pixels within rounding of the edge"
    return bound(measured, {"missed": 0, "extra": 0}, note)


def _ellipses(n: int, seed: int):
    """From specks to needles many times the image, centres on and off it."""
    splats = make_splats(n, seed, size=(61, 39), channels=(n,))
    rng = torch.Generator().manual_seed(seed + 1)
    scales = torch.exp(torch.rand(n, 3, generator=rng) * 9 - 6)
    shift = torch.cat([torch.randn(n, 2, generator=rng) * 2, torch.zeros(n, 1)], 1)
    weight = (0.004 + 0.996 * torch.rand(n, generator=rng) ** 6,)
    return replace(splats, scales=scales, means=splats.means + shift, weights=weight)


def _exponents(flat: project.Splats, width: int, height: int, eps: float) -> tuple[Tensor, Tensor]:
    """Exponent of every (pixel, Gaussian) in float64, and what rounding in the kernel's type may do to it."""
    mean, ellipse = flat.mean2d.double(), flat.ellipse.double()
    y, x = torch.meshgrid(
        torch.arange(height).double() + 0.5, torch.arange(width).double() + 0.5, indexing="ij"
    )
    dx, dy = x[..., None] - mean[:, 0], y[..., None] - mean[:, 1]
    p, s, r = ellipse.unbind(1)
    u, v = p * (dx - s * dy), r * dy
    d_u = 4 * eps * p * (dx.abs() + mean[:, 0].abs() + (s * dy).abs() + (s * mean[:, 1]).abs())
    d_v = 4 * eps * r * (dy.abs() + mean[:, 1].abs())
    exponent = (u * u + v * v) / 2
    return exponent, u.abs() * d_u + v.abs() * d_v + (d_u**2 + d_v**2) / 2 + 16 * eps * (
        1 + exponent
    )


def odd_quaternions(full: bool) -> Verdict:
    """Lengths 1e-20 and 1e20, negated and zero quaternions: no NaN, q and -q equal to the bit, gradient normal to q, zero ones change nothing."""
    n = 10_000 if full else 200
    splats = make_splats(n, seed=10)
    base, grads = render_with_gradients(splats)
    negated, _ = render_with_gradients(replace(splats, quats=-splats.quats))
    along = (grads["quats"] * splats.quats).sum(1).abs()
    along = along / (grads["quats"].norm(dim=1) * splats.quats.norm(dim=1)).clamp_min(1e-30)
    measured = {"grad . q": along.max().item(), "q and -q differ": float(
        not same_bits([*base.images], [*negated.images])
    )}  # fmt: skip
    lengths = 0.0
    for length in (1e-20, 1e20):
        scaled, scaled_grads = render_with_gradients(replace(splats, quats=splats.quats * length))
        if not all(t.isfinite().all() for t in tensors_of(scaled, scaled_grads)):
            lengths = math.inf
        lengths = max(lengths, (scaled.images[0] - base.images[0]).abs().max().item())
    measured["length"] = lengths
    hidden = torch.arange(n) % 3 == 0
    with_zero, zero_grads = render_with_gradients(
        replace(splats, quats=torch.where(hidden[:, None], 0.0, splats.quats))
    )
    without, _ = render(splats.rows(~hidden))
    same = same_bits([*with_zero.images], [*without.images])
    still = not any(g[hidden].any() for g in zero_grads.values())
    measured["zero ones seen"] = float(not (same and still))
    limits = {"grad . q": 1e-6, "q and -q differ": 0, "length": 1e-5, "zero ones seen": 0}
    return bound(measured, limits)


HOSTILE = (
    Case("N2 poison", poison, minutes=2),
    Case("N3 extreme scales", extreme_scales),
    Case("N4 needles", needles),
    Case("N5 near plane and edges", near_and_far),
    Case("N5 crops", crops),
    Case("N5 crops with a clamp", crops_with_a_clamp),
    Case("N6 full screens at 4k", full_screens_at_4k),
    Case("N6 more than 2^31 pairs", too_many_pairs),
    Case("N7 empty views", empty_views),
    Case("N8 tight bounds", tight_bounds),
    Case("N9 quaternions", odd_quaternions),
)
