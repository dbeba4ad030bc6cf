import math

import torch
from densified import (
    COLD,
    EARLY,
    EXTENT,
    HOT,
    LATE,
    MIDDLE,
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
    GaussiansConfig,
    densify,
)
from vlgs.geometry import quat_to_rotmat

LONG_AXIS = GaussiansConfig(densify=DensifyConfig(long_axis=True))


@given(
    turn=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(
        lambda q: sum(map(abs, q)) > 0.1
    ),
    log_scales=st.permutations([-3.0, -4.5, -7.0]),
    weight=st.floats(0.01, 0.99),
)
@settings(max_examples=40, deadline=None)
def test_halves_lie_side_by_side_on_the_longest_axis(turn, log_scales, weight):
    params = make(20, opacity=weight, indicator=0.5)
    with torch.no_grad():
        params["quats"][3] = torch.tensor(turn)
        params["log_scales"][3] = torch.tensor(log_scales)
    whole = {name: value[3].detach().clone() for name, value in params.items()}
    report = run(params, state_of([COLD] * 3 + [HOT] + [COLD] * 16), LONG_AXIS)
    assert report == DensifyReport(cloned=0, split=1, pruned=0, count=21)
    halves = {name: value[19:].detach() for name, value in params.items()}
    longest = torch.tensor(log_scales).argmax()
    axis = quat_to_rotmat(whole["quats"])[:, longest] * math.exp(-3.0)
    torch.testing.assert_close(halves["means"][0], whole["means"] + 0.8 * axis)
    torch.testing.assert_close(halves["means"][1], whole["means"] - 0.8 * axis)
    smaller = torch.full((3,), 0.85).index_fill(0, longest, 0.6)
    torch.testing.assert_close(
        halves["log_scales"].exp(), (whole["log_scales"].exp() * smaller).expand(2, 3)
    )
    torch.testing.assert_close(halves["opacity_logits"].sigmoid(), torch.full((2,), 0.6 * weight))
    for name in ("quats", "sh0", "shN", "features", "indicator_logits"):
        assert torch.equal(halves[name], whole[name].expand_as(halves[name]))


def test_halves_have_their_own_moments_and_no_seed_moves_them():
    left, right = make(20, MIDDLE), make(20)
    with torch.no_grad():
        right["log_scales"][:] = left["log_scales"]
    optimizer = adam(left)
    step_once(left, optimizer)
    before = optimizer.state[left["means"]]["exp_avg"]
    with torch.no_grad():
        for name in right:
            right[name][:] = left[name]
    state = [HOT, COLD] * 10
    densify(left, optimizer, state_of(state), LONG_AXIS, EXTENT, 0, EARLY)
    densify(right, adam(right), state_of(state), LONG_AXIS, EXTENT, 1, LATE - 50)
    assert all(torch.equal(left[name], right[name]) for name in left)
    moments = optimizer.state[left["means"]]["exp_avg"]
    assert torch.equal(moments[:10], before[1::2])
    assert moments[10:].eq(0).all()


def test_halves_of_what_is_faint_and_of_a_shape_of_languages_own():
    params = make(20, opacity=0.008)
    params["language_log_scales"] = nn.Parameter(torch.tensor([[-3.0, -2.0, -4.0]]).repeat(20, 1))
    params["language_quats"] = nn.Parameter(params["quats"].detach().flip(0))
    run(params, state_of([HOT] + [COLD] * 19), LONG_AXIS)
    torch.testing.assert_close(
        params["opacity_logits"][19:].sigmoid(), torch.full((2,), 0.008)
    )  # 0.6 of it would be pruned
    language = torch.tensor([-3.0, -2.0, -4.0]) + torch.tensor([0.85, 0.6, 0.85]).log()
    torch.testing.assert_close(params["language_log_scales"][19:].detach(), language.expand(2, 3))
