"""Masks of single views to objects: worked by hand, and against the objects that a procedural scene is made of."""

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_runs import composed
from torch import Tensor

from vlgs.config import instantiate
from vlgs.data.synthetic import NO_NOISE, LabelNoise, SceneSettings, load_scene
from vlgs.data.synthetic.capture import open_capture, regions
from vlgs.data.synthetic.scene_file import find_scene
from vlgs.runs import RunFolder
from vlgs.training.associate import Associate, of_objects, view_of_mask
from vlgs.training.build import Parts
from vlgs.training.fit import FitOptions
from vlgs.training.group_masks import group_masks
from vlgs.training.mask_weights import MaskWeights, mask_weights
from vlgs.training.stages import Method, Progress, Train, TrainColor
from vlgs.training.workshop import Workshop
from vlgs.types import Scene

OVERLAPS = (0.5, 0.3, 0.1)


def sums_of(dense: Sequence[Sequence[float]]) -> MaskWeights:
    """From a row per Gaussian and a column per mask."""
    table = torch.tensor(dense, dtype=torch.float32)
    gaussian, mask = table.nonzero().T
    return MaskWeights(gaussian, mask, table[gaussian, mask], torch.zeros(len(table)))


def test_masks_of_the_same_gaussians_are_one_object():
    # Two views of two masks. The second hides the third Gaussian; the last is at a border and belongs to nobody.
    dense = [[4, 0, 3, 0], [2, 0, 2, 0], [1, 0, 0, 0], [0, 5, 0, 5], [1, 1, 1, 1]]
    views = torch.tensor([0, 0, 1, 1])
    assert group_masks(sums_of(dense), views, OVERLAPS).tolist() == [0, 1, 0, 1]
    # IoU of masks 0 and 2 is 1: what only one view shows does not count. Of 1 and 3 it is 1 too, so that the surest bound will do.
    assert group_masks(sums_of(dense), views, (1.0,)).tolist() == [0, 1, 0, 1]


def test_a_bound_is_the_intersection_over_union():
    # sqrt(e e') is 2 for the Gaussian in both, and 1 and 1 for those in one of them: 2 / 4.
    dense = [[2, 0, 2, 0], [1, 0, 0, 1], [0, 1, 1, 0]]
    views = torch.tensor([0, 0, 1, 1])
    assert group_masks(sums_of(dense), views, (0.49,))[[0, 2]].unique().numel() == 1
    assert group_masks(sums_of(dense), views, (0.51,))[[0, 2]].unique().numel() == 2


def test_a_merged_mask_is_outvoted():
    # Objects a and b over four views; view 3 shows both as one mask. A chain through it would make one of all.
    a, b = [3, 0, 3, 0, 3, 0, 3], [0, 2, 0, 2, 0, 2, 2]
    views = torch.tensor([0, 0, 1, 1, 2, 2, 3])
    groups = group_masks(sums_of([a, b]), views, OVERLAPS)
    assert groups[[0, 2, 4]].unique().numel() == groups[[1, 3, 5]].unique().numel() == 1
    assert groups[0] != groups[1]


def test_what_lies_behind_a_glass_is_explained_away():
    # Each view sees the glass (Gaussian 0, faint) before another part of a wall (1 to 4), whose other parts are masks of their own.
    views, dense = torch.arange(8) // 2, [[0.0] * 8 for _ in range(5)]
    for view in range(4):
        glass, wall = 2 * view, 2 * view + 1
        dense[0][glass] = 1.0
        for part in range(4):
            dense[part + 1][glass if part == view else wall] = 6.0
    groups = group_masks(sums_of(dense), views, (0.5, 0.3, 0.2))
    assert groups[0::2].unique().numel() == 1
    assert groups[1::2].unique().numel() == 1
    assert groups[0] != groups[1]
    blind = group_masks(sums_of(dense), views, (0.2,))  # without a second look
    assert blind[0::2].unique().numel() > 1


def test_objects_take_the_place_of_masks(tiny_scene: Scene):
    count = len(tiny_scene.mask_vectors)
    objects = torch.arange(count) % 3
    objects[::7] = -1
    scene = of_objects(tiny_scene, objects)
    assert scene.mask_vectors.shape == (3, 512)
    torch.testing.assert_close(scene.mask_vectors.norm(dim=1), torch.ones(3))
    own = objects == 1
    weighted = (tiny_scene.mask_vectors * tiny_scene.mask_areas[:, None])[own].sum(0)
    torch.testing.assert_close(scene.mask_vectors[1], weighted / weighted.norm())
    assert scene.mask_areas[1] == tiny_scene.mask_areas[own].sum()
    for before, after in zip(tiny_scene.train, scene.train, strict=True):
        assert before.read_masks is not None
        assert after.read_masks is not None
        rows = before.read_masks().long()
        want = torch.where(rows >= 0, objects[rows], -1)
        assert torch.equal(after.read_masks().long(), want)


