"""The protocols beside LERF-OVS and dense: hand-worked cases, then what every protocol must do."""

from pathlib import Path

import hydra
import pytest
import torch
from hydra import compose, initialize_config_dir

from vlgs.metrics.dense import Dense
from vlgs.metrics.goi import Goi
from vlgs.metrics.lerf_ovs import LerfOvs
from vlgs.metrics.masks import Unit
from vlgs.metrics.ovs3d import OVS3D, Ovs3dArgmax, Ovs3dThreshold, select_level
from vlgs.metrics.protocol import Auto, EvaluationProtocol, Evidence, Figures, GaussianEvidence, tag
from vlgs.metrics.segment import LANGSPLAT_V2, Constants
from vlgs.metrics.select3d import Select3d

CONF = Path(__file__).parents[2] / "conf"
OPTIONS = sorted(path.stem for path in (CONF / "protocol").glob("*.yaml"))
CLASSES = ("left", "right", "absent")
H, W = 80, 120
PLAIN = Constants(box=1, vote=1)
"""No smoothing, no vote: masks stay exact."""


def halves() -> list[torch.Tensor]:
    """Masks of the classes, all away from the last row and column, which have no vote."""
    masks = [torch.zeros(H, W, dtype=torch.bool) for _ in CLASSES]
    masks[0][10:50, 10:50] = True
    masks[1][10:50, 60:110] = True
    return masks


def splats(relevancy: torch.Tensor) -> GaussianEvidence:
    """One opaque Gaussian per pixel."""
    levels = relevancy if relevancy.ndim == 4 else relevancy[None]
    return GaussianEvidence(
        [level.flatten(1) for level in levels],
        lambda level, selected: selected.reshape(H, W).float() * 0.9,
    )


def seen(maps: torch.Tensor, view: str = "v") -> Evidence:
    """Levels of class maps that are cosines and relevancy in one."""
    masks = halves()
    truth = torch.full((H, W), 255, dtype=torch.uint8)
    for i, mask in enumerate(masks):
        truth[mask] = i
    units = [Unit(name, mask) for name, mask in zip(CLASSES, masks, strict=True) if mask.any()]
    levels = list(maps if maps.ndim == 4 else maps[None])
    return Evidence(view, CLASSES, units, truth, levels, levels, lambda: splats(maps))


def figures(protocol: EvaluationProtocol, *views: Evidence) -> Figures:
    return protocol.conclude([s for view in views for s in protocol.score(view)], CLASSES)


def exact() -> torch.Tensor:
    return torch.stack(halves()).float()


def exact_of_all() -> torch.Tensor:
    """Exact, and `absent` is what most resembles a pixel of no class, so that no argmax is a tie."""
    maps = exact()
    maps[2] = 0.5 * ~halves()[0] * ~halves()[1]
    return maps


EXACT: list[EvaluationProtocol] = [
    Dense(),
    LerfOvs(PLAIN),
    LerfOvs(PLAIN, strict=True),
    Ovs3dArgmax(),
    Ovs3dThreshold(PLAIN),
    Ovs3dThreshold(PLAIN, form="mipnerf360_gags"),
    Goi(),
    Select3d(),
    Select3d("argmax"),
]


@pytest.mark.parametrize("protocol", EXACT, ids=str)
def test_truth_as_prediction_scores_one(protocol: EvaluationProtocol):
    got = figures(protocol, seen(exact_of_all()))
    assert got.miou == 1
    assert got.per_category["left"] == got.per_category["right"] == 1
    assert got.more.get("boundary_iou", 1) == 1
    assert got.loc_acc == (1 if "loc_acc" not in got.reasons else None)


# IoU of independent draws: a pixel is selected with chance p, true with share q, IoU = pq / (p + q - pq).
# Labelled areas: left 1600, right 2000 of 9600 pixels; p is 1/3 for argmax over three classes and what the threshold leaves else.
CHANCE: list[tuple[EvaluationProtocol, float]] = [
    (LerfOvs(PLAIN), 0.3),
    (Ovs3dArgmax(), 1 / 3),
    (Ovs3dThreshold(PLAIN), 0.3),
    (Ovs3dThreshold(Constants(box=1, vote=1, threshold=0.25)), 0.375),
    (Goi(threshold=0.86), 0.14),
    (Select3d(threshold=0.5), 0.5),
    (Select3d("argmax"), 1 / 3),
]


