"""What can be rendered of an opened run: numbers for each pixel, and a picture of them that means the same in every frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vlgs.fields import NO_LANGUAGE, FieldImages, HasDepth
from vlgs.opened import OpenedRun
from vlgs.opened.answers import Range, ask_view, ranges
from vlgs.queries import Questions
from vlgs.report import colors
from vlgs.report.features import FeatureColors, fit_feature_colors, paint_features
from vlgs.report.pictures import spread
from vlgs.types import Camera

WORD = "relevancy:"
_SAMPLE = 8
"""Photographs' cameras from which the bounds of pictures are found."""


@dataclass(frozen=True)
class Frame:
    """One output of one camera."""

    values: Float[Tensor, "h w *c"]
    picture: UInt8[Tensor, "h w 3"]


class Renderer:
    """Renders chosen outputs of a run. Bounds of heat maps, depths and feature colours are found from some photographs' cameras, once.

    Args:
        run: An opened run.
        outputs: ``color``, ``alpha``, ``depth``, ``language``, ``relevancy:WORD``.
        level: Mask level that language is of, by its number in the run; None: the last, of whole objects.
        depth: ``expected``: the mean along a ray; ``median``: where half of the light is gone.

    Raises:
        ValueError: If there is no output, or the run does not have one.
        OSError: If weights are missing that a word needs.
    """

    def __init__(
        self,
        run: OpenedRun,
        outputs: Sequence[str],
        level: int | None = None,
        depth: Literal["expected", "median"] = "expected",
    ) -> None:
        if not outputs:
            raise ValueError("render: outputs must be at least one, got none")
        self.run = run
        self.outputs = tuple(dict.fromkeys(outputs))
        self.kind: Literal["expected", "median"] = depth
        levels = run.field.levels()
        self.place = len(levels) - 1 if level is None else run.place(level)
        self.field = levels[self.place]
        had = self._had()
        for name in self.outputs:
            known = name in had or (name.startswith(WORD) and name != WORD)
            if not known:
                listed = ", ".join([*had, f"{WORD}WORD"])
                raise ValueError(f"render: outputs must be some of {listed}, got {name!r}")
        words = [name.removeprefix(WORD) for name in self.outputs if name.startswith(WORD)]
        self.asked: Questions | None = run.ask(words) if words else None
        if "language" in self.outputs and not run.field.has_language:
            raise ValueError(f"render: language cannot be rendered of {run.path}, {NO_LANGUAGE}")

    @torch.no_grad()
    def draw(self, camera: Camera) -> dict[str, Frame]:
        """Every output, by its name."""
        seen, frames = self._seen(camera), dict[str, Frame]()
        maps = {}
        if self.asked is not None:
            found = ask_view(self.field, camera, self.asked, seen)
            maps = {f"{WORD}{name}": found.relevancy[0, k] for k, name in enumerate(found.words)}
        for name in self.outputs:
            if name.startswith(WORD):
                shares = self._ranges[name].shares(maps[name])
                frames[name] = Frame(maps[name], colors.heat(shares))
            elif name == "color":
                assert seen.color is not None
                image = seen.color.clamp(0, 1)
                frames[name] = Frame(image, colors.to_uint8(image))
            elif name == "alpha":
                assert seen.alpha is not None
                frames[name] = Frame(seen.alpha, _grey(seen.alpha))
            elif name == "language":
                assert seen.feature is not None
                codes = seen.feature[0]
                frames[name] = Frame(codes, paint_features(codes, self._axes))
            else:
                depth = self._depth(camera)
                near, far = self._bounds
                share = (depth - near) / max(far - near, 1e-9)
                picture = torch.where((depth > 0)[..., None], colors.heat(1 - share), 0)
                frames[name] = Frame(depth, picture.to(torch.uint8))
        return frames

    def _had(self) -> list[str]:
        outputs = self.field.outputs
        had = [name for name in ("color", "alpha") if name in outputs]
        had += ["depth"] if isinstance(self.field, HasDepth) else []
        return had + (["language"] if "feature" in outputs else [])

    def _seen(self, camera: Camera) -> FieldImages:
        wanted = {"color", "alpha"} & set(self.outputs)
        wanted |= {"color"} if self.asked is not None else set()  # one pass gives both
        if "language" in self.outputs or self.asked is not None:
            wanted |= {"feature"} & self.field.outputs
        return self.field.render(camera, frozenset(wanted)) if wanted else FieldImages()

    def _depth(self, camera: Camera) -> Float[Tensor, "h w"]:
        assert isinstance(self.field, HasDepth)
        return self.field.depth(camera, self.kind)

    @property
    def _cameras(self) -> list[Camera]:
        return [one.camera for one in spread(self.run.held_out(), _SAMPLE)]

    @cached_property
    def _ranges(self) -> Mapping[str, Range]:
        """Of each word, so that its map stays cold where it is not seen."""
        assert self.asked is not None  # there are words
        found = ranges(self.field, self._cameras, self.asked)
        return {
            f"{WORD}{name}": one for name, one in zip(self.asked.prompts.names, found, strict=True)
        }

    @cached_property
    def _bounds(self) -> tuple[float, float]:
        """Nearest and farthest depth, without the last hundredth at both ends."""
        found = torch.cat([self._depth(camera).flatten()[::7] for camera in self._cameras])
        found = found[found > 0]
        if not len(found):
            return 0.0, 1.0
        return float(found.quantile(0.01)), float(found.quantile(0.99))

    @cached_property
    def _axes(self) -> FeatureColors:
        feature = frozenset({"feature"})
        seen = (self.field.render(camera, feature).feature for camera in self._cameras)
        return fit_feature_colors(image[0] for image in seen if image is not None)


def _grey(values: Float[Tensor, "h w"]) -> UInt8[Tensor, "h w 3"]:
    return colors.to_uint8(values[..., None].expand(-1, -1, 3))
