"""Finite differences in float64 for every differentiable function of the package; a new one must join a list to pass.

The functions are found, not remembered: whatever is public and returns floating tensors is either differentiated here or
stands among those without a gradient, with the reason. Inputs keep away from cutoffs, where a central difference fails.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import get_args

import pytest
import torch
from slow import with_slow
from torch import Tensor
from torch.autograd import gradcheck

from tests.stress.draws import Check, draw
from tests.stress.gradients_of_heads import HEAD_CHECKS
from tests.stress.gradients_of_rays import RAY_CHECKS
from tests.stress.no_gradient import AREAS, NO_GRADIENT, public_functions
from tests.stress.splats import SMOOTH, make_splats
from vlgs.fields.similarity import cosines, decoded_cosines
from vlgs.fields.splat import SplatModel
from vlgs.fusion.attention import CrossAttention, SelfAttention
from vlgs.fusion.blocks import BLOCK, from_blocks, linear, to_blocks
from vlgs.fusion.mlp import MLP
from vlgs.gaussians.attributes import STANDARD, sparse_softmax
from vlgs.gaussians.logistic import logistic
from vlgs.gaussians.parameters import activate
from vlgs.gaussians.sh import rgb_to_sh, sh_to_rgb
from vlgs.geometry import camera_center, pose_matrix, quat_to_rotmat, rotmat_to_quat
from vlgs.gsplat import rasterization
from vlgs.heads.identity import Identity
from vlgs.indicator import Learned, Opacity
from vlgs.losses import (
    l1_dssim,
    masked_cosine,
    masked_l1,
    masked_mse,
    ssim,
    ssim_map,
)
from vlgs.objectives import Language
from vlgs.ops import l1_dssim as ops_l1_dssim
from vlgs.ops import rasterize_reference
from vlgs.ops import ssim as ops_ssim
from vlgs.ops.absolute_error import absolute_error
from vlgs.ops.attention import Token, attend
from vlgs.ops.cached_weights import CachedView
from vlgs.ops.depth import at_rows, camera_depth, render_depth
from vlgs.ops.huber import huber_sum
from vlgs.ops.neighbours import neighbour_products
from vlgs.ops.rasterize import rasterize
from vlgs.ops.squared_error import squared_error
from vlgs.ops.view_color import view_color
from vlgs.queries.relevancy import LerfRelevancy, VocabSoftmax
from vlgs.types import Camera, ChannelGroup, DepthKind, Gaussians, RasterConfig
from vlgs.view_blend import FixedBlend, blend_targets
from vlgs.view_blend.pose import slerp

VALID = torch.tensor([[True, False, True, True]] * 3)
SIZE = (3, 4, 2)
LAYERS = ((6, 3), (6,), (12, 3), (12,), (3, 6), (3,))
"""Weights and biases of self-attention over three channels: queries, keys and values, output."""
LAYER = torch.nn.Linear(2, 3).double().requires_grad_(False)


def rasterizing(backend: str, outside: bool) -> Check:
    """Two groups of their own, one that shares a chain, one that leaves the shape alone; inside or outside the clamp."""
    s = make_splats(5, seed=2, size=(6, 5), channels=(2, 1)).to(torch.float64)
    if outside:
        far = torch.tensor([[6.0, 0.2], [-6, 0.1], [0.3, 6], [-0.2, -6], [5, -5]]).double()
        s = replace(s, means=torch.cat([far, s.means[:, 2:]], 1), scales=s.scales + 2.5)
    K = torch.tensor([[6.0, 0, 2.5], [0, 7, 3], [0, 0, 1]]).double()

    def images(
        means: Tensor, quats: Tensor, scales: Tensor, w0: Tensor, w1: Tensor, f0: Tensor, f1: Tensor
    ):
        groups = [ChannelGroup(f0, w0), ChannelGroup(f1, w1), ChannelGroup(f1, w0)]
        out = rasterize(means, quats, scales, groups, torch.eye(4), K, 6, 5, SMOOTH, backend)  # pyright: ignore
        return (*out.images, *out.alphas, out.mean2d)

    weights = [0.9 * w for w in s.weights]
    return images, [s.means, s.quats, s.scales, *weights, *s.values]


def depths(kind: DepthKind, backend: str = "cpu") -> Check:
    """One depth of the scene of `rasterizing`, seen by a turned camera; opaque enough for a median, and away from where it jumps."""
    s = make_splats(5, seed=2, size=(6, 5), channels=(1,)).to(torch.float64)
    viewmat = torch.eye(4).double()
    viewmat[:3, :3] = quat_to_rotmat(torch.tensor([1.0, 0.02, -0.03, 0.01]).double())
    camera = Camera(viewmat, view().K, 6, 5)

    def image(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor):
        splats = means, quats, scales, opacities
        if backend == "reference":
            return rasterize_reference.render_depth(*splats, camera, SMOOTH, kind)
        return render_depth(*splats, camera.viewmat, camera.K, 6, 5, SMOOTH, kind)

    opacities = 0.7 + 0.2 * s.weights[0]
    return image, [s.means, s.quats, 2 * s.scales, opacities]


def by_gsplats_names() -> Check:
    """Two cameras, antialiased, colour with a background and expected depth; cutoffs are where they are, and far enough."""
    s = make_splats(5, seed=2, size=(6, 5), channels=(2,)).to(torch.float64)
    viewmats = torch.eye(4).double().repeat(2, 1, 1)
    viewmats[1, :3, 3] = torch.tensor([0.1, -0.2, 0.3])

    def images(
        means: Tensor, quats: Tensor, scales: Tensor, o: Tensor, colors: Tensor, behind: Tensor
    ):
        image, alpha, meta = rasterization(
            means, quats, scales, o, colors, viewmats, view().K.repeat(2, 1, 1), 6, 5, backgrounds=behind,
            render_mode="RGB+ED", rasterize_mode="antialiased",
        )  # fmt: skip
        return image, alpha, meta["means2d"], meta["opacities"], meta["depths"]

    splats = [s.means, s.quats, 2 * s.scales, 0.5 + 0.4 * s.weights[0]]
    return images, [*splats, s.values[0], draw(2, 2)]


def shape_alone() -> Check:
    """Without its gradient on the shape, a group's values and weights keep theirs."""
    s = make_splats(5, seed=2, size=(6, 5), channels=(2,)).to(torch.float64)

    def image(weight: Tensor, values: Tensor):
        group = ChannelGroup(values, weight, shape_grad=False)
        means = s.means.clone().requires_grad_()
        out = rasterize(means, s.quats, s.scales, [group], torch.eye(4), K, 6, 5, SMOOTH)
        return out.images[0], out.alphas[0]

    K = torch.tensor([[6.0, 0, 2.5], [0, 7, 3], [0, 0, 1]]).double()
    return image, [0.9 * s.weights[0], s.values[0]]


