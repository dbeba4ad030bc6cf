"""Training as one LightningModule: parameters, the step of Eq. overall, one Adam."""

import math
from dataclasses import dataclass, field

import lightning as L
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vlgs.blend import ViewBlend, blend_camera, blend_targets
from vlgs.gaussians import DensifyState, GaussiansConfig
from vlgs.geometry import scene_extent
from vlgs.losses import Losses, view_similarity
from vlgs.module.sampler import PairSampler
from vlgs.module.settings import TrainerConfig
from vlgs.render.model import FusedGaussians, SplatModel, ViewRender
from vlgs.types import Scene, View


@dataclass(frozen=True)
class Target:
    """What one training view should look like."""

    view: View
    image: Float[Tensor, "h w 3"]
    codes: Float[Tensor, "h w d"] | None
    valid: Bool[Tensor, "h w"] | None
    """Pixels with a mask; None like `codes` where the view has no language."""


@dataclass
class StepReport:
    """What the last iteration saw; callbacks read it, nothing is computed for it."""

    step: int = -1
    views: tuple[str, ...] = ()
    renders: tuple[ViewRender, ...] = ()
    """The real views only; their `mean2d.grad` feeds densification."""
    loss: float = math.nan
    color_mse: float = math.nan
    blend_weight: float = 0.0
    """lambda * SSIM(I1, I2) of Eq. blend; 0 where the blended view was not rendered."""


@dataclass
class SkipCount:
    """Work that an iteration did not need, and how often."""

    blends_done: int = 0
    blends_without_weight: int = 0
    """Blended views not rendered because SSIM(I1, I2) is not positive, so that their loss is exactly zero."""
    similarities: dict[tuple[int, int], float] = field(default_factory=dict)
    """SSIM(I1, I2) per pair of views: constant, so computed once (systems.md D.12)."""


