import math

import pytest
import torch
from densified import (
    COLD,
    EARLY,
    EXTENT,
    HOT,
    LARGE,
    LATE,
    MIDDLE,
    PARAMETERS,
    SMALL,
    adam,
    make,
    run,
    state_of,
    step_once,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from vlgs.gaussians import (
    DensifyConfig,
    DensifyReport,
    DensifyState,
    GaussiansConfig,
    activate,
    densify,
    remove,
    reset_opacity,
)
from vlgs.geometry import quat_to_rotmat

ADAM = [{"foreach": False}, {"foreach": True}, {"fused": True}]


def test_statistic_is_the_mean_length_over_views_in_ndc():
    state = DensifyState.zeros(3)
    grads = torch.tensor([[3e-3, 0.0], [0.0, 1e-3], [5.0, 5.0]])
    state.accumulate(grads, torch.tensor([True, True, False]), width=200, height=100)
    state.accumulate(-grads / 3, torch.tensor([True, False, False]), width=200, height=100)
    # Row 0: lengths 0.3 and 0.1 of opposite gradients, which do not cancel. Row 2 was never seen.
    torch.testing.assert_close(state.mean(), torch.tensor([0.2, 0.05, 0.0]))


@pytest.mark.parametrize(
    ("full_to", "factor"), [(0.0, 1.0), (300.0, 1.0), (200.0, 1.0), (100.0, 2**0.5), (50.0, 2.0)]
)
def test_gradients_of_views_above_a_size_count_by_the_root_of_it(full_to: float, factor: float):
    state = DensifyState.zeros(1)
    seen, gradient = torch.tensor([True]), torch.tensor([[3e-3, 0.0]])
    state.accumulate(gradient, seen, width=400, height=100, full_to=full_to)
    torch.testing.assert_close(state.mean(), torch.tensor([0.6 * factor]))


@pytest.mark.parametrize("options", ADAM, ids=["loop", "foreach", "fused"])
def test_clones_copy_their_row_and_moments_stay_with_their_gaussians(options: dict):
    params = make(20)
    optimizer = adam(params, **options)
    step_once(params, optimizer)
    before = {name: value.detach().clone() for name, value in params.items()}
    report = run(params, state_of([COLD] * 18 + [HOT, COLD]), optimizer=optimizer)
    assert report == DensifyReport(cloned=1, split=0, pruned=0, count=21)
    rows = torch.tensor([*range(20), 18])
    for group in optimizer.param_groups:
        value = params[group["name"]]
        assert group["params"] == [value]
        assert torch.equal(value, before[group["name"]][rows])
        moments = optimizer.state[value]
        want = 0.1 * (rows + 1.0)
        want[20] = 0
        first = moments["exp_avg"].flatten(1)[:, 0] if value.dim() > 1 else moments["exp_avg"]
        torch.testing.assert_close(first, want)
        assert moments["exp_avg_sq"][20].eq(0).all()
        assert moments["step"].item() == 1
    assert len(optimizer.state) == len(PARAMETERS)
    step_once(params, optimizer)
    assert all(value.isfinite().all() for value in params.values())


@given(weight=st.floats(0.0101, 0.999), other=st.floats(0.0101, 0.999))
@settings(max_examples=40, deadline=None)
def test_a_clone_and_its_original_cover_what_the_original_did(weight: float, other: float):
    config = GaussiansConfig(densify=DensifyConfig(share_weights=True))
    params = make(20, opacity=weight, indicator=other)
    assert run(params, state_of([COLD] * 18 + [HOT, COLD]), config).cloned == 1
    for name, before in (("opacity_logits", weight), ("indicator_logits", other)):
        through = 1 - params[name].detach().double().sigmoid()
        assert (through[18] * through[20]).item() == pytest.approx(1 - before, rel=1e-4)
        assert torch.equal(through[18], through[20])
        torch.testing.assert_close(through[:18], torch.full((18,), 1 - before).double())


def test_weights_are_shared_by_levels_and_never_so_that_both_go():
    config = GaussiansConfig(densify=DensifyConfig(share_weights=True))
    params = make(20, opacity=0.008, indicator=0.5)
    params["indicator_logits"] = nn.Parameter(torch.tensor([[0.0, 3.0, 40.0]]).repeat(20, 1))
    run(params, state_of([HOT] + [COLD] * 19), config)
    torch.testing.assert_close(params["opacity_logits"][0].sigmoid().item(), 0.008)
    kept = 1 - params["indicator_logits"].detach().double().sigmoid()
    want = (1 - torch.tensor([0.0, 3.0, 40.0]).double().sigmoid()).sqrt()
    torch.testing.assert_close(kept[20], want, atol=1e-6, rtol=1e-6)
    split = make(20, scale=MIDDLE)
    run(split, state_of([HOT] + [COLD] * 19), config)
    torch.testing.assert_close(split["opacity_logits"][-2:].sigmoid(), torch.full((2,), 0.5))


def test_errors_choose_among_gradients_and_gradients_say_how_many():
    grads, error = [HOT, HOT, HOT / 2, COLD, 10 * COLD] + [COLD] * 15, torch.full((20,), 1e-3)
    error[:5] = torch.tensor([1.0, 0.0, 9.0, 100.0, 4.0])
    params, config = make(20), GaussiansConfig()
    # Three reach the threshold of 2e-4, and one of them draws nothing wrong; gradient times root: 1e-3, 0, 1.5e-3, 1e-4, 2e-4.
    report = densify(params, adam(params), state_of(grads), config, EXTENT, 0, EARLY, error=error)
    assert report.cloned == 3
    assert torch.equal(params["means"][20:], params["means"][[0, 2, 4]])
    right, zeros = make(20), torch.zeros(20)
    densify(right, adam(right), state_of(grads), config, EXTENT, 0, EARLY, error=zeros)
    assert len(right["means"]) == 20


def test_pruned_rows_take_their_moments_with_them():
    params = make(20)
    optimizer = adam(params)
    step_once(params, optimizer)
    with torch.no_grad():
        params["opacity_logits"][3] = params["indicator_logits"][3] = -9.0
    report = run(params, state_of([COLD] * 20), optimizer=optimizer)
    assert report == DensifyReport(cloned=0, split=0, pruned=1, count=19)
    moments = optimizer.state[params["indicator_logits"]]["exp_avg"]
    torch.testing.assert_close(moments, 0.1 * torch.tensor([1.0, 2, 3, *range(5, 21)]))


def test_removed_rows_take_their_moments_with_them_and_some_are_left():
    params, before = make(20), make(20)
    optimizer, state = adam(params), state_of([HOT] * 20)
    step_once(params, optimizer)
    remove(params, optimizer, state, torch.arange(20) == 3)
    torch.testing.assert_close(params["sh0"][3], before["sh0"][4], rtol=0, atol=2e-3)  # a step off
    moments = optimizer.state[params["indicator_logits"]]["exp_avg"]
    torch.testing.assert_close(moments, 0.1 * torch.tensor([1.0, 2, 3, *range(5, 21)]))
    assert state.grad_sum.tolist() == [0.0] * 19
    kept = params["means"]
    remove(params, optimizer, state, torch.zeros(19, dtype=torch.bool))
    assert params["means"] is kept
    remove(params, optimizer, state, torch.ones(19, dtype=torch.bool))
    assert len(params["means"]) == 16


def test_split_replaces_the_parent_by_two_smaller_ones_drawn_from_it():
    n = 2000
    params = make(n, scale=MIDDLE)
    with torch.no_grad():
        params["log_scales"] += torch.tensor([0.0, -1.0, -2.0])
        params["means"][:] = params["means"][0]
        params["quats"][:] = params["quats"][0]
    mean, rotation = params["means"][0].clone(), quat_to_rotmat(params["quats"][0]).detach()
    scales = params["log_scales"][0].exp().detach()
    assert run(params, state_of([HOT] * n)) == DensifyReport(0, n, 0, 2 * n)
    torch.testing.assert_close(params["log_scales"].detach().exp(), (scales / 1.6).expand(2 * n, 3))
    local = (params["means"].detach() - mean) @ rotation / scales
    torch.testing.assert_close(local.T.cov(), torch.eye(3), rtol=0, atol=0.08)
    torch.testing.assert_close(local.mean(0), torch.zeros(3), rtol=0, atol=0.08)
    assert torch.equal(params["features"][:n], params["features"][n:])


def test_only_the_opacity_counts_when_asked():
    glass = {"opacity": 1e-3, "indicator": 0.9}
    kept, removed = make(40, **glass), make(40, **glass)
    with torch.no_grad():
        removed["opacity_logits"][:20] = 0.0
    assert run(kept, state_of([COLD] * 40)).pruned == 0
    report = run(removed, state_of([COLD] * 40), GaussiansConfig(prune_on="opacity"))
    assert (report.pruned, report.count) == (20, 20)


def test_large_ones_go_only_after_the_first_reset():
    early, late, never = make(40, LARGE), make(40, LARGE), make(40, LARGE)
    for params in (early, late, never):
        with torch.no_grad():
            params["log_scales"][:20] = math.log(SMALL)
    assert run(early, state_of([COLD] * 40)).pruned == 0
    assert run(late, state_of([COLD] * 40), step=LATE).pruned == 20
    config = GaussiansConfig(densify=DensifyConfig(prune_large=False))
    assert run(never, state_of([COLD] * 40), config, step=LATE).pruned == 0


def test_a_background_may_be_large():
    params = make(40, LARGE)
    with torch.no_grad():
        params["means"][:20] = (
            torch.nn.functional.normalize(params["means"][:20], dim=1) * 9 * EXTENT
        )
        params["means"][20:] *= 0.1
    state, centers = state_of([COLD] * 40), torch.zeros(3, 3)
    report = densify(params, adam(params), state, GaussiansConfig(), EXTENT, 0, LATE, centers)
    assert report.pruned == 20
    assert params["means"].norm(dim=1).min() > 8


@pytest.mark.parametrize("distance", [1.1, 2.0, 3.9])
def test_what_a_background_starts_with_is_not_large(distance: float):
    """Neighbours of 1 500 directions touch: 0.092 of the distance (`vlgs.gaussians.background`)."""
    params = make(40, 0.092 * distance * EXTENT)
    with torch.no_grad():
        directions = torch.nn.functional.normalize(params["means"], dim=1)
        params["means"][:20] = distance * EXTENT * directions[:20]
        params["means"][20:] = 0.9 * EXTENT * directions[20:]
        params["log_scales"][20:] = math.log(0.101 * EXTENT)
    centers = 0.9 * EXTENT * torch.cat([torch.eye(3), -torch.eye(3)])
    state = state_of([COLD] * 40)
    report = densify(params, adam(params), state, GaussiansConfig(), EXTENT, 0, LATE, centers)
    assert report.pruned == 20  # those within the cameras, as 3DGS has it
    assert params["means"].norm(dim=1).min() > EXTENT


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf])
def test_broken_gaussians_are_removed(name: str, poison: float):
    params = make(20)
    with torch.no_grad():
        params[name].view(20, -1)[7, -1] = poison
    report = run(params, state_of([HOT] * 20))
    assert report == DensifyReport(cloned=19, split=0, pruned=1, count=38)
    assert all(value.isfinite().all() for value in params.values())