def frozen() -> Check:
    """Values alone: everything else of a cached view is a constant."""
    s = make_splats(5, seed=2, size=(6, 5), channels=(2,)).to(torch.float64)
    kept = CachedView(s.means, s.quats, s.scales, s.weights[0], view(), SMOOTH)
    return kept.render, [s.values[0]]


def coloring(degree: int) -> Check:
    """Colours that stay above the clamp at 0; degree 0 does not read the rest."""
    eye, bright = draw(3, seed=7), 2 + draw(3, 3)

    def color(base: Tensor, shN: Tensor, means: Tensor):
        return view_color(base, shN, means, eye, degree)

    return color, [bright, 0.1 * draw(3, 15, 3, seed=1), 3 + draw(3, 3, seed=2)]


def parameters() -> dict[str, Tensor]:
    s = make_splats(4, seed=3, size=(6, 5)).to(torch.float64)
    return {
        "means": s.means, "quats": s.quats, "log_scales": s.scales.log(), "sh0": draw(4, 3, seed=1),
        "shN": 0.1 * draw(4, 15, 3, seed=2), "opacity_logits": draw(4, seed=3),
        "indicator_logits": draw(4, seed=4), "features": draw(4, 3, seed=5),
        "language_quats": draw(4, 4, seed=6), "language_log_scales": draw(4, 3, seed=7),
    }  # fmt: skip


def activated(*values: Tensor) -> Gaussians:
    return activate(dict(zip(parameters(), values, strict=True)))


def tensors(gaussians: Gaussians) -> tuple[Tensor, ...]:
    """All that a set of Gaussians holds."""
    shape = gaussians.language_shape
    assert shape is not None
    own = (value for value in vars(gaussians).values() if isinstance(value, Tensor))
    return (*own, *vars(shape).values())


