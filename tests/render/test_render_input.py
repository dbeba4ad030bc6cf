"""Bad input is named; nothing that is not finite gets through."""

import contextlib
import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from render_scenes import RenderScene, random_splats, render, render_with_gradients
from torch import Tensor

from vlgs.ops.rasterize import check_camera, check_config, check_tensors, rasterize
from vlgs.types import Camera, ChannelGroup, RasterConfig


def poisoned(splats: RenderScene, name: str, row: int, value: float) -> RenderScene:
    if name in ("means", "quats", "scales"):
        tensor = getattr(splats, name).clone()
        tensor[row, 1] = value
        return replace(splats, **{name: tensor})
    tensors = [t.clone() for t in getattr(splats, name)]
    tensors[1][row] = value
    return replace(splats, **{name: tuple(tensors)})


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("name", "called"),
    [
        ("means", "means"), ("quats", "quats"), ("scales", "scales"),
        ("weights", r"groups\[1\].weight"), ("values", r"groups\[1\].values"),
    ],
)  # fmt: skip
def test_a_number_that_is_not_finite_is_named(name: str, called: str, value: float, backend: str):
    splats = random_splats(9, seed=1)
    splats = replace(
        splats, means=splats.means * 0 + torch.tensor([0, 0, 3.0]), viewmat=torch.eye(4).double()
    )
    with pytest.raises(
        ValueError, match=rf"rasterize: {called} must be .*got .*(nan|inf).* in row 7"
    ):
        render(poisoned(splats, name, 7, value), backend)


@pytest.mark.parametrize(
    ("name", "value"), [("scales", -1e-3), ("weights", -1e-6), ("weights", 1.001)]
)
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_number_out_of_range_is_named(name: str, value: float, backend: str):
    with pytest.raises(ValueError, match="in row 3"):
        render(poisoned(random_splats(9, seed=1), name, 3, value), backend)


def test_an_upstream_gradient_that_is_not_finite_is_named():
    out, leaves = render(random_splats(9, seed=1))
    upstream = torch.ones_like(out.images[1])
    upstream[20, 3, 1] = math.nan
    with pytest.raises(
        ValueError, match=r"gradient of images\[1\] must be finite, got .*nan in row 743"
    ):
        torch.autograd.grad(out.images[1], leaves["means"], upstream)


EXTREMES = [
    0.0,
    -0.0,
    5e-324,
    1e-45,
    1e-38,
    1e-20,
    1 / 255,
    0.99,
    1.0,
    16.0,
    1e5,
    1e20,
    3e38,
    -1e20,
    -3e38,
    1e300,
]


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    name=st.sampled_from(["means", "quats", "scales", "weights", "values"]),
    row=st.integers(0, 8),
    value=st.sampled_from(EXTREMES),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_any_number_gives_finite_results_or_a_named_error(
    seed: int, name: str, row: int, value: float, dtype: torch.dtype
):
    if dtype == torch.float32 and abs(value) > 1e39:
        value = math.copysign(1e38, value)
    splats = poisoned(random_splats(9, seed).to(dtype), name, row, value)
    with contextlib.suppress(ValueError):
        out, grads = render_with_gradients(splats)
        for tensor in (*out.images, *out.alphas, out.mean2d, *grads.values()):
            assert tensor.isfinite().all()


def test_lists_beyond_the_budget_are_refused_before_they_are_made():
    splats = random_splats(200, seed=1)
    with pytest.raises(
        ValueError, match="tile lists must be within memory_budget = 100 bytes, got"
    ):
        render(splats, config=RasterConfig(memory_budget=100))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"near": 0.0}, "near"), ({"near_sigmas": -0.5}, "near_sigmas"),
        ({"near_sigmas": math.nan}, "near_sigmas"), ({"eps2d": 0.0}, "eps2d"), ({"alpha_min": 0.0}, "alpha_min"),
        ({"alpha_min": 0.995}, "alpha_min"), ({"alpha_max": 1.0}, "alpha_max"),
        ({"transmittance_min": 1.0}, "transmittance_min"), ({"stop": "now"}, "stop"),
        ({"fov_margin": -0.1}, "fov_margin"), ({"fov_margin": math.inf}, "fov_margin"),
        ({"memory_budget": -1}, "memory_budget"),
    ],
)  # fmt: skip
def test_constants_out_of_range_are_named(changes: dict[str, float], named: str):
    config = RasterConfig()
    for key, value in changes.items():
        object.__setattr__(config, key, value)  # what a configuration file may ask for
    with pytest.raises(ValueError, match=f"RasterConfig: {named} must be "):
        check_config(config)


