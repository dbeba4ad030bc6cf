"""Pictures of what a browser asks for."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from vlgs.report.colors import diverging, heat, heat_over, to_uint8
from vlgs.report.features import paint_features
from vlgs.report.indicator import indicator_difference
from vlgs.types import Camera
from vlgs.view.eye import part
from vlgs.view.shown import Effort, Shown
from vlgs.view.wish import ASKING, Wish

_THINNEST = 8
"""Pixels; a narrower part of a divided picture is left out."""
_LINE = (255, 255, 255)


@dataclass(frozen=True)
class Answered:
    """What a run said to a word in a picture."""

    score: float
    """The largest relevancy."""
    level: int
    """Place of the mask level that answered."""
    approximate: bool
    """Whether some pixels stood for others."""


@dataclass(frozen=True)
class Picture:
    """What is sent to a browser."""

    pixels: UInt8[Tensor, "h w 3"]
    answers: tuple[Answered | None, ...] = ()
    """One for each run; None where it was not asked for a word, or is not in the picture."""


@torch.no_grad()
def paint(runs: list[Shown], wish: Wish, camera: Camera, effort: Effort) -> Picture:
    """One picture of one run, or of two: divided at a line, or beside each other, each with the middle of what the camera sees.

    Args:
        runs: One or two.
        wish: What is asked for.
        camera: That of the wish, in as many pixels as there is time for.
        effort: How much work it is worth.

    Raises:
        Stale: If it is no longer wanted.
    """
    w = camera.width
    if len(runs) == 1 or wish.layout == "one":
        pixels, answered = paint_one(runs[0], wish, camera, effort)
        return Picture(pixels, (answered, None)[: len(runs)])
    middle = round(wish.division * w) if wish.layout == "divided" else w // 2
    spans = [(0, middle), (middle, w)]
    if wish.layout == "beside":
        spans = [(w // 4, w // 4 + middle), (w // 4, w // 4 + w - middle)]
    elif middle < _THINNEST or w - middle < _THINNEST:
        first = middle > w // 2
        pixels, answered = paint_one(runs[0 if first else 1], wish, camera, effort)
        return Picture(pixels, (answered, None) if first else (None, answered))
    parts = [
        paint_one(run, wish, part(camera, *span), effort)
        for run, span in zip(runs, spans, strict=True)
    ]
    pixels = torch.cat([pixels for pixels, _ in parts], dim=1)
    pixels[:, middle - 1 : middle + 1] = torch.tensor(_LINE, dtype=torch.uint8)
    return Picture(pixels, tuple(answered for _, answered in parts))


def paint_one(
    run: Shown, wish: Wish, camera: Camera, effort: Effort
) -> tuple[UInt8[Tensor, "h w 3"], Answered | None]:
    """A picture of one run; what it cannot show is replaced by its render."""
    output = wish.output if wish.output in run.outputs else "render"
    level = run.place(wish.level)
    if output in ASKING and wish.word in run.asked:
        return _answer(run, wish, level, camera, effort)
    if output == "language":
        feature = run.look(camera, True, effort).images.feature
        assert feature is not None  # `Shown.outputs`
        return paint_features(feature[level or 0], run.colors(level or 0)), None
    if output == "depth":
        return _paint_depth(run.depth(camera), run.depths()), None
    if output == "indicator - opacity" and run.gaussians is not None:
        difference = indicator_difference(run.gaussians[level or 0], camera)
        return diverging(difference), None
    return _paint_color(run, camera, output in ASKING, effort), None


def _answer(
    run: Shown, wish: Wish, chosen: int | None, camera: Camera, effort: Effort
) -> tuple[UInt8[Tensor, "h w 3"], Answered]:
    maps = run.relevancy(camera, wish.word, effort)
    scores = maps.flatten(1).amax(dim=1)
    level = int(scores.argmax()) if chosen is None else chosen
    bounds, color = run.range(wish.word, chosen), _paint_color(run, camera, True, effort)
    if wish.output == "relevancy":
        pixels = heat_over(color, bounds.shares(maps[level]), wish.opacity)
    else:
        pixels = _dim_outside(color, maps[level] > bounds.threshold(wish.share), wish.opacity)
    approximate = run.is_approximate(camera, effort.most)
    return pixels, Answered(float(scores[level]), level, approximate)


def _paint_color(
    run: Shown, camera: Camera, language: bool, effort: Effort
) -> UInt8[Tensor, "h w 3"]:
    """The render; black where a run has no colour."""
    color = run.look(camera, language, effort).images.color
    if color is None:
        return torch.zeros(camera.height, camera.width, 3, dtype=torch.uint8)
    return to_uint8(color)


def _dim_outside(
    color: UInt8[Tensor, "h w 3"], mask: Bool[Tensor, "h w"], opacity: float
) -> UInt8[Tensor, "h w 3"]:
    """What answers as it is, all else grey and darker the more opaque."""
    grey = (color.float() @ torch.tensor([0.299, 0.587, 0.114]))[..., None]
    dim = ((1 - opacity) * grey).round().to(torch.uint8)
    return torch.where(mask[..., None], color, dim)


def _paint_depth(
    depth: Float[Tensor, "h w"], bounds: tuple[float, float]
) -> UInt8[Tensor, "h w 3"]:
    """Red is near, blue far; black where nothing is."""
    low, high = bounds
    pixels = heat(1 - (depth - low) / max(high - low, 1e-9))
    return pixels * (depth > 0)[..., None]
