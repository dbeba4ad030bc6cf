"""Settings of a training run, mirrored by conf/trainer."""

from dataclasses import dataclass


@dataclass(frozen=True)
class LearningRates:
    """Adam's rates per parameter (tab:lr); rates the paper does not give are marked."""

    means: float = 1.6e-4
    """Multiplied by the scene extent, decays log-linearly to `means_final` over the run."""
    means_final: float = 1.6e-6
    """3DGS's final rate; the paper is silent (systems.md D.11)."""
    quats: float = 1e-3
    log_scales: float = 5e-3
    sh0: float = 5e-3
    shN: float = 2.5e-4  # noqa: N815 (gsplat's name)
    """sh0's rate / 20 as in 3DGS; the paper is silent (systems.md D.7)."""
    opacity_logits: float = 5e-2
    indicator_logits: float = 5e-2
    features: float = 5e-3
    fusion: float = 1e-3
    """The paper is silent (systems.md D.6)."""


@dataclass(frozen=True)
class TrainerConfig:
    """Budget and schedule of a run."""

    iterations: int
    learning_rates: LearningRates
    sh_every: int = 1000
    """Iterations after which the next spherical harmonics degree joins."""
    log_every: int = 50
    checkpoint_every: int = 1000
    """Iterations between checkpoints; 0 writes one only at the end."""

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"trainer: iterations must be at least 1, got {self.iterations}")
        if self.sh_every < 1 or self.log_every < 1 or self.checkpoint_every < 0:
            raise ValueError(
                "trainer: sh_every and log_every must be at least 1 and checkpoint_every at least 0, got "
                f"{self.sh_every}, {self.log_every}, {self.checkpoint_every}"
            )

    def means_rate(self, step: int) -> float:
        """Learning rate of positions at a step, in units of the scene extent (3DGS's log-linear decay)."""
        share = min(step / self.iterations, 1.0)
        rates = self.learning_rates
        return rates.means * (rates.means_final / rates.means) ** share
