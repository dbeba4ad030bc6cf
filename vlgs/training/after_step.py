"""Base of the callbacks that act after an iteration, of which Lightning tells them more than they need."""

from abc import abstractmethod
from typing import Any

import lightning as L

from vlgs.training.learner import Learner
from vlgs.training.lightning import VLGSModule

TrainedModule = VLGSModule | Learner
"""What is trained: Gaussians, or a network."""


class AfterStep(L.Callback):
    """A callback that sees the module after every iteration, in the order in which callbacks are listed."""

    @abstractmethod
    def after_step(self, module: TrainedModule) -> None:
        """Look at what the iteration did, or go on from it; `next_step` counts it already."""

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """See `after_step`."""
        self.after_step(own(pl_module))


def own(module: L.LightningModule) -> TrainedModule:
    """The module that Lightning hands to a callback, as what it is here."""
    assert isinstance(module, VLGSModule | Learner)
    return module
