"""The interface of an objective, and what it sees of an iteration."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from vlgs.fields.splat import FusedGaussians, SplatModel, ViewRender
from vlgs.objectives.targets import Target, TrainingViews
from vlgs.skip_count import SkipCount
from vlgs.view_blend import ViewBlend


@dataclass(frozen=True)
class Setup:
    """What objectives are told before the first iteration."""

    views: TrainingViews
    model: SplatModel
    """What is trained, with its head. Parameters of Gaussians are other tensors after each densification: see `StepView.fused`."""
    objectives: Mapping[str, "Objective"]
    """All of the run, by name."""
    blend: ViewBlend
    blend_least: float
    """`vlgs.training.settings.SkipConfig.blend_weight`."""
    blend_reuse: float
    counts: SkipCount
    """Where work that is left out is counted."""
    iterations: int = 1
    """How many there will be."""


@dataclass(frozen=True)
class StepView:
    """One iteration as an objective sees it."""

    step: int
    pair: tuple[int, int]
    """Which training views; equal where no two go together."""
    targets: tuple[Target, Target]
    """What they should look like."""
    renders: tuple[ViewRender, ViewRender]
    """What they look like, with the graph; what no objective needs is None."""
    fused: FusedGaussians
    """The Gaussians of this iteration, with the graph."""
    render: Callable[..., ViewRender]
    """Render the Gaussians of this iteration from another camera; arguments as those of `SplatModel.render`."""
    log: dict[str, float] = field(default_factory=dict)
    """Numbers for callbacks, filled by the objectives."""

    def with_language(self) -> Iterator[tuple[str, ViewRender, Float[Tensor, "h w c"], Target]]:
        """Of the real views those with codes to learn from: their place, 1 or 2, their render, the codes of it, and their target."""
        for place, render, target in zip("12", self.renders, self.targets, strict=True):
            if render.feature is not None and target.has_language:
                yield place, render, render.feature, target


class Objective(ABC):
    """One part of the loss."""

    needs: frozenset[str] = frozenset()
    """What is rendered of the real views for it: ``color``, ``feature``, names of further attributes. A view without language has no
    ``feature``."""

    @property
    def teaches_codes(self) -> bool:
        """Whether it has something to say where colour is not trained; what stages of language alone ask of a loss."""
        return "feature" in self.needs and "color" not in self.needs

    rate: float = 0.0
    """Adam's, for the parameters of an objective that is a `torch.nn.Module`."""

    def bind(self, setup: Setup) -> None:  # noqa: B027 (most need nothing)
        """Look at the scene and at the other objectives: before the first iteration, and again where the views change their size."""

    @abstractmethod
    def __call__(self, step: StepView) -> Mapping[str, Float[Tensor, ""]]:
        """The terms of an iteration, weighted; empty where nothing counts. Names are free, their sum is minimised."""


def all_needs(objectives: Sequence[Objective]) -> frozenset[str]:
    """What several objectives need together."""
    return frozenset().union(*(objective.needs for objective in objectives))
