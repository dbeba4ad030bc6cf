"""augment=offline: what is added to the training views."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_runs import TINY, composed

from vlgs.config import instantiate
from vlgs.data.sampler import PairSampler, nearest_views
from vlgs.features.extractor import MaskFeatures
from vlgs.fields.splat import SplatModel
from vlgs.geometry import camera_center
from vlgs.identity import run_id
from vlgs.training.augment import Offline
from vlgs.training.build import Parts, build_module
from vlgs.training.separate import without_language
from vlgs.types import Scene


@pytest.fixture(scope="module")
def model(tiny_scene: Scene) -> SplatModel:
    config = composed(*TINY, "trainer=smoke")
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(without_language(tiny_scene), parts, 0).model


def test_added_views_look_from_between_with_masks_of_their_own(
    tiny_scene: Scene, model: SplatModel, tmp_path: Path
):
    extended = Offline(views=3).extend({3: tiny_scene}, model, 0, tmp_path)[3]
    assert extended.train[:6] == tiny_scene.train
    assert extended.test == tiny_scene.test
    added = extended.train[6:]
    assert [view.name for view in added] == [f"extra_{i:05d}" for i in range(1, 4)]
    centers = camera_center(torch.stack([v.camera.viewmat for v in tiny_scene.train]))
    rows: set[int] = set()
    for view in added:
        center = camera_center(view.camera.viewmat)
        pairs = [(a, b) for a in centers for b in centers]
        # On the segment between two training cameras: the detour over it is none.
        detour = min((a - center).norm() + (b - center).norm() - (a - b).norm() for a, b in pairs)
        assert detour < 1e-4
        image = model.render(view.camera, language=False).color
        assert image is not None
        assert torch.equal(view.read_image(), (image.clamp(0, 1) * 255).round().to(torch.uint8))
        assert view.read_masks is not None
        masks = view.read_masks()
        own = set(masks.unique().tolist()) - {-1}
        assert own
        assert not own & rows, "rows of the table belong to one view"
        rows |= own
        for row in own:
            assert extended.mask_areas[row] == (masks == row).sum()
    assert min(rows) >= len(tiny_scene.mask_vectors)
    assert max(rows) < len(extended.mask_vectors)
    assert torch.equal(
        extended.mask_vectors[: len(tiny_scene.mask_vectors)], tiny_scene.mask_vectors
    )


@pytest.mark.usefixtures("unchecked")
def test_added_views_are_a_function_of_the_seed(
    tiny_scene: Scene, model: SplatModel, tmp_path: Path
):
    def masks(seed: int) -> torch.Tensor:
        scene = Offline(views=2).extend({3: tiny_scene}, model, seed, tmp_path)[3]
        read = scene.train[-1].read_masks
        assert read is not None
        return read()

    assert torch.equal(masks(0), masks(0))
    assert not torch.equal(masks(0), masks(1))


def test_the_scenes_own_supervision_is_that_of_a_photograph(tiny_scene: Scene):
    assert tiny_scene.supervise is not None
    view = tiny_scene.test[0]
    index, vectors = tiny_scene.supervise(view.camera, 0)
    assert view.read_dense_labels is not None
    assert tiny_scene.vocabulary is not None
    truth = view.read_dense_labels().ids.long()
    names = [tiny_scene.vocabulary.names.index(name) for name in tiny_scene.classes]
    said = (vectors @ tiny_scene.vocabulary.vectors[names].T).argmax(dim=1)[index.long()]
    right = (said == truth)[index >= 0].float().mean()
    assert right > 0.6  # 0.05 missed, 0.03 merged, 0.05 mislabelled, ragged borders; chance is 0.1
    again = tiny_scene.supervise(view.camera, 0)
    assert torch.equal(index, again[0])
    other = tiny_scene.supervise(view.camera, 1)
    assert not (index.shape == other[0].shape and torch.equal(index, other[0]))


class Halves:
    """Masks of the left and right half, under numbers that other levels share."""

    def __init__(self):
        self.asked: list[str] = []

    def identity(self) -> dict[str, str]:
        return {"halves": "1"}

    def __call__(self, image: np.ndarray, stem: str) -> MaskFeatures:
        self.asked.append(stem)
        ids = np.full((4, *image.shape[:2]), -1, np.int32)
        ids[2, :, : image.shape[1] // 2] = 0
        ids[3, :, : image.shape[1] // 2], ids[3, 1:, image.shape[1] // 2 :] = 1, 3
        return MaskFeatures(ids, np.eye(4, 512, dtype=np.float32))


def test_an_extractor_describes_the_rendered_images_once_for_all_levels(
    tiny_scene: Scene, model: SplatModel, tmp_path: Path
):
    photographs, halves = replace(tiny_scene, supervise=None), Halves()
    augment = Offline(views=2, extractor=halves)
    assert augment.identity() == "[('halves', '1')]"
    both: dict[int | None, Scene] = {2: photographs, 3: photographs}
    augment.extend(both, model, 0, tmp_path / "maps")
    extended = augment.extend(both, model, 0, tmp_path / "maps")  # taken up again
    assert halves.asked == ["extra_00001", "extra_00002"]
    offset = len(tiny_scene.mask_vectors)
    read = extended[3].train[-1].read_masks
    assert read is not None
    assert set(read().unique().tolist()) == {-1, offset + 2, offset + 3}
    assert extended[3].mask_vectors[offset + 2 :, :4].argmax(dim=1).tolist() == [1, 3]
    assert len(extended[2].mask_vectors) == offset + 2


def test_photographs_need_an_extractor(tiny_scene: Scene):
    photographs = replace(tiny_scene, supervise=None)
    with pytest.raises(ValueError, match=r"extractor must be given for photographs.*offline_sam"):
        Offline().require({3: photographs})
    with pytest.raises(ValueError, match="data must have a mask level"):
        Offline(extractor=Halves()).require({None: photographs})
    Offline().require({None: without_language(photographs)})


def test_missing_weights_are_named_before_training():
    augment = instantiate(composed("augment=offline_sam", "features.weights=/nowhere").augment)
    with pytest.raises(FileNotFoundError, match="sam"):
        augment.identity()


def test_where_weights_lie_moves_no_run():
    def named(*overrides: str) -> str:
        return run_id(composed("augment=offline_sam", *overrides), "data")

    assert named("features.weights=/a") == named("features.weights=/b", "features.device=cuda")
    assert named() != named("features.dtype=bfloat16")
    assert named() != run_id(composed("augment=offline"), "data")


def test_neighbours_are_the_nearest_of_one_size(tiny_scene: Scene):
    cameras = [view.camera for view in tiny_scene.train]
    cameras[2] = replace(cameras[2], width=cameras[2].width + 1)
    near = nearest_views(cameras, 2)
    centers = camera_center(torch.stack([camera.viewmat for camera in cameras]))
    for index, others in enumerate(near):
        if index == 2:
            assert others == ()
            continue
        distances = (centers - centers[index]).norm(dim=1)
        distances[[index, 2]] = torch.inf
        assert set(others) == set(distances.argsort()[:2].tolist())
    sampler = PairSampler(((4, 4),) * 6, seed=0, near=near)
    pairs = [sampler.pair(step) for step in range(60)]
    assert all(second in (near[first] or (first,)) for first, second in pairs)
    assert sorted(first for first, _ in pairs[:6]) == list(range(6))
    assert len(set(pairs)) > 9