@pytest.mark.parametrize(("name", "value"), [("quats", 0.0), ("log_scales", 200.0)])
def test_finite_but_impossible_gaussians_are_removed(name: str, value: float):
    params = make(20)
    with torch.no_grad():
        params[name][7] = value
    assert run(params, state_of([COLD] * 20)).pruned == 1


def test_something_is_always_left(caplog: pytest.LogCaptureFixture):
    params = make(50, opacity=1e-3, indicator=1e-3)
    with torch.no_grad():
        params["opacity_logits"][30:] += 0.1  # still below the threshold, but the best there is
    wanted = params["means"][30:46].clone()
    assert run(params, state_of([COLD] * 50)).count == 16
    assert torch.equal(params["means"], wanted)
    assert "16 are kept" in caplog.text
    giants = make(50, scale=LARGE)
    assert run(giants, state_of([COLD] * 50), step=LATE).count == 16


def test_highest_gradients_go_first_when_room_is_short():
    params = make(20)
    grads = [HOT * (1 + i) for i in range(20)]
    report = run(params, state_of(grads), GaussiansConfig(max_count=23))
    assert report == DensifyReport(3, 0, 0, 23, refused=17)
    assert torch.equal(params["means"][20:], params["means"][17:20])


@given(
    n=st.integers(1, 60),
    seed=st.integers(0, 1000),
    max_count=st.integers(1, 90),
    step=st.sampled_from([EARLY, LATE]),
    prune_on=st.sampled_from(["max", "opacity"]),
)
@settings(max_examples=60, deadline=None)
def test_invariants(n: int, seed: int, max_count: int, step: int, prune_on):
    generator = torch.Generator().manual_seed(seed)
    config = GaussiansConfig(max_count=max_count, prune_on=prune_on)
    reports, results = [], []
    draws = {
        "log_scales": torch.randn(n, 3, generator=generator) * 2 - 4,
        "opacity_logits": torch.randn(n, generator=generator) * 5,
        "indicator_logits": torch.randn(n, generator=generator) * 5,
    }
    grads = torch.rand(n, generator=generator) * 4e-4
    for _ in range(2):
        params = make(n)
        with torch.no_grad():
            for name, value in draws.items():
                params[name].copy_(value)
        optimizer = adam(params)
        step_once(params, optimizer)
        state = DensifyState(grads.clone(), torch.ones(n))
        reports.append(densify(params, optimizer, state, config, EXTENT, seed, step))
        results.append(params)
        assert torch.equal(state.grad_sum, torch.zeros(reports[-1].count))
        assert torch.equal(state.count, torch.zeros(reports[-1].count))
    first, again = results
    report = reports[0]
    assert report == reports[1]
    assert all(torch.equal(first[name], again[name]) for name in PARAMETERS)
    assert report.count == n + report.cloned + report.split - report.pruned
    assert min(n, 16) <= report.count <= max(n, max_count)
    assert all(len(value) == report.count for value in first.values())
    assert all(value.isfinite().all() and value.requires_grad for value in first.values())


