"""Settings of a training run, mirrored by conf/trainer."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Literal

from vlgs.values import require_range

MOST_ITERATIONS = 10**9
"""Upper limit of `iterations`, far above any useful value."""

_LANGUAGE = ("features", "indicator_logits")
_COLOR = ("quats", "log_scales", "opacity_logits", "sh0", "shN")

SMALLEST_RATE = 1e-30
"""Above 0; the decay from one rate to another would leave the range of floats beyond it."""


@dataclass(frozen=True)
class LearningRates:
    """Adam's rates per parameter (Table 7), 0 to 1; rates the paper does not give are marked. What has a rate of 0 does not learn."""

    means: float = 1.6e-4
    """Multiplied by the scene extent, decays log-linearly to `means_final` over `TrainerConfig.means_steps`."""
    means_final: float = 1.6e-6
    """3DGS's final rate; the paper is silent (conf/README.md, D.11)."""
    quats: float = 1e-3
    log_scales: float = 5e-3
    sh0: float = 5e-3
    shN: float = 2.5e-4  # noqa: N815 (gsplat's name)
    """sh0's rate / 20 as in 3DGS; the paper is silent (conf/README.md, D.7)."""
    opacity_logits: float = 5e-2
    indicator_logits: float = 5e-2
    features: float = 5e-3
    fusion: float = 1e-3
    """The paper is silent (conf/README.md, D.6)."""

    exposure: float = 1e-3
    """Of the maps of `TrainerConfig.exposure`; 3DGS's last."""

    def __post_init__(self) -> None:
        require_range("learning_rates", 0, 1, **asdict(self))
        for name, rate in asdict(self).items():
            if 0 < rate < SMALLEST_RATE:
                raise ValueError(
                    f"learning_rates: {name} must be 0 or {SMALLEST_RATE:g} to 1, got {rate}"
                )


OTHERS = 5 << 28
"""Bytes of ``frozen_budget`` that are left to photographs, Gaussians, their optimiser and libraries; a constant, and not what a process happens to
hold, so that the same views are kept everywhere. With 101 photographs of 246x182 LangSplatV2's codes and all else take 1.1e9."""


@dataclass(frozen=True)
class SkipConfig:
    """Work of an iteration that is left out; `vlgs.skips` says what each costs in accuracy."""

    blend_weight: float = 0.0
    """Blended views with lambda * SSIM(I1, I2) up to this are not rendered; negative: every one is."""
    blend_reuse: float = 0.0
    """Blended views with min(k, 1 - k) below this take the language of the real view; 0: none."""
    frozen_weights: bool = True
    """Keep the blending weights of every view when geometry and weights are frozen."""
    frozen_budget: int = 2 << 30
    """Bytes that a process which keeps the weights of views may take, everything else included (`OTHERS`)."""

    @property
    def kept_bytes(self) -> int:
        """Bytes that the kept weights of all views may take together."""
        return max(0, self.frozen_budget - OTHERS)

    def __post_init__(self) -> None:
        if not 0 <= self.blend_reuse <= 0.5:
            raise ValueError(f"skip: blend_reuse must be in [0, 0.5], got {self.blend_reuse}")
        if not -float("inf") < self.blend_weight < float("inf"):
            raise ValueError(f"skip: blend_weight must be finite, got {self.blend_weight}")
        if self.frozen_budget < 0:
            raise ValueError(f"skip: frozen_budget must be at least 0, got {self.frozen_budget}")


