"""Language on finished Gaussians as the linear system that it is: the codes whose renders come closest to the masks of all views.

With finished geometry a rendered code is linear in the codes of the Gaussians, so that the best ones need no training. A mean over pixels, as the
other rules take it, is one step towards them: it blurs over an edge whatever a Gaussian on the edge reaches, and loses what is smaller than
a Gaussian is wide.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields.splat import SplatModel
from vlgs.heads.threads import one_thread
from vlgs.training.lift_rules import Consensus
from vlgs.training.mask_weights import MaskedView, masked_views
from vlgs.types import Scene
from vlgs.values import require_range


@dataclass(frozen=True)
class Solve(Consensus):
    """``min sum_p t_p |sum_i w_ip f_i - H_p|^2 + prior sum_i m_i |f_i - c_i|^2`` over the codes f, some conjugate gradients away from c.

    c are the codes of `Consensus`, m_i is what Gaussian i weighs in all images, t_p is 1 where a mask gives H_p, and `absent` where none does and H_p
    is 0. The prior decides where a Gaussian stands behind others, and keeps codes from swinging to explain faulty masks. Splat Feature Solver
    (Xiong et al., 2025) sees lifting as least squares too, and takes the weighted mean for its solution.

    Raises:
        ValueError: If `absent` is not in [0, 1], `prior` is not positive, or `steps` or `pixels` is negative.
    """

    steps: int = 4
    """Of conjugate gradients, each a render of every view and its backward pass; 0: `Consensus`."""
    prior: float = 0.1
    pixels: int = 250_000
    """Most of a view; of a larger one every n-th of every n-th row counts, for the smallest n that is enough. 0: all."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range("solve", 0, 10_000, steps=self.steps)
        require_range("solve", 0, 2**31, pixels=self.pixels)
        require_range("solve", 1e-6, 1e6, prior=self.prior)

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
        system = _System(model, weight, scene, level, vectors, self.absent, self.pixels)
        mass = system.gathered(torch.ones_like(start[:, :1]))
        scale = 1 / ((1 + self.prior) * mass).clamp_min(torch.finfo(mass.dtype).tiny)

        def product(codes: Tensor) -> Tensor:
            return system.gathered(codes) + self.prior * mass * codes

        return conjugate_gradients(product, system.missing(start), scale, start, self.steps)


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
                error = image.detach()
                if wanted:
                    error = (
                        error - self.vectors[index.clamp_min(0).long()] * (index >= 0)[..., None]
                    )
                total += torch.autograd.grad(image, values, trust * error)[0]
        return total

    def _looks(self) -> Iterator[tuple[MaskedView, Float[Tensor, "h w 1"]]]:
        """Every view and how much its pixels count."""
        for view in masked_views(self.scene, self.level, self.pixels):
            masked = (view.index >= 0)[..., None]
            trust = torch.where(masked, 1.0, self.absent).to(self.vectors)
            if view.covered is not None:
                trust = trust * (view.covered[..., None] | masked)
            yield view, trust
