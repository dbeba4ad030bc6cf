"""What a Gaussian carries, as one table.

A row is an `Attribute`. Activation, learning rates, PLY columns, densification, freezing and rendering read it there, so that one more attribute
is one more row. `STANDARD` has the rows of 3DGS and of the paper; `attributes_of` makes the table of one training from them, and from whatever
else ``gaussians.attributes`` names.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.gaussians.config import Activation, AttributeConfig, GaussiansConfig
from vlgs.gaussians.draws import seeded_generator
from vlgs.gaussians.logistic import logistic, logit

Role = Literal["position", "rotation", "scale", "weight", "value"]
"""What densification, freezing and rendering take an attribute for: a split shrinks scales, a rotation must not be zero, a weight has no
gradient far beyond the cutoffs, a value is everything else."""


SHORTEST = 1e-3
"""Added to the length of a value of activation ``unit``, so that zero stays zero. With LangSplat's 1e-9 the gradient at zero, where codes start, is
millions of times those that follow, and Adam's second moment has to forget it: that takes the 30 000 iterations which LangSplat has, and
in 400 nothing more is learned (mIoU of the benchmark 23 instead of 55 %)."""


@dataclass(frozen=True)
class Attribute:
    """One raw parameter of every Gaussian."""

    name: str
    """Its key among the parameters and in checkpoints; row i is Gaussian i."""
    shape: tuple[int, ...] | None
    """Of one Gaussian's value, () for a number; None: as the tensor has it."""
    columns: str | tuple[str, ...]
    """Its properties in a PLY file: the name of a number, the stem of ``stem_0``, ``stem_1`` ... of several, or all names."""
    role: Role = "value"
    activation: Activation = "none"
    """From the raw parameter to natural units."""
    parts: int = 1
    """How many vectors lie side by side in a value, each activated by itself: language codes of several mask levels."""
    kept: int = 4
    """How many weights of a vector the activation ``sparse`` keeps."""
    start: float | str = 0.0
    """Raw value where nothing else gives one, or the name of the attribute that it starts as a copy of."""
    seed: int | None = None
    """Of the numbers that it starts with in place of `start`, drawn from N(0, 1); None: nothing is drawn."""
    rate: float = 0.0
    """Adam's. That of the positions is in scene extents and decays (`vlgs.training.settings.TrainerConfig.means_rate`)."""
    blended_by: str | None = None
    """The weight that blends it into an image; None: it is not drawn. In place of the indicator stands what ``indicator=`` says."""
    shape_grad: bool = True
    """Whether the gradient of its image reaches positions, rotations and scales."""

    def activate(self, raw: Tensor) -> Tensor:
        """Natural units."""
        if self.parts > 1 and self.activation in ("unit", "sparse"):
            each = replace(self, parts=1)
            return torch.cat([each.activate(part) for part in raw.chunk(self.parts, dim=-1)], -1)
        if self.activation == "exp":
            return raw.exp()
        if self.activation == "unit":
            return raw / (torch.linalg.vector_norm(raw, dim=-1, keepdim=True) + SHORTEST)
        if self.activation == "sparse":
            return sparse_softmax(raw, self.kept)
        return logistic(raw) if self.activation == "logistic" else raw

    def first(self, count: int) -> Tensor:
        """Raw values of so many Gaussians at the start; the same draw for the same seed, name and count."""
        shape = (count, *(self.shape or ()))
        if self.seed is None:
            return torch.full(shape, float(self.start))
        return torch.randn(shape, generator=seeded_generator(self.name, self.seed, count))

    def column_names(self, width: int | None) -> tuple[str, ...]:
        """Its PLY properties; `width` is how many numbers a value has, None for the one of shape ()."""
        if isinstance(self.columns, tuple):
            return self.columns
        if width is None:
            return (self.columns,)
        return tuple(f"{self.columns}_{index}" for index in range(width))


def sparse_softmax(logits: Float[Tensor, "*n k"], kept: int) -> Float[Tensor, "*n k"]:
    """The largest weights of a softmax, divided by their sum; all others are zero.

    That is the softmax of the largest logits alone, which is how it is computed: by way of all weights, those that are left out would
    get gradients of rounding errors, from which Adam makes steps of full size. Of equal logits the first are kept.

    Example:
        >>> sparse_softmax(torch.tensor([0.1, 0.2, 0.3, 0.4]).log(), kept=2)
        tensor([0.0000, 0.0000, 0.4286, 0.5714])
    """
    order = logits.detach().argsort(dim=-1, descending=True, stable=True)[..., :kept]
    weights = logits.gather(-1, order).softmax(dim=-1)
    return torch.zeros_like(logits).scatter(-1, order, weights)


