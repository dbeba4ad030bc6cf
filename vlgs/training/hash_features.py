"""The stage that trains a language field at the means of finished Gaussians (FMGS; Zuo et al., IJCV 2024; its released program)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize

from vlgs.demands import Demand
from vlgs.fields import Field
from vlgs.fields.cached_weights import CachedViews
from vlgs.fields.hash_splat import HashSplatField
from vlgs.fields.language_field import LanguageConfig, LanguageField
from vlgs.fields.radiance import in_cube
from vlgs.fields.splat import SplatModel
from vlgs.fields.trained import SplatField
from vlgs.geometry import resize_camera
from vlgs.ops.cached_weights import CachedView
from vlgs.ops.huber import huber_sum
from vlgs.ops.neighbours import neighbour_products
from vlgs.training.fit_learner import train_learner
from vlgs.training.language_field import HUBER
from vlgs.training.learner import Descent, Learner, generator_of
from vlgs.training.radiance import frame_of
from vlgs.training.second_map import PhotographMap, SecondMap
from vlgs.training.settings import TrainerConfig
from vlgs.training.stages import Progress
from vlgs.training.workshop import Workshop
from vlgs.types import Camera, Scene
from vlgs.values import require_fields, require_range

_WARM, _COOL = 20, 0.2
"""The loss of embeddings counts a fifth in the first twenty steps, as released."""


@dataclass(frozen=True)
class TrainHashFeatures:
    """Trains hash grids and two networks, of embeddings and of a second map, over Gaussians that stay as they are.

    Raises:
        ValueError: If a number is out of range.
    """

    demands: ClassVar[Sequence[Demand]] = tuple(
        Demand("language of hash grids", group, "untrained", "as a Gaussian has no code of its own")
        for group in ("fusion", "indicator", "head")
    )
    start: str
    """The earlier stage whose Gaussians carry it."""
    name: str = ""
    """Of the sub-folder; empty for the folder of the run, or of the mask level."""
    network: LanguageConfig = field(default_factory=lambda: LanguageConfig(scaled=False))
    descent: Descent = field(
        default_factory=lambda: Descent("radam", 5e-3, 2e-3, over=10000, decay=1e-9, clip=1.0)
    )
    second: SecondMap = field(default_factory=PhotographMap)
    """What stands in DINO's place."""
    balance: float = 0.2
    """Weight of the loss of embeddings; that of the second map has the rest."""
    alignment: float = 0.01
    """Weight of the pixel alignment loss."""
    align_from: float = 0.6
    """Share of the steps after which pixels are aligned; released: the last 1700 of 4200."""
    shrink: int = 2
    """Language is drawn at so small a part of the width and height of a photograph."""
    opaque: float = 0.0
    """Only Gaussians of more opacity learn; the paper says 0.25, the released program leaves it out."""

    def __post_init__(self) -> None:
        require_fields("hash features", self)
        require_range("hash features", 0, 1, balance=self.balance, align_from=self.align_from)
        require_range("hash features", 0, 1e6, alignment=self.alignment)
        require_range("hash features", 1, 64, shrink=self.shrink)
        require_range("hash features", 0, 0.99, opaque=self.opaque)

    def require(self, scenes: Mapping[int | None, Scene]) -> None:
        """Refuse scenes without the second maps that were asked for, before anything is trained."""
        for scene in scenes.values():
            if len(scene.mask_vectors):
                self.second.require(scene)

    def run(self, progress: Progress, workshop: Workshop) -> Progress:
        """See `vlgs.training.stages.Stage`. A mask level without a single mask has colour alone."""
        models: dict[int | None, Field] = {}
        for level, scene in progress.scenes.items():
            start = _with_codes(progress.gaussians(self.start, level))
            models[level] = SplatField(start)
            if len(scene.mask_vectors):
                learner = HashLearner(
                    scene, start, self, workshop.make_parts().trainer, workshop.seed
                )
                made = HashSplatField(SplatField(start), learner.model, learner.frame)
                train_learner(
                    workshop, progress.folder(level, self.name), learner, made, start.count
                )
                models[level] = made
        return progress.having(self.name, models)


