"""Training of a network by draws of its own: what a stage that trains no Gaussians needs of a module, and the loop around it."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import lightning as L
import numpy as np
import torch
from torch import Tensor, nn

from vlgs.identity import RESULTS_VERSION
from vlgs.training.checkpoint import Checkpoint
from vlgs.training.radam import RAdam
from vlgs.training.settings import TrainerConfig
from vlgs.values import require_choice, require_fields, require_range

_OPTIMIZERS = {"adam": torch.optim.Adam, "radam": RAdam}


@dataclass(frozen=True)
class Descent:
    """How a network descends: the optimiser and its rate, which decays log-linearly.

    Raises:
        ValueError: If a number is out of range.
    """

    optimizer: Literal["adam", "radam"]
    rate: float
    """Of the first step."""
    final: float
    """Of the last step, or of step `over`."""
    over: int | None = None
    """Steps over which it decays; None: all of the run."""
    eps: float = 1e-15
    """Added to the root of the second moment: rows of a table with gradients far below it stay where they are."""
    beta2: float = 0.999
    """Of the second moment."""
    decay: float = 0.0
    """Weight decay, added to the gradient."""
    clip: float | None = None
    """Largest norm of all gradients together; None: any."""

    def __post_init__(self) -> None:
        require_choice("descent", "optimizer", self.optimizer, _OPTIMIZERS)
        require_fields("descent", self)
        require_range("descent", 1e-30, 1, rate=self.rate, final=self.final)
        require_range("descent", 1, 10**9, over=self.over)
        require_range("descent", 0, 1, decay=self.decay)
        require_range("descent", 1e-30, 1e30, clip=self.clip)

    def make(self, model: nn.Module) -> torch.optim.Optimizer:
        """The optimiser of all that a model trains."""
        parameters = [p for p in model.parameters() if p.requires_grad]
        make = _OPTIMIZERS[self.optimizer]
        return make(
            parameters, lr=self.rate, betas=(0.9, self.beta2), eps=self.eps, weight_decay=self.decay
        )

    def at(self, step: int, steps: int) -> float:
        """The rate of a step, of so many.

        Example:
            >>> Descent("adam", rate=1e-2, final=1e-4).at(5, 10)
            0.001
        """
        share = min(step / (self.over or steps), 1.0)
        return round(self.rate * (self.final / self.rate) ** share, 15)


@dataclass(frozen=True)
class Report:
    """What the last iteration did, for callbacks."""

    loss: float = math.nan
    color_mse: float = math.nan
    """NaN where no colour is trained."""
    log: Mapping[str, float] = field(default_factory=dict)


class Learner(L.LightningModule):
    """A network that learns from random draws, and the state that a checkpoint keeps.

    Everything random is a function of (seed, step), and `next_step` is the only counter. A learner that was saved after a step and restored
    goes on bit for bit as if it had never stopped.

    Args:
        model: What is trained; what needs no gradient keeps its values.
        settings: Budget, and how often is logged and saved; nothing else of it counts.
        descent: How.
        seed: Of all draws.
        batches: Draws, each with a step of the optimiser, in an iteration.
    """

    def __init__(
        self, model: nn.Module, settings: TrainerConfig, descent: Descent, seed: int, batches: int
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.model = model
        self.settings = settings
        self.descent = descent
        self.seed = seed
        self.batches = batches
        self.optimizer = descent.make(model)
        self.next_step = 0
        self.train_seconds = 0.0
        self.report = Report()

    @abstractmethod
    def terms(self, draw: int, generator: torch.Generator) -> Mapping[str, Tensor]:
        """The terms of the loss for one draw; their sum is minimised.

        Args:
            draw: Counts from 0 over the whole run.
            generator: What is random in this draw.
        """

    @property
    def mse(self) -> float:
        """Mean squared error of colour in the last draw; NaN without colour."""
        return math.nan

    @property
    def count(self) -> int:
        """Number of Gaussians that are trained; none."""
        return 0

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """The one optimiser."""
        return self.optimizer

    def training_step(self, step: int, batch_idx: int) -> None:
        """One iteration; `step` counts from 0 over the whole run, resumed or not.

        Raises:
            FloatingPointError: If a term of the loss or a gradient is not finite; it is named.
        """
        total, errors = 0.0, 0.0
        for draw in range(step * self.batches, (step + 1) * self.batches):
            total += self._descend(draw, f"in step {step}")
            errors += self.mse
        self.next_step = step + 1
        self.report = Report(total / self.batches, errors / self.batches)

    def _descend(self, draw: int, where: str) -> float:
        generator = generator_of(self.seed, draw)
        for group in self.optimizer.param_groups:
            group["lr"] = self.descent.at(draw, self.settings.iterations * self.batches)
        terms = self.terms(draw, generator)
        for name, term in terms.items():
            if not torch.isfinite(term):
                raise FloatingPointError(f"train: {name} must be finite, got {term.item()} {where}")
        loss = torch.stack([*terms.values()]).sum()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        for name, parameter in self.model.named_parameters():
            # Finite only if every number is.
            if parameter.grad is not None and not math.isfinite(parameter.grad.sum().item()):
                raise FloatingPointError(
                    f"train: gradient of {name} must be finite, got none {where}"
                )
        if self.descent.clip is not None:
            nn.utils.clip_grad_norm_(self.model.parameters(), self.descent.clip)
        self.optimizer.step()
        return loss.item()

    def capture(self, meta: dict[str, Any]) -> Checkpoint:
        """Everything that the next iteration depends on."""
        tensors = {f"model.{k}": v for k, v in self.model.state_dict().items()}
        for index, state in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{k}": v for k, v in state.items()}
        own = {"train_seconds": self.train_seconds, "results_version": RESULTS_VERSION}
        return Checkpoint(self.next_step, {k: v.clone() for k, v in tensors.items()}, meta | own)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Put a checkpoint back.

        Raises:
            ValueError: If it belongs to another model.
        """
        version = checkpoint.meta.get("results_version")
        if version != RESULTS_VERSION:
            raise ValueError(f"resume: results version must be {RESULTS_VERSION}, got {version}")
        model, states = {}, dict[int, dict[str, Tensor]]()
        for name, tensor in checkpoint.tensors.items():
            kind, _, rest = name.partition(".")
            if kind == "model":
                model[rest] = tensor
            else:
                index, _, key = rest.partition(".")
                states.setdefault(int(index), {})[key] = tensor
        odd = sorted(set(model) ^ set(self.model.state_dict()))
        if odd:
            raise ValueError(
                f"resume: checkpoint must hold the tensors of this model, got a difference in {odd}"
            )
        self.model.load_state_dict(model)
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": states})
        self.next_step = checkpoint.step
        self.train_seconds = float(checkpoint.meta["train_seconds"])


def generator_of(*numbers: int) -> torch.Generator:
    """A generator of its own for every tuple of numbers, such as (seed, draw)."""
    (state,) = np.random.SeedSequence(numbers).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state) >> 1)