Attributes = Mapping[str, Attribute]
"""By name, in the order of PLY files."""

STANDARD: Attributes = {row.name: row for row in (
    Attribute("means", (3,), ("x", "y", "z"), "position"),
    Attribute("sh0", (3,), "f_dc", blended_by="opacity_logits"),
    Attribute("shN", None, "f_rest", blended_by="opacity_logits"),  # [coefficients, 3]
    Attribute("opacity_logits", (), "opacity", "weight", "logistic"),
    Attribute("log_scales", (3,), "scale", "scale", "exp"),
    Attribute("quats", (4,), "rot", "rotation"),
    Attribute("features", None, "lang", blended_by="indicator_logits"),  # [d]
    Attribute("indicator_logits", None, "indicator", "weight", "logistic", start="opacity_logits"),  # () or [levels]
    Attribute("language_log_scales", (3,), "language_scale", "scale", "exp", start="log_scales"),
    Attribute("language_quats", (4,), "language_rot", "rotation", start="quats"),
)}  # fmt: skip
"""3DGS's, then language's: code, indicator, and with ``sharing=pos`` covariances of its own. Rates are zero here; a training gives them."""
THREE_DGS = tuple(STANDARD)[:6]
"""What every file of Gaussians has."""
LANGUAGE_SHAPE = tuple(STANDARD)[-2:]


def attributes_of(
    config: GaussiansConfig,
    width: int,
    levels: int | None = None,
    own_shape: bool = False,
    rates: Mapping[str, float] | None = None,
    parts: int = 1,
    seed: int = 0,
) -> Attributes:
    """The table of one training.

    Args:
        config: Harmonics, first weights, and further attributes.
        width: Of the language code of a Gaussian.
        levels: Number of indicators, one per mask level; None: a single one.
        own_shape: Whether language has covariances of its own.
        rates: Adam's rate per attribute. A copy that is not named learns like its original. None: nothing learns.
        parts: Codes of several mask levels that `width` holds side by side.
        seed: Of what starts at random.

    Raises:
        ValueError: If the width is not positive, or a further attribute has a name or PLY columns that are taken.
    """
    if width < 1:
        raise ValueError(f"gaussians: width of the language code must be at least 1, got {width}")
    kept = {n: row for n, row in STANDARD.items() if own_shape or n not in LANGUAGE_SHAPE}
    shapes = {"shN": ((config.degree + 1) ** 2 - 1, 3), "features": (width,)}
    shapes["indicator_logits"] = () if levels is None else (levels,)
    starts = {"opacity_logits": config.init_opacity, "indicator_logits": config.init_indicator}
    codes: dict[str, Any] = {"activation": config.codes, "kept": config.codes_kept, "parts": parts}
    codes |= {"shape_grad": config.codes_shape_grad}
    codes |= {"seed": seed if config.init_features == "normal" else None}
    table = {
        name: replace(
            row,
            shape=shapes.get(name, row.shape),
            start=logit(starts[name]) if name in starts else row.start,
            rate=_rate(row, rates or {}),
            **(codes if name == "features" else {}),
        )
        for name, row in kept.items()
    }
    return table | {name: _further(name, extra, seed) for name, extra in config.attributes.items()}


def _rate(row: Attribute, rates: Mapping[str, float]) -> float:
    return rates.get(row.name, rates.get(row.start, 0.0) if isinstance(row.start, str) else 0.0)


def _further(name: str, extra: AttributeConfig, seed: int) -> Attribute:
    taken = {column for row in STANDARD.values() for column in (row.name, *row.column_names(None))}
    if name in taken or not name.isidentifier():
        raise ValueError(
            f"gaussians: attributes must have names of letters, digits and _ that are not taken, got {name}"
        )
    weight = None if extra.blended_by is None else f"{extra.blended_by}_logits"
    drawn = extra.start == "normal"
    return Attribute(
        name,
        (extra.width,),
        name,
        activation=extra.activation,
        start=0.0 if isinstance(extra.start, str) else extra.start,
        seed=seed if drawn else None,
        rate=extra.rate,
        blended_by=weight,
        shape_grad=extra.shape_grad,
    )
