"""gsplat 1.5.3 itself, without CUDA: its strategy densifies what is trained here, and its definitions in torch agree."""

import importlib
import inspect
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.gsplat.dense import harmonics
from vlgs.data.synthetic import load_scene
from vlgs.gsplat import rasterization
from vlgs.gsplat.example import start, train
from vlgs.types import Scene

# Not "gsplat" alone: without it, this very folder would be found under that name.
pytest.importorskip("gsplat.strategy", reason="gsplat is not installed: pip install -e '.[test]'")
gsplat: Any = importlib.import_module("gsplat")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(width=48, height=36, train_views=6, test_views=2, points=400)


def strategy(**changed: Any) -> Any:
    """Soon and often, in a run of a few dozen steps."""
    often = {
        "refine_start_iter": 10,
        "refine_every": 20,
        "refine_stop_iter": 80,
        "reset_every": 10**6,
    }
    return gsplat.DefaultStrategy(**{**often, "grow_grad2d": 2e-3, "prune_opa": 0.07, **changed})


@pytest.mark.slow
def test_its_strategy_grows_and_prunes_and_the_loss_falls(scene: Scene):
    torch.manual_seed(0)
    grown = strategy()
    sizes: list[tuple[int, int]] = []
    grow, prune = grown._grow_gs, grown._prune_gs
    grown._grow_gs = lambda *a: sizes.append(grow(*a)) or sizes[-1]
    pruned: list[int] = []
    grown._prune_gs = lambda *a: pruned.append(prune(*a)) or pruned[-1]
    before = len(scene.points)
    splats, losses = train(scene, 100, grown)
    assert sum(duplicated for duplicated, _ in sizes) > 0
    assert sum(split for _, split in sizes) > 0
    assert sum(pruned) > 0
    added = sum(duplicated + split for duplicated, split in sizes)
    assert len(splats["means"]) == before + added - sum(pruned) > 1.2 * before
    assert sum(losses[-10:]) < 0.6 * sum(losses[:10])
    _, alone = train(scene, 100)
    assert sum(losses[-10:]) < sum(alone[-10:]), "more Gaussians show more"


@pytest.mark.parametrize("absgrad", [True, False])
@pytest.mark.parametrize("packed", [True, False])
def test_it_gathers_the_gradients_of_the_centres(scene: Scene, packed: bool, absgrad: bool):
    """Two cameras of 48x36 pixels: the sum over cameras of norms of gradients by units of half images, and how often each is seen."""
    splats, gathers = start(scene), strategy(refine_scale2d_stop_iter=100, absgrad=absgrad)
    state = gathers.initialize_state()
    cameras = [view.camera for view in scene.train[:2]]
    images, _, info = rasterization(
        splats["means"], splats["quats"], splats["scales"].exp(), splats["opacities"].sigmoid(), splats["sh0"],
        torch.stack([c.viewmat for c in cameras]), torch.stack([c.K for c in cameras]), 48, 36, sh_degree=0, packed=packed,
        absgrad=absgrad,
    )  # fmt: skip
    gathers.step_pre_backward(splats, {}, state, 0, info)
    images.square().mean().backward()
    gathers.step_post_backward(splats, {}, state, 0, info, packed=packed)

    want, count = torch.zeros(2, len(splats["means"]))
    radii = torch.zeros_like(want)
    ids = info["gaussian_ids"] if packed else torch.arange(len(want)).repeat(2)
    centers, boxes = info["means2d"], info["radii"].view(-1, 2)
    grads = (centers.absgrad if absgrad else centers.grad).view(-1, 2)
    for row, (dx, dy), box in zip(ids.tolist(), grads.tolist(), boxes.tolist(), strict=True):
        if min(box) > 0:
            want[row] += ((dx * 48 / 2 * 2) ** 2 + (dy * 36 / 2 * 2) ** 2) ** 0.5
            count[row] += 1
            radii[row] = max(radii[row].item(), max(box) / 48)
    assert count.max() == 2
    torch.testing.assert_close(state["count"], count)
    torch.testing.assert_close(state["grad2d"], want, rtol=1e-4, atol=1e-9)
    assert (state["radii"] <= radii + 1e-6).all()
    assert ((state["radii"] > 0) == (count > 0)).all()


def test_the_arguments_are_its_own():
    theirs = inspect.signature(gsplat.rasterization).parameters
    ours = inspect.signature(rasterization).parameters
    assert list(ours) == list(theirs)
    for name in set(theirs) - {"rolling_shutter"}:
        assert ours[name].default == theirs[name].default, name
    shutter = theirs["rolling_shutter"].default
    K = torch.tensor([[[9.0, 0, 4], [0, 9, 4], [0, 0, 1]]])
    alone = (
        torch.tensor([[0.0, 0, 2]]),
        torch.ones(1, 4),
        torch.ones(1, 3),
        torch.ones(1),
        torch.ones(1, 3),
    )
    rasterization(*alone, torch.eye(4)[None], K, 8, 8, rolling_shutter=shutter)
    other = type(shutter).ROLLING_TOP_TO_BOTTOM
    with pytest.raises(ValueError, match="rolling_shutter must be GLOBAL"):
        rasterization(*alone, torch.eye(4)[None], K, 8, 8, rolling_shutter=other)


def test_its_projection_in_torch_is_ours():
    its = importlib.import_module("gsplat.cuda._torch_impl")
    rng = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng).double()

    means, quats, scales = draw(60, 3), draw(60, 4), torch.exp(0.5 * draw(60, 3) - 2)
    viewmats = torch.eye(4).double().repeat(2, 1, 1)
    viewmats[:, 2, 3] = torch.tensor([3.0, 1.0])
    Ks = torch.tensor([[30.0, 0, 16], [0, 25, 12], [0, 0, 1]]).double().repeat(2, 1, 1)
    covars = its._quat_scale_to_covar_preci(quats, scales, True, False, triu=False)[0]
    theirs = its._fully_fused_projection(
        means, covars, viewmats, Ks, 32, 24, calc_compensations=True
    )
    ones = torch.ones(60).double()
    _, _, meta = rasterization(
        means, quats, scales, ones, means, viewmats, Ks, 32, 24, packed=False, rasterize_mode="antialiased",
    )  # fmt: skip
    seen = (meta["radii"] > 0).all(-1)
    assert 60 < seen.sum() < 120
    for name, want in zip(("means2d", "depths", "conics", "opacities"), theirs[1:], strict=True):
        torch.testing.assert_close(meta[name][seen], want[seen], rtol=1e-6, atol=1e-8)


def test_its_harmonics_are_ours():
    its = importlib.import_module("gsplat.cuda._torch_impl")
    directions = torch.nn.functional.normalize(torch.randn(20, 3).double(), dim=1)
    for k, basis in enumerate(harmonics(directions).T):
        one = torch.zeros(20, 16, 3).double()
        one[:, k] = 1
        want = its._spherical_harmonics(3, directions, one)
        torch.testing.assert_close(basis[:, None].expand(-1, 3), want, rtol=1e-6, atol=1e-8)
