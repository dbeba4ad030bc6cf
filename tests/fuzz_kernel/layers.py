"""Random input to the kernels beside the rasterizer: attention, view-dependent colour, losses, cached views, depth, peak_fma.

What `tests.fuzz_kernel` does for scenes, more lightly: shapes at the edges of the kernels' chunks and lanes, poison in one case in
four. These kernels look at nothing but shapes, and poison passes through them; ordinary numbers must stay finite. Squared errors are
compared with those of torch in float64, whatever the numbers are.
"""

from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest
import torch
from torch import Tensor

from vlgs.fusion.attention import CrossAttention, SelfAttention
from vlgs.losses import l1_dssim, masked_mse, ssim_map
from vlgs.ops.cached_weights import CachedView
from vlgs.ops.code_table import LANES, code_table
from vlgs.ops.depth import camera_depth, render_depth
from vlgs.ops.huber import huber_sum
from vlgs.ops.machine import peak_fma
from vlgs.ops.mapped_error import mapped_error_
from vlgs.ops.neighbours import neighbour_products
from vlgs.ops.radam import Moments, Rates, radam_step
from vlgs.ops.row_sums import row_sums_backward
from vlgs.ops.view_color import view_color
from vlgs.types import Camera, DepthKind, RasterConfig

ROWS = (0, 1, 2, 15, 16, 17, 40)
LONG = (2047, 2048, 2049, 4100)
"""Lengths around those of the chunks that one thread takes."""
SIDES = (1, 2, 10, 11, 12, 15, 16, 17, 33)
"""Sides around those of the window and of the lanes."""
CHUNK = 1 << 14
"""Numbers that one thread takes of squared errors; 16 such chunks are worth another thread."""


def run_layers(seed: int, poison: tuple[float, ...]) -> None:
    """Each kernel once, both ways.

    Args:
        seed: Of everything that is drawn.
        poison: What is strewn in.

    Raises:
        AssertionError: If a shape is wrong, a number is not finite though all that went in were ordinary, or a squared error is
            not that of torch.
    """
    rng = np.random.default_rng([seed, 1])
    for run in (_attention, _view_color, _ssim):
        bad = float(rng.choice(poison)) if rng.random() < 0.25 else None
        _differentiate(run.__name__.strip("_"), *run(rng), rng, bad)
    _squared_error(rng, poison)
    _code_table(np.random.default_rng([seed, 2]), poison)
    _learning(np.random.default_rng([seed, 3]), poison)
    packs = int(rng.integers(0, 1000))
    _require(peak_fma(packs) >= packs, "peak_fma did less than it was asked for")


def run_cached_view(
    tensors: dict[str, Tensor], width: int, height: int, config: RasterConfig, picture: Tensor
) -> None:
    """The first group of a scene as a cached view: the same picture to rounding, finite gradients.

    Args:
        tensors: Of a `tests.fuzz_kernel.scene.FuzzScene` that was rendered without complaint.
        width: Pixels.
        height: Pixels.
        config: The scene's.
        picture: What the rasterizer drew.

    Raises:
        AssertionError: If the pictures differ, or a gradient is not finite.
    """
    camera = Camera(tensors["viewmat"], tensors["K"], width, height)
    means, quats, scales = tensors["means"], tensors["quats"], tensors["scales"]
    view = CachedView(means, quats, scales, tensors["weight0"], camera, config)
    values = tensors["values0"].clone().requires_grad_()
    image = view.render(values)
    # Sums of up to 200 terms in another order.
    bound = 200 * torch.finfo(values.dtype).eps * (values.detach().abs().amax().item() if len(values) else 0.0)  # fmt: skip
    difference = (image - picture).detach().abs().amax().item()
    _require(difference <= bound, f"cached view is off by {difference}, more than {bound}")
    (gradient,) = torch.autograd.grad(image, values, torch.ones_like(image))
    _require(bool(gradient.isfinite().all()), "gradient of a cached view is not finite")