def test_draws_depend_on_seed_and_step_and_on_nothing_else():
    def means(seed: int, step: int) -> torch.Tensor:
        params = make(20, scale=MIDDLE)
        run(params, state_of([HOT] * 20), step=step, seed=seed)
        return params["means"].detach()

    before = torch.get_rng_state()
    first = means(0, EARLY)
    assert torch.equal(before, torch.get_rng_state())
    torch.rand(3)
    assert torch.equal(first, means(0, EARLY))
    assert not torch.equal(first, means(1, EARLY))
    assert not torch.equal(first, means(0, EARLY + 100))


def test_entries_without_a_group_and_frozen_ones_follow():
    params = make(20)
    params["features"].requires_grad_(False)
    optimizer = torch.optim.Adam([{"params": [params["means"]], "name": "means"}])
    assert run(params, state_of([HOT] * 20), optimizer=optimizer).count == 40
    assert params["features"].shape == (40, 2)
    assert not params["features"].requires_grad
    assert params["means"].requires_grad


@pytest.mark.parametrize("reset_indicator", [False, True])
def test_reset_lowers_opacity_and_forgets_its_moments(reset_indicator: bool):
    params = make(3)
    with torch.no_grad():
        params["opacity_logits"][0] = params["indicator_logits"][0] = -6.0
    optimizer = adam(params)
    step_once(params, optimizer)
    kept = params["opacity_logits"][0].item()
    before = activate(params)
    config = GaussiansConfig(densify=DensifyConfig(reset_indicator=reset_indicator))
    reset_opacity(params, optimizer, config)
    after = activate(params)
    assert params["opacity_logits"][0].item() == kept
    torch.testing.assert_close(after.opacities[1:], torch.full((2,), 0.01))
    assert optimizer.state[params["opacity_logits"]]["exp_avg"].eq(0).all()
    assert optimizer.state[params["opacity_logits"]]["exp_avg_sq"].eq(0).all()
    assert optimizer.state[params["means"]]["exp_avg"].ne(0).all()
    assert torch.equal(after.indicators, before.indicators) != reset_indicator
    assert optimizer.state[params["indicator_logits"]]["exp_avg"].eq(0).all() == reset_indicator


def test_bad_calls():
    params = make(20)
    with pytest.raises(ValueError, match="state must have 20 rows, got 3"):
        run(params, state_of([0.0] * 3))
    with torch.no_grad():
        params["means"].fill_(math.nan)
    with pytest.raises(ValueError, match="must be finite, got none"):
        run(params, state_of([0.0] * 20))
