"""A mask that no other view supports teaches nothing more; what few pixels or few views show stays."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from slow import with_slow
from test_training_training import assert_same_bits, module_of, stop_at, train
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.objectives import Language
from vlgs.training import mask_support as own_module
from vlgs.training.joint import join_levels
from vlgs.training.lightning import VLGSModule
from vlgs.training.mask_support import LeaveOut, mask_support
from vlgs.training.mask_weights import mask_weights
from vlgs.types import Scene

LIES = 2
"""View of which a mask says something else."""


def largest(scene: Scene, view: int) -> int:
    read = scene.train[view].read_masks
    assert read is not None
    masks = read().flatten().long()
    return int(torch.bincount(masks[masks >= 0]).argmax())


def exact(scene: Scene) -> tuple[Scene, Tensor]:
    """Masks without noise: each has the word that is nearest to it; and the number of that word."""
    assert scene.vocabulary is not None
    words = scene.vocabulary.vectors[: len(scene.classes)]
    nearest = (scene.mask_vectors @ words.T).argmax(dim=1)
    return replace(scene, mask_vectors=words[nearest].clone()), nearest


def with_a_lie(scene: Scene) -> tuple[Scene, int]:
    """The largest mask of a view has the word of something else."""
    scene, words = exact(scene)
    row = largest(scene, LIES)
    vectors = scene.mask_vectors.clone()
    vectors[row] = vectors[(words != words[row]).nonzero()[0, 0]]
    return replace(scene, mask_vectors=vectors), row


def by_pairs(module: VLGSModule, scene: Scene) -> Tensor:
    """`mask_support` of masks without noise, mask by mask from all pairs of a Gaussian and a mask."""
    pairs, count = mask_weights(module.model, scene), len(scene.mask_vectors)
    apart = normalize(scene.mask_vectors - scene.mask_vectors.mean(dim=0), dim=-1)
    alike = (apart @ apart.T > 0.5).double()
    weight = torch.zeros(module.model.count, count, dtype=torch.float64)
    weight[pairs.gaussian.long(), pairs.mask.long()] = pairs.weight.double()
    view = torch.zeros(count).long()
    for index, one in enumerate(scene.train):
        assert one.read_masks is not None
        rows = one.read_masks().unique().long()
        view[rows[rows >= 0]] = index
    support = torch.ones(count, dtype=torch.float64)
    for mask in range(count):
        mine, same = view == view[mask], alike[mask]
        inside, outside = weight[:, mine], weight[:, ~mine]
        judged = weight[:, mask] * (outside.sum(1) > 0.2 * inside.sum(1))
        if judged.sum() > 0.3 * weight[:, mask].sum():
            others = outside @ same[~mine] / outside.sum(1).clamp_min(1e-30)
            within = inside @ same[mine] / inside.sum(1).clamp_min(1e-30)
            support[mask] = (judged * others).sum() / (judged * within).sum()
    return support


def test_support_is_that_of_all_pairs(tiny_scene: Scene):
    scene, row = with_a_lie(tiny_scene)
    module = module_of(scene)
    got = mask_support(module.model, scene)
    torch.testing.assert_close(got.double(), by_pairs(module, scene), rtol=1e-3, atol=1e-4)
    assert got[row] < 0.2
    assert got.median() > 0.4


def test_what_all_views_say_has_support_and_one_that_lies_has_none(tiny_scene: Scene):
    scene, _ = exact(tiny_scene)
    before = mask_support(module_of(scene).model, scene)
    lying, row = with_a_lie(tiny_scene)
    after = mask_support(module_of(lying).model, lying)
    assert before[row] > 0.6
    assert after[row] < 0.2


@given(seed=st.integers(0, 1000), scale=st.floats(0.01, 100), shift=st.floats(-3, 3))
def test_meanings_do_not_hang_on_length_or_a_common_direction(
    seed: int, scale: float, shift: float
):
    draws = torch.Generator().manual_seed(seed)
    words = normalize(torch.randn(5, 16, generator=draws), dim=-1)
    which = torch.arange(60) % 5
    noise = 0.05 * torch.randn(60, 16, generator=draws)
    cluster, alike = own_module._meanings(scale * (words[which] + noise + shift))
    same = alike[cluster][:, cluster]
    right = (same == (which[:, None] == which)).double().mean()
    assert right > 0.9


def test_views_that_nobody_else_looks_into_cannot_be_judged(tiny_scene: Scene):
    alone = replace(with_a_lie(tiny_scene)[0], train=tiny_scene.train[LIES : LIES + 1])
    assert torch.equal(
        mask_support(module_of(alone).model, alone), torch.ones(len(tiny_scene.mask_vectors))
    )


def test_a_level_is_judged_by_its_own_masks(tiny_scene: Scene):
    lying, row = with_a_lie(tiny_scene)
    right, count = exact(tiny_scene)[0], len(lying.mask_vectors)
    joint = join_levels([right, lying, right])
    support = mask_support(module_of(joint, "levels=joint").model, joint).view(3, count)
    assert support[1, row] < 0.2
    assert (support[[0, 2], row] > 0.6).all()


def test_masks_that_are_left_out_are_no_masks_in_either_size(tiny_scene: Scene):
    module = module_of(tiny_scene, "trainer.half_size=0.5")
    row = largest(tiny_scene, 0)
    gone = torch.arange(len(tiny_scene.mask_vectors)) == row
    small = module.step.views(0)
    assert small is not module.views
    assert (small[0].masks == row).any()
    module.step.leave_out(gone)
    for views in (small, module.views, module.views.at_half_size()):
        target, plain = views[0], module_of(tiny_scene).views
        plain = plain if views is module.views else plain.at_half_size()
        inside = plain[0].masks == row
        assert inside.any()
        assert torch.equal(target.valid, plain[0].valid & ~inside)
        assert torch.equal(target.masks[~inside], plain[0].masks[~inside])
        assert (target.masks[inside] == -1).all()
        assert not target.codes[inside].any()
        assert torch.equal(target.codes[~inside], plain[0].codes[~inside])


def judged_at(module: VLGSModule, step: int) -> Tensor | None:
    module.next_step = step
    LeaveOut().after_step(module)
    return module.views.left_out


def test_it_happens_once_after_a_fifth_of_the_iterations(tiny_scene: Scene):
    scene, row = with_a_lie(tiny_scene)
    options = ("trainer.iterations=30", "loss.language.support=0.2")
    module = module_of(scene, *options)
    assert judged_at(module, 5) is None
    gone = judged_at(module, 6)
    assert gone is not None
    assert gone[row]
    assert 1 <= gone.sum() < len(gone) / 3
    module = module_of(scene, *options)
    assert judged_at(module, 7) is None
    assert judged_at(module_of(scene, options[0], "loss.language.support=0.0"), 6) is None


def test_all_stay_where_most_would_go(tiny_scene: Scene, caplog: pytest.LogCaptureFixture):
    scene = exact(tiny_scene)[0]
    draws = torch.Generator().manual_seed(0)
    noise = torch.randn(scene.mask_vectors.shape, generator=draws)
    with caplog.at_level("INFO"):
        assert (
            judged_at(module_of(replace(scene, mask_vectors=noise), "loss.language.support=0.9"), 5)
            is None
        )
    assert "all stay" in caplog.text


@pytest.mark.parametrize("stop", with_slow([2, 8], [2]))  # before and after masks are judged
@pytest.mark.usefixtures("unchecked")
def test_a_run_resumes_to_the_bit(tiny_scene: Scene, tmp_path: Path, stop: int):
    scene, _ = with_a_lie(tiny_scene)
    options = ("loss.language.support=0.2", "trainer.half_size=0.5", "trainer.iterations=15")

    def made() -> VLGSModule:
        return module_of(scene, *options)

    whole = train(made(), tmp_path / "whole")
    assert whole.views.left_out is not None
    first = made()
    stop_at(first, stop)
    train(first, tmp_path / "parts")
    second = train(made(), tmp_path / "parts")
    assert second.views.left_out is not None
    assert torch.equal(whole.views.left_out, second.views.left_out)
    assert_same_bits(whole, second)
    other = train(module_of(scene, *options[1:]), tmp_path / "other")
    assert not torch.equal(whole.model.splats["features"], other.model.splats["features"])


@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
def test_a_share_is_asked_for(value: float):
    make: Callable[..., Any] = Language
    with pytest.raises(ValueError, match="language: support must be 0 to 1, got"):
        make(support=value)
