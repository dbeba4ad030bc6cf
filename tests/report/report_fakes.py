"""A drawn still life with a model that has learnt it almost: everything a report needs, without a rasterizer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.fields import Field, FieldImages, PointCloud
from vlgs.fields.similarity import cosines
from vlgs.types import (
    IGNORE_ID,
    Camera,
    DenseLabels,
    ObjectLabels,
    Scene,
    View,
    Vocabulary,
)

CLASSES = ("wall", "table", "wine glass", "steel kettle", "red apple", "absent")
KINDS = {c: "other" for c in CLASSES} | {
    "wine glass": "translucent_reflective",
    "steel kettle": "translucent_reflective",
}
NEGATIVES = ("object", "things", "stuff", "texture")
COLORS = torch.tensor(
    [[150, 160, 175], [140, 100, 70], [190, 215, 220], [95, 100, 110], [190, 30, 35], [0, 0, 0]]
)
EMBEDDING = 16


def vocabulary(
    words: tuple[str, ...] = CLASSES + NEGATIVES, renamed: Mapping[str, str] | None = None
) -> Vocabulary:
    """Words in a narrow cone as CLIP's are; the negatives lie on the cone's axis."""
    rng = torch.Generator().manual_seed(0)
    rows = {(renamed or {}).get(c, c): i for i, c in enumerate(CLASSES + NEGATIVES)}
    vectors = torch.zeros(len(rows), EMBEDDING)
    vectors[:, 0] = 2
    vectors[: len(CLASSES), 1 : len(CLASSES) + 1] = torch.eye(len(CLASSES))
    vectors += 0.05 * torch.randn(vectors.shape, generator=rng)
    return Vocabulary(
        words, torch.nn.functional.normalize(vectors[[rows[word] for word in words]], dim=-1)
    )


@dataclass(frozen=True)
class Drawing:
    """What a camera sees; a camera's x position shifts the objects."""

    width: int = 200
    height: int = 150
    shift: float = 0.0

    @cached_property
    def ids(self) -> Tensor:
        """Class of every pixel."""
        y, x = torch.meshgrid(
            (torch.arange(self.height) + 0.5) / self.height,
            (torch.arange(self.width) + 0.5) / self.width,
            indexing="ij",
        )
        x = x + self.shift
        ids = (y > 0.55).to(torch.uint8)
        ids[((x - 0.25) / 0.09) ** 2 + ((y - 0.5) / 0.25) ** 2 < 1] = 2
        ids[((x - 0.55) / 0.14) ** 2 + ((y - 0.55) / 0.2) ** 2 < 1] = 3
        ids[((x - 0.8) / 0.07) ** 2 + ((y - 0.68) / 0.1) ** 2 < 1] = 4
        ids[-1, -1] = IGNORE_ID
        return ids

    @property
    def shown(self) -> Tensor:
        """Class ids to index with; the corner without a class is table."""
        return self.ids.long().masked_fill(self.ids == IGNORE_ID, 1)

    @property
    def image(self) -> Tensor:
        """The photograph, shaded from top to bottom."""
        light = torch.linspace(1.15, 0.75, self.height)[:, None, None]
        return (COLORS[self.shown] * light).clamp(0, 255).to(torch.uint8)

    @property
    def objects(self) -> ObjectLabels:
        """Masks and boxes of the three objects."""
        masks = {CLASSES[i]: self.ids == i for i in (2, 3, 4)}
        boxes = {}
        for name, mask in masks.items():
            y, x = torch.nonzero(mask, as_tuple=True)
            boxes[name] = torch.tensor([[x.min(), y.min(), x.max(), y.max()]]).float()
        return ObjectLabels(masks, boxes)

    @property
    def camera(self) -> Camera:
        """Carries the shift."""
        viewmat = torch.eye(4)
        viewmat[0, 3] = self.shift
        return Camera(viewmat, torch.eye(3), self.width, self.height)