def model(read: Callable[[SplatModel], object]) -> Check:
    """A method of the model as a function of its parameters."""
    whole = SplatModel(
        parameters(), SelfAttention(3, 3, init="xavier").double(), Learned(), Identity(3), SMOOTH, 3
    )

    def run(*values: Tensor):
        # Module attributes only take Parameters; a plain mapping serves here.
        del whole.splats
        whole.splats = dict(zip(parameters(), values, strict=True))  # pyright: ignore
        return read(whole)

    return run, list(parameters().values())


def view() -> Camera:
    K = torch.tensor([[6.0, 0, 2.5], [0, 7, 3], [0, 0, 1]]).double()
    return Camera(torch.eye(4).double(), K, 6, 5)


def fuse(module: torch.nn.Module) -> Check:
    """Inputs and every weight."""
    module = module.double()
    names = [name for name, _ in module.named_parameters()]

    def run(color: Tensor, feature: Tensor, *weights: Tensor):
        return torch.func.functional_call(
            module, dict(zip(names, weights, strict=True)), (color, feature)
        )

    return run, [draw(3, 2), draw(3, 2, seed=1), *(p.detach() for p in module.parameters())]


def both(loss: Callable[..., Tensor], *rest: object) -> Check:
    """A loss as a function of the render; the target differs from it everywhere."""
    return lambda render: loss(render, 2 + draw(*SIZE, seed=9), *rest), [draw(*SIZE)]


rotation = quat_to_rotmat(draw(4, 4, seed=4))


