"""Finds Gaussians that can no longer change, because their weight is below the cutoff or above the clamp and has no gradient (tests/README.md, N11)."""

import logging
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vlgs.training.after_step import AfterStep, TrainedModule
from vlgs.training.lightning import VLGSModule
from vlgs.types import Camera

log = logging.getLogger(__name__)

ALARM = 0.9
"""Share from which a look counts. Gaussians behind opaque ones have no gradient in any healthy run; nine in ten do not."""
LOOKS = 3
"""Looks in a row before the alarm: codes start at zero, so that the first steps move no indicator."""


def stuck_share(
    gradient: Float[Tensor, " n *levels"],
    means2d: Sequence[Float[Tensor, "n 2"]],
    cameras: Sequence[Camera],
) -> float:
    """Share of exactly zero gradients, at all levels, among the Gaussians whose centre lies in a view; 0 if there are none.

    Example:
        >>> camera = Camera(torch.eye(4), torch.eye(3), 10, 10)
        >>> stuck_share(torch.tensor([0.0, 1.0, 0.0]), [torch.tensor([[5.0, 5.0], [1.0, 2.0], [50.0, 5.0]])], [camera])
        0.5
    """
    still = (gradient == 0).reshape(len(gradient), -1).all(dim=1)
    seen = torch.zeros_like(still)
    for mean2d, camera in zip(means2d, cameras, strict=True):
        seen |= _inside(mean2d.detach(), camera)
    return float((still & seen).sum() / seen.sum().clamp_min(1))


def _inside(mean2d: Float[Tensor, "n 2"], camera: Camera) -> Bool[Tensor, " n"]:
    size = mean2d.new_tensor([camera.width, camera.height])
    return ((mean2d > 0) & (mean2d < size)).all(dim=1)  # a culled one is at exactly 0


class StuckAlarm(AfterStep):
    """Warn once per weight when almost no Gaussian in view can change it any more.

    Attributes:
        shares: Weight -> share at the last look.
        alarmed: Weights that were warned about.
    """

    def __init__(self, every: int) -> None:
        self.every = every
        self.shares: dict[str, float] = {}
        self.alarmed: set[str] = set()
        self.in_a_row: dict[str, int] = {}

    def after_step(self, module: TrainedModule) -> None:
        """Look at the gradients of this iteration; runs before densification replaces the parameters."""
        assert isinstance(module, VLGSModule)
        if module.next_step % self.every:
            return
        report = module.report
        means2d = [render.mean2d for render in report.renders]
        weights = (r.name for r in module.model.attributes.values() if r.role == "weight")
        for name in weights:
            gradient = module.model.splats[name].grad
            if gradient is None:  # this weight takes no part, e.g. with indicator=opacity
                continue
            share = self.shares[name] = stuck_share(gradient, means2d, report.cameras)
            self.in_a_row[name] = self.in_a_row.get(name, 0) + 1 if share >= ALARM else 0
            if self.in_a_row[name] >= LOOKS and name not in self.alarmed:
                self.alarmed.add(name)
                log.warning(
                    "train: %s of %.0f %% of the Gaussians in view have had no gradient at step %d and the %d looks before: "
                    "they are below raster.alpha_min, above raster.alpha_max or hidden, and will stay as they are",
                    name, 100 * share, module.next_step, LOOKS - 1,
                )  # fmt: skip
