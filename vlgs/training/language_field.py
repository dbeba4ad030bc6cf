"""The stage that trains a language field over a finished radiance field: LERF's, and OpenNeRF's, which has no scale."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import huber_loss

from vlgs.demands import Demand
from vlgs.fields import Field
from vlgs.fields.language_field import LanguageConfig, LanguageField
from vlgs.fields.nerf import NerfField, along
from vlgs.fields.radiance import RadianceField
from vlgs.queries.relevancy import CANONICAL_NEGATIVES
from vlgs.training.fit_learner import train_learner
from vlgs.training.learner import Descent, Learner, generator_of
from vlgs.training.radiance import NO_GAUSSIANS, rays_in
from vlgs.training.ray_bank import RayBank
from vlgs.training.second_map import SecondMap
from vlgs.training.settings import TrainerConfig
from vlgs.training.stages import Progress
from vlgs.training.workshop import Workshop
from vlgs.types import Scene
from vlgs.values import require_fields, require_range

HUBER = 1.25
"""LERF's delta. Unit vectors differ by less in nearly every number, so that this is half of the squared error."""


@dataclass(frozen=True)
class TrainLanguageField:
    """Trains hash grids and a network on the masks of a scene, over a radiance field that stays as it is.

    In the released LERF both are trained at once, but no gradient of language reaches the radiance field there either.

    Raises:
        ValueError: If a number is out of range.
    """

    demands: ClassVar[Sequence[Demand]] = NO_GAUSSIANS
    without_gaussians: ClassVar[bool] = True
    start: str
    """The earlier stage that made the radiance field."""
    name: str = ""
    """Of the sub-folder; empty for the folder of the run, or of the mask level."""
    network: LanguageConfig = field(default_factory=LanguageConfig)
    descent: Descent = field(
        default_factory=lambda: Descent("radam", 1e-2, 1e-3, over=4000, decay=1e-9)
    )
    rays: int = 1024
    """In a draw."""
    batches: int = 1
    """Draws in an iteration of ``trainer.iterations``."""
    samples: int = 4
    """Of a ray, how many with the largest weights are asked for their features."""
    weight: float = 0.1
    """Of the loss of embeddings; that of the second map counts whole."""
    second: SecondMap | None = None
    """What stands in DINO's place: a map that the same features are to give too, so that they change where it does; None: nothing."""
    scales: int = 6
    """At how many physical scales a word is asked, among those that masks have; LERF asks at 30."""
    relevancy_at: float | None = None
    """The one physical scale at which words are asked, in place of a search."""

    def __post_init__(self) -> None:
        require_fields("language field", self)
        require_range("language field", 1, 1 << 20, rays=self.rays, batches=self.batches)
        require_range("language field", 1, 4096, samples=self.samples, scales=self.scales)
        require_range("language field", 0, 1e6, weight=self.weight, relevancy_at=self.relevancy_at)

    def require(self, scenes: Mapping[int | None, Scene]) -> None:
        """Refuse scenes without the second maps that were asked for, before anything is trained."""
        for scene in scenes.values():
            if self.second is not None and len(scene.mask_vectors):
                self.second.require(scene)

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """See `vlgs.training.stages.Stage`. A mask level without a single mask has colour alone."""
        models: dict[int | None, Field] = {}
        for level, scene in progress.scenes.items():
            start = progress.model(self.start, level)
            if not isinstance(start, NerfField):
                raise ValueError(f"stages: {self.start!r} must make a radiance field, got another")
            models[level] = start
            if len(scene.mask_vectors):
                folder = progress.folder(level, self.name)
                models[level] = self._train(folder, scene, start.radiance, workshop)
        return progress.having(self.name, models)

    def _train(
        self, folder: str, scene: Scene, radiance: RadianceField, workshop: Workshop
    ) -> NerfField:
        settings = workshop.make_parts().trainer
        learner = LanguageLearner(scene, radiance, self, settings, workshop.seed)
        made = NerfField(
            radiance, learner.model, self.samples, self._asked_at(learner), negatives_of(scene)
        )
        train_learner(workshop, folder, learner, made)
        return made

    def _asked_at(self, learner: "LanguageLearner") -> list[float]:
        if not self.network.scaled:
            return []
        if self.relevancy_at is not None:
            return [self.relevancy_at]
        return torch.linspace(*learner.scale_range(), self.scales).tolist()


