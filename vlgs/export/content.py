"""What is exported of a run: its Gaussians as other programs draw them, and what they answer."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.fields import NO_GAUSSIANS, HasGaussians, PointCloud, gaussians_of
from vlgs.gaussians.ply import SH_COEFFICIENTS
from vlgs.geometry import camera_center
from vlgs.opened import OpenedRun
from vlgs.opened.answers import LEAST, Range, gaussian_relevancy, ranges, select_gaussians
from vlgs.queries import Questions


@dataclass(frozen=True)
class Word:
    """What every Gaussian answers to a word."""

    name: str
    relevancy: Float[Tensor, " n"]
    weight: int
    """Place in `Content.weights` of what blends it."""
    range: Range
    """What heat maps show, and above what a Gaussian answers; as `vlgs.query` has it."""


@dataclass(frozen=True)
class Content:
    """Gaussians to be written, and what should be said of them."""

    cloud: PointCloud
    weights: Sequence[Float[Tensor, " n"]] = ()
    """What blends language: one for all words, or one for each mask level that answers one."""
    words: Sequence[Word] = ()
    notes: Sequence[str] = ()

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.cloud.params["means"])

    def keep(self, rows: Int[Tensor, " m"]) -> "Content":
        """The same with some of the Gaussians, in an order."""
        params = {name: value[rows] for name, value in self.cloud.params.items()}
        return replace(
            self,
            cloud=replace(self.cloud, params=params),
            weights=[weight[rows] for weight in self.weights],
            words=[replace(word, relevancy=word.relevancy[rows]) for word in self.words],
        )

    def with_harmonics(self, degree: int) -> "Content":
        """The same without the spherical harmonics above a degree."""
        params = dict(self.cloud.params)
        params["shN"] = params["shN"][:, : SH_COEFFICIENTS[degree]]
        return replace(self, cloud=replace(self.cloud, params=params))


def answer(opened: OpenedRun, names: Sequence[str], level: int | None = None) -> Content:
    """The Gaussians of a run, and what each of them answers to words.

    Where mask levels share their Gaussians every word is answered by the level that `vlgs.opened.answers.select_gaussians` takes for
    it. Where each level has Gaussians of its own there is one level for all words: the one that most of them are answered by.

    Args:
        opened: The run.
        names: Words; none are needed.
        level: Place of a mask level that answers all words.

    Raises:
        ValueError: If the field has no Gaussians, or a word cannot be encoded.
    """
    levels = _levels(opened)
    if not names:
        return Content(_cloud(opened, levels[-1 if level is None else level]))
    asked = opened.ask(names)
    bounds = _ranges(opened, asked, level)
    places = [level] * len(names) if level is not None else _places(opened, asked, bounds)
    used = sorted(set(places))
    relevancy = {place: gaussian_relevancy(levels[place], asked) for place in used}
    weights = [_weight(levels[place]) for place in used]
    if all(weight.equal(weights[0]) for weight in weights):
        weights = weights[:1]
    words = []
    for index, (name, place) in enumerate(zip(names, places, strict=True)):
        own = used.index(place) if len(weights) > 1 else 0
        words.append(Word(name, relevancy[place][index], own, bounds[index]))
    notes = [asked.note] if asked.note else []
    if len(levels) > 1 and not isinstance(opened.field, HasGaussians):
        number = opened.notes.levels[used[0]]
        notes.append(f"the Gaussians of mask level {number}, which answers all words")
    return Content(_cloud(opened, levels[used[-1]]), weights, words, notes)


def selected(opened: OpenedRun, name: str, level: int | None = None) -> Content:
    """The Gaussians that answer a word (`vlgs.opened.answers.select_gaussians`).

    Raises:
        ValueError: If the field has no Gaussians, the word cannot be encoded, or none answers.
    """
    _levels(opened)
    asked = opened.ask([name])
    threshold = _ranges(opened, asked, level)[0].threshold()
    gaussians, chosen = select_gaussians(opened.field, asked, 0, threshold, level)
    if not chosen.any():
        raise ValueError(
            f"export: --select must leave a Gaussian, got none above a relevancy of {threshold:.3f} for {name!r}"
        )
    notes = [f"those that answer {name!r}, above a relevancy of {threshold:.3f}"]
    notes += [asked.note] if asked.note else []
    return replace(Content(_cloud(opened, gaussians)).keep(chosen.nonzero()[:, 0]), notes=notes)


def drawn(content: Content) -> Content:
    """Without Gaussians that no weight draws anywhere; a note counts them."""
    opacity = content.cloud.params["opacity_logits"].sigmoid()
    largest = torch.stack([opacity, *content.weights]).amax(dim=0)
    kept = content.keep((largest >= LEAST).nonzero()[:, 0])
    left = content.count - kept.count
    note = f"{left:,} of {content.count:,} Gaussians left out, which nothing draws"
    return replace(kept, notes=[*kept.notes, *([note] if left else [])])


def most_important(content: Content, opened: OpenedRun, most: int) -> Content:
    """At most so many Gaussians: those with the largest opacity times area, as seen from the camera that is nearest to them."""
    if content.count <= most:
        return content
    params = content.cloud.params
    eyes = torch.stack([camera_center(one.camera.viewmat) for one in opened.cameras()])
    near = torch.cdist(params["means"], eyes).amin(dim=1).clamp_min(1e-6)
    area = params["log_scales"].sort(dim=1).values[:, 1:].sum(dim=1) - 2 * near.log()
    matter = torch.nn.functional.logsigmoid(params["opacity_logits"]) + area
    rows = matter.argsort(descending=True, stable=True)[:most].sort().values
    note = f"{most:,} of {content.count:,} Gaussians, those with the largest opacity times area"
    return replace(content.keep(rows), notes=[*content.notes, note])


def _levels(opened: OpenedRun) -> Sequence[HasGaussians]:
    levels = gaussians_of(opened.field)
    if levels is None:
        raise ValueError(f"{opened.path}: must have Gaussians to be exported, got {NO_GAUSSIANS}")
    return levels


def _places(opened: OpenedRun, asked: Questions, bounds: Sequence[Range]) -> list[int]:
    """Place of the mask level that answers each word."""
    levels, places = _levels(opened), []
    for index, own in enumerate(bounds):
        gaussians, _ = select_gaussians(opened.field, asked, index, own.threshold())
        places.append(levels.index(gaussians))
    if isinstance(opened.field, HasGaussians):
        return places
    # Of levels that answer equally many words the one of larger objects.
    return [max(set(places), key=lambda place: (places.count(place), place))] * len(places)


def _ranges(opened: OpenedRun, asked: Questions, level: int | None) -> Sequence[Range]:
    return ranges(opened.field, [one.camera for one in opened.held_out()], asked, level)


def _cloud(opened: OpenedRun, gaussians: HasGaussians) -> PointCloud:
    cameras = opened.cameras("train") or opened.cameras()
    return gaussians.point_cloud([one.camera for one in cameras])


def _weight(gaussians: HasGaussians) -> Float[Tensor, " n"]:
    """What blends the language of one level."""
    weight = gaussians.language_weights()
    return weight if weight.dim() == 1 else weight[:, 0]