def workshop_in(folder: Path, *overrides: str) -> Workshop:
    config = composed("method=gs3d", "trainer=smoke", "gaussians.background=0", *overrides)

    def make_parts() -> Parts:
        torch.manual_seed(0)
        return Parts(**{part.name: instantiate(config[part.name]) for part in fields(Parts)})

    return Workshop(RunFolder(folder), make_parts, lambda: FitOptions({}, False), 0)


def true_objects(scene: Scene, faults: LabelNoise, size: dict[str, int]) -> Tensor:
    """Number of the thing that most pixels of every mask show."""
    full = SceneSettings(find_scene("lookalikes"), "hard", seed=0, faults=faults, **size)
    capture = open_capture(full)
    true = torch.full((len(scene.mask_vectors),), -1)
    for shot, view in zip(capture.train, scene.train, strict=True):
        assert view.read_masks is not None
        things = torch.from_numpy(regions(capture.world, shot.photo)[0][3].astype(np.int64))
        index = view.read_masks()
        for mask in index[index >= 0].unique().tolist():
            true[mask] = things[index == mask].mode().values
    return true


def agreement(groups: Tensor, true: Tensor) -> tuple[float, float, float]:
    """Adjusted Rand index over masks; precision and recall of "of one object" over their pairs."""
    alone = torch.where(groups < 0, groups.max() + 1 + torch.arange(len(groups)), groups)
    pairs = ~torch.eye(len(true), dtype=torch.bool)
    found, real = (alone[:, None] == alone) & pairs, (true[:, None] == true) & pairs
    both, f, r = (float(x.sum()) for x in (found & real, found, real))
    chance = f * r / float(pairs.sum())
    return (both - chance) / ((f + r) / 2 - chance), both / f, both / r


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "least"), [(NO_NOISE, (0.9, 0.95, 0.9)), (LabelNoise(), (0.75, 0.85, 0.7))]
)
def test_the_objects_of_a_scene_are_found(
    tmp_path: Path, faults: LabelNoise, least: tuple[float, float, float]
):
    size = {"width": 96, "height": 72, "train_views": 16, "test_views": 2, "points": 2000}
    scene = load_scene(scene="lookalikes", difficulty="hard", faults=faults, **size)  # type: ignore[arg-type]
    progress = TrainColor("geometry").run(
        Progress({3: scene}), workshop_in(tmp_path, "trainer.iterations=150")
    )
    sums = mask_weights(progress.gaussians("geometry", 3), scene)
    objects = Associate("geometry").objects(scene, [sums])
    true = true_objects(scene, faults, size)
    got = agreement(objects, true)
    assert all(value >= bound for value, bound in zip(got, least, strict=True)), got
    assert torch.equal(objects, Associate("geometry").objects(scene, [sums]))
    assert (view_of_mask(scene) >= 0).all()


def test_levels_have_objects_of_their_own(tiny_scene: Scene):
    dense = [[2.0, 0, 2, 0], [0, 1, 0, 1]]
    views = [replace(view, read_masks=None) for view in tiny_scene.train[2:]]
    index = torch.full((36, 48, 2), -1, dtype=torch.int32)
    for number in (0, 1):
        rows = index.clone()
        rows[:9, :, 0], rows[9:, :, 0] = 2 * number, 2 * number + 1
        rows[..., 1] = torch.where(rows[..., 0] >= 0, rows[..., 0] + 4, -1)
        views.insert(number, replace(tiny_scene.train[number], read_masks=rows.clone))
    joint = replace(
        tiny_scene, train=tuple(views), mask_levels=2, mask_vectors=torch.eye(8), mask_areas=torch.ones(8)
    )  # fmt: skip
    low = sums_of(dense)
    high = replace(low, mask=low.mask + 4)
    assert Associate("x").objects(joint, [low, high]).tolist() == [0, 1, 0, 1, 2, 3, 2, 3]
    none = sums_of(
        [[0.0] * 8] * 2
    )  # a level without masks, or with none that a Gaussian belongs to
    assert Associate("x").objects(joint, [low, none]).tolist() == [0, 1, 0, 1, -1, -1, -1, -1]


def test_what_cannot_be_associated_is_refused(tiny_scene: Scene):
    method = Method((TrainColor("geometry"), Associate("geometry"), Train()))
    bare = replace(tiny_scene, mask_vectors=torch.zeros(0, 512), mask_areas=torch.zeros(0))
    with pytest.raises(ValueError, match="scene must have masks to be associated"):
        method.require({3: bare})  # `vlgs.prepare` asks before anything is trained
    lonely = sums_of([[1.0] + [0.0] * (len(tiny_scene.mask_vectors) - 1)])
    with pytest.raises(ValueError, match="objects that 2 views show must be at least 1, got none"):
        Associate("geometry").objects(tiny_scene, [lonely])
    with pytest.raises(ValueError, match="overlaps must be above 0 and at most 1, one or more"):
        Associate("geometry", overlaps=())
    with pytest.raises(ValueError, match="start must be an earlier stage"):
        Method((Associate("geometry"), Train()))
