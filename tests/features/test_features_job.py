"""`python -m vlgs.features` and `python -m vlgs.vocabulary` from the command line to what training reads."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from colmap_scenes import write_model, write_scene
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from PIL import Image
from rich.console import Console
from slow import with_slow
from tiny_models import save_siglip

from vlgs import vocabulary
from vlgs.config import CONF, check_targets, instantiate
from vlgs.data.colmap import load_scene
from vlgs.data.language import find_mask_files, read_vocabulary
from vlgs.features import Encoder, Extractor, MaskExtractor, MaskFeatures, Segmenter, job
from vlgs.features.__main__ import extract
from vlgs.features.folder import FeatureFolder

LOOSE = (
    "features.extractor.segmenter.prompts.points_per_side=4",
    "features.extractor.segmenter.keep.predicted_iou=-20.0",
    "features.extractor.segmenter.keep.least_area=0",
    "features.extractor.segmenter.nms.score=-100.0",
    "features.extractor.segmenter.nms.inner=0.0",
)
"""Settings under which masks of random weights pass."""

QUICK = ("features/segmenter=superpixels", "features.extractor.segmenter.per_side=[6,4,2]")


def config(root: Path, weights: Path | None, *overrides: str) -> DictConfig:
    given = [f"data.root={root}", "progress=false", *overrides]
    if weights is not None:
        given.append(f"features.weights={weights}")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("features", overrides=given)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Nine photographs through a lens that distorts."""
    root = tmp_path / "scene"
    lens = ("SIMPLE_RADIAL", (60.0, 35.0, 25.0, 0.08))
    write_scene(root, camera=lens, size=(70, 50))
    return root


def maps_of(root: Path) -> dict[str, bytes]:
    folder = root / "language_features"
    return {p.name: p.read_bytes() for p in folder.glob("*.npy")}


def test_a_scene_of_a_release_gets_its_maps_in_its_own_folder(tmp_path: Path):
    write_scene(tmp_path / "release" / "bed", size=(70, 50))
    release = str(tmp_path / "release")
    overrides = (
        "data=ovs3d",
        f"data.root={release}",
        "data.scene=bed",
        "data.labels=null",
        "data.split=llff",
    )
    described = config(Path(release), None, *overrides, *QUICK)
    planned = job.plan(described)
    assert planned.folder.path == tmp_path / "release" / "bed" / "language_features"
    assert len(planned.views) > 0
    assert planned.views[0].photograph.width == 70


def test_photographs_become_language_that_training_reads(scene: Path, weights: Path):
    extract(config(scene, weights, *LOOSE))
    read = load_scene(str(scene), resize=0.5)
    assert len(read.train) == 7
    assert read.mask_vectors.shape[1] == 12
    assert len(read.mask_vectors) > 0
    assert all(view.read_masks is not None for view in read.train)
    for view in read.test:  # never read by training, so never made
        assert find_mask_files(scene / "language_features", view.name) is None
    ids = np.load(scene / "language_features" / f"{read.train[0].name}_s.npy")
    vectors = np.load(scene / "language_features" / f"{read.train[0].name}_f.npy")
    assert ids.shape == (4, 50, 70)  # of the file, not of the undistorted view
    assert ids.dtype == vectors.dtype == np.float32
    assert sorted(set(ids[ids >= 0].astype(int))) == list(range(len(vectors)))
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)


