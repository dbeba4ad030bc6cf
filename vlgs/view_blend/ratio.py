"""What is blended, and how the ratio k is drawn. k is the weight of view 1 everywhere."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from vlgs.demands import Demand
from vlgs.values import require_choice, require_range

Convention = Literal["consistent", "paper"]


@dataclass(frozen=True, kw_only=True)
class ViewBlend(ABC):
    """The switches of camera-view blending; a subclass says how the ratio is drawn.

    Raises:
        ValueError: If a value is not one of those listed.
    """

    rotation: bool = True
    """Off: the rotation of view 1 is kept (conf/README.md, D.12); see `kept`."""
    translation: bool = True
    """Off: the centre of view 1 is kept; see `kept`."""
    ssim: bool = True
    """Off: the loss is not weighted by the similarity of the two photographs."""
    convention: Convention = "consistent"
    """``paper``: Eq. 9 to the letter, whose slerp branch gives k to view 2 (conf/README.md, D.1 and D.2)."""
    mask: Literal["and", "or"] = "and"
    """Which pixels of the mixed language map count: those where both views have a code, or where either has."""
    renormalise: bool = False
    """Whether mixed codes, which are shorter than the originals, are stretched to the original length."""
    kept: Literal["first", "nearer"] = "first"
    """Which view's rotation (or centre) is kept if it is not blended: that of view 1, or of the view with the larger weight (conf/README.md, D.12)."""
    pairs: Literal["uniform", "neighbours"] = "uniform"
    """Whether the second view of an iteration is any other, or one of the nearest (conf/README.md, D.13)."""
    neighbours: int = 4
    """How many are near, for ``pairs=neighbours``."""

    def __post_init__(self) -> None:
        who = type(self).__name__
        require_choice(who, "convention", self.convention, ("consistent", "paper"))
        require_choice(who, "mask", self.mask, ("and", "or"))
        require_choice(who, "kept", self.kept, ("first", "nearer"))
        require_choice(who, "pairs", self.pairs, ("uniform", "neighbours"))
        if self.neighbours < 1:
            raise ValueError(f"{who}: neighbours must be at least 1, got {self.neighbours}")

    @property
    def demands(self) -> Sequence[Demand]:
        """A term of the loss that looks at blended views, unless there are none."""
        why = "as no other loss looks at it; blend=none has none"
        return (Demand("a blended view", "loss", "blends", why),) if self.active else ()

    @property
    def active(self) -> bool:
        """Whether there is a blended view at all: with rotation and translation both off there is no new camera."""
        return self.rotation or self.translation

    @abstractmethod
    def draw(self, rng: np.random.Generator) -> float:
        """Return the ratio k of one pair."""


@dataclass(frozen=True)
class BetaBlend(ViewBlend):
    """k ~ Beta(alpha, alpha), the paper's choice; a small alpha stays near the real views (Table 16).

    Example:
        >>> 0 <= BetaBlend(alpha=0.2).draw(np.random.default_rng(0)) <= 1
        True
    """

    alpha: float = 0.2

    def __post_init__(self) -> None:
        super().__post_init__()
        # Farther out every draw is an end, or the middle, of [0, 1]: blend=fixed says so.
        require_range("BetaBlend", 1e-3, 1e6, alpha=self.alpha)

    def draw(self, rng: np.random.Generator) -> float:
        """Return k in [0, 1]; with alpha = 0.2, 42 % of draws are within 0.01 of an end."""
        return float(rng.beta(self.alpha, self.alpha))


@dataclass(frozen=True)
class UniformBlend(ViewBlend):
    """k ~ U(0, 1), the "even distribution" of Table 4 C."""

    def draw(self, rng: np.random.Generator) -> float:
        """Return k in [0, 1)."""
        return float(rng.uniform())


@dataclass(frozen=True)
class GaussianBlend(ViewBlend):
    """k ~ N(mean, std^2), the "Gaussian distribution" of Table 4 C, whose N(0, 1) mostly leaves [0, 1] (conf/README.md, D.14)."""

    mean: float = 0.0
    std: float = 1.0
    out_of_range: Literal["clamp", "raw", "resample"] = "clamp"
    """``raw`` extrapolates the pose and gives one view a negative weight; ``resample`` draws until k is in [0, 1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice(
            "GaussianBlend", "out_of_range", self.out_of_range, ("clamp", "raw", "resample")
        )
        # With out_of_range=raw the camera leaves the world farther out.
        require_range("GaussianBlend", -100, 100, mean=self.mean)
        require_range("GaussianBlend", 0, 100, std=self.std)
        # Farther out, or narrower, a draw inside [0, 1] is so rare that resampling might not end.
        if self.out_of_range == "resample" and not -3 * self.std <= self.mean <= 1 + 3 * self.std:
            raise ValueError(
                f"GaussianBlend: mean must be within 3 std of [0, 1] to resample, got {self.mean}, std {self.std}"
            )

    def draw(self, rng: np.random.Generator) -> float:
        """Return k, in [0, 1] unless `out_of_range` is ``raw``."""
        k = rng.normal(self.mean, self.std)
        while self.out_of_range == "resample" and not 0 <= k <= 1:
            k = rng.normal(self.mean, self.std)
        return float(np.clip(k, 0, 1) if self.out_of_range == "clamp" else k)


@dataclass(frozen=True)
class FixedBlend(ViewBlend):
    """The same k for every pair (the "fixed to" rows of Table 4 C)."""

    value: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.value <= 1:
            raise ValueError(f"FixedBlend: value must be in [0, 1], got {self.value}")

    def draw(self, rng: np.random.Generator) -> float:
        """Return the value; the generator is left as it is."""
        return self.value


@dataclass(frozen=True)
class NoBlend(ViewBlend):
    """No blended view, hence no L_b (the row without any check mark of Table 5)."""

    rotation: bool = field(default=False, init=False)
    translation: bool = field(default=False, init=False)

    def draw(self, rng: np.random.Generator) -> float:
        """Return 1: view 1 itself; the generator is left as it is."""
        return 1.0