@pytest.mark.parametrize(("protocol", "p"), CHANCE, ids=str)
def test_noise_scores_at_chance(protocol: EvaluationProtocol, p: float):
    rng = torch.Generator().manual_seed(0)
    views = [seen(torch.rand(3, H, W, generator=rng), f"v{i}") for i in range(10)]
    shares = [1600 / (H * W), 2000 / (H * W)]
    want = sum(p * q / (p + q - p * q) for q in shares) / 2
    # 16 000 labelled pixels per class: three standard deviations are below 0.01
    assert figures(protocol, *views).miou == pytest.approx(want, abs=0.01)


@pytest.mark.parametrize("protocol", EXACT, ids=str)
def test_nothing_to_score_is_not_available(protocol: EvaluationProtocol):
    got = figures(protocol)
    assert (got.miou, got.loc_acc) == (None, None)
    assert got.reasons["miou"]
    assert all(value in (None, 0) for value in got.more.values())
    bare = Evidence("v", CLASSES, (), None, [exact()], [exact()])
    assert protocol.score(bare) == []


@pytest.mark.parametrize("protocol", EXACT, ids=str)
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_nan_never_becomes_a_score(protocol: EvaluationProtocol, bad: float):
    maps = exact()
    maps[:, 20, 20] = bad
    with pytest.raises(ValueError, match="must be finite, got NaN or inf"):
        protocol.score(seen(maps))


@pytest.mark.parametrize("protocol", EXACT, ids=str)
def test_empty_masks_are_left_out(protocol: EvaluationProtocol):
    if isinstance(protocol, Dense):
        pytest.skip("has no units")
    with_empty = seen(exact_of_all())
    units = [*with_empty.units, Unit("absent", torch.zeros(H, W, dtype=torch.bool))]
    got = figures(protocol, Evidence(**{**vars(with_empty), "units": units}))
    assert got.per_category["absent"] is None
    assert got.miou == pytest.approx(1)
    assert got.reasons["labels"] == "empty masks were left out: absent in v"


def test_a_stray_pixel_of_an_absent_class_costs_only_the_dense_mean():
    maps = exact()
    maps[2, 20, 20] = 2  # inside `left`
    assert figures(Dense(), seen(maps)).miou == pytest.approx((1599 / 1600 + 1 + 0) / 3)
    assert figures(Dense("skip"), seen(maps)).miou == pytest.approx((1599 / 1600 + 1) / 2)
    argmax = figures(Ovs3dArgmax(), seen(maps))
    assert argmax.per_category["right"] == 1
    assert "absent" not in argmax.per_category


def test_ovs3d_argmax_by_hand():
    # Everything is `left`: its IoU is its share of the image, the other's 0.
    maps = torch.zeros(3, H, W)
    maps[0] = 1
    got = figures(Ovs3dArgmax(), seen(maps))
    assert got.per_category == {"left": pytest.approx(1600 / 9600), "right": 0}
    assert got.more["mask_accuracy"] == pytest.approx((1600 / 9600 + 7600 / 9600) / 2)
    assert got.reasons["loc_acc"] == "ovs3d_argmax defines no localisation"


def test_ovs3d_threshold_is_the_top_three_eighths_of_the_range():
    ramp = torch.linspace(0, 1, W).expand(1, H, W)
    _, mask = select_level(ramp, Constants(box=1, vote=1, vote_edge="full", threshold=0.25))
    assert torch.equal(mask[0], ramp[0, 0] > 0.625)
    assert LANGSPLAT_V2.threshold == 0.4
    assert OVS3D.threshold == 0.25


def test_ovs3d_level_is_the_most_relevant_inside_its_mask():
    masks = halves()
    faint, strong = 0.4 * masks[0].float(), 0.9 * masks[1].float()
    assert select_level(torch.stack([faint, strong]), PLAIN)[0] == 1
    # An empty mask (a constant map) loses, however relevant; the released script would take it for its NaN.
    flat = torch.full((H, W), 0.95)
    assert select_level(torch.stack([flat, faint]), PLAIN)[0] == 1
    at, mask = select_level(torch.stack([flat, flat]), PLAIN)
    assert at == 0
    assert not mask.any()