def run_depth(tensors: dict[str, Tensor], width: int, height: int, config: RasterConfig) -> None:
    """Every kind of depth of a scene that was rendered without complaint, both ways.

    Args:
        tensors: Of a `tests.fuzz_kernel.scene.FuzzScene`.
        width: Pixels.
        height: Pixels.
        config: The scene's.

    Raises:
        AssertionError: If a depth or a gradient is not finite, or a depth is behind all Gaussians.
        ValueError: Where a gradient cannot be held.
    """
    camera = Camera(tensors["viewmat"], tensors["K"], width, height)
    names = ("means", "quats", "scales", "weight0")
    means, quats, scales, weight = leaves = [
        tensors[name].clone().requires_grad_() for name in names
    ]
    farthest = camera_depth(tensors["means"], camera).nan_to_num(0).clamp_min(0)
    most = farthest.amax().item() if len(farthest) else 0.0
    for kind in get_args(DepthKind):
        depth = render_depth(
            means, quats, scales, weight, camera.viewmat, camera.K, width, height, config, kind
        )
        _require(bool(depth.isfinite().all()), f"{kind} depth is not finite")
        bound = most * (1 + 1e3 * torch.finfo(depth.dtype).eps)
        _require(0 <= depth.min().item() <= depth.max().item() <= bound, f"{kind} depth is too far")
        grads = torch.autograd.grad(depth, leaves, torch.ones_like(depth), allow_unused=True)
        for name, grad in zip(names, grads, strict=True):
            fine = grad is None or bool(grad.isfinite().all())
            _require(fine, f"gradient of the {kind} depth by {name} is not finite")


Call = tuple[Callable[..., tuple[Tensor, ...]], list[Tensor]]


def _attention(rng: np.random.Generator) -> Call:
    build = SelfAttention if rng.integers(2) else CrossAttention
    color, feature = (int(rng.integers(1, 6)) for _ in "cf")
    width, heads = (int(rng.choice([1, 2, 3, 4, 8])) for _ in "wh")
    with torch.random.fork_rng():
        torch.manual_seed(int(rng.integers(1 << 30)))
        fusion = build(color, feature, width, heads, "xavier")
    dtype = _dtype(rng)
    fusion = fusion.to(dtype)
    n = int(rng.choice(ROWS if rng.random() < 0.8 else LONG))
    inputs = [_normal(rng, dtype, n, c) * 10.0 ** rng.uniform(-4, 4) for c in (color, feature)]
    names = [name for name, _ in fusion.named_parameters()]

    def call(color: Tensor, feature: Tensor, *weights: Tensor) -> tuple[Tensor, ...]:
        named = dict(zip(names, weights, strict=True))
        return torch.func.functional_call(fusion, named, (color, feature))

    return call, [*inputs, *(p.detach() for p in fusion.parameters())]


def _view_color(rng: np.random.Generator) -> Call:
    dtype, degree = _dtype(rng), int(rng.integers(4))
    n = int(rng.choice(ROWS if rng.random() < 0.8 else LONG))
    stored = int(rng.integers(degree, 4))
    means, eye = _normal(rng, dtype, n, 3), _normal(rng, dtype, 3)
    means[::5] = eye  # in the camera's centre, where there is no direction
    inputs = [_normal(rng, dtype, n, 3), _normal(rng, dtype, n, (stored + 1) ** 2 - 1, 3), means]
    return lambda c, sh, m: (view_color(c, sh, m, eye, degree),), inputs


def _ssim(rng: np.random.Generator) -> Call:
    dtype = _dtype(rng)
    shape = (*(int(rng.choice(SIDES)) for _ in "hw"), int(rng.integers(1, 4)))
    images = [torch.from_numpy(rng.random(shape)).to(dtype) for _ in "ab"]
    valid = torch.from_numpy(rng.random(shape[:2]) < rng.choice([0.0, 0.5, 1.0]))
    return lambda a, b: (ssim_map(a, b), l1_dssim(a, b), l1_dssim(a, b, valid)), images


