"""Kept weights give the rasterizer's pictures and gradients, for as long as nothing but the values moves."""

from dataclasses import replace

import pytest
import torch
from render_scenes import RenderScene, random_splats, relative_error, render
from torch import Tensor

from vlgs.fields.cached_weights import CachedViews
from vlgs.ops.cached_weights import CacheBudgetError, CachedView
from vlgs.types import Camera, RasterConfig


def freeze(splats: RenderScene, config: RasterConfig | None = None, **more: int) -> CachedView:
    camera = Camera(splats.viewmat, splats.K, splats.width, splats.height)
    geometry = splats.means, splats.quats, splats.scales, splats.weights[0]
    return CachedView(*geometry, camera, config or RasterConfig(), **more)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [1, 2, 3, 5, 8, 16, 29, 69])
@pytest.mark.parametrize("stop", ["after", "before"])
def test_pictures_and_gradients_are_the_rasterizers(dtype: torch.dtype, channels: int, stop: str):
    config = RasterConfig(stop=stop)  # pyright: ignore[reportArgumentType]
    splats = random_splats(80, seed=7, channels=(channels,)).to(dtype)
    out, leaves = render(splats, config=config)
    upstream = torch.randn_like(out.images[0])
    (want,) = torch.autograd.grad(out.images[0], leaves["values0"], upstream)

    view = freeze(splats, config)
    values = splats.values[0].clone().requires_grad_()
    image = view.render(values)
    (got,) = torch.autograd.grad(image, values, upstream)
    bound = 1e-6 if dtype == torch.float32 else 1e-14
    assert relative_error(image, out.images[0]) < bound
    assert relative_error(got, want) < bound
    assert want.norm() > 0
    assert torch.equal(view.alpha, out.alphas[0])
    assert torch.equal(view.visible, out.visible)
    assert torch.equal(view.mean2d, out.mean2d)


def test_the_gradient_is_that_of_finite_differences():
    view = freeze(random_splats(12, seed=2, channels=(4,)))
    values = torch.randn(12, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(view.render, values)


def test_threads_and_repeats_do_not_change_a_bit():
    splats = random_splats(5000, seed=1, channels=(7,), spread=0.3).to(torch.float32)
    splats = replace(
        splats, width=150, height=110, K=splats.K * torch.tensor([[4.0], [4.0], [1.0]])
    )
    upstream = torch.randn(110, 150, 7, generator=torch.Generator().manual_seed(0))
    results: list[list[Tensor]] = []
    for threads in (1, 2, 3, 1):
        torch.set_num_threads(threads)
        values = splats.values[0].clone().requires_grad_()
        image = freeze(splats).render(values)
        results.append([image, *torch.autograd.grad(image, values, upstream)])
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], result, strict=True))


@pytest.mark.parametrize("n", [0, 1])
def test_few_gaussians(n: int):
    splats = random_splats(n, seed=4, channels=(3,))
    view = freeze(splats)
    out, _ = render(splats)
    assert torch.allclose(view.render(splats.values[0]), out.images[0], atol=1e-14)


def test_the_budget_is_checked_before_weights_are_kept():
    splats = random_splats(50, seed=3, channels=(3,))
    size = freeze(splats).nbytes
    assert freeze(splats, budget=size).nbytes == size
    with pytest.raises(
        CacheBudgetError, match=rf"weights must be within {size - 1} bytes, got {size}"
    ):
        freeze(splats, budget=size - 1)


def test_as_many_views_are_kept_as_fit(caplog: pytest.LogCaptureFixture):
    splats = random_splats(50, seed=3, channels=(3,))
    camera = Camera(splats.viewmat, splats.K, splats.width, splats.height)
    arguments = {
        "means": splats.means, "quats": splats.quats, "scales": splats.scales,
        "weight": splats.weights[0], "camera": camera, "config": RasterConfig(),
    }  # fmt: skip
    views = CachedViews(2 * freeze(splats).nbytes)
    with caplog.at_level("INFO"):
        made = [views.make(i, **arguments) for i in range(4)]
    assert [view is not None for view in made] == [True, True, False, False]
    assert views.get(1) is made[1]
    assert views.get(2) is None
    assert views.refused(3)
    assert not views.refused(0)
    assert len(views) == 2
    assert views.used <= views.budget
    assert len(caplog.records) == 1


def test_bad_input_is_refused():
    splats = random_splats(9, seed=5, channels=(3,))
    view = freeze(splats)
    with pytest.raises(ValueError, match="must have its rows and pixels, got 8 rows"):
        view.render(splats.values[0][:8])
    broken = splats.values[0].clone()
    broken[4, 1] = float("nan")
    with pytest.raises(
        ValueError, match=r"values of a cached view must be finite, got nan in row 4"
    ):
        view.render(broken)
    values = splats.values[0].clone().requires_grad_()
    with pytest.raises(ValueError, match=r"gradient of a cached view must be finite, got inf"):
        view.render(values).backward(torch.full((splats.height, splats.width, 3), float("inf")))