def test_ovs3d_takes_the_coarsest_two_levels_and_gags_all():
    levels = torch.stack([exact() * 1.0, exact() * 0.5, exact() * 0.7])
    levels[1:, 0] = 0.6 * halves()[1].float()  # wrong at the two coarse levels
    two = {s.category: (s.level, s.iou) for s in Ovs3dThreshold(PLAIN).score(seen(levels))}
    assert two == {"left": (1, 0.0), "right": (2, 1.0)}
    gags = Ovs3dThreshold(PLAIN, levels=3, form="mipnerf360_gags").score(seen(levels))
    assert [(s.level, s.iou) for s in gags] == [(0, 1.0), (0, 1.0)]


def test_goi_averages_images_then_prompts():
    # `left` is in two views, once found and once missed; `right` in one, found: (0.5 + 1) / 2, not 2 / 3.
    first, second = seen(exact(), "v"), seen(torch.zeros(3, H, W), "w")
    second = Evidence(**{**vars(second), "units": second.units[:1]})
    got = figures(Goi(), first, second)
    assert got.miou == pytest.approx(0.75)
    assert figures(Ovs3dThreshold(PLAIN), first, second).miou == pytest.approx(2 / 3)
    assert got.more["mask_precision"] == 1  # nothing selected has no precision
    assert got.more["mask_accuracy"] == pytest.approx(((1 + 8000 / 9600) / 2 + 1) / 2)


def test_goi_needs_a_cosine_above_its_threshold_unless_told_otherwise():
    clip_like = 0.3 * exact()
    assert figures(Goi(), seen(clip_like)).miou == 0
    relevancy = figures(Goi("relevancy"), seen(clip_like)).miou
    assert relevancy is not None
    assert relevancy > 0.8  # LangSplat's smoothing rounds corners off


def test_select3d_counts_what_is_rendered_of_the_selected_alone():
    maps = 0.8 * exact()
    maps[0, 10:50, 30:50] = 0.4  # half of `left` is not selected
    got = figures(Select3d(), seen(maps))
    assert got.per_category == {"left": 0.5, "right": 1}
    assert (got.miou, got.more["acc25"], got.more["acc50"]) == (0.75, 1, 0.5)
    assert figures(Select3d(silhouette=0.95), seen(maps)).miou == 0  # no pixel is opaque enough
    with pytest.raises(ValueError, match="selects Gaussians, and the field has none"):
        Select3d().score(Evidence(**{**vars(seen(maps)), "splats": None}))


def test_select3d_takes_the_level_with_the_most_relevant_selection():
    levels = torch.stack([torch.zeros_like(exact()), 0.9 * exact(), 0.6 * exact().flip(2)])
    assert [s.level for s in Select3d().score(seen(levels))] == [1, 1]


def test_labels_of_another_size_are_refused():
    small = Unit("left", torch.ones(4, 4, dtype=torch.bool))
    for protocol in EXACT[1:-2]:
        wrong = Evidence("v", CLASSES, [small], None, [exact()], [exact()])
        with pytest.raises(ValueError, match="must be"):
            protocol.score(wrong)


@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_has_a_name_a_version_and_a_tag_of_its_own(option: str):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        protocol = hydra.utils.instantiate(compose("config", [f"protocol={option}"]).protocol)
    if option == "auto":
        assert protocol == Auto()
        return
    assert isinstance(protocol, EvaluationProtocol)
    assert protocol.version >= 1
    assert protocol.name in (option, "lerf_ovs")
    want = {
        "lerf_ovs_v2": "lerf_ovs@1[box=29,vote_edge=full,window=pool]/llff8",
        "mipnerf360_gags": "mipnerf360_gags@1[levels=3,threshold=0.4]/llff8",
    }
    assert tag(protocol, "llff8") == want.get(option, f"{option}@1/llff8")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Goi(threshold=1.0), r"threshold in \[-1, 1\), got 'cosine' and 1.0"),
        (lambda: Select3d(threshold=1.5), r"in \(0, 1\), got 1.5"),
        (lambda: Ovs3dThreshold(levels=0), "levels must be positive"),
    ],
)
def test_bad_options_are_refused(make, said: str):
    with pytest.raises(ValueError, match=said):
        make()
