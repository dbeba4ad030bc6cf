"""Settings of the Gaussians: how they start, multiply and die. Mirrored by conf/gaussians."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

from vlgs.demands import Demand
from vlgs.values import require_choice, require_range

Activation = Literal["none", "exp", "logistic", "unit", "sparse"]
"""From a raw parameter to natural units; ``unit`` is the direction of a vector, ``sparse`` its softmax of which only the largest weights
are kept."""
Start = float | Literal["normal"]
"""Raw value of all Gaussians at the start; ``normal``: drawn from N(0, 1), as the run's seed says."""


@dataclass(frozen=True)
class DensifyConfig:
    """Adaptive density control of 3DGS (Kerbl et al. 2023; conf/README.md, D.10 and D.11). Steps count from 0."""

    start: int = 500
    """No densification up to and including this step."""
    stop: int = 15_000
    """Neither densification nor opacity resets from this step on."""
    every: int = 100
    """Steps between two densifications."""
    grad_threshold: float = 2e-4
    """A Gaussian whose mean screen gradient reaches this, in NDC units, is cloned or split."""
    grad_threshold_size: float = 0.0
    """Up to views of this size, the root of width times height in pixels as they are rendered, `grad_threshold` holds as it is; where they are so
    many times larger it is divided by the root of that. 0: whatever their size. See `DensifyState.accumulate`."""
    dense_share: float = 0.01
    """Up to this largest scale, as a share of the scene extent, a Gaussian is cloned; above it is split."""
    prune_below: float = 0.005
    """Weight under which a Gaussian is removed; see `GaussiansConfig.prune_on`."""
    prune_unseen: float = 0.0
    """When densification ends, a Gaussian that fills fewer pixels than this in every training view, by the sum of its blending weights, is removed
    (`vlgs.training.most_shown`); 0: none is. With `prune_on` as in `prune_below`."""
    prune_large: bool = True
    """Whether Gaussians above `max_scale_share` are removed, once the first opacity reset has passed."""
    max_scale_share: float = 0.1
    """Largest scale of a Gaussian as a share of the scene extent."""
    reset_every: int = 3000
    """Steps between two opacity resets; 0 never resets."""
    reset_to: float = 0.01
    """A reset lowers every opacity to this at most."""
    reset_indicator: bool = False
    """Whether a reset lowers the indicators as well."""
    share_weights: bool = False
    """Whether a clone and its original together cover what the original did (Rota Bulo et al. 2024, "Revising Densification"): opacity and
    indicator w become 1 - sqrt(1 - w) in both. False is 3DGS's: both keep w, and what lies behind them loses light."""
    by_error: bool = False
    """Whether those that are cloned or split are chosen by the errors of the pixels that they blend, too (`vlgs.training.pixel_error`): as many
    as reach `grad_threshold`, those of the highest mean gradient times the root of that error."""
    long_axis: bool = False
    """Whether whatever is to grow, small or large, becomes two side by side on its longest axis (`vlgs.gaussians.long_axis`), in the place of clones
    and of children that are drawn at random; `dense_share` then says nothing."""

    def __post_init__(self) -> None:
        _require_at_least("densify", 1, every=self.every)
        _require_at_least("densify", 0, start=self.start, stop=self.stop)
        _require_at_least("densify", 0, reset_every=self.reset_every)
        _require_positive(
            "densify",
            grad_threshold=self.grad_threshold,
            dense_share=self.dense_share,
            max_scale_share=self.max_scale_share,
        )
        require_range("densify", 0, 10**9, prune_unseen=self.prune_unseen)
        require_range("densify", 0, 10**9, grad_threshold_size=self.grad_threshold_size)
        _require_inside_unit("densify", prune_below=self.prune_below, reset_to=self.reset_to)
        if self.long_axis and self.share_weights:
            raise ValueError(
                "densify: share_weights must be false with long_axis=true, where nothing is cloned, got true"
            )
        if self.reset_to <= self.prune_below:
            raise ValueError(
                f"densify: reset_to must be above prune_below ({self.prune_below}), or a reset kills every "
                f"Gaussian, got {self.reset_to}"
            )

    def densifies_at(self, step: int) -> bool:
        """Whether Gaussians are cloned, split and pruned after this step."""
        return self.start < step < self.stop and step % self.every == 0

    def resets_at(self, step: int) -> bool:
        """Whether opacities are lowered after this step (after densifying, if both are due)."""
        return 0 < step < self.stop and self.reset_every > 0 and step % self.reset_every == 0


