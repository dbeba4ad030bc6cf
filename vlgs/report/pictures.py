"""Picture files of a run: a folder per held-out view, a histogram and one sheet that shows them together."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from jaxtyping import UInt8
from torch import Tensor

from vlgs.fields import Field
from vlgs.files import write_atomically
from vlgs.names import file_names
from vlgs.queries import Prompts, Query
from vlgs.report.answer import KeptAnswers
from vlgs.report.draw import Painter, ViewPictures
from vlgs.report.overview import PNG_LEVEL, count_difference, write_histogram, write_overview
from vlgs.types import Scene, View

T = TypeVar("T")

OVERVIEW = "overview.png"
"""Written after all other pictures."""


@dataclass(frozen=True)
class PictureLimits:
    """How much is drawn."""

    views: int = 8
    """Held-out views, spread evenly over all of them."""
    prompts: int = 6
    """Prompts per view."""
    rows: int = 4
    """Views on the overview."""
    words: int = 12
    """Words of the vocabulary that are asked where nobody labelled the scene."""


def write_pictures(
    folder: Path,
    field: Field,
    scene: Scene,
    query: Query,
    prompts: Prompts | None,
    limits: PictureLimits = PictureLimits(),
    kept: KeptAnswers | None = None,
) -> Path | None:
    """Draw held-out views into ``<folder>/<view>/*.png``, and ``overview.png`` over them.

    Args:
        folder: Made if needed; the run's ``renders``.
        field: The trained scene; of several mask levels the last, of whole objects, is drawn.
        scene: Its held-out views and labels.
        query: How relevancy is computed.
        prompts: The scene's classes, encoded, or words for a scene without any; without either only colour, features and
            l - o are drawn, and colour alone where no language was trained. l - o needs Gaussians, and an l that is not o in all.
        limits: How many views and prompts.
        kept: Answers that scores were made from; None: all are made here.

    Returns:
        The overview, or None if there is no held-out view.
    """
    views = drawn(scene, limits)
    if not views:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    painter = Painter(field, scene, query, prompts, views, kept)
    # Of all views and prompts, so that a view and a prompt have one name however few are drawn.
    folders = file_names(view.name for view in scene.test)
    names = file_names(prompts.names if prompts is not None else ())
    rows: list[ViewPictures] = []
    on_overview = {view.name for view in spread(views, limits.rows)}
    # Those of the overview first: the painter gives a prompt that was not shown yet to each view in turn.
    for view in sorted(views, key=lambda view: view.name not in on_overview):
        pictures = painter.draw(view, limits.prompts)
        write_view(folder / folders[view.name], pictures, names)
        if view.name in on_overview:
            rows.append(pictures)
    density = None
    if painter.has_difference and painter.gaussians is not None:
        gaussians = painter.gaussians
        density = count_difference(gaussians.language_weights(), gaussians.opacities())
        write_histogram(folder / "indicator_minus_opacity.png", density)
    path = folder / OVERVIEW
    write_overview(path, prompts.names if prompts else (), rows, density)
    return path


def drawn(scene: Scene, limits: PictureLimits = PictureLimits()) -> list[View]:
    """Held-out views that have pictures."""
    return spread(scene.test, limits.views)


def write_view(folder: Path, pictures: ViewPictures, names: Mapping[str, str]) -> None:
    """Every picture of one view at its own size.

    Args:
        folder: Made if needed.
        pictures: Of the view.
        names: Prompt -> its name on disk.
    """
    folder.mkdir(parents=True, exist_ok=True)
    named = {
        "photograph": pictures.photograph,
        "render": pictures.render,
        "features": pictures.features,
        "indicator_minus_opacity": pictures.difference,
        "labels": pictures.labels,
        "prediction": pictures.prediction,
    }
    for prompt, answer in pictures.prompts.items():
        named[f"relevancy_{names[prompt]}"] = answer.relevancy
        named[f"segmentation_{names[prompt]}"] = answer.segmentation
    for word, heat in pictures.words.items():
        named[f"relevancy_{names[word]}"] = heat
    for name, picture in named.items():
        if picture is not None:
            save_picture(folder / f"{name}.png", picture)


def spread(items: Sequence[T], count: int) -> list[T]:
    """At most `count` items at even distances, the first among them, in order."""
    count = min(count, len(items))
    return [items[i * len(items) // count] for i in range(count)]


def save_picture(path: Path, picture: UInt8[Tensor, "h w 3"]) -> None:
    """Write a PNG, whole or not at all."""
    from PIL import (
        Image,
    )  # pycolmap must not be imported before it; whoever needs pycolmap sees to that

    stream = io.BytesIO()
    Image.fromarray(picture.numpy()).save(stream, format="png", compress_level=PNG_LEVEL)
    write_atomically(path, stream.getvalue(), durable=False)
