"""Codes that change little from place to place: the smoothness of LEGaussians (Shi et al., CVPR 2024)."""

from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn

from vlgs.heads.rows import layers
from vlgs.objectives.code_classes import require_attribute
from vlgs.objectives.objective import Objective, Setup, StepView
from vlgs.values import require_range


class SmoothCodes(nn.Module, Objective):
    """A small network learns the codes from the positions of the Gaussians, and codes are pulled to what it says.

    The network cannot follow fast changes, which is why its answer is smooth. A code is pulled the harder the less certain it is:
    with weight ``u + floor (1 - u)``. The network learns from codes that stay where they are, and the codes from an answer that
    stays; positions get no gradient.

    Args:
        dim: Width of the codes, those of all mask levels together.
        hidden: Layers of the network, each with a rectifier after it.
        width: Of these layers.
        every: Iterations between two such terms.
        floor: Pull of a code without any uncertainty.
        rate: Adam's, for the network.
        attribute: Name of the attribute that carries u (``gaussians.attributes``).

    Raises:
        ValueError: If a number is out of range.
    """

    needs = frozenset()

    def __init__(
        self,
        dim: int = 8,
        hidden: int = 4,
        width: int = 128,
        every: int = 10,
        floor: float = 0.1,
        rate: float = 1e-3,
        attribute: str = "uncertainty",
    ) -> None:
        super().__init__()
        require_range("smooth codes", 1, 65536, dim=dim, width=width)
        require_range("smooth codes", 1, 64, hidden=hidden)
        require_range("smooth codes", 1, 10**9, every=every)
        require_range("smooth codes", 0, 1, floor=floor, rate=rate)
        self.every = every
        self.floor = floor
        self.rate = rate
        self.attribute = attribute
        self.network = nn.Sequential()
        for before, after in pairwise([3, *[width] * hidden]):
            self.network.extend([nn.Linear(before, after), nn.ReLU()])
        self.network.append(nn.Linear(width, dim))

    def bind(self, setup: Setup) -> None:
        """Look for the attribute.

        Raises:
            ValueError: If Gaussians carry no such attribute.
        """
        require_attribute("smooth codes", setup, self.attribute)
        self.has_language = setup.views.has_language

    def __call__(self, step: StepView) -> dict[str, Float[Tensor, ""]]:
        """Both terms, each `every` iterations."""
        if not self.has_language or (step.step + 1) % self.every:
            return {}
        gaussians = step.fused.gaussians
        doubt = gaussians.further[self.attribute][:, 0]
        return self.terms(gaussians.means, step.fused.feature, doubt)

    def terms(
        self, means: Float[Tensor, "n 3"], codes: Float[Tensor, "n d"], doubt: Float[Tensor, " n"]
    ) -> dict[str, Float[Tensor, ""]]:
        """What the network and what the codes are told."""
        answer = layers(self.network, means.detach())
        pull = doubt.detach() + self.floor * (1 - doubt.detach())
        return {
            "smooth network": (answer - codes.detach()).square().mean(),
            "smooth codes": ((answer.detach() - codes).square().mean(dim=1) * pull).mean(),
        }
