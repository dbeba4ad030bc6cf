"""Draws what the rows of a table show of one scene."""

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, UInt8
from omegaconf import OmegaConf
from PIL import Image
from torch import Tensor

from vlgs.config import instantiate
from vlgs.gallery.rows import ScoredRow, choose_views, choose_word
from vlgs.names import file_names
from vlgs.opened import OpenedRun, open_run
from vlgs.opened.answers import ask_view, ranges
from vlgs.opened.run import read_config
from vlgs.report.answer import answer_view
from vlgs.report.colors import heat_over, outline, to_uint8
from vlgs.report.labels import read_truth, read_units
from vlgs.tables.gallery import GalleryView, Shown
from vlgs.types import Camera, Scene, View

_QUALITY = 85
"""Of JPEG."""
_OUTLINE = (255, 255, 255)
"""White is no colour of the heat map."""


@dataclass(frozen=True)
class _Chosen:
    """A held-out view that is drawn, and the word that is asked there."""

    place: str
    view: View
    word: str | None
    mask: Bool[Tensor, "h w"] | None
    """Truth of the word."""


@dataclass(frozen=True)
class DrawnScene:
    """Two views of a scene, by all rows."""

    views: Sequence[GalleryView]
    pictures: Mapping[str, bytes]
    """File -> JPEG."""
    notes: Sequence[str]
    """What was left out."""


def draw_scene(
    rows: Sequence[ScoredRow], tab: str, folder: str, places: Mapping[str, str]
) -> DrawnScene:
    """Draw the two views of `choose_views`, and the word of `choose_word` in each.

    A map goes from the lowest to the highest relevancy that its row gives the word in the held-out views: queries differ between rows,
    so that colours say where a row answers and not how surely.

    Args:
        rows: Of one scene and seed, at least one.
        tab: Label of their table.
        folder: Of the pictures, below the gallery's; their names begin with it.
        places: Key of `data` -> where it is on this machine, in place of what the runs recorded.

    Raises:
        ValueError: If a run folder is damaged, or the photographs are not where the runs found them.
        OSError: If a file cannot be read.
    """
    scene = _read_scene(rows[0], places)
    chosen = [_choose(rows, scene, *one) for one in choose_views(rows).items()]
    names = _Names(folder, rows, chosen)
    pictures: dict[str, bytes] = {}
    shown: dict[str, list[Shown]] = {one.place: [] for one in chosen}
    notes = []
    for row in rows:
        opened = open_run(row.folder.path)
        if note := _unlike(opened, [one.view for one in chosen]):
            notes.append(f"{row.label} is left out: {note}")
            continue
        for one, (render, relevancy) in zip(chosen, _draw(opened, scene, chosen), strict=True):
            entry = _entry(row, one, names, relevancy is not None)
            shown[one.place].append(entry)
            pictures[entry.render] = _jpeg(render)
            if entry.relevancy and relevancy is not None:
                pictures[entry.relevancy] = _jpeg(relevancy)
    views = [_view(rows[0], tab, one, names, shown[one.place]) for one in chosen]
    for one, view in zip(chosen, views, strict=True):
        photograph = one.view.read_image()
        pictures[view.photograph] = _jpeg(photograph)
        if view.outlined and one.mask is not None:
            pictures[view.outlined] = _jpeg(_outlined(photograph, one.mask))
    return DrawnScene([view for view in views if view.rows], pictures, notes)


def _read_scene(row: ScoredRow, places: Mapping[str, str]) -> Scene:
    """The data that a run learned from."""
    config = read_config(row.folder.path)
    for key, value in places.items():
        OmegaConf.update(config, f"data.{key}", value)
    try:
        return instantiate(config.data)
    except (ValueError, OSError) as error:
        raise ValueError(
            f"gallery: photographs must be where {row.folder.config} says, or where data.root=PATH does, got: {error}"
        ) from error


def _choose(rows: Sequence[ScoredRow], scene: Scene, place: str, name: str) -> _Chosen:
    view = next((view for view in scene.test if view.name == name), None)
    if view is None:
        raise ValueError(
            f"gallery: held-out views of the photographs must be those of {rows[0].folder.path}, got none called {name!r}"
        )
    word = choose_word(rows, name)
    return _Chosen(place, view, word, None if word is None else truth_of(view, scene, word))