@dataclass(frozen=True)
class AttributeConfig:
    """A further attribute of every Gaussian: carried, trained, densified, saved, written to PLY files, and drawn on demand."""

    width: int
    """How many numbers a Gaussian has of it."""
    activation: Activation = "none"
    """From the raw parameter to what is drawn."""
    start: Start = 0.0
    rate: float = 2.5e-3
    """Adam's rate; 0: it does not learn."""
    blended_by: Literal["opacity", "indicator"] | None = "opacity"
    """The weight that blends it into an image; None: it is not drawn."""
    shape_grad: bool = True
    """Whether the gradient of its image reaches positions, rotations and scales."""

    def __post_init__(self) -> None:
        require_range("attribute", 1, 4096, width=self.width)
        require_range("attribute", 0, 1, rate=self.rate)
        if self.start != "normal":
            if isinstance(self.start, str):
                raise ValueError(f"attribute: start must be a number or normal, got {self.start!r}")
            require_range("attribute", -1e6, 1e6, start=self.start)
        require_choice("attribute", "activation", self.activation, get_args(Activation))
        if self.blended_by is not None:
            require_choice("attribute", "blended_by", self.blended_by, ("opacity", "indicator"))


@dataclass(frozen=True)
class GaussiansConfig:
    """Which values each Gaussian has, and how they start."""

    color: Literal["rgb_dc", "rgb", "evaluated"] = "rgb_dc"
    """Colour that is fused with language (conf/README.md, D.7): the RGB of degree 0, to which the other degrees are added after fusion; RGB
    without harmonics; or all degrees as the view sees them, with which language depends on the view too."""
    sh_degree: int = 3
    """Highest spherical harmonics degree that is stored, 0 to 3; see `degree`."""
    init_opacity: float = 0.1
    init_indicator: float = 0.1
    """The paper starts the indicator in the same manner as the opacity (its section 4.1)."""
    init_features: Literal["zero", "lifted", "normal", "random"] = "zero"
    """Language codes at the start: zero; the mean of the training views' codes as the first Gaussians blend them (`vlgs.training.lift`; conf/README.md, D.9);
    drawn from N(0, 1), as LEGaussians'; or uniform as the degree-0 harmonic of a random colour, Gaussian Grouping's."""
    init_points: int = 20_000
    """Random points for a scene without sparse points."""
    background: int = 1500
    """Directions all around in which a Gaussian stands behind everything (`vlgs.gaussians.background`); 0: none."""
    background_opacity: float | None = None
    """Opacity that it starts with; None: `init_opacity`."""
    silent_above: float = 0.7
    """Share of a Gaussian's language weight outside of masks, over the training views, above which its code is zero in the end
    (`vlgs.training.silence`); 1: none is."""
    clear_air: bool = False
    """Whether Gaussians that only language sees, before a camera, are removed in the end (`vlgs.gaussians.in_air`)."""
    near_share: float = 0.0
    """Nothing is drawn nearer to a camera than this share of the depth at which the nearest sparse point stands before any training camera
    (`vlgs.gaussians.in_air.near_plane`), nor nearer than `RasterConfig.near`; 0: that alone."""
    max_init_angle: float = 0.1
    """Largest initial scale as a share of the distance to the nearest training camera: a lone outlier between
    the cameras and the scene would otherwise cover whole views."""
    max_angle: float = 0.0
    """The same while scales are trained, and in the end (`vlgs.gaussians.in_air.narrow`); 0: any."""
    max_count: int = 200_000
    """Sparse points beyond this are left out, and densification stops growing here."""
    prune_on: Literal["max", "opacity", "indicator"] = "max"
    """``max``: a Gaussian lives while its opacity or its indicator is high (glass); ``opacity`` is the literal
    reading of the paper (conf/README.md, D.10); ``indicator`` is for Gaussians of language alone. An indicator that nothing trains
    does not count (`vlgs.training.build.pruned_on`)."""
    init: str | None = None
    """File of Gaussians to start from (`vlgs.formats.read_gaussians`); None starts from the sparse points."""
    densify_on: Literal["total", "rgb"] = "total"
    """Loss whose screen gradients feed densification (conf/README.md, D.11)."""
    codes: Literal["none", "unit", "sparse"] = "none"
    """Activation of the language codes before they are blended: as they are, at unit length, as LangSplat's, or the weights of a few
    entries of a codebook, as LangSplatV2's."""
    codes_kept: int = 4
    """How many weights ``codes=sparse`` keeps."""
    codes_shape_grad: bool = True
    """Whether the gradient of language reaches positions, rotations and scales; Feature-3DGS's, as released, does not."""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    """Name -> what every Gaussian carries besides: an `AttributeConfig`, or a mapping of its values."""
    densify: DensifyConfig = field(default_factory=DensifyConfig)

    def __post_init__(self) -> None:
        if self.sh_degree not in range(4):
            raise ValueError(f"gaussians: sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}")
        _require_inside_unit(
            "gaussians",
            init_opacity=self.init_opacity,
            init_indicator=self.init_indicator,
        )
        # Many more have no place in memory; random ones are drawn by the dozen and the best are kept.
        require_range("gaussians", 1, 10**7, init_points=self.init_points)
        require_range("gaussians", 1, 10**9, max_count=self.max_count)
        require_range("gaussians", 0, 10**6, background=self.background)
        if self.background_opacity is not None:
            _require_inside_unit("gaussians", background_opacity=self.background_opacity)
        require_range("gaussians", 0, 1, silent_above=self.silent_above, near_share=self.near_share)
        require_range("gaussians", 1, 65536, codes_kept=self.codes_kept)
        _require_positive("gaussians", max_init_angle=self.max_init_angle)
        require_range("gaussians", 0, 1e6, max_angle=self.max_angle)
        for name, options in {
            "color": ("rgb_dc", "rgb", "evaluated"),
            "init_features": ("zero", "lifted", "normal", "random"),
            "prune_on": ("max", "opacity", "indicator"),
            "densify_on": ("total", "rgb"),
            "codes": ("none", "unit", "sparse"),
        }.items():
            require_choice("gaussians", name, getattr(self, name), options)

        if self.init_features == "lifted" and not self.takes_codes:
            raise ValueError(
                "gaussians: codes must be none or unit with init_features=lifted, as sparse ones are weights of a codebook's entries, "
                f"got {self.codes}"
            )
        further = {name: _attribute(name, extra) for name, extra in self.attributes.items()}
        object.__setattr__(self, "attributes", further)

    @property
    def demands(self) -> Sequence[Demand]:
        """Codes are there to be lifted where the head is fitted before."""
        if self.init_features != "lifted":
            return ()
        why = "as codes of masks are lifted onto the Gaussians"
        return (Demand("gaussians.init_features=lifted", "head", "untrained", why),)

    @property
    def takes_codes(self) -> bool:
        """Whether a code can be given to a Gaussian as it is to be blended."""
        return self.codes != "sparse"

    @property
    def degree(self) -> int:
        """Spherical harmonics degree that the Gaussians have: none with ``color=rgb``."""
        return 0 if self.color == "rgb" else self.sh_degree


def _attribute(name: str, extra: Any) -> AttributeConfig:
    if isinstance(extra, AttributeConfig):
        return extra
    known = [key.name for key in fields(AttributeConfig)]
    if not isinstance(extra, Mapping) or "width" not in extra or set(extra) - set(known):
        got = list(extra) if isinstance(extra, Mapping) else extra
        raise ValueError(
            f"gaussians: attributes.{name} must have a width and some of {', '.join(known[1:])}, got {got}"
        )
    return AttributeConfig(**{str(key): value for key, value in extra.items()})


def _require_at_least(who: str, least: int, **values: int) -> None:
    for name, value in values.items():
        if value < least:
            raise ValueError(f"{who}: {name} must be at least {least}, got {value}")


def _require_positive(who: str, **values: float) -> None:
    for name, value in values.items():
        if not 0.0 < value < float("inf"):
            raise ValueError(f"{who}: {name} must be positive and finite, got {value}")


def _require_inside_unit(who: str, **values: float) -> None:
    for name, value in values.items():
        if not 0.0 < value < 1.0:
            raise ValueError(f"{who}: {name} must be above 0 and below 1, got {value}")