CHECKS: dict[str, Callable[[], Check]] = {
    **HEAD_CHECKS,
    **RAY_CHECKS,
    "vlgs.ops.rasterize.rasterize": lambda: rasterizing("cpu", False),
    "vlgs.ops.rasterize.rasterize outside the clamp": lambda: rasterizing("cpu", True),
    "vlgs.ops.rasterize.rasterize shape_grad off": shape_alone,
    "vlgs.ops.rasterize_to_pixels.rasterize_to_pixels": lambda: rasterizing("cpu", False),
    "vlgs.ops.project.project": lambda: rasterizing("cpu", True),
    "vlgs.ops.rasterize_reference.rasterize": lambda: rasterizing("reference", False),
    **{f"vlgs.ops.depth.render_depth, {kind}": lambda kind=kind: depths(kind) for kind in get_args(DepthKind)},
    **{
        f"vlgs.ops.rasterize_reference.render_depth, {kind}": lambda kind=kind: depths(kind, "reference")
        for kind in get_args(DepthKind)
    },
    "vlgs.gsplat.rendering.rasterization": by_gsplats_names,
    "vlgs.gsplat.view.project_view": by_gsplats_names,
    "vlgs.gsplat.view.compensation": by_gsplats_names,
    "vlgs.ops.depth.camera_depth": lambda: (lambda means: camera_depth(means, view()), [draw(3, 3)]),
    "vlgs.ops.depth.at_rows": lambda: (
        lambda values: at_rows(values, torch.tensor([[0, -1, 2], [2, 2, -1]])), [draw(3)]
    ),
    "vlgs.ops.cached_weights.CachedView.render": frozen,
    "vlgs.fields.splat.SplatModel.view_color": lambda: model(lambda m: m.view_color(m.fuse(), view())),
    "vlgs.fields.splat.SplatModel.gaussians": lambda: model(
        lambda m: tensors(m.gaussians())
    ),
    "vlgs.fields.splat.SplatModel.fuse": lambda: model(
        lambda m: (lambda fused: (fused.color, fused.feature))(m.fuse())
    ),
    "vlgs.fields.splat.SplatModel.render": lambda: model(
        lambda m: (lambda seen: (seen.color, seen.feature))(m.render(view()))
    ),
    "vlgs.fields.splat.SplatModel.render_values": lambda: model(
        lambda m: m.render_values(view(), m.splats["features"], m.gaussians().indicators)
    ),
    "vlgs.fields.splat.SplatModel.render_each": lambda: model(
        lambda m: m.render_each(
            view(),
            [
                (m.splats["features"], m.gaussians().indicators, False),
                (m.splats["sh0"], m.gaussians().opacities, True),
            ],
        )
    ),
    "vlgs.ops.attention.attend": lambda: (
        lambda color, feature, *layers: attend(color, feature, Token(1, 2), layers, True),
        [draw(3, 2), draw(3, 1, seed=1), *(draw(*s, seed=i) for i, s in enumerate(LAYERS))],
    ),
    "vlgs.ops.absolute_error.absolute_error": lambda: (
        absolute_error, [draw(*SIZE), 2 + draw(*SIZE, seed=1)]
    ),
    "vlgs.ops.huber.huber_sum": lambda: (
        lambda image: huber_sum(image, torch.zeros_like(image), VALID, 0.4), [draw(*SIZE)]
    ),
    "vlgs.ops.neighbours.neighbour_products": lambda: (neighbour_products, [draw(4, 5, 2)]),
    "vlgs.ops.squared_error.squared_error": lambda: both(squared_error, VALID, "all"),
    "vlgs.ops.ssim.ssim_map": lambda: (ops_ssim.ssim_map, [draw(*SIZE), draw(*SIZE, seed=1)]),
    "vlgs.ops.l1_dssim.l1_dssim": lambda: both(ops_l1_dssim.l1_dssim, VALID, 0.3),
    "vlgs.losses.masked_mse": lambda: both(masked_mse, VALID),
    "vlgs.losses.masked_l1": lambda: both(masked_l1, VALID),
    "vlgs.losses.masked_cosine": lambda: both(masked_cosine, VALID),
    "vlgs.losses.ssim": lambda: (ssim, [draw(*SIZE), draw(*SIZE, seed=1)]),
    "vlgs.losses.ssim_map": lambda: (ssim_map, [draw(*SIZE), draw(*SIZE, seed=1)]),
    "vlgs.losses.ssim_map of a column": lambda: (ssim_map, [draw(13, 1, 3), draw(13, 1, 3, seed=1)]),
    **{
        f"vlgs.losses.ssim_map of a row with {c} channels": lambda c=c: (
            ssim_map, [draw(1, 7, c), draw(1, 7, c, seed=1)]
        )
        for c in (1, 3, 5)
    },
    "vlgs.losses.l1_dssim": lambda: both(l1_dssim, VALID),
    "vlgs.losses.l1_dssim by both images, without a mask": lambda: (
        l1_dssim, [draw(*SIZE), 2 + draw(*SIZE, seed=1)]
    ),
    "vlgs.objectives.language.Language.of": lambda: both(Language("cos").of, VALID),
    "vlgs.gaussians.logistic.logistic": lambda: (logistic, [draw(5, low=-20, high=20)]),
    "vlgs.gaussians.attributes.Attribute.activate": lambda: (
        STANDARD["log_scales"].activate, [draw(3, 3)]
    ),
    "vlgs.geometry.quat_to_rotmat": lambda: (quat_to_rotmat, [draw(4, 4)]),
    "vlgs.geometry.rotmat_to_quat": lambda: (rotmat_to_quat, [rotation]),
    "vlgs.geometry.camera_center": lambda: (camera_center, [draw(2, 4, 4)]),
    "vlgs.geometry.pose_matrix": lambda: (pose_matrix, [rotation, draw(4, 3)]),
    "vlgs.view_blend.pose.slerp": lambda: (slerp, [draw(4, 4), draw(4, 4, seed=1), draw(4, low=0.1, high=0.9)]),
    "vlgs.view_blend.target.blend_targets": lambda: (
        lambda a, b: blend_targets(a, VALID, b, VALID.flip(1), 0.3, FixedBlend(value=0.3, mask="or"))[0],
        [draw(*SIZE), draw(*SIZE, seed=1)],
    ),
    "vlgs.fusion.attention.SelfAttention.forward": lambda: fuse(SelfAttention(2, 2, 2, init="xavier")),
    "vlgs.fusion.attention.CrossAttention.forward": lambda: fuse(CrossAttention(2, 2, 2, init="xavier")),
    "vlgs.fusion.attention.SelfAttention.forward of two heads": lambda: fuse(SelfAttention(2, 2, 1, 2, "xavier")),
    "vlgs.fusion.attention.CrossAttention.forward of two heads": lambda: fuse(CrossAttention(2, 2, 1, 2, "xavier")),
    "vlgs.fusion.mlp.MLP.forward": lambda: fuse(MLP(2, 2, residual=False)),
    "vlgs.gaussians.attributes.sparse_softmax": lambda: (partial(sparse_softmax, kept=2), [draw(4, 5)]),
    "vlgs.gaussians.attributes.Attribute.activate of sparse codes": lambda: (
        replace(STANDARD["features"], activation="sparse", kept=2, parts=2).activate, [draw(4, 8)]
    ),
    "vlgs.fields.splat.SplatModel.predict": lambda: model(lambda m: m.predict(m.render(view(), color=False).feature)),  # type: ignore[arg-type]
    "vlgs.fusion.blocks.to_blocks": lambda: (lambda x: to_blocks(x)[:, :, :3], [draw(3, 2)]),
    "vlgs.fusion.blocks.from_blocks": lambda: (lambda x: from_blocks(x.expand(2, 2, BLOCK), 3), [draw(2, 2, 1)]),
    "vlgs.fusion.blocks.linear": lambda: (partial(linear, LAYER), [draw(2, 2, 4)]),
    "vlgs.gaussians.parameters.activate": lambda: (
        lambda *v: tensors(activated(*v)), list(parameters().values())
    ),
    "vlgs.gaussians.sh.sh_to_rgb": lambda: (sh_to_rgb, [draw(4, 3)]),
    "vlgs.gaussians.sh.rgb_to_sh": lambda: (rgb_to_sh, [draw(4, 3)]),
    **{f"vlgs.ops.view_color.view_color of degree {degree}": partial(coloring, degree) for degree in range(4)},
    "vlgs.fields.similarity.cosines": lambda: (cosines, [draw(4, 3), draw(2, 3, seed=1)]),
    "vlgs.fields.similarity.decoded_cosines": lambda: (
        lambda c, t: decoded_cosines(Identity(3).decode, c, t, chunk=4), [draw(3, 2, 3), draw(2, 3, seed=1)]
    ),
    "vlgs.queries.relevancy.LerfRelevancy.relevancy": lambda: (
        LerfRelevancy().relevancy, [draw(2, 4), draw(3, 4, seed=1)]
    ),
    "vlgs.queries.relevancy.LerfRelevancy.__call__": lambda: (
        LerfRelevancy(), [draw(4, 3), draw(2, 3, seed=1), draw(2, 3, seed=2)]
    ),
    "vlgs.queries.relevancy.VocabSoftmax.relevancy": lambda: (
        VocabSoftmax().relevancy, [draw(2, 4), draw(3, 4, seed=1)]
    ),
    "vlgs.queries.relevancy.VocabSoftmax.__call__": lambda: (
        VocabSoftmax(), [draw(4, 3), draw(2, 3, seed=1), draw(2, 3, seed=2)]
    ),
    "vlgs.indicator.Trained.__call__": lambda: (
        lambda *v: Learned()(activated(*v)), list(parameters().values())
    ),
    "vlgs.indicator.Opacity.__call__": lambda: (
        lambda *v: Opacity()(activated(*v)), list(parameters().values())
    ),
}  # fmt: skip