class LanguageLearner(Learner):
    """A language field that learns the vectors of masks.

    A tile pyramid teaches the released LERF: a ray has the embedding of a tile around it at a random scale. Here a ray has the vector of
    its mask, at a random level where there are several, and the side of a square as large as the mask stands for that of a tile.

    Args:
        scene: With masks.
        radiance: Trained; stays as it is.
        stage: How.
        settings: Budget.
        seed: Of all draws.
    """

    model: LanguageField

    def __init__(
        self,
        scene: Scene,
        radiance: RadianceField,
        stage: TrainLanguageField,
        settings: TrainerConfig,
        seed: int,
    ) -> None:
        width = scene.mask_vectors.shape[1]
        second = 0 if stage.second is None else stage.second.require(scene)
        model = LanguageField(stage.network, width, second, generator_of(seed))
        super().__init__(model, settings, stage.descent, seed, stage.batches)
        self.radiance = [radiance]  # in a list, so that it is no part of this module
        self.vectors = scene.mask_vectors
        self.bank = RayBank(scene.train, scene.points)
        self.rows = rows_of(scene)
        self.sides = mask_sides(self.rows, len(scene.mask_vectors))
        self.stage = stage
        self.rays = rays_in(self.bank, stage.rays)
        self.low = None
        if stage.second is not None:
            self.low = torch.cat([stage.second.read(v).flatten(0, 1).half() for v in scene.train])

    def terms(self, draw: int, generator: torch.Generator) -> Mapping[str, Tensor]:
        """Huber's loss between the embeddings of rays and the vectors of their masks, and the squared error of the second map."""
        features, scale, rows, pixels = self._look(self.rays, generator)
        seen = rows >= 0
        embeddings = self.model.embed(features[seen], scale[seen])
        terms = {"language": self.stage.weight * huber(embeddings, self.vectors[rows[seen]])}
        if self.low is not None:
            error = self.model.low(features) - self.low[pixels]
            terms["second"] = error.square().sum(-1).mean()
        return terms

    @torch.no_grad()
    def scale_range(self) -> tuple[float, float]:
        """The physical scales between which nearly all masks of a sample of rays are."""
        _, scale, rows, _ = self._look(4096, generator_of(self.seed, 0, 1))
        known = scale[rows >= 0]
        if not len(known):
            return 0.0, 0.0
        low, high = known.quantile(torch.tensor([0.05, 0.95])).tolist()
        return low, high

    def _look(self, rays: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Features, physical scales, masks and pixels of random rays."""
        radiance, drawn = self.radiance[0], self.bank.draw(rays, generator)
        level = torch.randint(self.rows.shape[1], drawn.pixels.shape, generator=generator)
        rows = self.rows[drawn.pixels, level].long()
        with torch.no_grad():
            samples = radiance.sample(radiance.frame.inside(drawn.rays), generator)
            weights = radiance.weights(samples)
        features, distance = along(self.model, samples, weights, self.stage.samples)
        scale = self.sides[rows] * distance / self.bank.K[drawn.views, 0, 0]
        return features, scale, rows, drawn.pixels


def huber(embeddings: Float[Tensor, "n e"], vectors: Float[Tensor, "n e"]) -> Float[Tensor, ""]:
    """Huber's loss, summed over the numbers of an embedding; the mean over pixels, and 0 of none."""
    loss = huber_loss(embeddings, vectors, delta=HUBER, reduction="sum")
    return loss / max(1, len(embeddings))


def rows_of(scene: Scene) -> Int[Tensor, "p levels"]:
    """Masks of all training views, as `RayBank` counts their pixels; -1 for none."""
    parts = []
    for view in scene.train:
        pixels = view.camera.width * view.camera.height
        rows = None if view.read_masks is None else view.read_masks().reshape(pixels, -1)
        none = torch.full((pixels, scene.mask_levels), -1, dtype=torch.int32)
        parts.append(none if rows is None else rows)
    return torch.cat(parts)


def mask_sides(rows: Int[Tensor, "p levels"], count: int) -> Float[Tensor, " m"]:
    """Side of a square as large as each mask, in pixels; the last one, of no mask, is 0."""
    found = rows.flatten()[rows.flatten() >= 0]
    areas = torch.bincount(found, minlength=count + 1)
    return areas.float().sqrt()


def negatives_of(scene: Scene) -> Float[Tensor, "m e"] | None:
    """Vectors of LERF's negatives, where the scene's vocabulary has them all."""
    known = scene.vocabulary
    if known is None or not set(CANONICAL_NEGATIVES) <= set(known.names):
        return None
    return known.vectors[[known.names.index(word) for word in CANONICAL_NEGATIVES]]
