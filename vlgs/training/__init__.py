"""Training: the LightningModule, its settings, callbacks and checkpoints."""

from vlgs.training.lean_dynamo import postpone_dynamo
from vlgs.training.lean_import import import_lightning

postpone_dynamo()
import_lightning()
