"""Adaptive density control: clone, split, prune and reset (Kerbl et al. 2023; conf/README.md, D.10 and D.11)."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from vlgs.gaussians.attributes import STANDARD, Attributes, Role
from vlgs.gaussians.config import GaussiansConfig
from vlgs.gaussians.draws import seeded_generator
from vlgs.gaussians.init import distance_to_nearest
from vlgs.gaussians.logistic import logit
from vlgs.gaussians.long_axis import halve
from vlgs.gaussians.parameters import Parameters
from vlgs.geometry import quat_to_rotmat

log = logging.getLogger(__name__)

CHILDREN = 2
"""Gaussians that a split one is replaced by."""
SHRINK = 1.6
"""Their scales are the parent's divided by this (3DGS: 0.8 times the number of children)."""
BACKGROUND = 4.0
"""What is more scene extents away from every training camera is a background, which may have any size."""
MIN_COUNT = 16
"""Pruning leaves at least this many, so that a bad step cannot end a run with an empty scene."""


@dataclass
class DensifyState:
    """Screen-space gradients of the Gaussians since the last densification."""

    grad_sum: Float[Tensor, " n"]
    """Sum over the views that saw a Gaussian of the length of its gradient, in NDC units."""
    count: Float[Tensor, " n"]
    """Number of those views."""

    @classmethod
    def zeros(cls, n: int) -> "DensifyState":
        """The state before the first view."""
        return cls(torch.zeros(n), torch.zeros(n))

    def accumulate(
        self,
        mean2d_grad: Float[Tensor, "n 2"],
        visible: Bool[Tensor, " n"],
        width: int,
        height: int,
        full_to: float = 0.0,
    ) -> None:
        """Add one real view; gradients of several views are never summed before their length is taken (conf/README.md, D.11).

        In NDC a detail that fills a fixed share of a photograph has the same gradient whatever the size, one that fills a pixel has it divided by
        the size: without `full_to` the finer a photograph, the less of what it adds is learned. The root of the size lies between the two.

        Args:
            mean2d_grad: Gradient of the loss with respect to `Rendered.mean2d`, per pixel.
            visible: `Rendered.visible` of the same view.
            width: Of the image in pixels; half of it is one NDC unit.
            height: Likewise.
            full_to: `DensifyConfig.grad_threshold_size`: gradients of views so many times larger are multiplied by the root of that; 0: of none.
        """
        half_image = mean2d_grad.new_tensor([width / 2, height / 2])
        if full_to > 0:
            half_image *= max(math.sqrt(width * height) / full_to, 1.0) ** 0.5
        length = (mean2d_grad * half_image).norm(dim=-1)
        self.grad_sum += torch.where(visible, length, 0.0)
        self.count += visible

    def mean(self) -> Float[Tensor, " n"]:
        """Mean length of the gradient over the views that saw a Gaussian; 0 where none did."""
        return self.grad_sum / self.count.clamp_min(1)

    def restart(self, n: int) -> None:
        """Forget everything and make room for n Gaussians."""
        self.grad_sum, self.count = torch.zeros(n), torch.zeros(n)


@dataclass(frozen=True)
class DensifyReport:
    """What one densification did: count = count before + cloned + split - pruned."""

    cloned: int
    split: int
    """Parents that were replaced by two children."""
    pruned: int
    """Gaussians removed, without the split parents."""
    count: int
    """Gaussians afterwards."""
    refused: int = 0
    """Gaussians that should have been cloned or split, but for `max_count`."""


@dataclass(frozen=True)
class _Rows:
    """The next generation in terms of the present one."""

    source: Int[Tensor, " m"]
    """Row that each new row copies."""
    fresh: Bool[Tensor, " m"]
    """Rows that start with zero Adam moments: clones and children."""
    child: Bool[Tensor, " m"]

    def __getitem__(self, kept: Bool[Tensor, " m"]) -> "_Rows":
        return _Rows(self.source[kept], self.fresh[kept], self.child[kept])