SAME = (
    "vlgs.gsplat.view.project_view",
    "vlgs.gsplat.view.compensation",
    "vlgs.ops.rasterize_to_pixels.rasterize_to_pixels",
    "vlgs.ops.project.project",
    "vlgs.fields.radiance.RadianceField.weights",
    "vlgs.fields.radiance.RadianceField.density",
    "vlgs.fields.splat.SplatModel.predict",
    "vlgs.fields.splat.SplatModel.render_values",
    "vlgs.fields.splat.SplatModel.gaussians",
    "vlgs.indicator.Trained.__call__",
    "vlgs.ops.rasterize_reference.rasterize",
)
"""Parts of what another name differentiates by the very same check, or with all the rest; and the reference, which others compare."""


@pytest.mark.parametrize("name", with_slow(CHECKS, SAME))
def test_gradient_matches_finite_differences(name: str):
    torch.manual_seed(0)
    function, inputs = CHECKS[name]()
    leaves = [t.clone().requires_grad_() for t in inputs]
    assert gradcheck(function, leaves)  # pyright: ignore


def test_every_differentiable_function_is_in_a_list():
    found = {name for area in AREAS for name in public_functions(f"vlgs.{area}")}
    assert len(found) > 40
    listed = {re.split("[ ,]", name)[0] for name in CHECKS} | NO_GRADIENT.keys()
    assert sorted(found - listed) == [], "new: add it to CHECKS, or to NO_GRADIENT with the reason"
    assert sorted(listed - found) == [], "gone: take it out"


def test_the_config_of_these_checks_has_no_cutoff_in_the_way():
    assert SMOOTH.alpha_min < 1e-9 < RasterConfig().alpha_min
    assert SMOOTH.transmittance_min == 0
