"""A run as the viewer shows it: what was rendered for a camera is kept, so that another word or threshold renders nothing again."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields import Field, FieldImages, HasDepth, depth_of, gaussians_of
from vlgs.geometry import resize_camera
from vlgs.metrics.segment import LANGSPLAT, Constants, blend, smooth
from vlgs.opened import OpenedRun
from vlgs.opened.answers import Range, tie
from vlgs.queries import Questions
from vlgs.report.features import FeatureColors, fit_feature_colors
from vlgs.report.pictures import spread
from vlgs.types import Camera
from vlgs.view.eye import part
from vlgs.view.few import Few, Stale, ask_all, ask_few, few_pixels
from vlgs.view.wish import OUTPUTS, Output

IsStale = Callable[[], bool]
"""Says whether what is being drawn is no longer wanted."""

_VIEWS = 4
"""Cameras whose images are kept, and from which ranges and colours are found."""
_SMALL = 160
"""Longer side of the views from which ranges and colours are found, in pixels."""
_SAMPLED = 1024
"""Pixels of these that are asked."""
_ANSWERS = 8
"""Words whose answers are kept for a camera."""
_BAND = 1 << 11
"""Pixels of a field without Gaussians that are rendered before it is looked whether they are still wanted."""


@dataclass(frozen=True)
class Effort:
    """How much work an answer is worth."""

    most: int | None = None
    """Pixels that are asked, for which others stand in (`vlgs.view.few`), of all mask levels together; None: all."""
    scale: float = 1.0
    """Size of the picture by that of the one that it stands in for, whose smoothing it imitates."""
    keep: bool = False
    """Whether the camera rests, so that the next picture may need the same images."""
    stale: IsStale = lambda: False


@dataclass
class Kept:
    """What is known of one camera."""

    images: FieldImages
    few: dict[tuple[int, int], Few] = field(default_factory=dict)
    """By mask level and most pixels."""
    relevancy: dict[tuple[str, int | None, float], Float[Tensor, "levels h w"]] = field(
        default_factory=dict
    )
    """By word, pixels asked and scale."""


@dataclass(frozen=True)
class _Small:
    """A photograph's camera made smaller, and what it sees."""

    camera: Camera
    scale: float
    kept: Kept