def _squared_error(rng: np.random.Generator, poison: tuple[float, ...]) -> None:
    """`masked_mse` against its definition: where no pixel counts, where few do, and with anything where none is looked at."""
    dtype, channels = _dtype(rng), int(rng.choice([1, 2, 3, 15, 16, 17, 40]))
    height, width = (int(rng.choice(SIDES)) for _ in "hw")
    if rng.random() < 0.1:  # around a chunk, or enough of them for several threads
        height = CHUNK // channels // width + int(rng.integers(-1, 2)) + 1
        height *= 17 if rng.random() < 0.2 else 1
    images = [
        _normal(rng, dtype, height, width, channels) * 10.0 ** rng.uniform(-4, 4) for _ in "ab"
    ]
    counts = torch.from_numpy(rng.random((height, width)) < rng.choice([0.0, 0.02, 0.5, 0.98, 1.0]))
    valid = counts if rng.random() < 0.8 else None
    if valid is not None:
        images[1][~valid] = _cast(rng.choice(poison), dtype)
    if rng.random() < 0.25:
        picked = images[int(rng.integers(2))].view(-1)
        for _ in range(int(rng.integers(1, 4))):
            picked[int(rng.integers(len(picked)))] = _cast(rng.choice(poison), dtype)
    pixels = "valid" if rng.integers(2) else "all"
    render, target = (image.requires_grad_() for image in images)
    loss, scale = masked_mse(render, target, valid, pixels), _cast(rng.standard_normal(), dtype)
    d_render, d_target = torch.autograd.grad(loss, (render, target), scale)

    counted = torch.ones_like(counts) if valid is None else valid
    gaps = (render.detach().double() - target.detach().double()).masked_fill(~counted[..., None], 0)
    number = max(gaps.numel() if pixels == "all" else int(counted.sum()) * channels, 1)
    # A lane sums up to 2^10 squares of a chunk in the type of the images.
    eps, most = 1e3 * torch.finfo(dtype).eps, torch.finfo(dtype).max
    _agree("squared error", loss, gaps.square().sum() / number, gaps.square().sum() < most / 4, eps)
    d_gaps = 2 * scale.double() / number * gaps
    in_range = gaps.abs().maximum(d_gaps.abs()) < most / 4
    _agree("gradient of a squared error", d_render, d_gaps, in_range, eps)
    opposite = torch.equal(d_target.nan_to_num(7), (-d_render).nan_to_num(7))
    _require(opposite, "squared error: gradients must be opposite")


