"""What the framework's seams add to a training step: attributes, objectives and the choice of a device.

Beside the step stands the same step written out for the default options: the same operations on the same numbers, with no table of attributes,
no objectives and no choice by device between them. The checks of input are on both sides. Fields and stages are not seen: no step calls them.
"""

from dataclasses import dataclass
from statistics import median
from time import thread_time

import torch
from torch import Tensor

from vlgs import losses
from vlgs.bench.iteration import SIZES, IterationSize, make_module
from vlgs.fields.splat import SplatModel
from vlgs.fusion import require_channels
from vlgs.fusion.attention import SelfAttention
from vlgs.gaussians.logistic import logistic
from vlgs.gaussians.sh import sh_to_rgb
from vlgs.losses import L1_SHARE
from vlgs.objectives import BlendedView
from vlgs.ops import attention, l1_dssim, project, rasterize_to_pixels, squared_error
from vlgs.ops.rasterize import check_camera, check_config, check_tensors
from vlgs.training.lightning import VLGSModule
from vlgs.types import Camera, ChannelGroup
from vlgs.view_blend import blend_targets

STEPS = range(1, 11)
SMALL = IterationSize(60, 24, 18, 40, 0)


@dataclass(frozen=True)
class SeamCost:
    """CPU milliseconds of a step up to its gradients, on one thread."""

    step: float
    """Median of a default step."""
    seams: float
    """Median over turns of what is more with seams than without, in a scene so small that the difference is not lost in the noise of the
    kernels. Seams are called as often in any scene."""

    @property
    def share(self) -> float:
        """Of a step."""
        return self.seams / self.step


def written_out(module: VLGSModule, step: int) -> Tensor:
    """The loss of a step of the default options, without a seam; the same bits as `TrainingStep.forward` gives."""
    setup, model = module.step.setup, module.model
    pair = setup.views.sampler.pair(step)
    first, second = setup.views[pair[0]], setup.views[pair[1]]
    raw = model.splats
    means, quats, scales = raw["means"], raw["quats"], raw["log_scales"].exp()
    opacity, indicator = logistic(raw["opacity_logits"]), logistic(raw["indicator_logits"])
    color, feature = _fuse(model, sh_to_rgb(raw["sh0"]), raw["features"])

    def render(camera: Camera, with_color: bool) -> tuple[Tensor, ...]:
        language = ChannelGroup(feature, indicator)
        groups = [ChannelGroup(color.clamp_min(0.0), opacity)] * with_color + [language]
        check_config(model.raster)
        check_tensors(means, quats, scales, groups)
        check_camera(camera)
        splats = project._on_cpu(means, quats, scales, camera, model.raster)
        if with_color:
            splats.mean2d.retain_grad()
        return rasterize_to_pixels._on_cpu(splats, groups, camera, model.raster).images

    seen = [render(target.view.camera, with_color=True) for target in (first, second)]
    errors = [
        _l1_dssim(image, target.image)
        for (image, _), target in zip(seen, (first, second), strict=True)
    ]
    total = errors[0] + errors[1]
    for (_, codes), target in zip(seen, (first, second), strict=True):
        assert target.codes is not None
        total = total + _squared_error(codes, target.codes, target.valid)
    between = setup.objectives["blended_view"]
    assert isinstance(between, BlendedView)
    weight = between.weight * setup.views.similarity(*pair)
    if weight > 0:
        assert first.codes is not None and first.valid is not None  # noqa: PT018
        assert second.codes is not None and second.valid is not None  # noqa: PT018
        k, camera = between.between.at(step)
        mixed = blend_targets(first.codes, first.valid, second.codes, second.valid, k, setup.blend)
        (codes,) = render(camera, with_color=False)
        total = total + weight * _squared_error(codes, *mixed)
    return total


def measure_seams(turns: int, size: IterationSize = SIZES[0]) -> SeamCost:
    """What a step of some size takes, and what seams add to any.

    Raises:
        RuntimeError: If a step and the same written out differ in a bit of the loss or of a gradient.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        module, small = make_module(size), make_module(SMALL)
        for each in (module, small):
            _require_same(each)
        steps = [_time(module, True) for _ in range(turns)]
        times = [_turn(small, turn % 2 == 0) for turn in range(10 * turns)]
    finally:
        torch.set_num_threads(threads)
    return SeamCost(median(steps), median(whole - plain for plain, whole in times))


def _turn(module: VLGSModule, plain_first: bool) -> tuple[float, float]:
    """Milliseconds without and with seams; who is second finds warmer caches, so that turns alternate."""
    if plain_first:
        return _time(module, False), _time(module, True)
    whole = _time(module, True)
    return _time(module, False), whole


def _time(module: VLGSModule, seams: bool) -> float:
    start = thread_time()
    for step in STEPS:
        _run(module, step, seams)
    return 1e3 * (thread_time() - start) / len(STEPS)


def _run(module: VLGSModule, step: int, seams: bool) -> Tensor:
    module.optimizer.zero_grad(set_to_none=True)
    if not seams:
        total = written_out(module, step)
        total.backward()
        return total
    done = module.step.forward(step)
    module.step.backward(done)
    return done.total


def _require_same(module: VLGSModule) -> None:
    """Both once over all steps, which also fills what is kept over steps."""
    for step in STEPS:
        found = []
        for seams in (False, True):
            total = _run(module, step, seams)
            grads = {n: p.grad for n, p in module.model.named_parameters() if p.grad is not None}
            found.append({"loss": total.detach(), **grads})
        plain, whole = found
        if plain.keys() != whole.keys() or any(not torch.equal(whole[n], plain[n]) for n in plain):
            raise RuntimeError(
                "bench: the step written out must be the step that trains, got others"
            )


def _fuse(model: SplatModel, color: Tensor, feature: Tensor) -> tuple[Tensor, Tensor]:
    fusion = model.fusion
    assert isinstance(fusion, SelfAttention)
    require_channels("SelfAttention", color, feature, fusion.widths)
    qkv, out, token = fusion.qkv, fusion.out, fusion.token
    inner = out.in_features
    weights, biases = (t.split([inner, 2 * inner]) for t in (qkv.weight, qkv.bias))
    layers = (weights[0], biases[0], weights[1], biases[1], out.weight, out.bias)
    fused = attention._on_cpu(color, feature, token, layers, mixes_color=True)
    return fused[0], fused[1]


def _l1_dssim(image: Tensor, photograph: Tensor) -> Tensor:
    losses._require_shapes("l1_dssim", image, photograph)
    losses._require_pixels("l1_dssim", image)
    return l1_dssim._on_cpu(image, photograph, None, L1_SHARE)


def _squared_error(codes: Tensor, wanted: Tensor, valid: Tensor | None) -> Tensor:
    losses._require_shapes("masked_mse", codes, wanted, valid)
    return squared_error._on_cpu(codes, wanted, valid, "valid")
