"""Settings of Gaussians and of their densification: what is due when, and what is refused."""

import math

import jaxtyping
import pytest

from vlgs.gaussians import DensifyConfig, GaussiansConfig


def test_schedule():
    config = DensifyConfig()
    due = [step for step in range(20_000) if config.densifies_at(step)]
    assert (due[0], due[-1], len(due)) == (600, 14_900, 144)
    resets = [step for step in range(20_000) if config.resets_at(step)]
    assert resets == [3000, 6000, 9000, 12_000]
    assert not DensifyConfig(reset_every=0).resets_at(3000)


@pytest.mark.parametrize(
    "options",
    [
        {"every": 0}, {"start": -1}, {"grad_threshold": 0.0}, {"dense_share": math.nan}, {"prune_below": 1.0},
        {"reset_to": 0.004}, {"max_scale_share": math.inf}, {"reset_every": -1}, {"share_weights": True, "long_axis": True},
    ],
)  # fmt: skip
def test_bad_densify_config(options: dict):
    with pytest.raises(ValueError, match=f"densify: {next(iter(options))} must be"):
        DensifyConfig(**options)


@pytest.mark.parametrize(
    "options",
    [
        {"sh_degree": 4},
        {"init_opacity": 1.0},
        {"background_opacity": 1.0},
        {"max_angle": -0.1},
        {"max_count": 0},
        {"prune_on": "x"},
        {"densify_on": "x"},
    ],
)
def test_bad_gaussians_config(options: dict):
    jaxtyping.config.update("jaxtyping_disable", True)  # the run-time types would speak first
    try:
        with pytest.raises(ValueError, match=f"gaussians: {next(iter(options))} must be"):
            GaussiansConfig(**options)
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