def test_a_vector_belongs_to_the_pixels_that_show_its_mask(scene: Path, weights: Path):
    from vlgs.features.masks import crop_mask

    plan = job.plan(config(scene, weights, *QUICK))
    assert isinstance(plan.extractor, MaskExtractor)
    image = plan.pixels(plan.views[0])
    got = plan.extractor(image, "a")
    for row in (0, len(got.vectors) // 2, len(got.vectors) - 1):
        level = int(np.flatnonzero((got.ids == row).any(axis=(1, 2)))[0])
        if level == 0:
            continue  # painted over in part
        mask = crop_mask(got.ids[level] == row)
        assert mask is not None
        vector = plan.extractor.encoder(image, [mask], "a")[0]
        np.testing.assert_allclose(vector / np.linalg.norm(vector), got.vectors[row], atol=1e-5)


def test_what_is_there_is_left_and_what_is_missing_is_made(scene: Path, weights: Path):
    given = config(scene, weights, *QUICK)
    extract(given)
    first = maps_of(scene)
    folder = scene / "language_features"
    (folder / "frame_00001_s.npy").unlink()
    (folder / "frame_00002_f.npy").unlink()
    untouched = (folder / "frame_00003_s.npy").stat().st_mtime_ns
    assert [view.name for view in job.plan(given).todo()] == ["frame_00001", "frame_00002"]
    extract(given)
    assert maps_of(scene) == first
    assert (folder / "frame_00003_s.npy").stat().st_mtime_ns == untouched


def test_a_crash_between_the_two_files_leaves_no_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from vlgs.features import folder as module

    features = MaskFeatures(np.zeros((4, 2, 2), np.int32), np.eye(4, dtype=np.float32)[:1])
    target = FeatureFolder(tmp_path)
    (tmp_path / "a_s.npy").write_bytes(b"left by a crash")
    written = []

    def crash_at_second(path: Path, data: bytes) -> None:
        written.append(path.name)
        if len(written) == 2:
            raise KeyboardInterrupt
        path.write_bytes(data)

    monkeypatch.setattr(module, "write_atomically", crash_at_second)
    with pytest.raises(KeyboardInterrupt):
        target.write("a", features)
    assert not target.has("a")
    monkeypatch.undo()
    target.write("a", features)
    assert target.has("a")


def test_a_folder_of_other_settings_is_refused(scene: Path, weights: Path):
    extract(config(scene, weights, *QUICK))
    changed = config(
        scene, weights, *QUICK, "features.views=all", "features.extractor.encoder.antialias=true"
    )
    with pytest.raises(ValueError, match=r"extractor\.encoder\.antialias was False, is True") as e:
        extract(changed)
    assert "features.out=FOLDER" in str(e.value)
    unmoved = ("features.views=all", "features.extractor.encoder.batch=3")  # moves no number
    extract(config(scene, weights, *QUICK, *unmoved))
    assert find_mask_files(scene / "language_features", "frame_00000") is not None


def test_a_complete_folder_of_other_settings_is_refused(scene: Path, weights: Path, tmp_path: Path):
    extract(config(scene, weights, *QUICK))
    first = maps_of(scene)
    extract(config(scene, weights, *QUICK))  # nothing is left to do
    changed = (*QUICK, "features.extractor.segmenter.rounds=3")
    for place in (weights, tmp_path):  # the latter has none
        with pytest.raises(ValueError, match=r"extractor\.segmenter\.rounds was 10, is 3"):
            extract(config(scene, place, *changed))
        with pytest.raises(ValueError, match=r"extractor\.segmenter\.rounds was 10, is 3"):
            list(job.estimate(job.plan(config(scene, place, *changed))))
    extract(config(scene, tmp_path, *QUICK))
    other = shutil.copytree(weights, tmp_path / "other")
    path = other / "CLIP-ViT-B-16-laion2B-s34B-b88K" / "config.json"
    path.write_text(path.read_text() + " ")
    with pytest.raises(ValueError, match=r"settings must be those .* read\.encoder was"):
        extract(config(scene, other, *QUICK))
    (scene / "language_features" / "features.json").unlink()  # as of another program
    extract(config(scene, weights, *changed))
    assert maps_of(scene) == first


def test_other_weights_are_other_settings(scene: Path, weights: Path, tmp_path: Path):
    extract(config(scene, weights, *QUICK))
    (scene / "language_features" / "frame_00001_s.npy").unlink()
    other = shutil.copytree(weights, tmp_path / "other")
    path = other / "CLIP-ViT-B-16-laion2B-s34B-b88K" / "config.json"
    path.write_text(path.read_text() + " ")
    with pytest.raises(ValueError, match=r"settings must be those .* read\.encoder was"):
        extract(config(scene, other, *QUICK))


def test_maps_of_another_program_are_not_mixed_with(scene: Path, weights: Path):
    folder = scene / "language_features"
    folder.mkdir()
    np.save(folder / "frame_00001_s.npy", np.zeros(1))
    with pytest.raises(ValueError, match=r"must be empty or have a features\.json"):
        extract(config(scene, weights, *QUICK))
    (folder / "features.json").write_text("[]")
    with pytest.raises(ValueError, match="content must be a JSON of settings"):
        extract(config(scene, weights, *QUICK))


def test_a_dry_run_writes_nothing(scene: Path, weights: Path):
    lines = list(job.estimate(job.plan(config(scene, weights, *QUICK))))
    assert lines[0].startswith("photographs 7 to do of 7")
    assert "masks as frame_00001 has" in lines[1]
    assert "min," in lines[2]
    assert "70 x 50" in lines[2]
    assert not (scene / "language_features").exists()
    lines = list(job.estimate(job.plan(config(scene, scene))))
    assert "hf download facebook/sam-vit-huge" in lines[2]


def test_a_scene_whose_maps_were_never_made_is_one_without_language(scene: Path, weights: Path):
    (scene / "maps").mkdir()
    dense = ("features/encoder=maps", f"features.extractor.encoder.folder={scene / 'maps'}")
    with pytest.raises(FileNotFoundError, match="must be the feature map of photograph"):
        extract(config(scene, None, *QUICK, *dense))
    assert not (scene / "language_features").exists()  # other settings can have the folder
    assert len(load_scene(str(scene)).mask_vectors) == 0
    extract(config(scene, weights, *QUICK))


def test_missing_weights_are_one_error_with_all_of_them(scene: Path):
    with pytest.raises(FileNotFoundError, match="hf download facebook/sam-vit-huge") as e:
        extract(config(scene, scene))
    assert "hf download laion/CLIP-ViT-B-16-laion2B-s34B-b88K" in str(e.value)
    assert not (scene / "language_features").exists()


def test_only_the_levels_that_are_wanted(scene: Path, weights: Path):
    extract(config(scene, weights, *QUICK, "features.extractor.levels=[3]"))
    ids = np.load(scene / "language_features" / "frame_00001_s.npy")
    assert (ids[:3] == -1).all()
    assert (ids[3] >= 0).all()
    assert len(load_scene(str(scene)).mask_vectors) > 0
    with pytest.raises(ValueError, match="levels must be some of 0, 1, 2 and 3"):
        job.plan(config(scene, weights, *QUICK, "features.extractor.levels=[4]"))


def test_high_photographs_are_scaled_as_langsplat_does(scene: Path, weights: Path):
    photographs = sorted((scene / "images").glob("*.png"))
    for path in photographs[2:]:
        path.unlink()
    for path in photographs[:2]:
        Image.new("RGB", (71, 1200), "gray").save(path)
    names = [path.name for path in photographs[:2]]
    write_model(scene / "sparse" / "0", names, size=(71, 1200))
    plan = job.plan(config(scene, weights, *QUICK, "features.extractor.levels=[3]"))
    assert plan.pixels(plan.views[0]).shape == (1080, 63, 3)  # 63.9 is cut
    list(job.run(plan, Console(quiet=True)))
    assert len(load_scene(str(scene)).mask_vectors) > 0  # the reader accepts that size
    with pytest.raises(ValueError, match="max_height must be 1080 or null"):
        job.plan(config(scene, weights, *QUICK, "features.max_height=500"))


def test_an_encoder_whose_vectors_are_zero_is_refused(scene: Path, tmp_path: Path):
    maps = tmp_path / "maps"
    maps.mkdir()
    for path in (scene / "images").glob("*.png"):
        np.save(maps / f"{path.stem}.npy", np.zeros((5, 7, 3), np.float32))
    given = config(
        scene, None, *QUICK, "features/encoder=maps", f"features.extractor.encoder.folder={maps}"
    )
    with pytest.raises(ValueError, match="vectors of frame_00001 must be finite and not zero"):
        extract(given)
    assert not list((scene / "language_features").glob("*_s.npy"))


def test_words_get_vectors_in_the_space_of_the_masks(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    words = tmp_path / "words.txt"
    words.write_text("wine glass # translucent\n\nkettle\n", encoding="utf-8")
    model = str(weights / "CLIP-ViT-B-16-laion2B-s34B-b88K")
    out = tmp_path / "deep" / "vocabulary.npz"
    vocabulary.main([str(words), str(out), "--model", model])
    assert "6 words" in capsys.readouterr().out
    read = read_vocabulary(out)
    assert read.names == ("wine glass", "kettle", "object", "things", "stuff", "texture")
    assert read.vectors.shape == (6, 12)
    words.write_text("kettle\nkettle\n")
    with pytest.raises(SystemExit, match="words must be unique, got kettle more than once"):
        vocabulary.main([str(words), str(out), "--model", model])
    words.write_text("kettle")
    for out in (words, tmp_path / "vocabulary.txt", tmp_path / "vocabulary"):
        with pytest.raises(SystemExit, match=r"OUT must be a file that ends in \.npz"):
            vocabulary.main([str(words), str(out), "--model", model])
    assert words.read_text() == "kettle"
    out = tmp_path / "deep" / "vocabulary.npz"
    with pytest.raises(SystemExit, match="weights must be on this machine"):
        vocabulary.main([str(words), str(out), "--model", str(tmp_path / "none")])


def test_siglip_2_makes_both_words_and_masks(scene: Path, tmp_path: Path):
    save_siglip(tmp_path / "siglip2-base-patch16-224")
    extract(config(scene, tmp_path, *QUICK, "features/encoder=siglip2"))
    maps = scene / "language_features"
    words = tmp_path / "words.txt"
    words.write_text("wine glass\nkettle\n", encoding="utf-8")
    model = str(tmp_path / "siglip2-base-patch16-224")
    vocabulary.main([str(words), str(maps / "vocabulary.npz"), "--model", model])
    read = load_scene(root=str(scene))
    assert read.vocabulary is not None
    assert read.vocabulary.vectors.shape == (6, 16)
    assert read.mask_vectors.shape[1] == 16


OPTIONS = sorted(
    (path.parent.name, path.stem) for g in ("segmenter", "encoder") for path in (CONF / "features" / g).glob("*.yaml")
)  # fmt: skip


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_composes_and_keeps_the_contract(group: str, option: str):
    given = config(Path("x"), None, f"features/{group}={option}")
    if option == "maps":
        given.features.extractor.encoder.folder = "x"
    check_targets(given, "features")
    extractor = instantiate(given.features.extractor)
    assert isinstance(extractor, Extractor)
    assert isinstance(extractor, MaskExtractor)
    assert isinstance(extractor.segmenter, Segmenter)
    assert isinstance(extractor.encoder, Encoder)


def test_an_extractor_of_your_own_needs_only_its_target():
    given = config(
        Path("x"),
        None,
        "features=own",
        "+features.extractor._target_=my_lab.Masks",
        "plugins=[my_lab]",
    )
    check_targets(given, "features")
    assert given.features.extractor == {"_target_": "my_lab.Masks"}


@pytest.mark.parametrize("module", with_slow(["vlgs.features", "vlgs.check"], ["vlgs.check"]))
def test_each_entry_point_has_a_manual_of_its_own(module: str, tmp_path: Path):
    import subprocess
    import sys

    done = subprocess.run(
        [sys.executable, "-m", module, "--help"],
        capture_output=True, text=True, timeout=60, check=True, cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
    )  # fmt: skip
    assert f"python -m {module} - " in done.stdout


def test_settings_are_readable(scene: Path, weights: Path):
    extract(config(scene, weights, *QUICK))
    settings = json.loads((scene / "language_features" / "features.json").read_text())
    assert settings["extractor"]["encoder"]["pretrained"]["name"].startswith("laion/")
    assert str(weights) not in json.dumps(settings)
    assert len(settings["read"]["encoder"]) == 32