@dataclass(frozen=True)
class _View:
    """What a training view sees, and should see, at the size at which language is drawn."""

    weights: CachedView
    """Of the Gaussians that it sees."""
    rows: Tensor
    """Which ones."""
    camera: Camera
    """At that size."""


class HashLearner(Learner):
    """A language field that learns the maps of training views through Gaussians.

    Args:
        scene: With masks.
        splats: Trained; they stay as they are.
        stage: How.
        settings: Budget.
        seed: Of all draws.

    Raises:
        ValueError: If a training view has no second map.
    """

    model: LanguageField

    def __init__(
        self,
        scene: Scene,
        splats: SplatModel,
        stage: TrainHashFeatures,
        settings: TrainerConfig,
        seed: int,
    ) -> None:
        width = scene.mask_vectors.shape[1]
        second = stage.second.require(scene)
        model = LanguageField(stage.network, width, second, generator_of(seed))
        super().__init__(model, settings, stage.descent, seed, batches=1)
        self.scene, self.stage, self.frame = scene, stage, frame_of(scene)
        self.splats = [splats]  # in a list, so that they are no part of this module
        self.places = in_cube(
            (splats.splats["means"].detach() - self.frame.center) * self.frame.scale
        )
        self.seen = [index for index, view in enumerate(scene.train) if view.read_masks is not None]
        self._views = CachedViews(settings.skip.kept_bytes)
        self._rows: dict[int, Tensor] = {}
        self._sets: dict[int, tuple[Tensor, Tensor]] = {}
        self._seconds: dict[int, Tensor] = {}
        # Now, and not when a view is first drawn: while training keeps the memory that it frees, what stays of each view would lie
        # between holes of what was needed to make it, and a hundred views would take a gigabyte more.
        for index in self.seen:
            camera = self._view(index).camera
            size = torch.Size((camera.height, camera.width))
            self._sets_of(index, size)
            self._second(index, size)

    def terms(self, draw: int, generator: torch.Generator) -> Mapping[str, Tensor]:
        """The two maps of one view, and how they agree on which neighbours are alike."""
        index = self.seen[int(torch.randint(len(self.seen), (), generator=generator))]
        view, stage = self._view(index), self.stage
        features = self.model.features(self.places[view.rows])
        values = torch.cat([self.model.embed(features), self.model.low(features)], dim=-1)
        image = view.weights.render(values)
        vectors, valid = self._vectors(index, image.shape[:2])
        embedding, low = image.split([vectors.shape[-1], image.shape[-1] - vectors.shape[-1]], -1)
        balance = stage.balance * (_COOL if draw < _WARM else 1.0)
        terms = {
            "language": balance * embedding_loss(embedding, vectors, valid),
            "second": (1 - stage.balance) * second_loss(low, self._second(index, image.shape[:2])),
        }
        if draw >= stage.align_from * self.settings.iterations and stage.alignment > 0:
            terms["alignment"] = stage.alignment * alignment_loss(embedding, low)
        return terms

    def _view(self, index: int) -> _View:
        splats, given = self.splats[0], self.scene.train[index].camera
        width, height = (max(1, n // self.stage.shrink) for n in (given.width, given.height))
        camera = resize_camera(given, width, height)
        with torch.no_grad():
            gaussians = splats.gaussians()
        weight = gaussians.opacities * (gaussians.opacities > self.stage.opaque)
        means, quats, scales = gaussians.means, gaussians.quats, gaussians.scales
        if index not in self._rows:
            whole = CachedView(means, quats, scales, weight, camera, splats.raster)
            self._rows[index] = whole.visible.nonzero()[:, 0]
        rows, view = self._rows[index], self._views.get(index)
        if view is None:
            part: dict[str, Any] = {"means": means[rows], "quats": quats[rows]}
            part |= {"scales": scales[rows], "weight": weight[rows]}
            part |= {"camera": camera, "config": splats.raster}
            # Where there is no room for them, the weights of a view are made each time.
            view = self._views.make(index, **part) or CachedView(**part)
        return _View(view, rows, camera)

    def _vectors(self, index: int, size: torch.Size) -> tuple[Tensor, Tensor]:
        """Mean vector of the masks of each pixel over the mask levels, and where there is one."""
        sets, which = self._sets_of(index, size)
        valid = sets >= 0
        vectors = (self.scene.mask_vectors[sets] * valid[..., None]).sum(1)
        means = vectors / valid.sum(1, keepdim=True).clamp_min(1)
        return means[which], valid.any(1)[which]

    def _sets_of(self, index: int, size: torch.Size) -> tuple[Tensor, Tensor]:
        """Which masks come together, one of each level, and which of these sets a pixel has: a view has some hundred."""
        if index not in self._sets:
            read = self.scene.train[index].read_masks
            assert read is not None  # `self.seen`
            rows = read()
            rows = _nearest(rows[..., None] if rows.dim() == 2 else rows, size).long()
            which = torch.zeros(size, dtype=torch.long)
            for level in rows.unbind(2):
                number = which * (len(self.scene.mask_vectors) + 1) + level + 1
                which = number.unique(return_inverse=True)[1]
            sets = rows.new_empty(int(which.max()) + 1, rows.shape[2])
            sets[which] = rows
            self._sets[index] = sets, which  # not the means: of many views they are gigabytes
        return self._sets[index]

    def _second(self, index: int, size: torch.Size) -> Float[Tensor, "h w c"]:
        if index not in self._seconds:
            target = self.stage.second.read(self.scene.train[index]).permute(2, 0, 1)[None]
            small = interpolate(target, tuple(size), mode="area")[0].permute(1, 2, 0)
            self._seconds[index] = small.half()
        return self._seconds[index].float()


def _with_codes(model: SplatModel) -> SplatModel:
    """The same model, whose Gaussians have codes again if a stage of colour alone left them out; all zero."""
    features, width = model.splats["features"], model.head.dim
    if features.shape[1] < width:
        model.splats["features"] = nn.Parameter(features.new_zeros(len(features), width), False)
        row = replace(model.attributes["features"], shape=(width,))
        model.attributes = {**model.attributes, "features": row}
    return model


def embedding_loss(
    image: Float[Tensor, "h w e"], vectors: Float[Tensor, "h w e"], valid: Bool[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """Huber's loss with delta 1.25, summed over the numbers of an embedding; the mean over pixels with a mask, and 0 without any."""
    return huber_sum(image, vectors, valid, HUBER) / valid.sum().clamp_min(1)


def second_loss(image: Float[Tensor, "h w c"], target: Float[Tensor, "h w c"]) -> Float[Tensor, ""]:
    """Squared error, summed over channels; the mean over pixels."""
    return (image - target).square().sum(-1).mean()


def alignment_loss(
    embedding: Float[Tensor, "h w e"], low: Float[Tensor, "h w c"]
) -> Float[Tensor, ""]:
    """Mean distance between the cosines of each pixel with its eight neighbours in one map and in the other, which gets no gradient."""
    return (neighbour_cosines(embedding) - neighbour_cosines(low.detach())).abs().mean()


def neighbour_cosines(image: Float[Tensor, "h w c"]) -> Float[Tensor, "8 ih iw"]:
    """Cosine of each inner pixel with its eight neighbours."""
    return neighbour_products(normalize(image, dim=-1, eps=1e-6))  # once for all pairs


def _nearest(rows: Tensor, size: torch.Size) -> Tensor:
    """A map of numbers that cannot be averaged, at another size."""
    h, w = size
    y = (torch.arange(h) + 0.5) * rows.shape[0] / h
    x = (torch.arange(w) + 0.5) * rows.shape[1] / w
    return rows[y.long()][:, x.long()]