def truth_of(view: View, scene: Scene, word: str) -> Bool[Tensor, "h w"]:
    """The pixels that labels call by a word: as an object, or where none is labelled so, as a class of pixels.

    Raises:
        ValueError: If labels do not know the word, although a run was scored on it.
    """
    truth = read_truth(view)
    for unit in read_units(view, scene.classes, truth):
        if unit.category == word:
            return unit.mask
    if truth is None or word not in scene.classes:
        raise ValueError(
            f"gallery: labels of view {view.name!r} must be those that the runs were scored on, got none of {word!r}"
        )
    return truth == scene.classes.index(word)


class _Names:
    """Files of one scene. The run is part of a name, so that pictures of other runs never take its place."""

    def __init__(self, folder: str, rows: Sequence[ScoredRow], chosen: Sequence[_Chosen]) -> None:
        self.folder = folder
        who = ["photograph", "outlined", *map(self._who, rows)]
        self.files = file_names(self._text(one, each) for one in chosen for each in who)

    def of(self, one: _Chosen, row: ScoredRow | str, what: str = "") -> str:
        """Of the photograph, or of a row's picture."""
        who = row if isinstance(row, str) else self._who(row)
        kind = f"-{what}" if what else ""
        return f"{self.folder}/{self.files[self._text(one, who)]}{kind}.jpg"

    def _text(self, one: _Chosen, who: str) -> str:
        word = f"-{one.word}" if who == "outlined" else ""
        return f"{one.view.name}-{who}{word}"

    def _who(self, row: ScoredRow) -> str:
        return f"{row.label}-{row.folder.path.name[:8]}"


def _unlike(opened: OpenedRun, views: Sequence[View]) -> str:
    """Why a run cannot be shown beside the photographs; empty where it can."""
    cameras = {one.name: one.camera for one in opened.cameras("test")}
    for view in views:
        own = cameras.get(view.name)
        if own is None or not _same(own, view.camera):
            return f"its view {view.name!r} is not the photograph's"
    return ""


def _same(first: Camera, second: Camera) -> bool:
    same_size = (first.width, first.height) == (second.width, second.height)
    return (
        same_size
        and torch.allclose(first.viewmat, second.viewmat, atol=1e-4)
        and torch.allclose(first.K, second.K, atol=1e-2)
    )


@torch.no_grad()
def _draw(
    opened: OpenedRun, scene: Scene, chosen: Sequence[_Chosen]
) -> Iterator[tuple[UInt8[Tensor, "h w 3"], UInt8[Tensor, "h w 3"] | None]]:
    """What a run shows of each view, and where it answers the view's word."""
    field = opened.field
    asked = bounds = None
    if field.has_language and any(one.word for one in chosen):
        asked = opened.ask(scene.classes)  # all of them, as where it was scored
        bounds = ranges(field, [one.camera for one in opened.held_out()], asked)
    for one in chosen:
        if asked is None or bounds is None or one.word is None or one.mask is None:
            answer = answer_view(field, one.view.camera, None)
            yield to_uint8(answer.color), None
            continue
        seen, word = ask_view(field, one.view.camera, asked), scene.classes.index(one.word)
        shares = bounds[word].shares(seen.relevancy[seen.level(word), word])
        heat = heat_over(one.view.read_image(), shares)
        yield to_uint8(seen.color), _outlined(heat, one.mask)


def _entry(row: ScoredRow, one: _Chosen, names: _Names, answered: bool) -> Shown:
    score = row.answers.get((one.view.name, one.word)) if one.word and answered else None
    return Shown(
        label=row.label,
        run=row.folder.path.name,
        render=names.of(one, row, "render"),
        psnr=row.psnr(one.view.name),
        relevancy=names.of(one, row, "relevancy") if answered else None,
        iou=score.iou if score else None,
    )


def _view(
    row: ScoredRow, tab: str, one: _Chosen, names: _Names, shown: Sequence[Shown]
) -> GalleryView:
    camera = one.view.camera
    return GalleryView(
        scene=str(row.metrics["scene"]),
        view=one.view.name,
        place="lowest" if one.place == "lowest" else "highest",
        tab=tab,
        seed=row.metrics["seed"],
        results_version=row.metrics["results_version"],
        protocol=row.protocol,
        width=camera.width,
        height=camera.height,
        photograph=names.of(one, "photograph"),
        word=one.word,
        outlined=names.of(one, "outlined") if one.word else None,
        rows=tuple(shown),
    )


def _outlined(picture: UInt8[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]) -> UInt8[Tensor, "h w 3"]:
    drawn = picture.clone()
    drawn[outline(mask)] = torch.tensor(_OUTLINE, dtype=torch.uint8)
    return drawn


def _jpeg(picture: UInt8[Tensor, "h w 3"]) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(picture.numpy()).save(stream, "JPEG", quality=_QUALITY)
    return stream.getvalue()