class VLGSModule(L.LightningModule):
    """Two real views and one language-only blended view per iteration (Eqs. raster, blend, overall).

    Everything random is a function of (seed, step); `next_step` is the only counter, so a module that was saved after
    a step and restored goes on bit for bit as if it had never stopped.

    Args:
        model: What is trained.
        scene: Training views and language supervision.
        blend: The blended camera view.
        losses: Losses of Eqs. raster, blend, overall.
        gaussians_config: Densification.
        trainer_config: Budget, schedule and learning rates.
        seed: Seed of all draws.

    Raises:
        ValueError: If the scene has no training view.
    """

    def __init__(
        self,
        model: SplatModel,
        scene: Scene,
        blend: ViewBlend,
        losses: Losses,
        gaussians_config: GaussiansConfig,
        trainer_config: TrainerConfig,
        seed: int,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.model = model
        self.scene = scene
        self.blend = blend
        self.losses = losses
        self.gaussians_config = gaussians_config
        self.settings = trainer_config
        self.seed = seed
        sizes = tuple((view.camera.width, view.camera.height) for view in scene.train)
        self.sampler = PairSampler(sizes, seed)
        self.extent = scene_extent(torch.stack([view.camera.viewmat for view in scene.train]))
        self.has_language = scene.mask_vectors.shape[0] > 0
        self.mask_codes = self._encode_masks()
        self.optimizer = self._make_optimizer()
        self.densify_state = DensifyState.zeros(model.count)
        self.next_step = 0
        self.train_seconds = 0.0
        self.report = StepReport()
        self.screen_gradients: tuple[Tensor, ...] = ()
        self.skips = SkipCount()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """The one Adam; its groups are named after the parameters."""
        return self.optimizer

    def training_step(self, step: int, batch_idx: int) -> None:
        """One iteration; `step` counts from 0 over the whole run, resumed or not."""
        self._set_schedule(step)
        first, second = (self.target(index) for index in self.sampler.pair(step))
        fused = self.model.fuse()
        renders = [self._render(target, fused) for target in (first, second)]
        targets = (first, second)
        color_losses = [self._color_loss(r, t) for r, t in zip(renders, targets, strict=True)]
        total = sum(color_losses, torch.zeros(()))
        for render, target in zip(renders, targets, strict=True):
            total = total + self._language_loss(render, target)
        weight = 0.0
        if second is not first:
            blended, weight = self._blended_loss(step, first, second, fused)
            if blended is not None:
                total = total + blended
        views = (first.view.name, second.view.name)
        where = f"in step {step} with views {' and '.join(views)}"
        if not torch.isfinite(total):
            raise FloatingPointError(f"train: loss must be finite, got {total.item()} {where}")
        self.optimizer.zero_grad(set_to_none=True)
        self.screen_gradients = self._backward(total, color_losses, renders)
        self._refuse_non_finite_gradients(where)
        self.optimizer.step()
        self.next_step = step + 1
        mse = self._color_mse(renders, targets)
        self.report = StepReport(step, views, tuple(renders), float(total.detach()), mse, weight)

    def target(self, index: int) -> Target:
        """Image, code map and mask of a training view."""
        view = self.scene.train[index]
        image = view.read_image().to(torch.float32).div_(255.0)
        if view.read_masks is None or not self.has_language:
            return Target(view, image, None, None)
        rows = view.read_masks()
        # Row -1, "no mask", takes the zero code that stands last.
        return Target(view, image, self.mask_codes[rows.long()], rows >= 0)

    def similarity(self, first: int, second: int) -> float:
        """SSIM(I1, I2), clamped at 0, computed once per pair."""
        pair = (min(first, second), max(first, second))
        known = self.skips.similarities
        if pair not in known:
            images = [self.scene.train[i].read_image().to(torch.float32) / 255.0 for i in pair]
            known[pair] = view_similarity(*images)
        return known[pair]

    def _encode_masks(self) -> Float[Tensor, "m d"]:
        dim = self.model.splats["features"].shape[1]
        if not self.has_language:
            return torch.zeros(1, dim)
        with torch.no_grad():
            codes = self.model.codec.encode(self.scene.mask_vectors)
        return torch.cat([codes, torch.zeros(1, codes.shape[1])])

    def _make_optimizer(self) -> torch.optim.Adam:
        rates = self.settings.learning_rates
        groups = [
            {"params": [parameter], "lr": getattr(rates, name), "name": name}
            for name, parameter in self.model.splats.items()
        ]
        if isinstance(self.model.fusion, nn.Module):
            weights = list(self.model.fusion.parameters())
            if weights:
                groups.append({"params": weights, "lr": rates.fusion, "name": "fusion"})
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    def _set_schedule(self, step: int) -> None:
        for group in self.optimizer.param_groups:
            if group["name"] == "means":
                group["lr"] = self.settings.means_rate(step) * self.extent
        highest = {0: 0, 3: 1, 8: 2, 15: 3}[self.model.splats["shN"].shape[1]]
        # Gaussians that come trained have all their degrees from the start.
        trained = self.gaussians_config.init is not None
        self.model.sh_degree = highest if trained else min(highest, step // self.settings.sh_every)

    def _render(self, target: Target, fused: FusedGaussians) -> ViewRender:
        language = target.codes is not None
        render = self.model.render(target.view.camera, language=language, fused=fused)
        if render.mean2d.requires_grad:
            render.mean2d.retain_grad()
        return render

    def _color_loss(self, render: ViewRender, target: Target) -> Float[Tensor, ""]:
        assert render.color is not None
        return self.losses.color_loss(render.color, target.image, _covered(target.view))

    def _language_loss(self, render: ViewRender, target: Target) -> Float[Tensor, ""]:
        if render.feature is None or target.codes is None:
            return torch.zeros(())
        return self.losses.language_loss(render.feature, target.codes, target.valid)

    def _backward(
        self, total: Tensor, color_losses: list[Tensor], renders: list[ViewRender]
    ) -> tuple[Float[Tensor, "n 2"], ...]:
        """Gradients of everything; returns those of the screen positions, per view, that feed densification."""
        screen = [render.mean2d for render in renders]
        if self.gaussians_config.densify_on == "rgb":
            color = torch.autograd.grad(
                sum(color_losses, torch.zeros(())), screen, retain_graph=True
            )
            total.backward()
            return color
        total.backward()
        return tuple(
            mean2d.grad if mean2d.grad is not None else torch.zeros_like(mean2d)
            for mean2d in screen
        )

    def _blended_loss(
        self, step: int, first: Target, second: Target, fused: FusedGaussians
    ) -> tuple[Tensor | None, float]:
        """Third term of Eq. overall and its weight; None where it is not needed."""
        if not self.blend.active or first.codes is None or second.codes is None:
            return None, 0.0
        assert first.valid is not None
        assert second.valid is not None
        similarity = self.similarity(*self.sampler.pair(step)) if self.blend.ssim else 1.0
        weight = self.losses.blend_weight * similarity
        if weight <= 0:
            self.skips.blends_without_weight += 1
            return None, 0.0
        k = self.blend.draw(self.sampler.ratio_rng(step))
        camera = blend_camera(first.view.camera, second.view.camera, k, self.blend)
        codes, valid = blend_targets(
            first.codes, first.valid, second.codes, second.valid, k, self.blend
        )
        feature = self.model.render(camera, color=False, fused=fused).feature
        assert feature is not None
        self.skips.blends_done += 1
        return self.losses.blended_loss(feature, codes, valid, similarity), weight

    def _color_mse(self, renders: list[ViewRender], targets: tuple[Target, ...]) -> float:
        with torch.no_grad():
            errors = [
                nn.functional.mse_loss(render.color, target.image)
                for render, target in zip(renders, targets, strict=True)
                if render.color is not None
            ]
            return float(torch.stack(errors).mean())

    def _refuse_non_finite_gradients(self, where: str) -> None:
        """Stop before Adam spreads one bad number over everything (pitfalls N1)."""
        for name, parameter in self.model.named_parameters():
            gradient = parameter.grad
            if gradient is None or torch.isfinite(gradient.sum()):
                continue
            rows = ~torch.isfinite(gradient.flatten(1) if gradient.dim() > 1 else gradient[:, None])
            if rows.any():  # a sum can overflow where every term is finite
                row = int(rows.any(dim=1).nonzero()[0])
                raise FloatingPointError(
                    f"train: gradient of {name} must be finite, got {gradient[row].tolist()} in row {row} {where}"
                )


def _covered(view: View) -> Bool[Tensor, "h w"] | None:
    return None if view.read_valid is None else view.read_valid()
