"""Language on finished Gaussians as the linear system that it is: the codes whose renders come closest to the masks of all views.

With finished geometry a rendered code is linear in the codes of the Gaussians, so that the best ones need no training. A mean over pixels, as the
other rules take it, is one step towards them: it blurs over an edge whatever a Gaussian on the edge reaches, and loses what is smaller than
a Gaussian is wide.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields.splat import SplatModel
from vlgs.heads.threads import one_thread
from vlgs.training.lift_rules import Consensus
from vlgs.training.lift_system import Alike, System
from vlgs.training.mask_weights import mask_weights
from vlgs.types import Scene, View
from vlgs.values import require_range

log = logging.getLogger(__name__)

TRIAL_EVERY = 4
"""Each so-manyth view of a trial is asked, codes are solved from the others. From few views what smooths wins: from half of 30 `alike` on photographs that
lose by it, from half of 44 or more no longer."""
TRIAL_GAIN = 0.017
"""Share by which what is tried has to lower what is left unexplained: a little less of it is had by smoothing alone. Drawn between scenes of glass that lose by
likeness (1.5 % less and below) and scenes that gain by it (1.8 % and above)."""
TRIAL_STEPS = 2
TRIAL_CHANNELS = 8
"""Directions in which targets spread most; more tell the same."""


@dataclass(frozen=True)
class Solve(Consensus):
    """``min sum_p t_p |sum_i w_ip f_i - H_p|^2 + prior sum_i m_i |f_i - c_i|^2`` over the codes f, some conjugate gradients away from c.

    c are the codes of `Consensus`, m_i is what Gaussian i weighs in all images, t_p is 1 where a mask gives H_p, and `absent` where none does and H_p
    is 0. The prior decides where a Gaussian stands behind others, and keeps codes from swinging to explain faulty masks. Splat Feature Solver
    (Xiong et al., 2025) sees lifting as least squares too, and takes the weighted mean for its solution.

    Masks end some pixels beside the edge of a thing, elsewhere in every view. Of a thing that is hardly wider their mean has more of what is behind than of
    itself. `border` blurs the images as such masks are blurred on the mean, so that the codes are those of what was blurred; `alike` holds what is sharpened
    so to what photographs say of edges, by ``alike sum_ij a_ij |f_i - f_j|^2`` over pairs of neighbours, where a_ij grows with what both weigh and falls with
    the distance of their colours. Neither is right everywhere: with exact masks both together cost half a point of mIoU, on photographs of a street
    `alike` costs two. On `trial` each has to show first that codes of some views foretell the masks of others better with it than without.

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
    trial: bool = False
    """Whether `border`, and then `alike`, are left out where they do not foretell masks better than going without."""

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
        vectors: Float[Tensor, "m t"],
        starts: Sequence[Float[Tensor, "n t"]],
    ) -> list[Float[Tensor, "n t"]]:
        """See `vlgs.training.lift_rules.Refining`. Levels whose weights are the same are one system: a pixel's weights are found once for all."""
        if not self.steps:
            return list(starts)
        with torch.no_grad():
            weight = model.fuse().language_weight
        groups = {tuple(range(len(starts))): weight}
        if weight.dim() == 2:
            groups = {(level,): own.contiguous() for level, own in enumerate(weight.unbind(1))}
        rule, codes = self, []
        for levels, own in groups.items():
            system = System(model, own, scene, levels, vectors, self.absent, self.pixels)
            if self.trial and (self.border or self.alike) and 0 in levels:
                rule = self._tried(replace(system, levels=(0,)))
            start = torch.cat([starts[level] for level in levels], dim=1)
            solved = rule._solved(system, system.masses(), start)
            codes += solved.split(vectors.shape[1], dim=1)
        return codes

    def _solved(
        self, sharp: System, mass: Float[Tensor, "n l"], start: Float[Tensor, "n c"]
    ) -> Float[Tensor, "n c"]:
        levels = len(sharp.levels)

        def wide(numbers: Float[Tensor, "n l"]) -> Float[Tensor, "n c"]:
            return numbers.repeat_interleave(start.shape[1] // levels, dim=1)

        system = replace(sharp, border=self.border)
        held = wide(self.prior * mass)
        missing, diagonal = system.missing(start), (1 + self.prior) * mass
        alike = Alike.of(sharp.model, self.alike, mass) if self.alike else None
        if alike is not None:
            missing, diagonal = missing - alike.apart(start), diagonal + alike.diagonal()
        scale = wide(1 / diagonal.clamp_min(torch.finfo(mass.dtype).tiny))

        def product(codes: Tensor) -> Tensor:
            pushed = system.gathered(codes) + held * codes
            return pushed if alike is None else pushed + alike.apart(codes)

        return conjugate_gradients(product, missing, scale, start, self.steps)

    def _tried(self, system: System) -> "Solve":
        """The rule with what passes the trial, on the masks of one level."""
        views = [view for view in system.scene.train if view.read_masks is not None]
        left_out = tuple(views[TRIAL_EVERY - 1 :: TRIAL_EVERY])
        others = tuple(view for i, view in enumerate(views) if (i + 1) % TRIAL_EVERY)
        solved = replace(
            system,
            scene=replace(system.scene, train=others),
            vectors=_leading(system.vectors),
            pixels=_quarter(self.pixels, others),
        )
        asked = replace(solved, scene=replace(system.scene, train=left_out))
        [level] = system.levels
        sums = mask_weights(system.model, solved.scene, level, self.share, solved.pixels)
        start, mass = self.combine(sums, solved.vectors), solved.masses()

        def unexplained(rule: Solve) -> float:
            codes = rule._solved(solved, mass, start)
            return replace(asked, border=rule.border).unexplained(codes)

        kept = replace(self, steps=TRIAL_STEPS, border=0.0, alike=0.0, trial=False)
        least = unexplained(kept)
        for name in ("border", "alike"):
            if value := getattr(self, name):
                with_it = replace(kept, **{name: value})
                error = unexplained(with_it)
                better = error < (1 - TRIAL_GAIN) * least
                log.info(
                    "lift: with %s=%g codes of %d views leave %.4g of the masks of %d others unexplained, without %.4g: %s",
                    name, value, len(others), error, len(left_out), least,
                    "kept" if better else "left out",
                )  # fmt: skip
                if better:
                    kept, least = with_it, error
        return replace(kept, steps=self.steps)


def _quarter(pixels: int, views: Sequence[View]) -> int:
    """Of the pixels that count of a view: a trial tells as much from every second pixel of every second row."""
    most = max((view.camera.width * view.camera.height for view in views), default=4)
    return max(1, min(pixels or most, most) // 4)


def _leading(vectors: Float[Tensor, "m t"]) -> Float[Tensor, "m k"]:
    """Coordinates in the directions that vectors spread most in, of which there are `TRIAL_CHANNELS`."""
    with one_thread():
        rows = vectors.detach().double()
        _, directions = torch.linalg.eigh(rows.T @ rows)  # ascending
        return (rows @ directions[:, -TRIAL_CHANNELS:]).to(vectors.dtype).contiguous()


@torch.no_grad()
def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    residual: Float[Tensor, "n t"],
    scale: Float[Tensor, "n t"],
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
