"""Language on finished Gaussians as the linear system that it is: the codes whose renders come closest to the masks of all views.

With finished geometry a rendered code is linear in the codes of the Gaussians, so that the best ones need no training. A mean over pixels, as the
other rules take it, is one step towards them: it blurs over an edge whatever a Gaussian on the edge reaches, and loses what is smaller than
a Gaussian is wide.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.fields.splat import SplatModel
from vlgs.gaussians.neighbors import nearest, pairs
from vlgs.heads.threads import one_thread
from vlgs.training.blur import blurred
from vlgs.training.lift_rules import Consensus
from vlgs.training.mask_weights import MaskedView, masked_views
from vlgs.types import Scene
from vlgs.values import require_range

NEIGHBOURS = 8
"""Nearest Gaussians that one is compared with, see `Solve.alike`."""
COLOR = 0.1
"""Standard deviation of what counts as one colour, a distance in RGB."""


@dataclass(frozen=True)
class Solve(Consensus):
    """``min sum_p t_p |sum_i w_ip f_i - H_p|^2 + prior sum_i m_i |f_i - c_i|^2`` over the codes f, some conjugate gradients away from c.

    c are the codes of `Consensus`, m_i is what Gaussian i weighs in all images, t_p is 1 where a mask gives H_p, and `absent` where none does and H_p
    is 0. The prior decides where a Gaussian stands behind others, and keeps codes from swinging to explain faulty masks. Splat Feature Solver
    (Xiong et al., 2025) sees lifting as least squares too, and takes the weighted mean for its solution.

    Masks end some pixels beside the edge of a thing, elsewhere in every view. Of a thing that is hardly wider their mean has more of what is behind than of
    itself. `border` blurs the images as such masks are blurred on the mean, so that the codes are those of what was blurred; `alike` holds what is sharpened
    so to what photographs say of edges, by ``alike sum_ij a_ij |f_i - f_j|^2`` over pairs of neighbours, where a_ij grows with what both weigh and falls with
    the distance of their colours.

    Raises:
        ValueError: If `absent` is not in [0, 1], `prior` is not positive, or another number is negative.
    """

    steps: int = 4
    """Of conjugate gradients, each a render of every view and its backward pass; 0: `Consensus`."""
    prior: float = 0.1
    pixels: int = 250_000
    """Most of a view; of a larger one every n-th of every n-th row counts, for the smallest n that is enough. 0: all."""
    border: float = 0.0
    """Standard deviation of where masks end about the edges of things, in pixels; 0: they end there."""
    alike: float = 0.0
    """How strongly neighbours of one colour are held to one code, beside what they weigh; 0: not at all."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range("solve", 0, 10_000, steps=self.steps)
        require_range("solve", 0, 2**31, pixels=self.pixels)
        require_range("solve", 1e-6, 1e6, prior=self.prior)
        require_range("solve", 0, 100, border=self.border)
        require_range("solve", 0, 1e6, alike=self.alike)

    def refine(
        self,
        model: SplatModel,
        scene: Scene,
        level: int,
        vectors: Float[Tensor, "m t"],
        start: Float[Tensor, "n t"],
    ) -> Float[Tensor, "n t"]:
        """See `vlgs.training.lift_rules.Refining`."""
        if not self.steps:
            return start
        with torch.no_grad():
            weight = model.fuse().language_weight
        weight = weight if weight.dim() == 1 else weight[:, level].contiguous()
        sharp = _System(model, weight, scene, level, vectors, self.absent, self.pixels)
        mass = sharp.gathered(torch.ones_like(start[:, :1]))
        system = replace(sharp, border=self.border)
        held = self.prior * mass
        missing, diagonal = system.missing(start), (1 + self.prior) * mass
        alike = _Alike.of(model, self.alike, mass[:, 0]) if self.alike else None
        if alike is not None:
            missing, diagonal = missing - alike.apart(start), diagonal + alike.diagonal()
        scale = 1 / diagonal.clamp_min(torch.finfo(mass.dtype).tiny)

        def product(codes: Tensor) -> Tensor:
            pushed = system.gathered(codes) + held * codes
            return pushed if alike is None else pushed + alike.apart(codes)

        return conjugate_gradients(product, missing, scale, start, self.steps)