@dataclass(frozen=True)
class TrainerConfig:
    """Budget and schedule of a run."""

    iterations: int
    learning_rates: LearningRates
    sh_every: int = 1000
    """Iterations after which the next spherical harmonics degree joins."""
    means_steps: int | None = None
    """Iterations over which the rate of the positions decays; None: all of the run (conf/README.md, D.11)."""
    language_decay: float = 1.0
    """Share of their rates that codes and indicators have left in the end, after half a cosine over the run; 1: they stay."""
    color_decay: float = 1.0
    """The same for quats, log_scales, opacity_logits, sh0 and shN; positions have `LearningRates.means_final`."""
    average_language: float = 0.0
    """Share of the iterations, the last ones, over which codes and indicators are averaged in the end (`vlgs.training.average`); 0: their last
    values stand."""
    average_color: float = 0.0
    """The same for all else that is trained."""
    rates_for: int | None = None
    """Iterations that the rates of positions, shapes, opacities and colours are made for: in a budget of others they are sqrt(rates_for / iterations)
    times as large. None: they are as they stand."""
    half_size: float = 0.0
    """Share of the iterations, from the first, that see the training views at half their width and height (`vlgs.data.half_size`). Where shapes
    are frozen none do."""
    transmittance_min: float = 0.0
    """What lies behind so little of a pixel's light is not blended in an iteration, where that is more than `RasterConfig.transmittance_min`: what is
    rendered then is off by as much as `vlgs.skips` says of its `early_stop`. Where shapes are frozen it does not count, as with `half_size`."""
    dropout: float = 0.0
    """Share of the Gaussians that the last iteration leaves out (`vlgs.training.dropout`), were there no view; others by `dropout_at`."""
    dropout_views: int = 30
    """Training views from which on nothing is left out."""
    steps_scaler: float = 1.0
    """Factor of all that a run says in iterations, densification included (`vlgs.training.build.scaled`), but of logs and checkpoints: gsplat's."""
    log_every: int = 50
    checkpoint_every: int = 1000
    """Iterations between checkpoints; 0 writes one only at the end."""
    freeze: Sequence[str] = ()
    """Parameters of the Gaussians that keep their values, by name (`vlgs.gaussians.attributes`)."""
    exposure: bool = False
    """Whether every training photograph has a gain, white balance and offset of its own (`vlgs.training.exposure`)."""
    skip: SkipConfig = field(default_factory=SkipConfig)
    codes_apart: int = 0
    """What ``head.training.spread`` is unless given. This and the next seven belong to other parts, but whether they are the paper's goes with the budget, as all else
    that is not: those of the tables are, those for everyday use are not."""
    codes_faint: float = 0.0
    """What ``head.training.faint`` is unless given."""
    indicator_reach: float = 0.0
    """What ``indicator.reach`` is unless given, of an indicator that is trained."""
    language_weight: float = 1.0
    """What ``loss.language.weight`` is unless given, with ``loss=default``."""
    language_error: Literal["mse", "l1", "cos"] = "mse"
    """What ``loss.language.error`` is unless given, likewise."""
    language_support: float = 0.0
    """What ``loss.language.support`` is unless given, likewise."""
    best_rates_for: int = 15_000
    """What `rates_for` is with ``method=best`` unless given."""
    best_shN: float = 5e-4  # noqa: N815 (as in `LearningRates`)
    """What `LearningRates.shN` is, likewise."""

    def __post_init__(self) -> None:
        require_range("trainer", 1, MOST_ITERATIONS, iterations=self.iterations)
        if self.sh_every < 1 or self.log_every < 1 or self.checkpoint_every < 0:
            raise ValueError(
                "trainer: sh_every and log_every must be at least 1 and checkpoint_every at least 0, got "
                f"{self.sh_every}, {self.log_every}, {self.checkpoint_every}"
            )

        shares = {"language_decay": self.language_decay, "color_decay": self.color_decay}
        shares |= {"average_language": self.average_language, "average_color": self.average_color}
        require_range("trainer", 0, 1, **shares, half_size=self.half_size)
        require_range("trainer", 0, 0.9, dropout=self.dropout)
        require_range("trainer", 0, 0.1, transmittance_min=self.transmittance_min)
        require_range("trainer", 1, 10**9, dropout_views=self.dropout_views)
        require_range("trainer", 1e-4, 1e4, steps_scaler=self.steps_scaler)
        if self.means_steps is not None and self.means_steps < 1:
            raise ValueError(f"trainer: means_steps must be at least 1, got {self.means_steps}")
        if self.rates_for is not None:
            require_range("trainer", 1, MOST_ITERATIONS, rates_for=self.rates_for)

    @property
    def pace(self) -> float:
        """Factor of the rates of colour and shape: what a run of steps of random sign covers grows with the root of their number."""
        return 1.0 if self.rates_for is None else math.sqrt(self.rates_for / self.iterations)

    def means_rate(self, step: int) -> float:
        """Learning rate of positions at a step, in units of the scene extent (3DGS's log-linear decay)."""
        share = min(step / (self.means_steps or self.iterations), 1.0)
        rates = self.learning_rates
        if rates.means == 0 or rates.means_final == 0:
            rate = rates.means * (1 - share) + rates.means_final * share  # no logarithm leads to 0
        else:
            rate = rates.means * (rates.means_final / rates.means) ** share
        return self.pace * rate

    def decay(self, name: str, step: int) -> float:
        """Factor of its rate that a parameter of the Gaussians has at a step: half a cosine over the run."""
        end = (
            self.language_decay if name in _LANGUAGE else self.color_decay if name in _COLOR else 1
        )
        fallen = (1 - math.cos(math.pi * min(step / self.iterations, 1.0))) / 2
        return (self.pace if name in _COLOR else 1) * (1 + (end - 1) * fallen)

    def average(self, name: str) -> float:
        """Share of the iterations, the last ones, whose mean a parameter takes in the end; of the Gaussians' by ``splats.`` and its name."""
        language = name.removeprefix("splats.") in _LANGUAGE
        return self.average_language if language else self.average_color

    def dropout_at(self, step: int, views: int) -> float:
        """Share of the Gaussians that an iteration leaves out, with so many training views: it grows over the run, and is 0 from `dropout_views` on.

        Example:
            >>> TrainerConfig(100, LearningRates(), dropout=0.25).dropout_at(50, 6)
            0.1
        """
        return self.dropout * max(0.0, 1 - views / self.dropout_views) * step / self.iterations

    def is_half_size(self, step: int) -> bool:
        """Whether an iteration sees views at half their size."""
        return step < self.half_size * self.iterations
