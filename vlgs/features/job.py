"""The work of `python -m vlgs.features`: finds the photographs that have no language maps yet, and makes these one by one."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import get_object
from jaxtyping import UInt8
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from vlgs.config import instantiate
from vlgs.data.colmap import load_scene, open_training_views
from vlgs.data.images import read_photograph
from vlgs.data.source import ColmapSource
from vlgs.data.views import ViewSource
from vlgs.features.extractor import Extractor, KnowsWords
from vlgs.features.folder import FeatureFolder, pair_bytes

_NO_NUMBER_MOVES = frozenset({"weights", "device", "batch", "labels", "words"})
"""Keys of an extractor that are not part of the settings of a folder: speed, and places whose content `identity` has."""

_VERSION = 1
"""Of the computation: to be raised when the same settings lead to other maps."""


@dataclass(frozen=True)
class Job:
    """Photographs of a scene, the folder of their maps and what makes them."""

    views: Sequence[ViewSource]
    """All that are wanted."""
    folder: FeatureFolder
    extractor: Extractor
    extractor_settings: Mapping[str, Any]
    max_height: int | None

    def todo(self) -> list[ViewSource]:
        """Photographs without maps."""
        return [view for view in self.views if not self.folder.has(view.name)]

    def settings(self) -> dict[str, Any]:
        """Everything that moves a map, as `FeatureFolder.claim` writes it down.

        Raises:
            FileNotFoundError: If weights are missing.
        """
        return {**self._given(), "read": dict(self.extractor.identity())}

    def require_same_when_done(self) -> None:
        """Do nothing if maps that are all there are what this job would make, or of another program.

        Without weights only the settings are compared.

        Raises:
            ValueError: If they were made with other settings.
        """
        if not self.folder.has_settings:
            return
        self.folder.require_same(self._given(), unknown=["read"])
        try:
            settings = self.settings()
        except (OSError, ValueError):  # no weights here, or not the package that finds them
            return
        self.folder.require_same(settings)

    def _given(self) -> dict[str, Any]:
        """Settings that are known without weights."""
        return {
            "version": _VERSION,
            "max_height": self.max_height,
            "extractor": self.extractor_settings,
        }

    def pixels(self, view: ViewSource) -> UInt8[np.ndarray, "h w 3"]:
        """What the extractor is given: the photograph as its file has it, not undistorted, at most `max_height` high."""
        image = read_photograph(view.photograph).numpy()
        height, width = map_size(view, self.max_height)
        if image.shape[:2] == (height, width):
            return image
        return np.array(Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR))


def plan(config: DictConfig) -> Job:
    """Look at the scene and construct the extractor; no weights are read.

    Raises:
        FileNotFoundError: If there is no scene.
        SceneError: If its photographs or cameras are at fault.
        ValueError: If an option cannot be right.
    """
    if get_object(config.data._target_) is not load_scene:
        raise ValueError(
            f"features: data must be photographs with cameras (data=colmap or a data set of it), got {config.data._target_}"
        )
    options = OmegaConf.to_container(config.data, resolve=True, throw_on_missing=True)
    assert isinstance(options, dict)
    source = ColmapSource(**{str(k): v for k, v in options.items() if k != "_target_"})
    chosen = config.features
    if chosen.views not in ("train", "all"):
        raise ValueError(f"features: views must be train or all, got {chosen.views}")
    if chosen.max_height not in (None, 1080):
        raise ValueError(
            f"features: max_height must be 1080 or null, as readers know no other size, got {chosen.max_height}"
        )
    out = chosen.out or source.features or str(source.folder / "language_features")
    views = open_training_views(source, every_view=chosen.views == "all")
    settings = OmegaConf.to_container(chosen.extractor, resolve=True, throw_on_missing=True)
    return Job(
        views=views,
        folder=FeatureFolder(Path(out)),
        extractor=instantiate(chosen.extractor),
        extractor_settings=_without(settings, _NO_NUMBER_MOVES),
        max_height=chosen.max_height,
    )


def run(job: Job, console: Console) -> Iterator[str]:
    """Make what is missing, each photograph's files as soon as they are there.

    Yields:
        The stem of each photograph once it is written.

    Raises:
        FileNotFoundError: If weights are missing.
        ValueError: If the folder was made with other settings, or a photograph cannot be described.
    """
    todo = job.todo()
    if not todo:
        job.require_same_when_done()
        return
    job.folder.require_same(job.settings())
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(elapsed_when_finished=False),
    )
    # The first photograph also loads the weights; a long window evens out busy and empty ones.
    with Progress(*columns, console=console, speed_estimate_period=3600) as bar:
        task = bar.add_task(
            "photographs", total=len(job.views), completed=len(job.views) - len(todo)
        )
        for view in todo:
            bar.update(task, description=view.name)
            features = job.extractor(job.pixels(view), view.name)
            job.folder.claim(job.settings())  # not before: what cannot be read claims no folder
            job.folder.write(view.name, features)
            bar.advance(task)
            yield view.name
    if isinstance(job.extractor, KnowsWords):
        job.folder.write_words(job.extractor.vocabulary)


def estimate(job: Job) -> Iterator[str]:
    """What the job would take, a line each; times the second look at one photograph where weights are there.

    Raises:
        ValueError: If the folder was made with other settings, or a photograph cannot be described.
    """
    todo = job.todo()
    yield f"photographs {len(todo)} to do of {len(job.views)}, to {job.folder.path}"
    if not todo:
        job.require_same_when_done()
        return
    vectors, width = 400, 512  # a usual SAM photograph; measured where that can be
    guess = f"if a photograph has {vectors} masks"
    try:
        job.folder.require_same(job.settings())
        image = job.pixels(todo[0])
        job.extractor(image[:64, :64], todo[0].name)  # loads the weights, which is not to be timed
        start = time.perf_counter()
        vectors, width = job.extractor(image, todo[0].name).vectors.shape
        seconds = time.perf_counter() - start
    except FileNotFoundError as error:
        needed = f"unknown: {error}"
    else:
        guess = f"if all have {vectors} masks as {todo[0].name} has"
        needed = (
            f"{seconds * len(todo) / 60:.1f} min, {seconds:.1f} s a photograph of "
            f"{image.shape[1]} x {image.shape[0]}"
        )
    size = sum(pair_bytes(map_size(v, job.max_height), vectors, width) for v in todo)
    yield f"disk        {size / 2**20:.0f} MiB, {guess}"
    yield f"time        {needed}"


def map_size(view: ViewSource, max_height: int | None) -> tuple[int, int]:
    """Height and width of a photograph's maps; LangSplat's rule for the width: it is cut, not rounded."""
    width, height = view.photograph.width, view.photograph.height
    if max_height is None or height <= max_height:
        return height, width
    return max_height, int(width / (height / max_height))


def _without(node: Any, keys: frozenset[str]) -> Any:
    if isinstance(node, dict):
        return {k: _without(v, keys) for k, v in node.items() if k not in keys}
    return node
