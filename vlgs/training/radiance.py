"""The stage that trains a radiance field on photographs, along rays (`vlgs.fields.radiance`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from vlgs.demands import Demand
from vlgs.fields.nerf import NerfField
from vlgs.fields.radiance import Frame, RadianceConfig, RadianceField
from vlgs.fields.rays import Spacing, spread
from vlgs.geometry import camera_center
from vlgs.training.fit_learner import train_learner
from vlgs.training.learner import Descent, Learner, generator_of
from vlgs.training.ray_bank import RayBank, pixels_of
from vlgs.training.separate import without_language
from vlgs.training.settings import TrainerConfig
from vlgs.training.stages import Progress
from vlgs.training.workshop import Workshop
from vlgs.types import Scene
from vlgs.values import require_fields, require_range

_FIELD = "a radiance field"
NO_GAUSSIANS = (
    *(
        Demand(_FIELD, group, "untrained", "as there are no Gaussians that it could act on")
        for group in ("fusion", "indicator", "head")
    ),
    Demand(
        _FIELD, "augment", "as_photographed", "as there are no Gaussians to render further views"
    ),
    Demand(_FIELD, "levels", "one_model", "as there is one field for all mask levels"),
)
"""What stages without Gaussians ask of the axes."""

_SHARE = 64
"""A draw has at most one in so many pixels of a scene, so that tiny scenes are trained in no time."""


@dataclass(frozen=True)
class TrainRadiance:
    """Trains a radiance field on colour: one model, whatever the mask levels.

    Raises:
        ValueError: If a number is out of range.
    """

    demands: ClassVar[Sequence[Demand]] = NO_GAUSSIANS
    without_gaussians: ClassVar[bool] = True
    name: str = "radiance"
    """Of the sub-folder."""
    radiance: RadianceConfig = field(default_factory=RadianceConfig)
    descent: Descent = field(default_factory=lambda: Descent("adam", 1e-2, 3e-4, beta2=0.99))
    rays: int = 1024
    """In a draw."""
    batches: int = 3
    """Draws in an iteration of ``trainer.iterations``."""
    spread: float = 1e-3
    """Weight of the distortion loss, which gathers what a ray sees in one place."""

    def __post_init__(self) -> None:
        require_fields("radiance", self)
        require_range("radiance", 1, 1 << 20, rays=self.rays, batches=self.batches)
        require_range("radiance", 0, 1e6, spread=self.spread)

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """See `vlgs.training.stages.Stage`."""
        scene = without_language(next(iter(progress.scenes.values())))
        settings = workshop.make_parts().trainer
        learner = RadianceLearner(scene, self, settings, workshop.seed)
        made = NerfField(learner.model)
        train_learner(workshop, self.name, learner, made)
        return progress.having(self.name, {None: made})


class RadianceLearner(Learner):
    """A radiance field that learns the colours of rays.

    Args:
        scene: With at least one training view.
        stage: How.
        settings: Budget.
        seed: Of all draws.

    Raises:
        ValueError: If the scene has no training view.
    """

    model: RadianceField

    def __init__(
        self, scene: Scene, stage: TrainRadiance, settings: TrainerConfig, seed: int
    ) -> None:
        if not scene.train:
            raise ValueError(f"train: training views of {scene.name} must be at least 1, got 0")
        frame = frame_of(scene)
        model = RadianceField(stage.radiance, frame, generator_of(seed))
        model.expect((scene.points - frame.center) * frame.scale)
        super().__init__(model, settings, stage.descent, seed, stage.batches)
        self.bank = RayBank(scene.train, scene.points)
        self.colors = pixels_of(scene.train)
        self.rays = rays_in(self.bank, stage.rays)
        self.spread = stage.spread
        self._mse = torch.nan

    @property
    def mse(self) -> float:
        """See `Learner`."""
        return self._mse

    def terms(self, draw: int, generator: torch.Generator) -> Mapping[str, Tensor]:
        """Squared error of colour, and how far what a ray sees is spread."""
        drawn = self.bank.draw(self.rays, generator)
        rays = self.model.frame.inside(drawn.rays)
        samples = self.model.sample(rays, generator)
        color, weights, density = self.model(rays, samples)
        self.model.keep(samples, density.detach())
        error = (color - self.colors[drawn.pixels] / 255).square().mean()
        self._mse = error.item()
        return {"photometric": error, "spread": self.spread * spread(samples.edges, weights)}


def rays_in(bank: RayBank, most: int) -> int:
    """Rays of a draw."""
    return min(most, max(1, bank.count // _SHARE))


def frame_of(scene: Scene) -> Frame:
    """Puts what the cameras look at into the unit ball: its centre is the point that their axes pass nearest to, its radius their median distance.

    Nothing is looked for much nearer to a camera than the nearest sparse point, or beyond the horizon of the farthest ones.
    """
    viewmats = torch.stack([view.camera.viewmat for view in scene.train]).double()
    centers, axes = camera_center(viewmats), viewmats[:, 2, :3]
    points = scene.points.double() if len(scene.points) else centers
    # Where the axes are parallel, or one, the points decide.
    across = torch.eye(3, dtype=torch.double) - axes[:, :, None] * axes[:, None]
    matrix = across.sum(0) + 1e-3 * torch.eye(3, dtype=torch.double)
    target = (across @ centers[:, :, None]).sum(0)[:, 0] + 1e-3 * points.mean(0)
    center = torch.linalg.solve(matrix, target)
    radius = (centers - center).norm(dim=1).median().clamp_min(1e-6)
    near, far = 0.05, 2.0
    if len(scene.points):
        distances = torch.cdist(centers, points) / radius
        near = 0.5 * distances.min().clamp(1e-3, 1).item()
        far = 1.1 * distances.median(dim=0).values.quantile(0.95).clamp_min(2 * near).item()
    return Frame(center.float(), 1 / radius.item(), Spacing(near, far), scene.points)
