"""Further training views, rendered once from a first model of colour: the offline augmentation of Table 13 (conf/README.md, D.17)."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from vlgs.data.sampler import nearest_views
from vlgs.data.untrusted.arrays import Archive
from vlgs.fields.splat import SplatModel
from vlgs.files import write_atomically
from vlgs.training.stages import Progress, Stage, Stages, TrainColor
from vlgs.training.workshop import Workshop
from vlgs.types import Camera, Scene, View
from vlgs.values import require_range
from vlgs.view_blend import UniformBlend, blend_camera

_CAMERAS = 7  # purpose of draws
_FIRST = "augment"
"""Name of the stage that renders."""


@dataclass(frozen=True)
class AddedView:
    """A view that nobody photographed."""

    number: int
    camera: Camera
    image: UInt8[Tensor, "h w 3"]


@runtime_checkable
class Augment(Stages, Protocol):
    """The interface of an option of conf/augment."""

    def identity(self) -> str:
        """What moves the added views besides the configuration; counts for the id of a run."""
        ...

    def require(self, scenes: Mapping[int | None, Scene]) -> None:
        """Refuse scenes that no views can be added to, before anything is trained."""
        ...


@dataclass(frozen=True)
class NoAugment:
    """The training views alone."""

    as_photographed: ClassVar[bool] = True
    """No view is rendered."""

    def identity(self) -> str:
        """See `Augment`."""
        return ""

    def require(self, scenes: Mapping[int | None, Scene]) -> None:
        """See `Augment`."""

    def stages(self, language: bool) -> Sequence[Stage]:
        """None."""
        return []


@dataclass(frozen=True)
class Offline:
    """Cameras between pairs of training cameras, with images of a trained model and language maps made for them.

    Raises:
        ValueError: If a value is out of range.
    """

    views: int = 40
    """How many are added to the training views."""
    pairs: Literal["neighbours", "uniform"] = "neighbours"
    """Which training cameras they lie between: one and another among its nearest, or any two."""
    neighbours: int = 4
    """How many cameras are near, for ``pairs=neighbours``."""
    extractor: Any | None = None
    """A `vlgs.features.Extractor`, which is run on the rendered images; None asks the scene (`Scene.supervise`)."""

    def __post_init__(self) -> None:
        require_range("augment", 1, 10**5, views=self.views, neighbours=self.neighbours)
        if self.pairs not in ("neighbours", "uniform"):
            raise ValueError(f"augment: pairs must be neighbours or uniform, got {self.pairs}")

    def identity(self) -> str:
        """What moves the maps besides the configuration: hashes of the extractor's weights.

        Raises:
            FileNotFoundError: If weights are missing.
        """
        return "" if self.extractor is None else repr(sorted(self.extractor.identity().items()))

    def require(self, scenes: Mapping[int | None, Scene]) -> None:
        """Do nothing if further views and their language maps can be made.

        Raises:
            ValueError: If no two views have one size, only an extractor can, and there is none, or the mask level is not known.
        """
        cameras = [view.camera for view in next(iter(scenes.values())).train]
        if not any(self._near(cameras)):
            raise ValueError("augment: two training views must have one image size, got none")
        for level, scene in scenes.items():
            if len(scene.mask_vectors) == 0:
                continue
            if self.extractor is None and scene.supervise is None:
                raise ValueError(
                    "augment: extractor must be given for photographs, as only procedural scenes make language maps of "
                    "views that nobody photographed (augment=offline_sam), got null"
                )
            if self.extractor is not None and level is None:
                raise ValueError("augment: data must have a mask level for the extractor, got none")

    def stages(self, language: bool) -> Sequence[Stage]:
        """A first model of colour alone, and the views that it renders; see `vlgs.training.stages.Stages`."""
        return [TrainColor(_FIRST, kept=False), RenderViews(self)]

    def extend(
        self, scenes: Mapping[int | None, Scene], model: SplatModel, seed: int, folder: Path
    ) -> dict[int | None, Scene]:
        """The same scenes with further training views.

        Args:
            scenes: Mask level -> scene; they share cameras.
            model: Renders the images.
            seed: Of the cameras.
            folder: Where an extractor's maps are kept, all levels of a view in one file: they are dear.
        """
        views = self._render(next(iter(scenes.values())), model, seed)
        extended = {}
        for level, scene in scenes.items():
            maps = [self._describe(scene, added, level, folder) for added in views]
            extended[level] = _with_views(scene, views, maps)
        return extended

    def _near(self, cameras: Sequence[Camera]) -> Sequence[Sequence[int]]:
        return nearest_views(cameras, self.neighbours if self.pairs == "neighbours" else None)

    @torch.no_grad()
    def _render(self, scene: Scene, model: SplatModel, seed: int) -> list[AddedView]:
        cameras = [view.camera for view in scene.train]
        near = self._near(cameras)
        with_others = [index for index, others in enumerate(near) if others]
        rng, between, fused = np.random.default_rng([seed, _CAMERAS]), UniformBlend(), model.fuse()
        views = []
        for number in range(self.views):
            first = with_others[number * len(with_others) // self.views % len(with_others)]
            second = near[first][int(rng.integers(len(near[first])))]
            camera = blend_camera(cameras[first], cameras[second], between.draw(rng), between)
            color = model.render(camera, language=False, fused=fused).color
            assert color is not None  # it was asked for
            image = (color.clamp(0, 1) * 255).round().to(torch.uint8)
            views.append(AddedView(number, camera, image))
        return views

    def _describe(
        self, scene: Scene, added: AddedView, level: int | None, folder: Path
    ) -> tuple[Int[Tensor, "h w"], Float[Tensor, "m e"]] | None:
        if len(scene.mask_vectors) == 0:
            return None
        if self.extractor is None:
            assert scene.supervise is not None  # `require`
            return scene.supervise(added.camera, added.number)
        path = folder / f"{_name(added)}.npz"
        if not path.is_file():
            found, stream = self.extractor(added.image.numpy(), _name(added)), io.BytesIO()
            np.savez(stream, ids=found.ids, vectors=found.vectors)
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically(path, stream.getvalue())
        with Archive(path, "the maps of an added view (delete it: it is made again)") as kept:
            index = torch.from_numpy(kept.read("ids")[level])
            every = torch.from_numpy(kept.read("vectors"))
        rows, compact = index.unique(return_inverse=True)
        first = int(rows[0] < 0)
        return (compact - first).int(), every[rows[rows >= 0].long()]


@dataclass(frozen=True)
class RenderViews:
    """Adds views that an earlier stage renders to the training views of every mask level."""

    augment: Offline
    start: str = _FIRST
    """The earlier stage."""

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """See `vlgs.training.stages.Stage`."""
        model = progress.gaussians(self.start, None)
        maps = workshop.folder.part(self.start).path / "language"
        scenes = self.augment.extend(progress.scenes, model, workshop.seed, maps)
        return replace(progress, scenes=scenes)


def _with_views(
    scene: Scene,
    added: Sequence[AddedView],
    maps: Sequence[tuple[Int[Tensor, "_ _"], Float[Tensor, "_ e"]] | None],
) -> Scene:
    views, vectors, areas = list(scene.train), [scene.mask_vectors], [scene.mask_areas]
    offset = len(scene.mask_vectors)
    for view, described in zip(added, maps, strict=True):
        masks = None
        if described is not None:
            index, own = described
            masks = torch.where(index >= 0, index + offset, -1).int()
            offset += len(own)
            vectors.append(own.to(scene.mask_vectors.dtype))
            areas.append(torch.bincount(index[index >= 0].long(), minlength=len(own)).float())
        views.append(_view(view, masks))
    return replace(
        scene,
        train=tuple(views),
        mask_vectors=torch.cat(vectors),
        mask_areas=torch.cat(areas),
    )


def _view(added: AddedView, masks: Int[Tensor, "h w"] | None) -> View:
    return View(
        name=_name(added),
        camera=added.camera,
        read_image=added.image.clone,
        read_masks=None if masks is None else masks.clone,
    )


def _name(added: AddedView) -> str:
    return f"extra_{added.number + 1:05d}"
