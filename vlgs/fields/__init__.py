"""Trained scenes as their users see them: images from a camera, and how well words fit what is there.

Evaluation, pictures, timing and queries know `Field` and, where they ask for single Gaussians, `HasGaussians`. How a scene is
represented, and how it was trained, is hidden behind the two.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int
from torch import Tensor

from vlgs.types import Camera, DepthKind, RasterConfig
from vlgs.values import require_range


@dataclass(frozen=True)
class FieldImages:
    """Images of a field from one camera. One that was not asked for is None."""

    color: Float[Tensor, "h w 3"] | None = None
    """RGB, not clamped; of several mask levels that of the first."""
    alpha: Float[Tensor, "h w"] | None = None
    """How much of the background `color` covers, in [0, 1]."""
    feature: Float[Tensor, "levels h w d"] | None = None
    """What the field knows of language, in a form of its own."""


@runtime_checkable
class Field(Protocol):
    """The interface of a trained scene. Nothing changes in it, and no method needs a gradient."""

    @property
    def outputs(self) -> frozenset[str]:
        """Names of `FieldImages` that it can render."""
        ...

    @property
    def has_language(self) -> bool:
        """Whether it can be asked for words; off: it was made to show colour alone."""
        ...

    def levels(self) -> Sequence["Field"]:
        """A field for each mask level, finest first; a field of one level lists itself."""
        ...

    def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
        """Images from one camera, all in one pass where that is possible.

        Raises:
            ValueError: If there is nothing to render, or an output that the field does not have.
        """
        ...

    def similarity(
        self,
        camera: Camera,
        words: Float[Tensor, "k e"],
        seen: FieldImages | None = None,
        pixels: Int[Tensor, " p"] | None = None,
    ) -> Float[Tensor, "levels k h w"]:
        """How well each word fits each pixel: the cosine, or a score that is used like one.

        Args:
            camera: Where to look from.
            words: Text vectors.
            seen: What `render` gave for this camera; with ``feature`` in it language need not be rendered again.
            pixels: Look at these only, counted row by row; they come back as an image of one row.
        """
        ...


@dataclass(frozen=True)
class PointCloud:
    """Gaussians that are drawn as they are: colour with the opacity, codes with the indicator."""

    params: dict[str, Tensor]
    """Raw parameters by name, see `vlgs.gaussians.attributes`."""
    notes: tuple[str, ...]
    """What a file of them says of itself; the first is `vlgs.gaussians.ply.PLAIN`."""
    raster: RasterConfig
    """Constants with which they are drawn as they were trained."""


@runtime_checkable
class HasGaussians(Protocol):
    """What a field of Gaussians also answers. Of several mask levels each one of `Field.levels` is asked for itself."""

    def opacities(self) -> Float[Tensor, " n"]:
        """What blends colour, o in [0, 1]."""
        ...

    def language_weights(self) -> Float[Tensor, " n *levels"]:
        """What blends language, l in [0, 1]."""
        ...

    def gaussian_similarity(self, words: Float[Tensor, "k e"]) -> Float[Tensor, "levels k n"]:
        """How well each word fits each Gaussian; see `Field.similarity`."""
        ...

    def render_values(
        self, camera: Camera, values: Float[Tensor, "n c"], weight: Float[Tensor, " n"]
    ) -> Float[Tensor, "h w c"]:
        """Any values of the Gaussians, blended with any weight in [0, 1]."""
        ...

    def point_cloud(self, cameras: Sequence[Camera]) -> PointCloud:
        """Gaussians from which another program draws the same pictures.

        Args:
            cameras: Where colours count, at least one; the training cameras.
        """
        ...


@runtime_checkable
class HasDepth(Protocol):
    """What a field that knows distances also answers."""

    def depth(self, camera: Camera, kind: DepthKind = "expected") -> Float[Tensor, "h w"]:
        """Camera z of what each pixel shows, in world units, 0 where nothing is; `vlgs.ops.depth.render_depth` says which."""
        ...


@runtime_checkable
class HasObjects(Protocol):
    """What a field of one mask level also answers that tells objects apart, which have numbers from 0."""

    @property
    def object_count(self) -> int:
        """How many there are; 0: it knows none."""
        ...

    def objects(self, camera: Camera) -> Int[Tensor, "h w"]:
        """The likeliest object of each pixel; `object_count` where it is none."""
        ...

    def with_objects(self, words: Float[Tensor, "k e"], chosen: Bool[Tensor, "k objects"]) -> Field:
        """The same field, whose score of these words is the probability of the objects that are chosen for each."""
        ...


@runtime_checkable
class HasFaster(Protocol):
    """What a field also is that can compare words without making the embedding of every pixel."""

    def faster(self, within: float) -> Field:
        """See `faster`."""
        ...


NO_GAUSSIANS = "the field has no Gaussians"
"""Why a figure that speaks of Gaussians is not available."""


NO_LANGUAGE = (
    "the field has no language: its scene has no language maps, or its method learns colour alone"
)
"""Why a figure that speaks of words is not available."""


def gaussians_of(field: Field) -> Sequence[HasGaussians] | None:
    """The Gaussians of each mask level; None where the field has none."""
    found = [level for level in field.levels() if isinstance(level, HasGaussians)]
    return found if len(found) == len(field.levels()) else None


def depth_of(field: Field, camera: Camera, kind: DepthKind = "expected") -> Float[Tensor, "h w"]:
    """See `HasDepth`.

    Raises:
        ValueError: If the field knows no distances.
    """
    if not isinstance(field, HasDepth):
        raise ValueError(
            f"depth: the field must know distances (HasDepth), got {type(field).__name__}"
        )
    return field.depth(camera, kind)


def faster(field: Field, within: float = 0.0) -> Field:
    """The same scene, which answers words with less work; itself, where there is no way. Scores are not made of it.

    Args:
        field: The trained scene.
        within: By how much a cosine may be off, as far as that is measured (`vlgs.fields.comparing.Tabulating`); 0: by rounding alone.

    Raises:
        ValueError: If the bound is not in [0, 2].
    """
    require_range("faster", 0, 2, within=within)
    return field.faster(within) if field.has_language and isinstance(field, HasFaster) else field


def require_outputs(who: str, outputs: Iterable[str], had: frozenset[str]) -> None:
    """Refuse what a field cannot render.

    Raises:
        ValueError: If there is nothing to render, or an output that is not `had`.
    """
    odd = sorted(set(outputs) - had)
    if odd or not outputs:
        names = ", ".join(sorted(had))
        raise ValueError(f"{who}: outputs must be some of {names}, got {', '.join(odd) or 'none'}")