@torch.no_grad()
def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    residual: Float[Tensor, "n t"],
    scale: Float[Tensor, "n 1"],
    start: Float[Tensor, "n t"],
    steps: int,
) -> Float[Tensor, "n t"]:
    """Some steps towards the solution of ``A x = b``, for every column by itself.

    Args:
        product: A x; A is symmetric and positive definite.
        residual: ``b - A start``.
        scale: Diagonal of the preconditioner, about that of the inverse of A.
        start: First guess.
        steps: How many.
    """
    solution, ahead = start.clone(), scale * residual
    size = _dot(residual, ahead)
    for _ in range(steps):
        pushed = product(ahead)
        step = _ratio(size, _dot(ahead, pushed))
        solution = solution + step * ahead
        residual = residual - step * pushed
        next_size = _dot(residual, scale * residual)
        ahead = scale * residual + _ratio(next_size, size) * ahead
        size = next_size
    return solution


def _dot(a: Float[Tensor, "n t"], b: Float[Tensor, "n t"]) -> Float[Tensor, " t"]:
    with one_thread():  # the order of a sum over rows would depend on the number of threads
        return (a * b).sum(0)


def _ratio(a: Float[Tensor, " t"], b: Float[Tensor, " t"]) -> Float[Tensor, " t"]:
    """0 where b is 0: that column is solved."""
    return torch.where(b > 0, a / b.clamp_min(torch.finfo(b.dtype).tiny), 0)


@dataclass(frozen=True)
class _System:
    """Renders of codes in all views that have masks, and their transpose."""

    model: SplatModel
    weight: Float[Tensor, " n"]
    scene: Scene
    level: int
    vectors: Float[Tensor, "m t"]
    absent: float
    pixels: int
    border: float = 0.0

    def gathered(self, codes: Float[Tensor, "n t"]) -> Float[Tensor, "n t"]:
        """``W^T T W codes``."""
        return self._back(codes, wanted=False)

    def missing(self, codes: Float[Tensor, "n t"]) -> Float[Tensor, "n t"]:
        """``W^T T (H - W codes)``."""
        return -self._back(codes, wanted=True)

    def _back(self, codes: Float[Tensor, "n t"], wanted: bool) -> Float[Tensor, "n t"]:
        total = torch.zeros_like(codes)
        for view, trust in self._looks():
            index = view.index
            values = codes.detach().requires_grad_()
            with torch.enable_grad():
                image = self.model.render_values(view.camera, values, self.weight, view.step)
            border = self.border / view.step
            error = blurred(image.detach(), border)
            if wanted:
                target = self.vectors[index.clamp_min(0).long()] * (index >= 0)[..., None]
                if border:  # an image without language is 0 beyond its border, too
                    target = target * blurred(torch.ones_like(trust), border)
                error = error - target
            error = blurred(trust * error, border)
            total += torch.autograd.grad(image, values, error)[0]
        return total

    def _looks(self) -> Iterator[tuple[MaskedView, Float[Tensor, "h w 1"]]]:
        """Every view and how much its pixels count."""
        for view in masked_views(self.scene, self.level, self.pixels):
            masked = (view.index >= 0)[..., None]
            trust = torch.where(masked, 1.0, self.absent).to(self.vectors)
            if view.covered is not None:
                trust = trust * (view.covered[..., None] | masked)
            yield view, trust


@dataclass(frozen=True)
class _Alike:
    """``sum_ij weight_ij |f_i - f_j|^2``, over each pair of neighbours once."""

    one: Int[Tensor, " p"]
    other: Int[Tensor, " p"]
    weight: Float[Tensor, "p 1"]
    count: int

    @classmethod
    def of(cls, model: SplatModel, strength: float, mass: Float[Tensor, " n"]) -> "_Alike":
        """Pairs weigh what the lighter of the two does, up to a factor of 2, so that neither is drawn by what is hardly seen."""
        with torch.no_grad():
            color = model.fuse().color
            one, other = pairs(nearest(model.gaussians().means, NEIGHBOURS))
            apart = (color[one] - color[other]).square().sum(dim=1)
            both = (mass[one] + mass[other]).clamp_min(torch.finfo(mass.dtype).tiny)
            weight = (apart / (-2 * COLOR**2)).exp() * mass[one] * mass[other] / both
        weight = strength * 2 / NEIGHBOURS * weight
        return cls(one, other, weight[:, None], len(mass))

    def apart(self, codes: Float[Tensor, "n t"]) -> Float[Tensor, "n t"]:
        """Half of the gradient."""
        pull = self.weight * (codes[self.one] - codes[self.other])
        return self._summed(pull, -pull)

    def diagonal(self) -> Float[Tensor, "n 1"]:
        """Of the matrix that `apart` is."""
        return self._summed(self.weight, self.weight)

    def _summed(
        self, ones: Float[Tensor, "p t"], others: Float[Tensor, "p t"]
    ) -> Float[Tensor, "n t"]:
        with one_thread():  # the order of a sum would depend on the number of threads
            total = ones.new_zeros(self.count, ones.shape[1])
            return total.index_add_(0, self.one, ones).index_add_(0, self.other, others)