def view(drawing: Drawing, name: str, dense: bool = True, objects: bool = False) -> View:
    """A held-out view with the labels asked for."""
    return View(
        name,
        drawing.camera,
        read_image=lambda: drawing.image,
        read_dense_labels=(lambda: DenseLabels(drawing.ids)) if dense else None,
        read_object_labels=(lambda: drawing.objects) if objects else None,
    )


def scene(views: int = 3, width: int = 200, height: int = 150, **labels: bool) -> Scene:
    """A scene of some held-out views and no training views."""
    shifts = [0.05 * i for i in range(views)]
    return Scene(
        name="still life",
        train=(),
        test=tuple(
            view(Drawing(width, height, shift), f"view_{i:02}", **labels)
            for i, shift in enumerate(shifts)
        ),
        split="synthetic",
        points=torch.zeros(0, 3),
        point_colors=torch.zeros(0, 3, dtype=torch.uint8),
        mask_vectors=torch.eye(1, EMBEDDING),
        mask_areas=torch.ones(1),
        classes=CLASSES,
        class_kinds=KINDS,
        vocabulary=vocabulary(),
    )


class FakeField:
    """Shows the drawing with noise of a given strength; 0 is the truth. Its features are embeddings, and it has Gaussians."""

    outputs = frozenset({"color", "feature"})
    has_language = True

    def __init__(self, noise: float = 0.0) -> None:
        self.noise = noise

    def levels(self) -> Sequence[Field]:
        """The one level."""
        return (self,)

    def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
        """The drawing that the camera sees."""
        drawing = self._drawing(camera)
        rng = torch.Generator().manual_seed(2)
        image = drawing.image / 255
        image = image + self.noise * torch.randn(image.shape, generator=rng)
        feature = vocabulary(CLASSES).vectors[drawing.shown]
        feature = feature + self.noise * torch.randn(feature.shape, generator=rng)
        return FieldImages(
            color=image if "color" in outputs else None,
            feature=feature[None] if "feature" in outputs else None,
        )

    def similarity(
        self,
        camera: Camera,
        words: Float[Tensor, "k e"],
        seen: FieldImages | None = None,
        pixels: Int[Tensor, " p"] | None = None,
    ) -> Float[Tensor, "levels k h w"]:
        """Cosines with the features."""
        feature = (seen or self.render(camera, frozenset({"feature"}))).feature
        assert feature is not None
        if pixels is not None:
            feature = feature.flatten(1, 2)[:, None, pixels]
        return torch.stack([cosines(level, words) for level in feature])

    def opacities(self) -> Tensor:
        """Of a thousand Gaussians."""
        return torch.rand(1000, generator=torch.Generator().manual_seed(1))

    def language_weights(self) -> Tensor:
        """Most of them more indicative than opaque."""
        more = torch.rand(1000, generator=torch.Generator().manual_seed(3))
        return (self.opacities() + 0.6 * more - 0.1).clamp(0, 1)

    def codes(self) -> Tensor:
        """Embeddings of the Gaussians."""
        return torch.zeros(1000, EMBEDDING)

    def gaussian_similarity(self, words: Tensor) -> Tensor:
        """Cosines with the codes."""
        return cosines(self.codes(), words)[None]

    def render_values(
        self, camera: Camera, values: Float[Tensor, "n c"], weight: Float[Tensor, " n"]
    ) -> Float[Tensor, "h w c"]:
        """Glass and steel above 0, a glare below."""
        drawing = self._drawing(camera)
        per_class = torch.tensor([0.05, 0.1, 0.85, 0.6, 0.2, 0.0])
        image = per_class[drawing.shown]
        image[: drawing.height // 8, : drawing.width // 6] = -0.6
        return torch.stack([image, torch.ones_like(image)], dim=-1)[..., : values.shape[1]]

    def point_cloud(self, cameras: Sequence[Camera]) -> PointCloud:
        """Not asked for."""
        raise NotImplementedError

    @staticmethod
    def _drawing(camera: Camera) -> Drawing:
        return Drawing(camera.width, camera.height, camera.viewmat[0, 3].item())


def with_test(scene: Scene, *views: View) -> Scene:
    """The scene with other held-out views."""
    return replace(scene, test=views)
