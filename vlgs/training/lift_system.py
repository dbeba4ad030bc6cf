"""What masks of all views say of the codes of Gaussians, as a linear system: products with its matrix, and none of the matrix itself."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.fields.splat import SplatModel
from vlgs.gaussians.neighbors import nearest, pairs
from vlgs.heads.threads import one_thread
from vlgs.training.blur import blurred
from vlgs.training.lift import sums_back
from vlgs.training.mask_weights import MaskedView, masked_views
from vlgs.types import Scene

NEIGHBOURS = 8
"""Nearest Gaussians that one is compared with, see `vlgs.training.lift_solve.Solve.alike`."""
COLOR = 0.1
"""Standard deviation of what counts as one colour, a distance in RGB."""


@dataclass(frozen=True)
class System:
    """Renders of codes in all views that have masks, and their transpose. Codes of several mask levels stand beside each other, ``c = l t``."""

    model: SplatModel
    weight: Float[Tensor, " n"]
    scene: Scene
    levels: tuple[int, ...]
    """Places of l mask levels."""
    vectors: Float[Tensor, "m t"]
    absent: float
    pixels: int
    border: float = 0.0

    def gathered(self, codes: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """``W^T T W codes``."""
        return self._back(codes, wanted=False)

    def masses(self) -> Float[Tensor, "n l"]:
        """What every Gaussian weighs in all images."""
        sharp = replace(self, border=0.0)
        return sharp.gathered(self.vectors.new_ones(len(self.weight), len(self.levels)))

    def missing(self, codes: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """``W^T T (H - W codes)``."""
        return -self._back(codes, wanted=True)

    @torch.no_grad()
    def unexplained(self, codes: Float[Tensor, "n c"]) -> float:
        """``sum_p t_p |W codes - H|^2``."""
        total = 0.0
        for view, trust in self._looks():
            image = self.model.render_values(view.camera, codes, self.weight, view.step)
            error = blurred(image, self.border / view.step) - self._wanted(view, trust)
            with one_thread():  # the order of a sum would depend on the number of threads
                total += float((self._over(trust, error) * error).sum(dtype=torch.float64))
        return total

    def _back(self, codes: Float[Tensor, "n c"], wanted: bool) -> Float[Tensor, "n c"]:
        total = torch.zeros_like(codes)
        for view, trust in self._looks():
            values = codes.detach().requires_grad_()
            with torch.enable_grad():
                image = self.model.render_values(view.camera, values, self.weight, view.step)
            border = self.border / view.step
            error = blurred(image.detach(), border)
            if wanted:
                error = error - self._wanted(view, trust)
            error = blurred(self._over(trust, error), border)
            total += sums_back(image, values, error)
        return total

    def _wanted(self, view: MaskedView, trust: Float[Tensor, "h w l"]) -> Float[Tensor, "h w c"]:
        index = view.index.reshape(trust.shape)
        target = self.vectors[index.clamp_min(0).long()] * (index >= 0)[..., None]
        border = self.border / view.step
        if border:  # an image without language is 0 beyond its border, too
            target = target * blurred(torch.ones_like(trust[..., :1]), border)[..., None]
        return target.flatten(2)

    def _over(
        self, trust: Float[Tensor, "h w l"], error: Float[Tensor, "h w c"]
    ) -> Float[Tensor, "h w c"]:
        if bool((trust == 1).all()):
            return error
        return (trust[..., None] * error.unflatten(2, (len(self.levels), -1))).flatten(2)

    def _looks(self) -> Iterator[tuple[MaskedView, Float[Tensor, "h w l"]]]:
        """Every view and how much its pixels count."""
        for view in masked_views(self.scene, self.levels, self.pixels):
            masked = view.index >= 0
            trust = torch.where(masked, 1.0, self.absent).to(self.vectors)
            if view.covered is not None:
                trust = trust * (view.covered[..., None] | masked)
            yield view, trust


@dataclass(frozen=True)
class Alike:
    """``sum_ij weight_ij |f_i - f_j|^2``, over each pair of neighbours once, for every mask level."""

    one: Int[Tensor, " p"]
    other: Int[Tensor, " p"]
    weight: Float[Tensor, "p l"]
    count: int

    @classmethod
    def of(cls, model: SplatModel, strength: float, mass: Float[Tensor, "n l"]) -> "Alike":
        """Pairs weigh what the lighter of the two does, up to a factor of 2, so that neither is drawn by what is hardly seen."""
        with torch.no_grad():
            color = model.fuse().color
            one, other = pairs(nearest(model.gaussians().means, NEIGHBOURS))
            apart = (color[one] - color[other]).square().sum(dim=1, keepdim=True)
            both = (mass[one] + mass[other]).clamp_min(torch.finfo(mass.dtype).tiny)
            weight = (apart / (-2 * COLOR**2)).exp() * mass[one] * mass[other] / both
        return cls(one, other, strength * 2 / NEIGHBOURS * weight, len(mass))

    def apart(self, codes: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """Half of the gradient. Level by level: pairs are several times as many as Gaussians."""
        levels = codes.chunk(self.weight.shape[1], dim=1)
        return torch.cat([self._apart(i, own) for i, own in enumerate(levels)], dim=1)

    def diagonal(self) -> Float[Tensor, "n l"]:
        """Of the matrix that `apart` is."""
        return self._summed(self.weight, self.weight)

    def _apart(self, level: int, codes: Float[Tensor, "n t"]) -> Float[Tensor, "n t"]:
        pull = self.weight[:, level, None] * (codes[self.one] - codes[self.other])
        return self._summed(pull, -pull)

    def _summed(
        self, ones: Float[Tensor, "p k"], others: Float[Tensor, "p k"]
    ) -> Float[Tensor, "n k"]:
        with one_thread():  # the order of a sum would depend on the number of threads
            total = ones.new_zeros(self.count, ones.shape[1])
            return total.index_add_(0, self.one, ones).index_add_(0, self.other, others)
