"""Training as one LightningModule: parameters, the step of Eq. 12, one Adam."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from statistics import fmean

import lightning as L
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vlgs.blend import ViewBlend, blend_targets
from vlgs.data.cache import PixelCache
from vlgs.gaussians import DensifyState, GaussiansConfig
from vlgs.gaussians.clearance import Clearance
from vlgs.geometry import camera_center, scene_extent
from vlgs.losses import Losses, masked_mse, view_similarity
from vlgs.module.blended import BlendPlan, CamerasBetween, plan_blend
from vlgs.module.exposure import Exposure
from vlgs.module.frozen import GEOMETRY, FrozenRenders, freeze
from vlgs.module.sampler import PairSampler, nearest_views
from vlgs.module.settings import TrainerConfig
from vlgs.module.skips import SkipCount
from vlgs.render.model import FusedGaussians, SplatModel, ViewRender
from vlgs.types import Scene, View

TARGET_BYTES = 256 << 20
"""Most bytes of float32 images and code maps that are kept for the losses. If all views need more, those of one iteration are kept."""


@dataclass(frozen=True)
class Target:
    """What one training view should look like; its tensors are shared between iterations."""

    view: View
    image: Float[Tensor, "h w 3"]
    codes: Float[Tensor, "h wl d"] | None
    """Language codes; with ``levels=joint`` those of the l mask levels of a pixel stand beside each other in its row, so that losses
    and blending need not know of levels."""
    valid: Bool[Tensor, "h wl"] | None
    """Where there is a mask; None like `codes` where the view has no language."""


@dataclass
class StepReport:
    """What the last iteration did, for callbacks. Recording it costs no extra computation."""

    step: int = -1
    views: tuple[str, ...] = ()
    renders: tuple[ViewRender, ...] = ()
    """The real views only, without their graph, which holds the tile lists of all views: the next step makes its own."""
    loss: float = math.nan
    color_mse: float = math.nan
    blend_weight: float = 0.0
    """lambda * SSIM(I1, I2) of Eq. 11; 0 where the blended view was not rendered."""


class VLGSModule(L.LightningModule):
    """Two real views and one language-only blended view per iteration (Eqs. 8, 11 and 12).

    Everything random is a function of (seed, step); `next_step` is the only counter, so a module that was saved after
    a step and restored goes on bit for bit as if it had never stopped.

    Args:
        model: What is trained.
        scene: Training views and language supervision.
        blend: The blended camera view.
        losses: Losses of Eqs. 8, 11 and 12.
        gaussians_config: Densification.
        trainer_config: Budget, schedule and learning rates.
        seed: Seed of all draws.
        color: Off: language alone is rendered and learned.

    Raises:
        ValueError: If the scene has no training view, or what is frozen cannot be (`vlgs.module.frozen.freeze`).
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
        color: bool = True,
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
        self.color = color
        sizes = tuple((view.camera.width, view.camera.height) for view in scene.train)
        near = None
        if blend.pairs == "neighbours":
            near = nearest_views([view.camera for view in scene.train], blend.neighbours)
        self.sampler = PairSampler(sizes, seed, near)
        self.between = CamerasBetween(self.sampler, [v.camera for v in scene.train], blend)
        viewmats = torch.stack([view.camera.viewmat for view in scene.train])
        self.extent, self.centers = scene_extent(viewmats), camera_center(viewmats).float()
        self.clearance = Clearance(scene, gaussians_config.densify.clear_share)
        self.has_language = scene.mask_vectors.shape[0] > 0
        self.mask_codes = self._encode_masks()
        self.target_cache = PixelCache(self._room_for_targets())
        freeze(model, tuple(trainer_config.freeze), gaussians_config.densify.stop)
        self.exposure = Exposure(len(scene.train)) if trainer_config.exposure and color else None
        self.optimizer = self._make_optimizer()
        self.densify_state = DensifyState.zeros(model.count)
        self.next_step = 0
        self.train_seconds = 0.0
        self.report = StepReport()
        self.screen_gradients: tuple[Tensor, ...] = ()
        self.skips = SkipCount()
        self.frozen = None
        geometry = GEOMETRY & set(model.splats)
        keeps = trainer_config.skip.frozen_weights and color and not model.evaluated
        if keeps and set(trainer_config.freeze) >= geometry:
            self.frozen = FrozenRenders(model, trainer_config.skip.frozen_budget, self.skips)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """The one Adam; its groups are named after the parameters."""
        return self.optimizer

    def training_step(self, step: int, batch_idx: int) -> None:
        """One iteration; `step` counts from 0 over the whole run, resumed or not.

        Raises:
            FloatingPointError: If the loss or a gradient is not finite; tensor, row, step and views are named.
            ValueError: If the rasterizer refuses a number; likewise.
        """
        views = " and ".join(self.scene.train[index].name for index in self.sampler.pair(step))
        where = f"in step {step} with views {views}"
        try:
            self._step(step, where)
        except ValueError as error:
            raise ValueError(f"{error} {where}") from error

    def _step(self, step: int, where: str) -> None:
        self._set_schedule(step)
        pair = self.sampler.pair(step)
        first, second = targets = self.target(pair[0]), self.target(pair[1])
        plan = None if pair[0] == pair[1] else self._plan_blend(step, first, second)
        fused = self.model.fuse()
        renders = [self._render(i, t, fused) for i, t in zip(pair, targets, strict=True)]
        renders = [self._exposed(i, render) for i, render in zip(pair, renders, strict=True)]
        color_losses = [self._color_loss(r, t) for r, t in zip(renders, targets, strict=True)]
        total = sum(color_losses, torch.zeros(()))
        for render, target in zip(renders, targets, strict=True):
            total = total + self._language_loss(render, target)
        if plan is not None:
            total = total + self._blended_loss(plan, targets, renders, fused)
        views = (first.view.name, second.view.name)
        if not torch.isfinite(total):
            raise FloatingPointError(f"train: loss must be finite, got {total.item()} {where}")
        self.optimizer.zero_grad(set_to_none=True)
        if total.requires_grad:
            self.screen_gradients = self._backward(total, color_losses, renders)
        else:  # nothing that is trained is in view, or neither view has a mask
            self.screen_gradients = tuple(torch.zeros_like(r.mean2d) for r in renders)
        self._refuse_non_finite(where)
        self.optimizer.step()
        self.next_step = step + 1
        mse = self._color_mse(color_losses, renders, targets)
        weight = 0.0 if plan is None else plan.weight
        seen = tuple(render.detach() for render in renders)
        self.report = StepReport(step, views, seen, float(total.detach()), mse, weight)

    def target(self, index: int) -> Target:
        """Image, code map and mask of a training view."""
        view, kept = self.scene.train[index], self.target_cache
        image = kept.get((index, "image"), lambda: view.read_image().to(torch.float32).div_(255.0))
        if view.read_masks is None or not self.has_language:
            return Target(view, image, None, None)
        read = view.read_masks
        # "No mask" is -1, which indexes the last row, a zero code. With l mask levels, each pixel becomes l neighbours in its row.
        codes = kept.get((index, "codes"), lambda: self.mask_codes[read().long()].flatten(1, -2))
        valid = kept.get((index, "valid"), lambda: (read() >= 0).flatten(1))
        return Target(view, image, codes, valid)

    def similarity(self, first: int, second: int) -> float:
        """SSIM(I1, I2), clamped at 0, computed once per pair."""
        pair = (min(first, second), max(first, second))
        known = self.skips.similarities
        if pair in known:
            self.skips.skip("similarity_cache")
        else:
            with self.skips.doing("similarity"):
                known[pair] = view_similarity(*(self.target(i).image for i in pair))
        return known[pair]

    def _encode_masks(self) -> Float[Tensor, "m d"]:
        dim = self.model.splats["features"].shape[1]
        if not self.has_language:
            return torch.zeros(1, dim)
        with torch.no_grad():
            codes = self.model.codec.encode(self.scene.mask_vectors)
        return torch.cat([codes, torch.zeros(1, codes.shape[1])])

    def _room_for_targets(self) -> int:
        """Bytes for cached targets: all views if they fit, else the two views of one iteration. Caching some of the views would rarely help."""
        code = 4 * self.mask_codes.shape[1] + 1  # and whether it counts
        pixel = 3 * 4 + (code * self.scene.mask_levels if self.has_language else 0)
        views = [pixel * view.camera.width * view.camera.height for view in self.scene.train]
        return sum(views) if sum(views) <= TARGET_BYTES else 2 * max(views)

    def _make_optimizer(self) -> torch.optim.Adam:
        rates = self.settings.learning_rates
        groups = [
            {"params": [parameter], "lr": rates.of(name), "name": name}
            for name, parameter in self.model.splats.items()
            if parameter.requires_grad
        ]
        if isinstance(self.model.fusion, nn.Module):
            weights = list(self.model.fusion.parameters())
            if weights:
                groups.append({"params": weights, "lr": rates.fusion, "name": "fusion"})
        if self.exposure is not None:
            maps = list(self.exposure.parameters())
            groups.append({"params": maps, "lr": rates.exposure, "name": "exposure"})
        if not groups:
            raise ValueError("train: trainer.freeze must leave something to train, got everything")
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    def _set_schedule(self, step: int) -> None:
        for group in self.optimizer.param_groups:
            if group["name"] == "means":
                group["lr"] = self.settings.means_rate(step) * self.extent
        highest = {0: 0, 3: 1, 8: 2, 15: 3}[self.model.splats["shN"].shape[1]]
        # Gaussians that come trained, or whose harmonics stay as they are, have all their degrees from the start.
        trained = self.gaussians_config.init is not None or "shN" in self.settings.freeze
        self.model.sh_degree = highest if trained else min(highest, step // self.settings.sh_every)

    def _render(self, index: int, target: Target, fused: FusedGaussians) -> ViewRender:
        language = target.codes is not None or not self.color
        if self.frozen is not None:
            kept = self.frozen.render(index, target.view.camera, language, fused)
            if kept is not None:
                return kept
        camera = target.view.camera
        render = self.model.render(camera, color=self.color, language=language, fused=fused)
        if render.mean2d.requires_grad:
            render.mean2d.retain_grad()
        return render

    def _exposed(self, index: int, render: ViewRender) -> ViewRender:
        if self.exposure is None or render.color is None:
            return render
        return replace(render, color=self.exposure(index, render.color))

    def _color_loss(self, render: ViewRender, target: Target) -> Float[Tensor, ""]:
        if render.color is None:
            return torch.zeros(())
        return self.losses.color_loss(render.color, target.image, covered(target.view))

    def _language_loss(self, render: ViewRender, target: Target) -> Float[Tensor, ""]:
        if render.feature is None or target.codes is None:
            return torch.zeros(())
        feature = render.feature.view_as(target.codes)
        return self.losses.language_loss(feature, target.codes, target.valid)

    def _backward(
        self, total: Tensor, color_losses: list[Tensor], renders: list[ViewRender]
    ) -> tuple[Float[Tensor, "n 2"], ...]:
        """Gradients of everything; returns those of the screen positions, per view, that feed densification."""
        screen = [render.mean2d for render in renders]
        if not all(mean2d.requires_grad for mean2d in screen):  # frozen, hence no densification
            total.backward()
            return ()
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

    def _plan_blend(self, step: int, first: Target, second: Target) -> BlendPlan | None:
        """The blended view of an iteration; None where there is none or its loss does not count."""
        if not self.blend.active or first.codes is None or second.codes is None:
            return None
        similarity = self.similarity(*self.sampler.pair(step)) if self.blend.ssim else 1.0
        weight = self.losses.blend_weight * similarity
        least = self.settings.skip.blend_weight
        if weight <= least:
            self.skips.skip("blend_zero" if weight <= 0 else "blend_small")
            return None
        k, between = self.between.at(step)
        cameras, reuse = (first.view.camera, second.view.camera), self.settings.skip.blend_reuse
        return plan_blend(cameras, k, between, similarity, weight, self.blend, reuse)

    def _blended_loss(
        self,
        plan: BlendPlan,
        targets: tuple[Target, Target],
        renders: list[ViewRender],
        fused: FusedGaussians,
    ) -> Float[Tensor, ""]:
        """Third term of Eq. 12."""
        (first, second), feature = targets, None
        assert first.codes is not None
        assert first.valid is not None
        assert second.codes is not None
        assert second.valid is not None
        codes, valid = blend_targets(
            first.codes, first.valid, second.codes, second.valid, plan.k, self.blend
        )
        if plan.reuse is not None:
            self.skips.skip("blend_reuse")
            feature = renders[plan.reuse].feature
        else:
            with self.skips.doing("blended render"):
                feature = self.model.render(plan.camera, color=False, fused=fused).feature
        assert feature is not None
        return self.losses.blended_loss(feature.view_as(codes), codes, valid, plan.similarity)

    @torch.no_grad()
    def _color_mse(
        self, losses: list[Tensor], renders: list[ViewRender], targets: tuple[Target, ...]
    ) -> float:
        errors = []
        for loss, render, target in zip(losses, renders, targets, strict=True):
            if render.color is None:
                continue
            known = self.losses.rgb_loss == "mse" and target.view.read_valid is None
            errors.append((loss if known else masked_mse(render.color, target.image)).item())
        return fmean(errors) if errors else math.nan

    def _trained(self) -> Iterator[tuple[str, nn.Parameter]]:
        """What the step can move, by name: not the codec, which is fitted before."""
        for name, parameter in self.model.splats.items():
            yield f"splats.{name}", parameter
        if isinstance(self.model.fusion, nn.Module):
            yield from self.model.fusion.named_parameters("fusion")
        if self.exposure is not None:
            yield from self.exposure.named_parameters("exposure")

    def _refuse_non_finite(self, where: str) -> None:
        """Stop before Adam spreads one bad number over everything (tests/README.md, N1)."""
        looked_at: dict[str, Tensor] = {}
        for name, parameter in self._trained():
            if parameter.grad is not None:
                looked_at[f"gradient of {name}"] = parameter.grad
            # Others are looked at where they are read; these come to a finite weight or scale, with no gradient, at infinity.
            if name.endswith(("_logits", "log_scales")):
                looked_at[name] = parameter.detach()
        # Finite only if every number is; the sum of large ones can overflow, hence the search.
        if all(math.isfinite(tensor.sum().item()) for tensor in looked_at.values()):
            return
        for name, tensor in looked_at.items():
            rows = ~torch.isfinite(tensor.flatten(1) if tensor.dim() > 1 else tensor[:, None])
            if rows.any():
                row = int(rows.any(dim=1).nonzero()[0])
                raise FloatingPointError(
                    f"train: {name} must be finite, got {tensor[row].tolist()} in row {row} {where}"
                )


def covered(view: View) -> Bool[Tensor, "h w"] | None:
    """Pixels that the photograph of a view covers; None for all."""
    return None if view.read_valid is None else view.read_valid()
