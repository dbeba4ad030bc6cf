"""Training as one LightningModule: schedule, one step, one Adam."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import lightning as L
import torch
from jaxtyping import Float
from torch import Tensor, nn

from vlgs.fields.splat import SplatModel
from vlgs.gaussians import DensifyState, GaussiansConfig
from vlgs.gaussians.ply import SH_COEFFICIENTS
from vlgs.geometry import camera_center, scene_extent
from vlgs.objectives import Setup
from vlgs.training.cached_renders import CachedRenders, freeze, has_frozen_shape
from vlgs.training.exposure import Exposure
from vlgs.training.means import Means
from vlgs.training.settings import TrainerConfig
from vlgs.training.step import StepReport, TrainingStep

Rate = float | Mapping[str, float]
"""Adam's, or one for each part of a module."""


@dataclass
class Densifying:
    """What densification goes by."""

    config: GaussiansConfig
    state: DensifyState
    extent: float
    """`vlgs.geometry.scene_extent` of the training cameras."""
    centers: Float[Tensor, "v 3"]
    """Of the training cameras."""


class VLGSModule(L.LightningModule):
    """Gaussians and what is trained with them, and the state that a checkpoint keeps.

    Everything random is a function of (seed, step); `next_step` is the only counter, so a module that was saved after
    a step and restored goes on bit for bit as if it had never stopped.

    Args:
        model: What is trained.
        setup: What it learns from, and the terms of the loss, which are bound to it.
        config: Densification.
        settings: Budget, schedule and learning rates.
        seed: Seed of all draws.

    Raises:
        ValueError: If what is frozen cannot be (`vlgs.training.cached_renders.freeze`), or nothing is left to train.
    """

    def __init__(
        self,
        model: SplatModel,
        setup: Setup,
        config: GaussiansConfig,
        settings: TrainerConfig,
        seed: int,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.model = model
        self.views = views = setup.views
        self.settings = settings
        self.seed = seed
        self.skips = setup.counts
        freeze(model, tuple(settings.freeze), config.densify.stop)
        viewmats = torch.stack([view.camera.viewmat for view in views.scene.train])
        self.densifying = Densifying(
            config,
            DensifyState.zeros(model.count),
            scene_extent(viewmats),
            camera_center(viewmats).float(),
        )
        color = any("color" in objective.needs for objective in setup.objectives.values())
        keeps = settings.skip.frozen_weights and not model.evaluated
        self.step = TrainingStep(
            model,
            setup,
            config.densify_on == "rgb",
            Exposure(len(viewmats)) if settings.exposure and color else None,
            CachedRenders(
                model,
                [view.camera for view in views.scene.train],
                settings.skip.kept_bytes,
                setup.counts,
            )
            if keeps and has_frozen_shape(model)
            else None,
            settings,
        )
        self.optimizer = self._make_optimizer()
        self.means = Means()
        self.next_step = 0
        self.train_seconds = 0.0
        self.report = StepReport()

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return self.model.count

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """The one Adam; its groups are named after the parameters."""
        return self.optimizer

    def training_step(self, step: int, batch_idx: int) -> None:
        """One iteration; `step` counts from 0 over the whole run, resumed or not.

        Raises:
            FloatingPointError: If the loss or a gradient is not finite; tensor, row, step and views are named.
            ValueError: If the rasterizer refuses a number; likewise.
        """
        names = tuple(self.views.scene.train[i].name for i in self.views.sampler.pair(step))
        where = f"in step {step} with views {' and '.join(names)}"
        self.set_schedule(step)
        try:
            done = self.step.forward(step)
            if not torch.isfinite(done.total):
                raise FloatingPointError(
                    f"train: loss must be finite, got {done.total.item()} {where}"
                )
            self.optimizer.zero_grad(set_to_none=True)
            screen_gradients = self.step.backward(done)
        except ValueError as error:
            raise ValueError(f"{error} {where}") from error
        self._refuse_non_finite(where)
        self.optimizer.step()
        self.next_step = step + 1
        self.report = StepReport(
            step,
            names,
            tuple(render.detach() for render in done.seen.renders),
            screen_gradients,
            float(done.total.detach()),
            done.seen.log,
            tuple(target.image for target in done.seen.targets),
            tuple(target.view.camera for target in done.seen.targets),
        )

    def _make_optimizer(self) -> torch.optim.Adam:
        groups = [
            {"params": [parameter], "lr": self.model.attributes[name].rate, "name": name}
            for name, parameter in self.model.splats.items()
            if parameter.requires_grad
        ]
        given = self.settings.learning_rates
        rates: dict[str, Rate] = {"fusion": given.fusion, "exposure": given.exposure}
        rates |= {"head": self.model.head.learning_rate or 0.0}
        rates |= {f"loss.{name}": part.rate for name, part in self.step.setup.objectives.items()}
        for name, part in self.step.modules().items():
            groups += _groups(name, part, rates[name])
        if not groups:
            raise ValueError("train: trainer.freeze must leave something to train, got everything")
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    def set_schedule(self, step: int) -> None:
        """The rates that decay, and the degree of harmonics, of a step."""
        for group in self.optimizer.param_groups:
            if group["name"] == "means":
                group["lr"] = self.settings.means_rate(step) * self.densifying.extent
            elif group["name"] in self.model.attributes:
                row = self.model.attributes[group["name"]]
                # A copy learns like its original (`vlgs.gaussians.attributes`).
                name = row.start if isinstance(row.start, str) else row.name
                group["lr"] = row.rate * self.settings.decay(name, step)
        highest = SH_COEFFICIENTS.index(self.model.splats["shN"].shape[1])
        # Gaussians that come trained, or whose harmonics stay as they are, have all their degrees from the start.
        trained = self.densifying.config.init is not None or "shN" in self.settings.freeze
        self.model.sh_degree = highest if trained else min(highest, step // self.settings.sh_every)

    def _refuse_non_finite(self, where: str) -> None:
        """Stop before Adam spreads one bad number over everything (tests/README.md, N1)."""
        looked_at: dict[str, Tensor] = {}
        for name, parameter in self.step.trained():
            if parameter.grad is not None:
                looked_at[f"gradient of {name}"] = parameter.grad
            # Others are looked at where they are read; these come to a finite weight or scale, with no gradient, at infinity.
            row = self.model.attributes.get(name.removeprefix("splats."))
            if row is not None and row.activation != "none":
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


def _groups(name: str, module: nn.Module, rate: Rate) -> list[dict[str, Any]]:
    """Groups of the optimiser for what is trained beside the Gaussians: one, or one for each part that has a rate."""
    if not isinstance(rate, Mapping):
        return [{"params": list(module.parameters()), "lr": rate, "name": name}]
    parts: dict[str, list[nn.Parameter]] = {part: [] for part in rate}
    for own, parameter in module.named_parameters():
        parts[own.partition(".")[0]].append(parameter)
    return [
        {"params": parameters, "lr": rate[part], "name": f"{name}.{part}"}
        for part, parameters in parts.items()
    ]