def densify(
    params: nn.ParameterDict,
    optimizer: torch.optim.Optimizer,
    state: DensifyState,
    config: GaussiansConfig,
    extent: float,
    seed: int,
    step: int,
    centers: Float[Tensor, "v 3"] | None = None,
    attributes: Attributes = STANDARD,
    error: Float[Tensor, " n"] | None = None,
) -> DensifyReport:
    """Clone small and split large Gaussians whose screen gradient is high, then remove the useless ones.

    With `DensifyConfig.long_axis` small ones are split as well. A Gaussian with two shapes is as large as the larger one, and its children
    are drawn from colour's.
    Parameters are replaced in `params` and in the optimiser's groups of the same name; Adam's moments follow their
    Gaussian and are zero for new ones. `state` restarts at zero. The result is a function of the arguments alone.

    Args:
        params: Raw parameters; every entry has one row per Gaussian.
        optimizer: Adam with one parameter per group and `group["name"]` equal to the key in `params`.
        state: Gradients accumulated since the last call.
        config: Thresholds; `max_count` stops growth, the highest mean gradients going first.
        extent: `vlgs.geometry.scene_extent` of the training cameras, world units.
        seed: Of the run.
        step: Of the run; large Gaussians are spared until the first opacity reset has passed.
        centers: Of the training cameras; what is behind them may be large, and larger the farther it is. None: nothing may.
        attributes: The table of `params`.
        error: Of the pixels that a Gaussian blends, from 0 on, in any unit. As many as reach the threshold are cloned or split, those of the highest
            mean gradient times the root of it. None: those that reach the threshold.

    Raises:
        ValueError: If `state` has another size than `params`, or no Gaussian is finite.
    """
    n = params["means"].shape[0]
    if state.grad_sum.shape[0] != n:
        raise ValueError(f"densify: state must have {n} rows, got {state.grad_sum.shape[0]}")
    with torch.no_grad():
        dead = _dead(params, config, attributes)
        hot, merit = _hot(state, config) & ~dead, state.mean()
        if error is not None:
            merit = merit * error.sqrt()
            hot = _highest(~dead & (merit > 0), merit, int(hot.sum()))
        grow = _highest(hot, merit, config.max_count - int((~dead).sum()))
        small = _largest_scale(params, attributes) <= config.densify.dense_share * extent
        clone = grow & small & (not config.densify.long_axis)
        rows = _next_generation(dead, clone, split=grow & ~clone)
        values = {name: value[rows.source] for name, value in params.items()}
        if config.densify.share_weights:
            _share_weights(values, clone[rows.source], config.densify.prune_below)
        if config.densify.long_axis:
            halve(values, rows.child, attributes, config.densify.prune_below)
        else:
            _place_children(values, rows, seeded_generator("densify", seed, step), attributes)
        kept = _not_large(values, config, extent, step, centers, attributes)
        if not kept.all():
            rows, values = rows[kept], {name: value[kept] for name, value in values.items()}
    _replace(params, optimizer, values, rows)
    state.restart(rows.source.shape[0])
    cloned, split, count = int(clone.sum()), int((grow & ~clone).sum()), len(rows.source)
    pruned, refused = n + cloned + split - count, int((hot & ~grow).sum())
    return DensifyReport(cloned, split, pruned, count, refused)


def reset_opacity(
    params: nn.ParameterDict, optimizer: torch.optim.Optimizer, config: GaussiansConfig
) -> None:
    """Lower every opacity to `reset_to` at most and forget its Adam moments, in place.

    Indicators stay as they are unless `reset_indicator` (conf/README.md, D.10).
    """
    names = ["opacity_logits"]
    if config.densify.reset_indicator:
        names.append("indicator_logits")
    for name in names:
        with torch.no_grad():
            params[name].clamp_(max=logit(config.densify.reset_to))
        for moment in _moments(optimizer, params[name]).values():
            moment.zero_()


