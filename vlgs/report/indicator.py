"""How far the semantic indicator departs from opacity: as a map of a view, and by kind of category (Fig. 3)."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields import HasGaussians
from vlgs.report.labels import read_truth
from vlgs.types import Camera, View

BINS = 40
ANY = "any"
"""Kind of the categories of a scene that names no kinds."""


def indicator_difference(gaussians: HasGaussians, camera: Camera) -> Float[Tensor, "h w"]:
    """Mean of l - o over the Gaussians of each pixel, in [-1, 1]; 0 where there are none.

    Gaussians count by the larger of l and o, so that neither glass (low o) nor glare (low l) is hidden.
    """
    language, color = gaussians.language_weights(), gaussians.opacities()
    values = torch.stack([language - color, torch.ones_like(color)], dim=1)
    image = gaussians.render_values(camera, values, torch.maximum(language, color))
    return image[..., 0] / image[..., 1].clamp_min(1e-3)


class Histogram:
    """Pixels of held-out views by `indicator_difference`, under the kind of their true class.

    A view without a class for every pixel adds nothing.

    Args:
        classes: Of the scene, by class id.
        kinds: Class -> kind.
    """

    def __init__(self, classes: Sequence[str], kinds: Mapping[str, str]) -> None:
        self.edges = torch.linspace(-1, 1, BINS + 1)
        self.kinds = [kinds.get(name, ANY) for name in classes]
        self.counts: dict[str, Tensor] = {}

    def add(self, view: View, gaussians: HasGaussians) -> None:
        """Count the pixels of one view."""
        truth = read_truth(view)
        if truth is None:
            return
        difference = indicator_difference(gaussians, view.camera).double()
        for kind in dict.fromkeys(self.kinds):
            ids = truth.new_tensor([i for i, k in enumerate(self.kinds) if k == kind])
            counts = torch.histc(difference[torch.isin(truth, ids)], bins=BINS, min=-1, max=1)
            self.counts[kind] = self.counts.get(kind, torch.zeros_like(counts)) + counts

    def shares(self) -> dict[str, list[float]] | None:
        """``edges`` of the bins, and per kind the share of its pixels in each; None if no pixel was counted."""
        shown = {kind: counts for kind, counts in self.counts.items() if counts.sum() > 0}
        if not shown:
            return None
        shares = {kind: (counts / counts.sum()).tolist() for kind, counts in shown.items()}
        return {"edges": self.edges.tolist(), **shares}
