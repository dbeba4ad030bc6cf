"""Builds a module that is ready to train from a scene and the chosen parts."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from vlgs.data.sampler import PairSampler, nearest_views
from vlgs.demands import has
from vlgs.fields.splat import SplatModel
from vlgs.formats import load_weights, start_from
from vlgs.fusion import Fusion
from vlgs.fusion.none import NoFusion
from vlgs.gaussians import GaussiansConfig, Sharing, attributes_of, conform, initialise
from vlgs.gaussians.background import with_background
from vlgs.gaussians.in_air import near_plane
from vlgs.gaussians.init import seeded_generator
from vlgs.gaussians.sh import SH_C0
from vlgs.heads import FittedHead, Head
from vlgs.indicator import Indicator
from vlgs.objectives import Objective, Setup
from vlgs.objectives.targets import TrainingViews
from vlgs.skip_count import SkipCount
from vlgs.training.lift import lift_features
from vlgs.training.lightning import VLGSModule
from vlgs.training.settings import SkipConfig, TrainerConfig
from vlgs.types import RasterConfig, Scene
from vlgs.view_blend import ViewBlend


@dataclass(frozen=True)
class Parts:
    """The chosen parts of a run; one field per configuration group."""

    gaussians: GaussiansConfig
    sharing: Sharing
    fusion: Fusion
    indicator: Indicator
    blend: ViewBlend
    head: Head
    loss: Mapping[str, Objective]
    """Name -> objective."""
    raster: RasterConfig
    trainer: TrainerConfig

    def __post_init__(self) -> None:
        """Refuse a mean of iterations in which Gaussians come and go."""
        trainer, stop = self.trainer, self.gaussians.densify.stop
        averaged = trainer.average_language or trainer.average_color
        if averaged and stop >= trainer.iterations:
            raise ValueError(
                "trainer: average_language and average_color must have iterations after gaussians.densify.stop, "
                f"got {stop} of {trainer.iterations}; 0 turns them off"
            )


def scaled(parts: Parts, share: float, interval: bool = False) -> Parts:
    """The parts with a share of the iterations: what is said in iterations from the start shrinks or grows alike.

    Args:
        parts: The parts.
        share: Factor of the iterations.
        interval: Whether there are as many densifications as before, further apart, and not as many in a hundred iterations.
    """
    if share == 1:
        return parts
    trainer, densify = parts.trainer, parts.gaussians.densify

    def of(steps: int, least: int = 1) -> int:
        return max(least, round(steps * share))

    trainer = replace(
        trainer,
        iterations=of(trainer.iterations),
        sh_every=of(trainer.sh_every),
        means_steps=None if trainer.means_steps is None else of(trainer.means_steps),
    )
    densify = replace(
        densify,
        start=of(densify.start, 0),
        stop=of(densify.stop, 0),
        every=of(densify.every) if interval else densify.every,
        reset_every=of(densify.reset_every) if densify.reset_every else 0,
    )
    return replace(parts, trainer=trainer, gaussians=replace(parts.gaussians, densify=densify))


def build_module(
    scene: Scene,
    parts: Parts,
    seed: int,
    color: bool = True,
    start: Mapping[str, Tensor] | None = None,
    codes: bool = True,
) -> VLGSModule:
    """Fit the head, place the Gaussians and put everything together.

    Args:
        scene: What is learned.
        parts: How.
        seed: Of all draws.
        color: Off: language alone. A fusion that comes to trained Gaussians would change their colours, and still learns from both.
        start: Raw parameters to start from; None: those of ``gaussians.init``, or the scene's points.
        codes: Off: Gaussians carry a single number in place of codes that would stay zero, as a later stage gives them its own.

    Raises:
        ValueError: If the scene has no training view.
    """
    if not scene.train:
        raise ValueError(f"train: training views of {scene.name} must be at least 1, got 0")
    fusion, head, config = parts.fusion, parts.head, parts.gaussians
    if scene.mask_vectors.shape[0] > 0:
        if isinstance(head, FittedHead) and head.weights is not None:
            load_weights(head, head.weights)
        else:
            head.fit(scene.mask_vectors, scene.mask_areas)
    else:
        fusion = NoFusion()
    config = replace(config, prune_on=pruned_on(config, parts.indicator, scene, color))
    language = scene.mask_vectors.shape[0] > 0
    # Codes that come with the Gaussians or are drawn are not zero: a later stage goes on from these.
    given = config.init is not None or config.init_features == "normal"
    width = head.dim * scene.mask_levels if codes or language or given else 1
    own = language and parts.sharing.own_shape
    several = has(parts.indicator, "each_level") and scene.mask_levels > 1
    levels = scene.mask_levels if several else None
    rates = asdict(parts.trainer.learning_rates)
    attributes = attributes_of(config, width, levels, own, rates, scene.mask_levels, seed)
    if start is not None:
        parameters = conform(start, attributes)
    elif config.init is not None:
        parameters = start_from(config.init, attributes)
    else:
        first = initialise(scene, config, attributes, seed)
        parameters = with_background(first, scene, config, attributes)
    near = max(parts.raster.near, near_plane(scene, config.near_share))
    model = SplatModel(
        parameters,
        fusion,
        parts.indicator,
        head,
        replace(parts.raster, near=near),
        sh_degree=0,
        evaluated=config.color == "evaluated",
        attributes=attributes,
    )
    color = color or (start is not None and not has(fusion, "untrained"))
    objectives = {n: o for n, o in parts.loss.items() if color or "color" not in o.needs}
    if not any(language or o.needs != {"feature"} for o in objectives.values()):
        why = "" if language else ", as the scene has no language"
        raise ValueError(f"loss: there must be a term of what is trained{why}, got none")
    setup = bind(
        objectives, scene, model, parts.blend, parts.trainer.skip, seed, parts.trainer.iterations
    )
    module = VLGSModule(model, setup, config, parts.trainer, seed)
    if config.init_features == "lifted":
        lift_features(module)
    elif config.init_features == "random" and language:
        _randomise(model.splats["features"], seed)
    return module


def pruned_on(
    config: GaussiansConfig, indicator: Indicator, scene: Scene, color: bool
) -> Literal["max", "opacity", "indicator"]:
    """The weights that decide whether a Gaussian lives: those of ``gaussians.prune_on`` that are trained.

    An indicator that nothing trains stays where it starts, above the bound, and would keep every Gaussian alive.
    """
    trained = len(scene.mask_vectors) > 0 and not has(indicator, "untrained")
    return config.prune_on if trained or not color else "opacity"


@torch.no_grad()
def _randomise(features: Tensor, seed: int) -> None:
    """Draw codes as degree-0 harmonics of random colours, in place."""
    generator = seeded_generator("features", seed, 0)
    features.copy_((torch.rand(features.shape, generator=generator) - 0.5) / SH_C0)


def bind(
    objectives: Mapping[str, Objective],
    scene: Scene,
    model: SplatModel,
    blend: ViewBlend,
    skip: SkipConfig,
    seed: int,
    iterations: int = 1,
) -> Setup:
    """Show a scene to objectives, with the targets that the model's head makes of its masks."""
    cameras = [view.camera for view in scene.train]
    near = nearest_views(cameras, blend.neighbours) if blend.pairs == "neighbours" else None
    sampler = PairSampler(tuple((c.width, c.height) for c in cameras), seed, near)
    codes = torch.zeros(0, model.splats["features"].shape[1])
    if len(scene.mask_vectors) > 0:
        with torch.no_grad():
            codes = model.head.targets(scene.mask_vectors)
    counts = SkipCount()
    views = TrainingViews(scene, codes, sampler, counts)
    least, reuse = skip.blend_weight, skip.blend_reuse
    setup = Setup(views, model, objectives, blend, least, reuse, counts, iterations)
    for objective in objectives.values():
        objective.bind(setup)
    return setup
