"""Values that cross module borders: frozen dataclasses, no behaviour.

Conventions, here and nowhere else:

* Camera axes are OpenCV's: x right, y down, z forward. `viewmat` maps world to camera: ``x_cam = R x + t``.
* Quaternions are ``(w, x, y, z)`` and need not be normalised.
* Pixel centres are at +0.5: the middle of the top-left pixel is ``(0.5, 0.5)``. `K` holds COLMAP's principal point as is.
* Images are ``[height, width, channels]``. Colours are in [0, 1] as floats and in [0, 255] as uint8 storage.
* The background is black for colour and zero for language.
* Shape letters: n Gaussians, h w pixels, c channels, d language code width, e embedding width (512 for CLIP), k classes.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; lenses with distortion are undistorted when a scene is read."""

    viewmat: Float[Tensor, "4 4"]
    """World to camera."""
    K: Float[Tensor, "3 3"]
    """fx, fy, cx, cy in pixels of this camera's own width and height."""
    width: int
    height: int


@dataclass(frozen=True)
class ObjectLabels:
    """Labelled objects of one view, as LERF-OVS has them: what is not labelled is unknown, not background."""

    masks: Mapping[str, Bool[Tensor, "h w"]]
    """Category -> union of its instances."""
    boxes: Mapping[str, Float[Tensor, "b 4"]]
    """Category -> one ``(x1, y1, x2, y2)`` per instance, in pixels, edges inclusive; NaN: the view shows nothing of it."""


@dataclass(frozen=True)
class DenseLabels:
    """A class id for every pixel of one view."""

    ids: UInt8[Tensor, "h w"]
    """Index into `Scene.classes`, or `IGNORE_ID`."""


IGNORE_ID = 255
"""Pixels with this class id take no part in any score."""


@dataclass(frozen=True)
class View:
    """One photograph. Pixels stay on disk until a `read_*` is called; each reader returns the same values every time."""

    name: str
    """File stem; labels and language maps are matched by it, never by position."""
    camera: Camera
    read_image: Callable[[], UInt8[Tensor, "h w 3"]]
    read_masks: Callable[[], Int[Tensor, "h w *levels"]] | None = None
    """Language supervision: row of `Scene.mask_vectors` per pixel, -1 where no mask lies (int32); with `Scene.mask_levels` above 1
    one per level."""
    read_object_labels: Callable[[], ObjectLabels] | None = None
    read_dense_labels: Callable[[], DenseLabels] | None = None
    read_valid: Callable[[], Bool[Tensor, "h w"]] | None = None
    """Pixels that the photograph covers; None where it covers all (undistortion leaves borders)."""


@dataclass(frozen=True)
class Vocabulary:
    """Words and their text embeddings, one embedding space."""

    names: tuple[str, ...]
    vectors: Float[Tensor, "k e"]
    """Unit length, row i belongs to names[i]."""


@dataclass(frozen=True)
class Scene:
    """Everything that training and evaluation need from the outside world."""

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    """Held-out views; no view is in both unless the split says so."""
    split: str
    """How train and test were told apart, as it stands in the protocol name: ``llff8``, ``list``, ``all``, ``synthetic``."""
    points: Float[Tensor, "p 3"]
    """Sparse points in world units; may be empty."""
    point_colors: UInt8[Tensor, "p 3"]
    mask_vectors: Float[Tensor, "m e"]
    """Unit image-text embedding of every mask of every training view at the chosen level; m = 0 without language."""
    mask_areas: Float[Tensor, " m"]
    """Pixels that each row of `mask_vectors` covers over all training views."""
    mask_levels: int = 1
    """How many mask levels `View.read_masks` tells apart (``levels=joint``)."""
    classes: tuple[str, ...] = ()
    """What can be asked for: names of dense class ids, or the categories of the object labels."""
    class_kinds: Mapping[str, str] = field(default_factory=dict)
    """Category -> ``translucent_reflective`` or ``other``, where it is known."""
    vocabulary: Vocabulary | None = None
    label_set: str = ""
    """Which labels of a data set these are, where there are several (``mipnerf360_goi``); part of the protocol's name."""
    supervise: Callable[[Camera, int], tuple[Int[Tensor, "h w"], Float[Tensor, "m e"]]] | None = (
        None
    )
    """Where a scene can look from anywhere: camera and number -> language supervision as of a training view, with a row of its own
    vectors per pixel, or -1. Faults are a function of the number."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where in the world of its files the scene's coordinates begin (`vlgs.data.sparse.origin`)."""
    fingerprint: str = ""
    """Content hash of all that was read; two scenes with one fingerprint give one result."""


