"""Every data set is read from its release's own layout, and gives back what was written there."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from releases import (
    as_taken,
    class_masks,
    objects,
    truth,
    write_gags,
    write_goi,
    write_lerf_ovs,
    write_mipnerf360,
    write_ovs3d,
)
from tiny_runs import composed

from vlgs.check import check
from vlgs.config import instantiate
from vlgs.data.diagnostics import SceneError, errors
from vlgs.data.split import Split
from vlgs.types import Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return truth()


@pytest.fixture(scope="module")
def release(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All releases below one folder, one folder each."""
    root = tmp_path_factory.mktemp("releases")
    write_lerf_ovs(scene, root / "lerf_ovs")
    write_ovs3d(scene, root / "ovs3d")
    write_mipnerf360(scene, root / "mip")
    write_goi(scene, root / "goi")
    write_gags(scene, root / "gags")
    return root


def options(release: Path, option: str) -> list[str]:
    folder, name = {
        "lerf_ovs": ("lerf_ovs", "ramen"),
        "ovs3d": ("ovs3d", "bed"),
        "mipnerf360": ("mip", "garden"),
        "mipnerf360_goi": ("mip", "garden"),
        "mipnerf360_gags": ("mip", "garden"),
    }[option]
    labels = {"mipnerf360_goi": "goi", "mipnerf360_gags": "gags"}
    more = [f"data.release.labels={release / labels[option]}"] if option in labels else []
    return [f"data={option}", f"data.root={release / folder}", f"data.scene={name}", *more]


def read(release: Path, option: str, *more: str) -> Scene:
    return instantiate(composed(*options(release, option), *more).data)


def named(scene: Scene, option: str) -> Scene:
    """What the release holds, under the names that it has there."""
    return as_taken(scene) if option.startswith("mip") else scene


ALL = ("lerf_ovs", "ovs3d", "mipnerf360", "mipnerf360_goi", "mipnerf360_gags")
LABELLED = tuple(option for option in ALL if option != "mipnerf360")


@pytest.mark.parametrize("option", ALL)
def test_images_cameras_and_masks_are_those_that_were_written(
    scene: Scene, release: Path, option: str
):
    scene = named(scene, option)
    got = read(release, option, "data.split=list", f"data.test={[v.name for v in scene.test]}")
    assert torch.equal(got.points, scene.points)
    assert torch.equal(got.mask_areas, scene.mask_areas)
    torch.testing.assert_close(got.mask_vectors, scene.mask_vectors, atol=1e-6, rtol=0)
    assert got.vocabulary is not None
    assert [v.name for v in got.train] == [v.name for v in scene.train]
    for ours, theirs in zip(got.train + got.test, scene.train + scene.test, strict=True):
        torch.testing.assert_close(ours.camera.viewmat, theirs.camera.viewmat, atol=1e-6, rtol=0)
        torch.testing.assert_close(ours.camera.K, theirs.camera.K, atol=1e-4, rtol=0)
        assert torch.equal(ours.read_image(), theirs.read_image())
    for ours, theirs in zip(got.train, scene.train, strict=True):
        assert ours.read_masks is not None
        assert theirs.read_masks is not None
        assert torch.equal(ours.read_masks(), theirs.read_masks())


@pytest.mark.parametrize("option", ["ovs3d", "mipnerf360_goi"])
def test_masks_of_folders_are_the_labels(scene: Scene, release: Path, option: str):
    scene = named(scene, option)
    got = read(release, option)
    shown = sorted({c for view in scene.test for c in class_masks(view, scene)})
    assert list(got.classes) == (sorted(scene.classes) if option == "ovs3d" else shown)
    assert [view.name for view in got.test] == [view.name for view in scene.test]
    for ours, theirs in zip(got.test, scene.test, strict=True):
        want, labels = class_masks(theirs, scene), objects(ours)
        assert set(labels.masks) == set(want)
        for name, mask in want.items():
            np.testing.assert_array_equal(labels.masks[name].numpy(), mask)
        assert not labels.boxes


@pytest.mark.parametrize("option", ["lerf_ovs", "mipnerf360_gags"])
def test_polygons_are_the_labels(scene: Scene, release: Path, option: str):
    scene = named(scene, option)
    got = read(release, option)
    for ours, theirs in zip(got.test, scene.test, strict=True):
        assert ours.name == theirs.name
        want, labels = objects(theirs), objects(ours)
        assert set(labels.masks) == set(want.masks)
        for name, mask in want.masks.items():
            assert (mask & ~labels.masks[name]).sum() == 0  # polygons close holes
            assert sorted(labels.boxes[name].tolist()) == sorted(want.boxes[name].tolist())
    assert set(got.classes) == {c for view in scene.test for c in objects(view).masks}


