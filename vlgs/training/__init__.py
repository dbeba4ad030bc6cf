"""Training: the LightningModule, its settings, callbacks and checkpoints."""