def tensors(**changes: Tensor) -> dict[str, Tensor]:
    return {
        "means": torch.zeros(4, 3), "quats": torch.zeros(4, 4), "scales": torch.zeros(4, 3),
        "values": torch.zeros(4, 2), "weight": torch.zeros(4),
    } | changes  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"means": torch.zeros(4, 2)}, "means"), ({"means": torch.zeros(3)}, "means"),
        ({"quats": torch.zeros(5, 4)}, "quats"), ({"scales": torch.zeros(4, 1)}, "scales"),
        ({"values": torch.zeros(4, 0)}, "values"), ({"values": torch.zeros(3, 2)}, "values"),
        ({"weight": torch.zeros(4, 1)}, "weight"), ({"quats": torch.zeros(4, 4).double()}, "quats"),
        ({"means": torch.zeros(4, 3).half()}, "means"),
    ],
)  # fmt: skip
def test_shapes_and_dtypes_that_do_not_fit_are_named(changes: dict[str, Tensor], named: str):
    given = tensors(**changes)
    group = object.__new__(
        ChannelGroup
    )  # past the run-time checks of annotations, which only tests have
    object.__setattr__(group, "values", given["values"])
    object.__setattr__(group, "weight", given["weight"])
    with pytest.raises(ValueError, match=f"rasterize: .*{named} must be "):
        check_tensors(given["means"], given["quats"], given["scales"], [group])


def test_no_groups():
    t = tensors()
    with pytest.raises(ValueError, match="groups must be at least one ChannelGroup"):
        check_tensors(t["means"], t["quats"], t["scales"], [])


@pytest.mark.parametrize(
    ("viewmat", "K", "size", "message"),
    [
        (torch.eye(4) * math.nan, torch.eye(3), (4, 3), "viewmat must be finite"),
        (2 * torch.eye(4), torch.eye(3), (4, 3), "viewmat must be .* in its last row"),
        (
            torch.eye(4),
            -torch.eye(3) + 2 * torch.eye(3)[2:].T @ torch.eye(3)[2:],
            (4, 3),
            "focal lengths > 0",
        ),
        (
            torch.eye(4),
            torch.eye(3) + torch.tensor([[0, 1.0, 0]] + [[0, 0, 0]] * 2),
            (4, 3),
            "without skew",
        ),
        (torch.eye(4), torch.eye(3), (0, 3), "width must be"),
        (torch.eye(4), torch.eye(3), (4, 1 << 17), "height must be"),
        (torch.eye(4).requires_grad_(), torch.eye(3), (4, 3), "viewmat must be without gradient"),
    ],
)
def test_cameras_that_are_none(viewmat: Tensor, K: Tensor, size: tuple[int, int], message: str):
    with pytest.raises(ValueError, match=message):
        check_camera(Camera(viewmat, K, *size))


def test_a_gradient_that_overflows_is_named_with_its_row():
    means = torch.tensor([[0.0, 0.0, 2.0], [0.1, 0.1, 3.0]], requires_grad=True)
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4), torch.full((2, 3), 0.1)
    values = torch.tensor([[1.0], [1e30]])
    K = torch.tensor([[20.0, 0, 9], [0, 20.0, 7], [0, 0, 1]])
    out = rasterize(
        means, quats, scales, [ChannelGroup(values, torch.full((2,), 0.5))], torch.eye(4), K, 18, 14
    )
    with pytest.raises(
        ValueError, match=r"rasterize: gradient of mean2d must be finite, got .* in row \d"
    ):
        out.images[0].backward(torch.full_like(out.images[0], 1e30))
