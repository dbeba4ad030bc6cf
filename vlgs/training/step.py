"""One iteration up to the gradients: two real views, whatever the objectives need of them, and their terms (Eq. 12)."""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, reduce
from statistics import fmean

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vlgs.fields.splat import FusedGaussians, SplatModel, ViewRender
from vlgs.losses import masked_mse
from vlgs.objectives import Setup, StepView
from vlgs.objectives.objective import all_needs
from vlgs.objectives.targets import Target, TrainingViews, covered
from vlgs.training.cached_renders import CachedRenders, has_frozen_shape
from vlgs.training.dropout import leave_out
from vlgs.training.exposure import Exposure
from vlgs.training.settings import TrainerConfig
from vlgs.types import Camera, RasterConfig

COLOR = frozenset({"color"})


@dataclass
class StepReport:
    """What the last iteration did, for callbacks."""

    step: int = -1
    views: tuple[str, ...] = ()
    renders: tuple[ViewRender, ...] = ()
    """The real views only, without their graph, which holds the tile lists of all views: the next step makes its own."""
    screen_gradients: tuple[Float[Tensor, "n 2"], ...] = ()
    """Gradients of the screen positions per real view, which feed densification; empty where positions are frozen."""
    loss: float = math.nan
    log: Mapping[str, float] = field(default_factory=dict)
    """What objectives say: ``blend_weight`` is lambda * SSIM(I1, I2) of Eq. 11, absent where no blended view counted."""
    photographs: tuple[Float[Tensor, "h w 3"], ...] = ()
    cameras: tuple[Camera, ...] = ()
    """Of the real views, in the size that was rendered."""

    @cached_property
    @torch.no_grad()
    def color_mse(self) -> float:
        """Mean squared error of colour over both views; NaN without colour. Computed when it is asked for."""
        pairs = zip(self.renders, self.photographs, strict=True)
        errors = [masked_mse(r.color, image).item() for r, image in pairs if r.color is not None]
        return fmean(errors) if errors else math.nan


@dataclass(frozen=True)
class Forward:
    """An iteration before its gradients."""

    seen: StepView
    total: Float[Tensor, ""]
    color: Float[Tensor, ""]
    """The part of it that comes from colour alone."""
    terms: Mapping[str, Float[Tensor, ""]]
    """By the names that objectives give them."""