@dataclass(frozen=True)
class Covariance:
    """Covariances of Gaussians: R S S^T R^T."""

    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the principal axes, world units, >= 0."""


@dataclass(frozen=True)
class Gaussians:
    """Activated Gaussians: what is differentiated, in natural units."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the principal axes, world units, > 0."""
    opacities: Float[Tensor, " n"]
    """Colour opacity o in [0, 1]."""
    indicators: Float[Tensor, " n *levels"]
    """Semantic indicator l in [0, 1] (Eq. 6); one per mask level with ``indicator=per_level``."""
    sh0: Float[Tensor, "n 3"]
    """Degree-0 spherical harmonics coefficient; RGB = 0.5 + 0.28209479 * sh0."""
    shN: Float[Tensor, "n s 3"]  # noqa: N815 (gsplat's name)
    """Coefficients of degrees 1 to 3; s is 0, 3, 8 or 15."""
    features: Float[Tensor, "n d"]
    """Language code f; those of all mask levels side by side with ``levels=joint``."""
    language_shape: Covariance | None = None
    """Covariance that language is blended with; None where it is colour's (``sharing=pos``, Table 17)."""
    further: Mapping[str, Float[Tensor, "n _"]] = field(default_factory=dict)
    """Further attributes by name, in natural units (``gaussians.attributes``)."""


@dataclass(frozen=True)
class ChannelGroup:
    """Channels that are blended with one weight per Gaussian and one transmittance per pixel (Eqs. 1 and 6)."""

    values: Float[Tensor, "n c"]
    """What is blended: colour, language code, ids, CLIP vectors; any c >= 1."""
    weight: Float[Tensor, " n"]
    """Opacity, indicator, ...; in [0, 1]. Groups that share this very tensor share one transmittance chain."""
    shape_grad: bool = True
    """Whether this group's gradient reaches means, quats and scales (systems differ: Feature-3DGS as released says no)."""
    shape: Covariance | None = None
    """Covariances of this group's own, around the same means and in the same depth order; None: those of the scene."""


@dataclass(frozen=True)
class RasterConfig:
    """Every constant of the rasterizer, used by the kernel and by the reference alike."""

    near: float = 0.01
    """Gaussians with a view-space depth at or below this are culled, in world units."""
    near_sigmas: float = 0.0
    """Those with a depth of at most so many of their own standard deviations along the view axis are culled as well; 0: none. A Gaussian is
    drawn by the projection's Jacobian at its centre, which says nothing of one that reaches the plane of the camera: what is large, far
    away and far to the side would lie over the whole image as fog."""
    eps2d: float = 0.3
    """Added to the diagonal of the 2D covariance, in pixel^2."""
    alpha_min: float = 1.0 / 255.0
    """Contributions below this are skipped: part of the image model, not an approximation."""
    alpha_max: float = 0.99
    """Alpha is clamped here; the gradient beyond is zero."""
    transmittance_min: float = 1e-4
    """A group of a pixel is done once its transmittance is at or below this."""
    stop: Literal["after", "before"] = "after"
    """Whether the contribution that crosses `transmittance_min` is still included; ``before`` is 3DGS's."""
    fov_margin: float = 0.3
    """How far outside the image a centre may lie, as a share m of half the image, before the projection's Jacobian is clamped:
    x/z is kept in ``[-(cx + m W/2) / fx, (W - cx + m W/2) / fx]``, y/z likewise. The bounds depend on the size of the image. A crop
    of a view therefore draws Gaussians that lie further than m W/2 outside of the crop with a slightly different shape; with 1e6
    nothing is clamped, and a crop equals the same part of the whole image up to rounding."""
    memory_budget: int = 2 << 30
    """Most bytes for the tile lists, and, if gradients may be needed, for the gradients of each Gaussian in each tile. If a view
    needs more, an error says so before anything is allocated."""
    tile_test: bool = True
    """Whether tiles of the bounding box that the ellipse misses are left out (`vlgs.skips`)."""
    block_masks: bool = True
    """Whether 4x4 blocks of a tile that the ellipse misses are left out."""
    opacity_extent: bool = True
    """Whether the ellipse is cut where the Gaussian's own weight reaches `alpha_min`, rather than a weight of 1."""
    share_chains: bool = True
    """Whether groups with one weight tensor share one transmittance."""


DepthKind = Literal["accumulated", "expected", "median"]
"""Which depth of a pixel: sum_i w_i z_i; the same by the sum of the weights; or that at which half of the light is gone."""


@dataclass(frozen=True)
class Rendered:
    """What `vlgs.rasterize` returns."""

    images: tuple[Float[Tensor, "h w _"], ...]
    """One per group; no background is added."""
    alphas: tuple[Float[Tensor, "h w"], ...]
    """One per group: accumulated weight, 1 - final transmittance."""
    visible: Bool[Tensor, " n"]
    """Whether the Gaussian reaches any pixel above `RasterConfig.alpha_min` in any group."""
    mean2d: Float[Tensor, "n 2"]
    """Projected centres in pixels; `retain_grad()` on it feeds densification."""
