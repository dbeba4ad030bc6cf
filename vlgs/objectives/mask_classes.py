"""Gaussian Grouping's two terms of language (Ye et al., ECCV 2024): which object a pixel is of, and agreement of neighbours in space."""

import math
from collections.abc import Sequence
from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import cross_entropy, embedding

from vlgs.demands import Demand
from vlgs.gaussians.init import seeded_generator
from vlgs.heads.classifier import Classifier
from vlgs.objectives.objective import Objective, Setup, StepView
from vlgs.values import require_choice, require_range

SURE = 1e-10
"""Added to probabilities before their logarithm is taken, as in the released code."""


def _demand(name: str) -> Sequence[Demand]:
    return (Demand(f"loss.{name}", "head", "classifies", "as it looks at probabilities of masks"),)


class MaskClasses(Objective):
    """Cross-entropy of the rendered codes' classes and the masks of a view, divided by the logarithm of the number of classes.

    Args:
        unmasked: Pixels without a mask. ``nothing``: they are a class of their own, as in the released code; ``ignored``: they do not count.

    Raises:
        ValueError: If there is no such choice.
    """

    demands: ClassVar[Sequence[Demand]] = _demand("mask_classes")
    needs = frozenset({"feature"})

    def __init__(self, unmasked: Literal["nothing", "ignored"] = "nothing") -> None:
        require_choice("mask classes", "unmasked", unmasked, ("nothing", "ignored"))
        self.unmasked = unmasked

    def bind(self, setup: Setup) -> None:
        """See `Objective`."""
        self.head = _classifier(setup)

    def __call__(self, step: StepView) -> dict[str, Float[Tensor, ""]]:
        """One for each view that has masks."""
        terms: dict[str, Tensor] = {}
        for place, _, feature, target in step.with_language():
            codes = feature.view(*target.masks.shape, -1)
            terms[f"classes {place}"] = self.of(codes, target.masks)
        return terms

    def of(self, codes: Float[Tensor, "*b d"], masks: Int[Tensor, "*b"]) -> Float[Tensor, ""]:
        """The term of some codes and the rows of their masks, -1 where there is none."""
        if self.unmasked == "ignored":
            codes, masks = codes[masks >= 0], masks[masks >= 0]
        if masks.numel() == 0:
            return codes.sum() * 0
        classes = self.head.classes
        wanted = torch.where(masks >= 0, masks, classes - 1).long()
        error = cross_entropy(self.head.logits(codes).flatten(0, -2), wanted.flatten())
        return error / math.log(classes)


class NeighbourClasses(Objective):
    """Gaussians that are near each other in space should be of one class, also where no view sees them.

    ``weight / classes * mean KL(p_i || p_j)`` over the `neighbours` nearest others j of `samples` drawn Gaussians i. Positions are not moved by it.

    Args:
        weight: Of the term.
        every: Iterations from one to the next.
        samples: Gaussians that are drawn.
        neighbours: Of each of them.
        among: Gaussians that are drawn from; of more, so many are chosen at random.

    Raises:
        ValueError: If the weight is negative or not finite, or a number is not positive.
    """

    demands: ClassVar[Sequence[Demand]] = _demand("neighbour_classes")

    def __init__(
        self,
        weight: float = 2.0,
        every: int = 5,
        samples: int = 1000,
        neighbours: int = 5,
        among: int = 200_000,
    ) -> None:
        require_range("neighbour classes", 0, 1e6, weight=weight)
        require_range("neighbour classes", 1, 10**9, every=every, samples=samples, among=among)
        require_range("neighbour classes", 1, 1000, neighbours=neighbours)
        self.weight = weight
        self.every = every
        self.samples = samples
        self.neighbours = neighbours
        self.among = among

    def bind(self, setup: Setup) -> None:
        """See `Objective`."""
        self.head = _classifier(setup)
        self.seed = setup.views.sampler.seed
        self.has_language = setup.views.has_language

    def __call__(self, step: StepView) -> dict[str, Float[Tensor, ""]]:
        """One term in every `every`-th iteration."""
        if not self.has_language or step.step % self.every:
            return {}
        drawn, near = self.draw(step.fused.gaussians.means.detach(), step.step)
        if near.numel() == 0:
            return {}
        # By index several threads would sum the gradient of a neighbour of many in any order.
        own, others = (
            embedding(rows, step.fused.feature).unflatten(-1, (-1, self.head.dim))
            for rows in (drawn, near)
        )
        return {"neighbours": self.of(own, others)}

    def draw(
        self, means: Float[Tensor, "n 3"], step: int
    ) -> tuple[Int[Tensor, " s"], Int[Tensor, "s k"]]:
        """The Gaussians of an iteration, a function of seed and step, and the nearest others of each, nearest first."""
        generator = seeded_generator("neighbours", self.seed, step)
        chosen = torch.randperm(len(means), generator=generator)[: self.among]
        count = min(self.neighbours, len(chosen) - 1)
        drawn = chosen[: self.samples]
        if count < 1:
            return drawn, drawn.new_zeros(len(drawn), 0)
        places = means[chosen].double().numpy()
        near = torch.from_numpy(KDTree(places).query(places[: len(drawn)], k=count + 1)[1])
        itself = near == torch.arange(len(drawn))[:, None]
        itself[:, -1] |= ~itself.any(dim=1)  # crowded out by others in its place
        return drawn, chosen[near[~itself].view(len(drawn), count)]

    def of(
        self, codes: Float[Tensor, "s levels d"], near: Float[Tensor, "s k levels d"]
    ) -> Float[Tensor, ""]:
        """The term of codes and those of their neighbours."""
        # The gradient of softmax has other bits on more threads.
        own = self.head.logits(codes).log_softmax(dim=-1).exp()[:, None]
        others = self.head.logits(near).log_softmax(dim=-1).exp()
        divergence = (own * ((own + SURE).log() - (others + SURE).log())).sum(dim=-1)
        return self.weight / self.head.classes * divergence.mean()


def _classifier(setup: Setup) -> Classifier:
    """The head of the model.

    Raises:
        ValueError: If it is another one.
    """
    head = setup.model.head
    if not isinstance(head, Classifier):
        raise ValueError(f"mask classes: head must be classifier, got {type(head).__name__}")
    return head
