"""The fuzzer itself: scenes are functions of their seed, and what it must catch it catches."""

from collections.abc import Callable
from dataclasses import replace
from math import inf, isnan, nan
from typing import Any

import pytest
import torch
from torch.utils.dlpack import from_dlpack

from tests import fuzz_kernel as fuzz
from tests.fuzz_kernel import run_scene
from tests.fuzz_kernel.layers import run_layers
from tests.fuzz_kernel.scene import SWITCHES, FuzzScene, make_scene
from vlgs.ops import _csrc
from vlgs.types import ChannelGroup


def test_a_scene_is_a_function_of_its_seed():
    for seed in range(20):
        a, b = make_scene(seed), make_scene(seed)
        assert a.tensors.keys() == b.tensors.keys()
        for name in a.tensors:
            assert torch.equal(a.tensors[name].nan_to_num(7), b.tensors[name].nan_to_num(7))


def test_scenes_differ_in_everything_that_matters():
    scenes = [make_scene(seed) for seed in range(300)]
    assert {len(scene.chain_of) for scene in scenes} == {1, 2, 3, 4, 5}
    assert {scene.tensors["means"].dtype for scene in scenes} == {torch.float32, torch.float64}
    assert {scene.config.stop for scene in scenes} == {"after", "before"}
    assert {0, 1} < {len(scene.tensors["means"]) for scene in scenes}
    assert any(len(set(s.chain_of)) < len(s.chain_of) for s in scenes)
    assert {scene.tame for scene in scenes} == {True, False}
    channels = [[s.tensors[f"values{i}"].shape[1] for i in range(len(s.chain_of))] for s in scenes]
    assert {c for each in channels for c in each} == set(range(1, 41))
    assert sum(set(each) == {3} for each in channels) > 100
    shapes = [s.shape_of for s in scenes]
    assert any(set(each) == {None} for each in shapes)
    assert any({None, 0, 1} <= set(each) for each in shapes)
    assert any(each.count(0) > 1 for each in shapes), "two groups with one shape of their own"
    assert {scene.threads for scene in scenes} == {1, 2, 3}
    for switch in SWITCHES:
        assert {getattr(scene.config, switch) for scene in scenes} == {True, False}
    assert any(not scene.asked for scene in scenes)
    assert any(scene.asked and len(scene.used) < len(scene.upstream) for scene in scenes)


def first_tame() -> FuzzScene:
    return next(s for s in map(make_scene, range(100)) if s.tame and len(s.tensors["means"]) > 2)


def test_a_refused_tame_scene_is_a_failure():
    scene = first_tame()
    scene.tensors["means"][0, 0] = torch.nan
    with pytest.raises(AssertionError, match="a tame scene was refused: rasterize: means must be"):
        run_scene(scene)
    assert "means must be finite" in (run_scene(replace(scene, tame=False)) or "")


def test_a_shape_of_its_own_is_drawn_and_refused_by_name():
    scene = next(
        s for s in map(make_scene, range(300))
        if s.tame and s.shape_of[0] == 0 and len(s.tensors["means"]) > 2
    )  # fmt: skip
    scene.tensors["shape0.scales"][1, 2] = -1.0
    message = run_scene(replace(scene, tame=False)) or ""
    assert "scales must be finite and >= 0, got -1.000000 in row 1" in message
    assert message.endswith("of a group's own shape")


@pytest.mark.parametrize(
    ("answer", "caught"),
    [(ValueError("went wrong"), "error without a name"), (RuntimeError("x"), "RuntimeError: x")],
)
def test_other_errors_are_failures_of_their_seed(
    monkeypatch: pytest.MonkeyPatch, answer: Exception, caught: str
):
    def broken(*args: object) -> None:
        raise answer

    monkeypatch.setattr(fuzz, "rasterize", broken)
    report = fuzz.fuzz([3])
    assert list(report.failures) == [3]
    assert caught in str(report)


def test_numbers_that_are_not_finite_are_failures(monkeypatch: pytest.MonkeyPatch):
    real = fuzz.rasterize

    def poisoned(means, quats, scales, groups, *rest):
        bad = [ChannelGroup(group.values, group.weight) for group in groups]
        out = real(means, quats, scales, bad, *rest)
        return replace(out, images=(out.images[0] + torch.inf, *out.images[1:]))

    monkeypatch.setattr(fuzz, "rasterize", poisoned)
    seed = next(seed for seed in range(100) if make_scene(seed).tame)
    assert "picture 0 is not finite" in str(fuzz.fuzz([seed]))


squared_error, squared_error_backward = _csrc.squared_error, _csrc.squared_error_backward


def reads_everything(a: Any, b: Any, valid: Any, threads: int) -> tuple[float, int]:
    a, b = from_dlpack(a), from_dlpack(b)  # a capsule is good for one call
    return squared_error(a, b, None, threads)[0], squared_error(a, b, valid, threads)[1]


def counts_one_more(*args: Any) -> tuple[float, int]:
    total, count = squared_error(*args)
    return total, count + 1


def hides_what_is_no_number(*args: Any) -> tuple[float, int]:
    total, count = squared_error(*args)
    return 0.0 if isnan(total) else total, count


def moves_masked_pixels(a: Any, b: Any, valid: Any, scale: float, d_a: Any, threads: int) -> None:
    squared_error_backward(a, b, None, scale, d_a, threads)


def run_many() -> None:
    for seed in range(60):
        run_layers(seed, (nan, inf, 1e38))


@pytest.fixture(scope="module")
def right() -> None:
    """The kernels as they are pass."""
    run_many()


@pytest.mark.usefixtures("right")
@pytest.mark.parametrize(
    "wrong",
    [reads_everything, counts_one_more, hides_what_is_no_number, moves_masked_pixels],
)
def test_a_wrong_squared_error_is_a_failure(
    monkeypatch: pytest.MonkeyPatch, wrong: Callable[..., Any]
):
    backward = wrong is moves_masked_pixels
    monkeypatch.setattr(_csrc, "squared_error" + "_backward" * backward, wrong)
    with pytest.raises(AssertionError, match=r"squared error must be that of float64"):
        run_many()