def remove(
    params: nn.ParameterDict,
    optimizer: torch.optim.Optimizer,
    state: DensifyState,
    gone: Bool[Tensor, " n"],
) -> None:
    """Take Gaussians away, down to `MIN_COUNT`; `state` restarts at zero. Nothing is touched where none goes."""
    gone = _spare(gone, params["opacity_logits"].detach())
    if not gone.any():
        return
    source = (~gone).nonzero().squeeze(1)
    old = torch.zeros_like(source, dtype=torch.bool)
    with torch.no_grad():
        values = {name: value[source] for name, value in params.items()}
    _replace(params, optimizer, values, _Rows(source, fresh=old, child=old))
    state.restart(len(source))


def _dead(
    params: nn.ParameterDict, config: GaussiansConfig, attributes: Attributes
) -> Bool[Tensor, " n"]:
    """Gaussians that are too faint to matter, and those with broken parameters."""
    indicator, opacity = params["indicator_logits"].sigmoid(), params["opacity_logits"].sigmoid()
    if indicator.dim() == 2:  # one level that needs a Gaussian keeps it
        indicator = indicator.amax(dim=1)
    weight = indicator if config.prune_on == "indicator" else opacity
    if config.prune_on == "max":
        weight = weight.maximum(indicator)
    # A scale that overflows and a rotation of length zero are as broken as a NaN.
    finite = _largest_scale(params, attributes).isfinite()
    for quats in _having(params, attributes, "rotation"):
        finite &= quats.norm(dim=1) > 0
    for value in params.values():
        finite &= value.isfinite().flatten(1).all(dim=1) if value.dim() > 1 else value.isfinite()
    if not finite.any():
        raise ValueError("densify: Gaussians must be finite, got none that is")
    if not finite.all():
        log.warning("densify: %d of %d Gaussians are not finite", int((~finite).sum()), len(finite))
    return _spare(weight < config.densify.prune_below, weight, finite) | ~finite


def _spare(
    doomed: Bool[Tensor, " n"], merit: Float[Tensor, " n"], finite: Bool[Tensor, " n"] | None = None
) -> Bool[Tensor, " n"]:
    """Keep the best of those to be pruned if fewer than `MIN_COUNT` would be left."""
    able = torch.ones_like(doomed) if finite is None else finite
    alive = int((able & ~doomed).sum())
    floor = min(MIN_COUNT, int(able.sum()))
    if alive >= floor:
        return doomed
    log.warning("densify: %d Gaussians would be left, %d are kept", alive, floor)
    best = _highest(doomed & able, merit, floor - alive)
    return doomed & ~best


def _hot(state: DensifyState, config: GaussiansConfig) -> Bool[Tensor, " n"]:
    return (state.mean() >= config.densify.grad_threshold) & (state.count > 0)


def _highest(
    candidates: Bool[Tensor, " n"], merit: Float[Tensor, " n"], room: int
) -> Bool[Tensor, " n"]:
    """At most `room` of the candidates, those of highest merit; the earlier row where it is equal."""
    if int(candidates.sum()) <= room:
        return candidates
    rows = candidates.nonzero().squeeze(1)
    best = rows[merit[rows].argsort(descending=True, stable=True)[: max(room, 0)]]
    return torch.zeros_like(candidates).index_fill_(0, best, True)


def _next_generation(
    dead: Bool[Tensor, " n"], clone: Bool[Tensor, " n"], split: Bool[Tensor, " n"]
) -> _Rows:
    survivors = (~dead & ~split).nonzero().squeeze(1)
    clones = clone.nonzero().squeeze(1)
    children = split.nonzero().squeeze(1).repeat(CHILDREN)
    counts = torch.tensor([len(survivors), len(clones), len(children)])
    fresh = torch.tensor([False, True, True]).repeat_interleave(counts)
    child = torch.tensor([False, False, True]).repeat_interleave(counts)
    return _Rows(torch.cat([survivors, clones, children]), fresh, child)