@pytest.mark.parametrize("option", LABELLED)
def test_splits(scene: Scene, release: Path, option: str):
    scene = named(scene, option)
    every, held = read(release, option), read(release, option, "data.split=holdout")
    labelled = {view.name for view in scene.test}
    assert (every.split, held.split) == ("all", "holdout")
    assert {view.name for view in every.test} == {view.name for view in held.test} == labelled
    assert labelled < {view.name for view in every.train}
    assert not labelled & {view.name for view in held.train}
    assert read(release, option, "data.split=llff", "data.every=3").split == "llff3"
    assert every.fingerprint != held.fingerprint


def test_the_two_label_sets_of_mipnerf360_never_share_a_name(release: Path):
    sets = [read(release, f"mipnerf360_{name}") for name in ("goi", "gags")]
    assert [scene.label_set for scene in sets] == ["mipnerf360_goi", "mipnerf360_gags"]
    assert sets[0].fingerprint != sets[1].fingerprint


@pytest.mark.parametrize("option", ALL)
def test_check_works_on_every_release(release: Path, option: str):
    report = check(composed(*options(release, option)).data)
    assert not errors(report.faults)
    assert any(line.startswith("views") for line in report.summary)


def test_annotated_frames_of_lerf_ovs_under_the_llff_split():
    # LangSplat's release: frames are numbered from 1 without gaps; of the annotated ones only these are held out.
    annotated = {
        "figurines": ((41, 105, 152, 195), [41, 105], 299),
        "ramen": ((6, 24, 60, 65, 81, 119, 128), [65, 81], 131),
        "teatime": ((2, 25, 43, 107, 129, 140), [25, 129], 177),
        "waldo_kitchen": ((53, 66, 89, 140, 154), [89], 187),
    }
    for frames, want, count in annotated.values():
        names = [f"frame_{i:05d}" for i in range(1, count + 1)]
        _, test = Split("llff").divide(names, [])
        assert [i for i in frames if f"frame_{i:05d}" in test] == want
        train, held = Split("holdout").divide(names, [f"frame_{i:05d}" for i in frames])
        assert held == tuple(f"frame_{i:05d}" for i in frames)
        assert not set(held) & set(train)


def test_a_missing_release_prints_its_tree(release: Path, tmp_path: Path):
    with pytest.raises(FileNotFoundError) as error:
        instantiate(
            composed("data=lerf_ovs", f"data.root={release / 'lerf_ovs'}", "data.scene=soup").data
        )
    text = str(error.value)
    root = release / "lerf_ovs"
    assert "root must hold LERF-OVS (linked from LangSplat's README)" in text
    for line in (
        f"✓ {root}/",
        f"✗ {root}/soup/images/  <name>.jpg ...",
        f"✗ {root}/soup/sparse/0/",
        f"✗ {root}/label/soup/",
        "(folders beside it: label, ramen)",
    ):
        assert line in text
    with pytest.raises(FileNotFoundError, match=r"✗ .*nowhere/bed/segmentations/"):
        instantiate(
            composed("data=ovs3d", f"data.root={tmp_path / 'nowhere'}", "data.scene=bed").data
        )


def test_faults_of_mask_folders_are_named(scene: Scene, tmp_path: Path):
    write_ovs3d(scene, tmp_path)
    folder = tmp_path / "bed" / "segmentations"
    frame = folder / scene.test[0].name
    masks = sorted(frame.glob("*.png"))
    (frame / "unheard of.png").write_bytes(masks[0].read_bytes())
    with_warning = check(
        composed("data=ovs3d", f"data.root={tmp_path}", "data.scene=bed").data
    ).faults
    assert any(
        "mask must be of a class in classes.txt, got 'unheard of'" in f.what for f in with_warning
    )
    masks[0].write_bytes(b"no picture")
    with pytest.raises(SceneError, match=r"\.png: content must be a whole image"):
        instantiate(composed("data=ovs3d", f"data.root={tmp_path}", "data.scene=bed").data)
    (folder / "classes.txt").write_text("cup\ncup\n")
    with pytest.raises(SceneError, match=r"classes\.txt: classes must be unique names"):
        instantiate(composed("data=ovs3d", f"data.root={tmp_path}", "data.scene=bed").data)


def test_a_number_that_no_image_has_is_a_stray_label(scene: Scene, tmp_path: Path):
    write_mipnerf360(scene, tmp_path / "mip")
    write_gags(scene, tmp_path / "gags")
    empty = {"info": {"name": "frame_00099.jpg", "width": 64, "height": 48}, "objects": []}
    (tmp_path / "gags" / "garden" / "frame_00099.json").write_text(json.dumps(empty))
    with pytest.raises(SceneError, match="no image with stem 'frame_00099'"):
        instantiate(
            composed(
                "data=mipnerf360_gags",
                f"data.root={tmp_path / 'mip'}",
                "data.scene=garden",
                f"data.release.labels={tmp_path / 'gags'}",
            ).data
        )
