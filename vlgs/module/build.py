"""Builds a module that is ready to train from a scene and the chosen parts."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace

from torch import Tensor

from vlgs.blend import ViewBlend
from vlgs.codec import Codec
from vlgs.codec.autoencoder import Autoencoder
from vlgs.fusion import Fusion
from vlgs.fusion.none import NoFusion
from vlgs.gaussians import GaussiansConfig, Sharing, initialise
from vlgs.gaussians.background import with_background
from vlgs.gaussians.parameters import with_language_shape, with_level_indicators
from vlgs.indicator import Indicator, PerLevel
from vlgs.interchange import load_weights, start_from
from vlgs.losses import Losses
from vlgs.module.lift import lift_features
from vlgs.module.lightning import VLGSModule
from vlgs.module.settings import TrainerConfig
from vlgs.render.model import SplatModel
from vlgs.types import RasterConfig, Scene

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Parts:
    """The chosen parts of a run; one field per configuration group."""

    gaussians: GaussiansConfig
    sharing: Sharing
    fusion: Fusion
    indicator: Indicator
    blend: ViewBlend
    codec: Codec
    loss: Losses
    raster: RasterConfig
    trainer: TrainerConfig


def build_module(
    scene: Scene,
    parts: Parts,
    seed: int,
    color: bool = True,
    start: Mapping[str, Tensor] | None = None,
) -> VLGSModule:
    """Fit the codec, place the Gaussians and put everything together.

    Args:
        scene: What is learned.
        parts: How.
        seed: Of all draws.
        color: Off: language alone.
        start: Raw parameters to start from; None: those of ``gaussians.init``, or the scene's points.

    Raises:
        ValueError: If the scene has no training view.
    """
    if not scene.train:
        raise ValueError(f"train: training views of {scene.name} must be at least 1, got 0")
    fusion, codec, config = parts.fusion, parts.codec, parts.gaussians
    if scene.mask_vectors.shape[0] > 0:
        if isinstance(codec, Autoencoder) and codec.weights is not None:
            load_weights(codec, codec.weights)
        else:
            codec.fit(scene.mask_vectors, scene.mask_areas)
    else:
        log.info("no language supervision: training colour only, without fusion or blended views")
        # Indicators that nothing trains would keep every Gaussian alive.
        fusion = NoFusion()
        config = replace(config, prune_on="opacity")
    width = codec.dim * scene.mask_levels
    if start is not None:
        parameters = dict(start)
    elif config.init is None:
        parameters = with_background(initialise(scene, config, width, seed), scene, config)
    else:
        parameters = start_from(config.init, config, width)
    language = scene.mask_vectors.shape[0] > 0
    own = language and parts.sharing.own_shape
    parameters = with_language_shape(parameters, own)
    several = isinstance(parts.indicator, PerLevel) and scene.mask_levels > 1
    parameters = with_level_indicators(parameters, scene.mask_levels if several else None)
    evaluated = config.color == "evaluated"
    model = SplatModel(parameters, fusion, parts.indicator, codec, parts.raster, 0, evaluated)
    module = VLGSModule(model, scene, parts.blend, parts.loss, config, parts.trainer, seed, color)
    if config.init_features == "lifted":
        lift_features(module)
    return module