@dataclass
class TrainingStep:
    """What is computed in an iteration; it holds no state of its own.

    Args:
        model: What is trained.
        setup: What it learns from, and the terms of the loss, which are bound to it.
        densify_on_color: Whether densification goes by the gradients of colour's objectives alone.
        exposure: A map of colour per photograph, or None.
        frozen: Renders from kept weights where shapes and weights are frozen, or None.
        settings: Which iterations see views at half their size, what share of the Gaussians they leave out, and where they stop to blend.
    """

    model: SplatModel
    setup: Setup
    densify_on_color: bool
    exposure: Exposure | None
    frozen: CachedRenders | None
    settings: TrainerConfig

    def __post_init__(self) -> None:
        self.bound = self.setup
        """What the objectives look at."""

    def views(self, step: int) -> TrainingViews:
        """What an iteration sees; where that is of another size than before, objectives are shown it, and what the other size kept is given up."""
        small = self.settings.is_half_size(step) and not has_frozen_shape(self.model)
        if small != (self.bound is not self.setup):
            whole = self.setup
            self.bound = replace(whole, views=whole.views.at_half_size()) if small else whole
            for objective in self.bound.objectives.values():
                objective.bind(self.bound)
        return self.bound.views

    def leave_out(self, masks: Bool[Tensor, " m"]) -> None:
        """Learn nothing more from these masks, in views of either size."""
        for views in {self.setup.views, self.bound.views}:
            views.leave_out(masks)

    @cached_property
    def needs(self) -> frozenset[str]:
        """What is rendered of the real views."""
        return all_needs(list(self.setup.objectives.values()))

    def forward(self, step: int) -> Forward:
        """Render and judge; fusion runs once for all views."""
        pair = self.setup.views.sampler.pair(step)
        views = self.views(step)
        targets = (views[pair[0]], views[pair[1]])
        fused = self._fuse(step)
        first, second = (
            self._exposed(index, self.render(index, target, fused))
            for index, target in zip(pair, targets, strict=True)
        )
        again = partial(self.model.render, fused=fused, raster=self._raster)
        seen = StepView(step, pair, targets, (first, second), fused, again)
        terms: dict[str, Tensor] = {}
        of_color: list[Tensor] = []
        for objective in self.setup.objectives.values():
            own = objective(seen)
            if objective.needs == COLOR:
                of_color += own.values()
            terms |= own
        return Forward(seen, _sum(terms.values()), _sum(of_color), terms)

    def backward(self, forward: Forward) -> tuple[Float[Tensor, "n 2"], ...]:
        """Gradients of everything; returns those of the screen positions, per view, that feed densification."""
        screen = [render.mean2d for render in forward.seen.renders]
        if not forward.total.requires_grad:  # nothing that is trained is in view, or no view counts
            return tuple(torch.zeros_like(mean2d) for mean2d in screen)
        if not all(mean2d.requires_grad for mean2d in screen):  # frozen, hence no densification
            forward.total.backward()
            return ()
        if self.densify_on_color and forward.color.requires_grad:
            color = torch.autograd.grad(forward.color, screen, retain_graph=True)
            forward.total.backward()
            return color
        forward.total.backward()
        return tuple(
            mean2d.grad if mean2d.grad is not None else torch.zeros_like(mean2d)
            for mean2d in screen
        )

    def render(self, index: int, target: Target, fused: FusedGaussians) -> ViewRender:
        """A training view in all that is needed of it; a view without language in colour alone."""
        color, further = "color" in self.needs, self._further
        language = ("feature" in self.needs and target.has_language) or not (color or further)
        camera = target.view.camera
        if self.frozen is not None and not further:
            kept = self.frozen.render(index, camera, color, language, fused)
            if kept is not None:
                return kept
        render = self.model.render(camera, color, language, fused, further, self._raster)
        if render.mean2d.requires_grad:
            render.mean2d.retain_grad()
        return render

    @torch.no_grad()
    def color_error(self, index: int, step: int, fused: FusedGaussians) -> Float[Tensor, "h w"]:
        """Mean absolute error of a training view's colours, in the size that an iteration sees; 0 where its photograph shows nothing."""
        target = self.views(step)[index]
        render = self._exposed(index, self.model.render(target.view.camera, True, False, fused))
        assert render.color is not None
        error = (render.color - target.image).abs().mean(dim=-1)
        seen = covered(target.view)
        return error if seen is None else error * seen

    def trained(self) -> Iterator[tuple[str, nn.Parameter]]:
        """What an iteration can move, by name: not a head that was fitted before."""
        for name, parameter in self.model.splats.items():
            yield f"splats.{name}", parameter
        for name, part in self.modules().items():
            yield from part.named_parameters(name)

    def modules(self) -> dict[str, nn.Module]:
        """What is trained beside the Gaussians, by the names of the optimiser's groups."""
        trained = self.setup.views.has_language and self.model.head.learning_rate is not None
        head = self.model.head if trained else None
        named = {"fusion": self.model.fusion, "head": head, "exposure": self.exposure}
        named |= {f"loss.{name}": objective for name, objective in self.setup.objectives.items()}
        return {
            name: part
            for name, part in named.items()
            if isinstance(part, nn.Module) and next(part.parameters(), None) is not None
        }

    @cached_property
    def _raster(self) -> RasterConfig:
        """The constants of the model, or an earlier stop; where shapes are frozen those of the model, as kept weights have them."""
        raster = self.model.raster
        if has_frozen_shape(self.model):
            return raster
        least = max(raster.transmittance_min, self.settings.transmittance_min)
        return replace(raster, transmittance_min=least)

    @cached_property
    def _further(self) -> tuple[str, ...]:
        """Attributes beside colour and language that objectives need rendered."""
        return tuple(sorted(self.needs - {"color", "feature"}))

    def _fuse(self, step: int) -> FusedGaussians:
        """What the views of an iteration share; where no shape is learned it is all Gaussians, as what is kept of them."""
        fused, sampler = self.model.fuse(), self.setup.views.sampler
        share = self.settings.dropout_at(step, len(sampler.sizes))
        if share == 0 or has_frozen_shape(self.model):
            return fused
        return leave_out(fused, share, sampler.dropout_rng(step))

    def _exposed(self, index: int, render: ViewRender) -> ViewRender:
        if self.exposure is None or render.color is None:
            return render
        return replace(render, color=self.exposure(index, render.color))


def _sum(terms: Collection[Float[Tensor, ""]]) -> Float[Tensor, ""]:
    """In their order; zero without any."""
    first, *others = terms or (torch.zeros(()),)
    return reduce(torch.add, others, first)
