import math
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf
from scipy import stats

from vlgs.view_blend import BetaBlend, FixedBlend, GaussianBlend, NoBlend, UniformBlend, ViewBlend

CONF = Path(__file__).parents[2] / "conf" / "blend"
DRAWS = 20_000


def draws(blend: ViewBlend, count: int = DRAWS) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.array([blend.draw(rng) for _ in range(count)])


@pytest.mark.parametrize(
    ("blend", "law"),
    [
        (BetaBlend(), stats.beta(0.2, 0.2)),
        (BetaBlend(3.0), stats.beta(3, 3)),
        (UniformBlend(), stats.uniform()),
        (GaussianBlend(out_of_range="raw"), stats.norm()),
        (GaussianBlend(out_of_range="resample"), stats.truncnorm(0, 1)),
        (GaussianBlend(0.5, 0.1, "resample"), stats.truncnorm(-5, 5, 0.5, 0.1)),
    ],
    ids=["beta", "beta(3)", "uniform", "gaussian", "resampled", "narrow"],
)
def test_draws_follow_their_law(blend: ViewBlend, law):
    assert stats.kstest(draws(blend), law.cdf).pvalue > 1e-3


def test_beta_stays_near_the_real_views():
    k = draws(BetaBlend(alpha=0.2))
    assert np.mean(np.minimum(k, 1 - k) < 0.01) == pytest.approx(0.42, abs=0.02)


def test_clamped_gaussian_ends_where_the_raw_one_leaves():
    raw = draws(GaussianBlend(out_of_range="raw"), 1000)
    assert np.array_equal(draws(GaussianBlend(), 1000), raw.clip(0, 1))
    assert (raw < 0).any()
    assert (raw > 1).any()


def test_one_seed_gives_one_sequence():
    assert np.array_equal(draws(BetaBlend(), 50), draws(BetaBlend(), 50))


def test_fixed_leaves_the_generator_alone():
    rng = np.random.default_rng(0)
    before = rng.bit_generator.state
    assert FixedBlend(0.75).draw(rng) == 0.75
    assert NoBlend().draw(rng) == 1.0
    assert rng.bit_generator.state == before


@pytest.mark.parametrize(
    ("blend", "active"),
    [
        (BetaBlend(), True),
        (BetaBlend(rotation=False), True),
        (BetaBlend(translation=False), True),
        (BetaBlend(ssim=False), True),
        (BetaBlend(rotation=False, translation=False), False),
        (NoBlend(), False),
    ],
    ids=str,
)
def test_without_a_new_camera_there_is_no_blended_view(blend: ViewBlend, active: bool):
    assert blend.active is active


@pytest.mark.parametrize(
    ("option", "want"),
    [
        ("beta", BetaBlend(0.2)),
        ("uniform", UniformBlend()),
        ("gaussian", GaussianBlend(0.0, 1.0, "clamp")),
        ("fixed", FixedBlend(0.5)),
        ("none", NoBlend()),
    ],
)
def test_option_is_the_default_of_its_class(option: str, want: ViewBlend):
    assert instantiate(OmegaConf.load(CONF / f"{option}.yaml")) == want


@pytest.mark.parametrize(
    ("build", "arguments", "message"),
    [
        (BetaBlend, {"alpha": 0.0}, "BetaBlend: alpha must be 0.001 to 1e.06, got 0.0"),
        (BetaBlend, {"alpha": math.nan}, "alpha must be 0.001"),
        (FixedBlend, {"value": 1.5}, r"FixedBlend: value must be in \[0, 1\], got 1.5"),
        (GaussianBlend, {"std": -1.0}, "std must be 0 to 100, got -1"),
        (GaussianBlend, {"mean": 5.0, "out_of_range": "resample"}, "mean must be within 3 std"),
        (GaussianBlend, {"out_of_range": "wrap"}, "one of clamp, raw, resample, got 'wrap'"),
        (UniformBlend, {"convention": "slerp"}, "UniformBlend: convention must be one of"),
        (UniformBlend, {"mask": "xor"}, "mask must be one of and, or, got 'xor'"),
    ],
)
def test_bad_value_is_refused(
    build, arguments: dict, message: str, monkeypatch: pytest.MonkeyPatch
):
    # The run-time types would speak first.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match=message):
        build(**arguments)