def _place_children(
    values: dict[str, Tensor], rows: _Rows, generator: torch.Generator, attributes: Attributes
) -> None:
    """Draw the centres of the children from their parent and shrink them, in place."""
    log_scales = values["log_scales"][rows.child]
    offsets = log_scales.exp() * torch.randn(
        log_scales.shape, generator=generator, dtype=log_scales.dtype
    )
    rotation = quat_to_rotmat(values["quats"][rows.child])
    values["means"][rows.child] += (rotation @ offsets[..., None]).squeeze(-1)
    for scales in _having(values, attributes, "scale"):
        scales[rows.child] -= math.log(SHRINK)


def _share_weights(
    values: dict[str, Tensor], paired: Bool[Tensor, " m"], prune_below: float
) -> None:
    """Clones and their originals let through together what the original did, in place; a share that would be pruned is not made."""
    for name in ("opacity_logits", "indicator_logits"):
        logits = values[name]
        # By numpy, as the bits of torch's logarithms depend on the number of threads; through: what one of the two lets, its logarithm.
        through = -np.logaddexp(0.0, logits.double().numpy()) / 2
        shared = torch.from_numpy(np.log(-np.expm1(through)) - through).to(logits.dtype)
        at = paired if logits.dim() == 1 else paired[:, None]
        values[name] = torch.where(at & (shared > logit(prune_below)), shared, logits)


def _having(params: Parameters, attributes: Attributes, role: Role) -> list[Tensor]:
    return [value for name, value in params.items() if attributes[name].role == role]


def _largest_scale(params: Parameters, attributes: Attributes) -> Float[Tensor, " n"]:
    """Of colour's shape and, where it has one, of language's."""
    return torch.cat(_having(params, attributes, "scale"), dim=1).amax(dim=1).exp()


def _not_large(
    values: Mapping[str, Tensor],
    config: GaussiansConfig,
    extent: float,
    step: int,
    centers: Float[Tensor, "v 3"] | None,
    attributes: Attributes,
) -> Bool[Tensor, " n"]:
    """Gaussians that stay, once large ones are looked for.

    3DGS also names a radius of 20 px on the screen; its code as released clears the radii just before it looks at
    them, so that only the size in the world ever counted. That is what is done here, but what is farther from the middle of the
    cameras than all of them may grow with its distance, by twice the share, since a background (`vlgs.gaussians.background`) starts
    as wide as it is far.
    """
    largest, first_reset = _largest_scale(values, attributes), config.densify.reset_every
    if not config.densify.prune_large or first_reset == 0 or step <= first_reset:
        return torch.ones_like(largest, dtype=torch.bool)
    size = torch.full_like(largest, extent)
    if centers is not None:
        means = values["means"].float()
        size += 2 * ((means - centers.mean(dim=0)).norm(dim=1) - extent).clamp_min(0)
        size[distance_to_nearest(means, centers) >= BACKGROUND * extent] = math.inf
    large = largest > config.densify.max_scale_share * size
    return ~_spare(large, -largest)


def _replace(
    params: nn.ParameterDict,
    optimizer: torch.optim.Optimizer,
    values: dict[str, Tensor],
    rows: _Rows,
) -> None:
    """Put new tensors in the place of the parameters, here and in the optimiser, with the moments of their rows."""
    groups = {group.get("name"): group for group in optimizer.param_groups}
    for name, value in values.items():
        old = params[name]
        new = nn.Parameter(value, requires_grad=old.requires_grad)
        params[name] = new
        if name not in groups:
            continue
        moments = _moments(optimizer, old)
        kept = optimizer.state.pop(old, {})
        for key, moment in moments.items():
            moved = moment[rows.source]
            moved[rows.fresh] = 0
            kept[key] = moved
        groups[name]["params"] = [new]
        if kept:
            optimizer.state[new] = kept


def _moments(optimizer: torch.optim.Optimizer, parameter: Tensor) -> dict[str, Tensor]:
    """The optimiser's tensors with one entry per entry of the parameter; a step count is not one of them."""
    state = optimizer.state.get(parameter, {})
    return {
        key: value
        for key, value in state.items()
        if isinstance(value, Tensor) and value.dim() > 0 and value.shape == parameter.shape
    }
