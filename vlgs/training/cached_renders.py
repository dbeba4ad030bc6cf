"""Training with frozen geometry: everything about a view that stays constant is computed once."""

import logging
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields.cached_weights import CachedViews
from vlgs.fields.splat import FusedGaussians, SplatModel, ViewRender
from vlgs.ops.cached_weights import CachedView, weights_bytes
from vlgs.skip_count import SkipCount
from vlgs.types import Camera, Covariance

log = logging.getLogger(__name__)


def freeze(model: SplatModel, names: tuple[str, ...], densify_stop: int) -> None:
    """Turn off the gradients of the parameters that are to be kept.

    Raises:
        ValueError: If a name is unknown, or Gaussians would still multiply and die, or their weights be reset.
    """
    unknown = sorted(set(names) - set(model.splats))
    if unknown:
        raise ValueError(
            f"train: trainer.freeze must name some of {', '.join(model.splats)}, got {unknown}"
        )
    if names and densify_stop > 0:
        raise ValueError(
            "train: gaussians.densify.stop must be 0 where trainer.freeze keeps parameters, or densification moves "
            f"them, got {densify_stop}"
        )
    for name in names:
        model.splats[name].requires_grad_(False)


def has_frozen_shape(model: SplatModel) -> bool:
    """Whether positions, rotations and scales keep their values."""
    shape = ("position", "rotation", "scale")
    rows = (row.name for row in model.attributes.values() if row.role in shape)
    return not any(model.splats[name].requires_grad for name in rows)


class CachedRenders:
    """Renders the training views from kept blending weights, as far as these are constant.

    Args:
        model: Whose means, quats and scales do not change.
        cameras: Of the training views. Weights of the first ones are kept, as far as the budget goes: which ones does not depend on the order in
            which they come, so that a resumed run has the bits of one that was not interrupted.
        budget: Bytes for the weights of all views.
        counts: Where work done and left out is counted.
    """

    def __init__(
        self, model: SplatModel, cameras: Sequence[Camera], budget: int, counts: SkipCount
    ) -> None:
        self.model = model
        self.cameras = cameras
        self.views = CachedViews(budget)
        self._left = budget
        self._first: dict[str, int] = {}
        self.counts = counts
        self._colors: dict[int, Tensor] = {}

    def render(
        self, index: int, camera: Camera, color: bool, language: bool, fused: FusedGaussians
    ) -> ViewRender | None:
        """A training view in colour, in language or in both; None where it must be rendered in full."""
        opacities, weight = fused.gaussians.opacities, fused.language_weight
        if (color and opacities.requires_grad) or (language and weight.requires_grad):
            return None
        if language and weight.dim() == 2:  # as many views as there are indicators
            return None
        shape = Covariance(fused.gaussians.quats, fused.gaussians.scales)
        own = fused.gaussians.language_shape
        one = weight is opacities and own is None
        by_color = by_language = None
        if color or one:
            by_color = self._view((index, "opacity"), camera, opacities, shape, fused)
        if language:
            by_language = by_color
            if not one:
                kept = (index, "language")
                by_language = self._view(kept, camera, weight, own or shape, fused)
        if (color and by_color is None) or (language and by_language is None):
            return None
        seen = [view for view in (by_color, by_language) if view is not None]
        return ViewRender(
            color=self._color(index, camera, by_color, fused) if color and by_color else None,
            feature=by_language.render(fused.feature) if by_language else None,
            alpha_color=by_color.alpha if color and by_color else None,
            alpha_language=by_language.alpha if by_language else None,
            visible=seen[0].visible | seen[-1].visible,
            mean2d=seen[0].mean2d,
        )

    def _view(
        self,
        name: tuple[int, str],
        camera: Camera,
        weight: Float[Tensor, " n"],
        shape: Covariance,
        fused: FusedGaussians,
    ) -> CachedView | None:
        view = self.views.get(name)
        if view is not None:
            self.counts.skip("frozen_weights")
            return view
        index, kind = name
        if kind not in self._first:
            self._first[kind] = self._how_many(weight, shape, fused)
        if index >= self._first[kind]:
            return None
        with self.counts.doing("weights"):
            return self.views.make(
                name,
                means=fused.gaussians.means,
                quats=shape.quats,
                scales=shape.scales,
                weight=weight,
                camera=camera,
                config=self.model.raster,
            )

    def _how_many(
        self, weight: Float[Tensor, " n"], shape: Covariance, fused: FusedGaussians
    ) -> int:
        """So many views, the first ones, fit into what is left of the budget, and are taken from it."""
        means, raster = fused.gaussians.means, self.model.raster
        for index, camera in enumerate(self.cameras):
            size = weights_bytes(means, shape.quats, shape.scales, weight, camera, raster)
            if size > self._left:
                log.info(
                    "frozen weights: of %d of %d views, others are rendered in full (trainer.skip.frozen_budget)",
                    index, len(self.cameras),
                )  # fmt: skip
                return index
            self._left -= size
        return len(self.cameras)

    def _color(
        self, index: int, camera: Camera, view: CachedView, fused: FusedGaussians
    ) -> Float[Tensor, "h w 3"]:
        """The colour image; kept too where nothing that it depends on is trained."""
        if index in self._colors:
            self.counts.skip("frozen_color")
            return self._colors[index]
        values = self.model.view_color(fused, camera)
        if values.requires_grad:
            return view.render(values)
        with self.counts.doing("color render"), torch.no_grad():
            self._colors[index] = view.render(values)
        return self._colors[index]