def _code_table(rng: np.random.Generator, poison: tuple[float, ...]) -> None:
    """Codes anywhere and nowhere, places that are no rows: an answer is a mean of its eight nodes, or not a number."""
    dtype, side, words = _dtype(rng), int(rng.integers(2, 7)), int(rng.choice([1, 7, 8, 9]))
    n, count = int(rng.choice([*ROWS, *LONG, 4095, 4097, 9000])), side**3
    codes = _normal(rng, dtype, n, 3)
    if n:
        for _ in range(int(rng.integers(0, 6))):
            codes.view(-1)[int(rng.integers(3 * n))] = _cast(
                rng.choice([*poison, -1.5, 1.5]), dtype
            )
    places = torch.from_numpy(rng.permutation(count)).int().view(side, side, side)
    odd = torch.from_numpy(rng.random((side, side, side)) < rng.choice([0.0, 0.01]))
    places[odd] = int(rng.choice([-1, -(2**31), count, 2**31 - 1]))
    rows = _normal(rng, dtype, count, -(-words // LANES) * LANES)
    answers, lacking = code_table(codes, 1.5, places, rows, words)
    unknown = answers.isnan()
    _require(bool((unknown == unknown[0]).all()), "code_table: words must lack the same codes")
    _require(int(unknown[0].sum()) == lacking, "code_table: lacking codes must be counted")
    beyond = ~((codes >= -1.5) & (codes < 1.5)).all(dim=1)
    least = int(beyond.sum())
    _require(lacking >= least, "code_table: codes beyond it must be lacking")
    _require(lacking == least or bool(odd.any()), "code_table: no other code is lacking")
    most = rows.abs().amax() * (1 + 1e2 * torch.finfo(dtype).eps)
    _require(bool((answers[~unknown].abs() <= most).all()), "code_table: answers must be means")


def _learning(rng: np.random.Generator, poison: tuple[float, ...]) -> None:
    """What trains networks, with anything in it: gradients where no pixel counts, rows that are none, weights of any number."""
    dtype, width = _dtype(rng), int(rng.choice([1, 3, 15, 16, 17, 40]))
    height, columns = (int(rng.choice(SIDES)) for _ in "hw")
    image = _normal(rng, dtype, height, columns, width + 3)
    if rng.random() < 0.5:
        picked = image.view(-1)
        picked[int(rng.integers(len(picked)))] = _cast(rng.choice(poison), dtype)
    valid = torch.from_numpy(rng.random((height, columns)) < rng.choice([0.0, 0.5, 1.0]))
    leaf = image.requires_grad_()
    part = leaf[..., 3:]
    loss = huber_sum(part, torch.zeros_like(part), valid, 1.25)
    (gradient,) = torch.autograd.grad(loss, leaf)
    _require(not gradient[~valid].any(), "huber: pixels that do not count must have no gradient")
    torch.autograd.grad(neighbour_products(leaf).sum(), leaf)

    n = int(rng.choice([*ROWS[1:], *LONG]))
    made, table = _normal(rng, dtype, n, width), _normal(rng, dtype, 3, width)
    signs = made - table[torch.arange(n) % 3]
    mapped_error_(made, torch.zeros(width, dtype=dtype), table, torch.arange(n) % 3, 1.0)
    _require(torch.equal(made, signs.sign()), "mapped_error: the gradient must be the sign")

    grids, points = int(rng.integers(1, 4)), int(rng.choice(ROWS))
    rows = torch.from_numpy(rng.integers(0, 5, (grids, points * 8))).int()
    rows += 5 * torch.arange(grids).int()[:, None]
    rows, weights = rows.view(-1, 8), torch.ones(grids * points, 8, dtype=dtype)
    d_sums = torch.ones(points, grids, int(rng.choice([1, 2, 8])), dtype=dtype)
    d_table = row_sums_backward(5 * torch.arange(grids), rows, weights, d_sums, 5 * grids)
    _require(float(d_table.sum()) == 8 * d_sums.numel(), "row_sums: every corner must count once")
    if len(rows):
        rows[int(rng.integers(len(rows))), 3] = int(
            rng.choice([-1, 5 * grids, 2**31 - 1, -(2**31)])
        )
        with pytest.raises(ValueError, match="rows must be those of their grids"):
            row_sums_backward(5 * torch.arange(grids), rows, weights, d_sums, 5 * grids)

    tensors = [_normal(rng, dtype, n) for _ in range(3)]
    moments = Moments(tensors[1], tensors[2].abs())
    radam_step(
        tensors[0],
        tensors[1].clone(),
        moments,
        Rates(1e-2, 0.9, 0.999, 1e-15, 0.0, float(rng.integers(1, 20))),
    )
    _require(bool(tensors[0].isfinite().all()), "radam: must stay finite")


def _agree(name: str, got: Tensor, want: Tensor, in_range: Tensor, relative: float) -> None:
    """Require that a result equals the truth (float64) up to rounding where its type can hold it, and is not finite elsewhere.

    Not a number is one on both sides; what the type cannot hold may be infinite instead.
    """
    smallest = torch.finfo(got.dtype).tiny
    same = torch.isclose(got.detach().double(), want, rtol=relative, atol=smallest, equal_nan=True)
    fine = same | (~in_range & ~got.isfinite())
    _require(bool(fine.all()), f"{name} must be that of float64")


def _differentiate(
    name: str,
    call: Callable[..., tuple[Tensor, ...]],
    inputs: list[Tensor],
    rng: np.random.Generator,
    bad: float | None,
) -> None:
    if bad is not None:
        picked = inputs[int(rng.integers(len(inputs)))]
        if picked.numel():
            row = int(rng.integers(picked.numel()))
            picked.view(-1)[row] = _cast(bad, picked.dtype)
    leaves = [t.clone().requires_grad_() for t in inputs]
    outputs = call(*leaves)
    upstream = [_normal(rng, out.dtype, *out.shape) for out in outputs]
    grads = torch.autograd.grad(outputs, leaves, upstream, allow_unused=True)
    for leaf, grad in zip(leaves, grads, strict=True):
        _require(grad is None or grad.shape == leaf.shape, f"{name}: a gradient has another shape")
    if bad is None:
        found = [*outputs, *(g for g in grads if g is not None)]
        _require(all(bool(t.isfinite().all()) for t in found), f"{name}: must stay finite")


def _cast(number: float, dtype: torch.dtype) -> Tensor:
    return torch.tensor(float(number), dtype=torch.float64).to(dtype)


def _normal(rng: np.random.Generator, dtype: torch.dtype, *shape: int) -> Tensor:
    return torch.from_numpy(np.asarray(rng.standard_normal(shape))).to(dtype)


def _dtype(rng: np.random.Generator) -> torch.dtype:
    return torch.float32 if rng.integers(2) else torch.float64


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise AssertionError(otherwise)