class Shown:
    """A run in the viewer. Words may be learnt while another thread draws; everything else is for one thread at a time.

    Args:
        run: The run.
        asked: Words that were encoded before; those of the same run at an earlier step.
    """

    def __init__(self, run: OpenedRun, asked: dict[str, Questions] | None = None) -> None:
        self.run = run
        self.levels: Sequence[Field] = run.field.levels()
        self.gaussians = gaussians_of(run.field)
        self.asked = {} if asked is None else asked
        self._encoding = Lock()
        self._kept: OrderedDict[bytes, Kept] = OrderedDict()
        self._ranges: dict[tuple[str, int | None], Range] = {}
        self._colors: dict[int, FeatureColors] = {}
        self._depths: tuple[float, float] | None = None

    @property
    def outputs(self) -> tuple[Output, ...]:
        """What can be shown of it."""
        run = self.run.field
        language = run.has_language
        there: dict[Output, bool] = {
            "render": "color" in run.outputs,
            "depth": isinstance(run, HasDepth),
            "language": language and "feature" in run.outputs,
            "indicator - opacity": language and self.gaussians is not None,
            "relevancy": language,
            "mask": language,
        }
        return tuple(output for output in OUTPUTS if there[output])

    @cached_property
    def count(self) -> int | None:
        """Number of Gaussians, of all mask levels where each has its own; None where there are none."""
        if self.gaussians is None:
            return None
        different: list[Tensor] = []
        for level in self.gaussians:
            opacities = level.opacities()
            if not any(opacities.equal(other) for other in different):
                different.append(opacities)
        return sum(map(len, different))

    def prepare(self) -> None:
        """Render what the first word will need, unless that takes seconds."""
        if self.gaussians is not None:
            _ = self._small

    def learn(self, word: str) -> Questions:
        """The vectors of a word, looked up or encoded.

        Raises:
            ValueError: If it cannot be encoded; says what could.
            OSError: If weights are missing.
        """
        with self._encoding:
            if word not in self.asked:
                self.asked[word] = self.run.ask([word])
            return self.asked[word]

    def look(self, camera: Camera, language: bool, effort: Effort) -> Kept:
        """Images of a camera, rendered only where they are not kept.

        Raises:
            Stale: If they are no longer wanted.
        """
        key, language = _key(camera), language and "feature" in self.run.field.outputs
        kept = self._kept.get(key)
        if kept is None or (language and kept.images.feature is None):
            names = self.run.field.outputs & {"color", *(["feature"] if language else [])}
            kept = Kept(self._render(camera, names or self.run.field.outputs, effort.stale))
            if effort.keep:
                self._kept[key] = kept
        if key in self._kept:
            self._kept.move_to_end(key)
        while len(self._kept) > _VIEWS:
            self._kept.popitem(last=False)
        return kept

    def relevancy(self, camera: Camera, word: str, effort: Effort) -> Float[Tensor, "levels h w"]:
        """Of a word that was learnt, as `vlgs.opened.answers.ask_view` has it where all pixels are asked.

        Raises:
            Stale: If it is no longer wanted.
        """
        return self._relevancy(self.look(camera, True, effort), camera, word, effort)

    def _relevancy(
        self, kept: Kept, camera: Camera, word: str, effort: Effort
    ) -> Float[Tensor, "levels h w"]:
        most = effort.most if self.is_approximate(camera, effort.most) else None
        key = (word, most, effort.scale)
        if key not in kept.relevancy:
            if len(kept.relevancy) >= _ANSWERS:
                kept.relevancy.clear()
            asked = self.asked[word]
            words = torch.cat([asked.prompts.text, asked.prompts.negatives])
            found = self._ask(camera, kept, words, most, effort.stale)
            own, negatives = found.split([1, len(asked.prompts.negatives)], dim=1)
            maps = [asked.query.relevancy(*one)[0] for one in zip(own, negatives, strict=True)]
            constants = Constants(box=max(round(LANGSPLAT.box * effort.scale), 1))
            raw = torch.stack(maps)
            kept.relevancy[key] = blend(raw, smooth(raw, constants), constants)
        return kept.relevancy[key]

    def is_approximate(self, camera: Camera, most: int | None) -> bool:
        """Whether some pixels stand for others if at most so many are asked."""
        there = "feature" in self.run.field.outputs
        return there and most is not None and most < camera.width * camera.height * len(self.levels)

    @torch.no_grad()
    def range(self, word: str, level: int | None) -> Range:
        """`vlgs.opened.answers.ranges` of a word that was learnt, from fewer and smaller views.

        Args:
            word: The word.
            level: Place of the mask level; None: the best of each view.
        """
        if (word, level) not in self._ranges:
            lows, highs = [], []
            for small in self._small:
                effort = Effort(_SAMPLED, small.scale)
                maps = self._relevancy(small.kept, small.camera, word, effort)
                scores = maps.flatten(1).amax(dim=1)
                found = maps[int(scores.argmax()) if level is None else level]
                lows.append(float(found.min()))
                highs.append(float(found.max()))
            least = tie(self.asked[word].query, 1)
            self._ranges[word, level] = Range(min(lows), max(highs), least)
        return self._ranges[word, level]

    def colors(self, level: int) -> FeatureColors:
        """How codes of a mask level are painted, in all views."""
        if level not in self._colors:
            features = [small.kept.images.feature for small in self._small]
            maps = [feature[level] for feature in features if feature is not None]
            self._colors[level] = fit_feature_colors(maps)
        return self._colors[level]

    def depth(self, camera: Camera) -> Float[Tensor, "h w"]:
        """Camera z."""
        return depth_of(self.run.field, camera)

    def depths(self) -> tuple[float, float]:
        """Depths between which colours are spread: the 1st and 99th percentile of what a few cameras see."""
        if self._depths is None:
            every = torch.cat([self.depth(camera).flatten() for camera, _ in self._small_cameras()])
            seen = every[every > 0]
            if not len(seen):
                seen = torch.tensor([0.0, 1.0])
            low, high = seen.quantile(torch.tensor([0.01, 0.99])).tolist()
            self._depths = low, high
        return self._depths

    def place(self, level: int | None) -> int | None:
        """Place of a mask level among those of the field; None where none was chosen, or the run has not this one."""
        return None if level not in self.run.levels else self.run.levels.index(level)

    def _ask(
        self, camera: Camera, kept: Kept, words: Tensor, most: int | None, stale: IsStale
    ) -> Float[Tensor, "levels k h w"]:
        feature = kept.images.feature
        if most is not None and feature is not None:
            for level in range(len(self.levels)):
                if (level, most) not in kept.few:
                    kept.few[level, most] = few_pixels(feature[level], most // len(self.levels))
            few = [kept.few[level, most] for level in range(len(self.levels))]
            return ask_few(self.levels, camera, feature, few, words)
        if self.gaussians is None:
            # Such a field may choose one scale for all pixels that are asked together.
            return self.run.field.similarity(camera, words, kept.images)
        return ask_all(self.run.field, camera, kept.images, words, stale)

    @torch.no_grad()
    def _render(self, camera: Camera, names: frozenset[str], stale: IsStale) -> FieldImages:
        rows = camera.height if self.gaussians else max(_BAND // camera.width, 1)
        if rows >= camera.height:
            return self.run.field.render(camera, names)
        bands = []
        for top in range(0, camera.height, rows):  # every pixel is a ray of its own
            if stale():
                raise Stale
            band = part(camera, 0, camera.width, top, min(top + rows, camera.height))
            bands.append(self.run.field.render(band, names))
        return FieldImages(
            color=_joined([band.color for band in bands], 0),
            feature=_joined([band.feature for band in bands], 1),
        )

    @cached_property
    def _small(self) -> list[_Small]:
        """What a few photographs' cameras see."""
        return [
            _Small(camera, scale, self.look(camera, self.run.field.has_language, Effort()))
            for camera, scale in self._small_cameras()
        ]

    def _small_cameras(self) -> list[tuple[Camera, float]]:
        """A few photographs' cameras with the factor by which they were made smaller."""
        small = []
        for camera in spread([one.camera for one in self.run.held_out()], _VIEWS):
            scale = min(_SMALL / max(camera.width, camera.height), 1.0)
            w, h = (max(round(side * scale), 1) for side in (camera.width, camera.height))
            small.append((resize_camera(camera, w, h), scale))
        return small


def _joined(parts: Sequence[Tensor | None], dim: int) -> Tensor | None:
    there = [one for one in parts if one is not None]
    return torch.cat(there, dim=dim) if there else None


def _key(camera: Camera) -> bytes:
    size = f"{camera.width} {camera.height}".encode()
    return camera.viewmat.numpy().tobytes() + camera.K.numpy().tobytes() + size
