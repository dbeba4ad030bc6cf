"""Training: the LightningModule, its settings, callbacks and checkpoints."""

from vlgs.training.lean_import import import_lightning

import_lightning()
