"""Maps from dense labels: exact where nothing errs, as often wrong as told, and read by training."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from colmap_scenes import HEIGHT, WIDTH, add_dense, write_scene
from hydra import compose, initialize_config_dir
from PIL import Image

from vlgs.config import CONF, instantiate
from vlgs.data.colmap import load_scene
from vlgs.data.synthetic.masks import NO_NOISE, LabelNoise
from vlgs.features import Extractor
from vlgs.features.__main__ import extract
from vlgs.features.labels import LabelMasks

WORDS = ("sky", "road", "car")


def write_labels(folder: Path, pictures: dict[str, np.ndarray]) -> Path:
    """Classes 4, 7, 9 (`WORDS`) and 2, which does not count."""
    folder.mkdir()
    listed: dict[str, Any] = {
        str(i): {"name": name} for i, name in zip((4, 7, 9), WORDS, strict=True)
    }
    listed["2"] = {"name": "rest", "ignore": True}
    (folder / "classes.json").write_text(json.dumps({"classes": listed}))
    for stem, ids in pictures.items():
        Image.fromarray(ids.astype(np.uint8)).save(folder / f"{stem}.png")
    return folder


def write_words(path: Path, words: tuple[str, ...] = WORDS, width: int = 32) -> np.ndarray:
    """Vectors in a narrow cone, as CLIP's are."""
    vectors = 3 + np.random.default_rng(0).normal(size=(len(words), width))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    np.savez(path, names=np.array(words), embeddings=vectors)
    return vectors


def street() -> np.ndarray:
    """Sky over road, two cars on it, a corner that nobody labelled."""
    ids = np.full((30, 40), 4)
    ids[12:] = 7
    ids[15:21, 4:12] = 9
    ids[18:26, 25:35] = 9
    ids[26:, 36:] = 2
    return ids


def made(tmp_path: Path, noise: LabelNoise, picture: np.ndarray | None = None, **given: Any) -> Any:
    labels = write_labels(tmp_path / "labels", {"a": street() if picture is None else picture})
    vectors = write_words(tmp_path / "words.npz")
    extractor = LabelMasks(str(labels), str(tmp_path / "words.npz"), noise, **given)
    assert isinstance(extractor, Extractor)
    return extractor, vectors


def test_without_errors_masks_are_the_labels_and_each_says_its_own_word(tmp_path: Path):
    extractor, text = made(tmp_path, NO_NOISE)
    ids, label = extractor(np.zeros((30, 40, 3), np.uint8), "a"), street()
    vectors = ids.vectors
    assert np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)
    assert [len(np.unique(level[level >= 0])) for level in ids.ids[1:]] == [16, 4, 3]
    for level in ids.ids:
        assert ((level >= 0) == (label != 2)).all()
        said = (vectors @ text.T).argmax(1)[level[level >= 0]]
        assert (np.array([4, 7, 9])[said] == label[label != 2]).all()
    two_cars = ids.ids[2][label == 9]
    assert len(np.unique(two_cars)) == 2
    cosines = (vectors @ text.T)[ids.ids[3][0, 0]]
    assert cosines[0] == pytest.approx(1 / np.hypot(1, 0.8), abs=1e-6)  # beside text


def test_errors_come_as_often_as_told_and_depend_on_the_name_alone(tmp_path: Path):
    # A board of 300 squares: one piece each, so that shares can be counted.
    picture = np.full((60, 80), 4)
    picture[2::4, :] = 2
    picture[3::4, :] = 2
    picture[:, 2::4] = 2
    picture[:, 3::4] = 2
    rows, columns = np.nonzero(picture == 4)
    picture[rows, columns] = np.array([4, 7, 9])[(rows // 4 * 20 + columns // 4) % 3]
    noise = LabelNoise(0.2, 0.0, 0.3, 0.1, 0.0, 0.0)
    extractor, text = made(tmp_path, noise, picture)
    made_a = extractor(np.zeros((60, 80, 3), np.uint8), "a")
    part, centre = made_a.ids[2][::4, ::4].ravel(), picture[::4, ::4].ravel()
    assert np.mean(part < 0) == pytest.approx(0.2, abs=0.07)  # three deviations of 300 draws
    found = part >= 0
    said = np.array([4, 7, 9])[(made_a.vectors @ text.T).argmax(1)[part[found]]]
    assert np.mean(said != centre[found]) == pytest.approx(0.3 / 0.8, abs=0.095)
    again = extractor(np.zeros((60, 80, 3), np.uint8), "a")
    assert (again.ids == made_a.ids).all()
    assert (again.vectors == made_a.vectors).all()
    labels, words = extractor.files
    other = LabelMasks(labels, words, noise, seed=1)(np.zeros((60, 80, 3), np.uint8), "a")
    assert (other.ids != made_a.ids).any()


def test_labels_of_another_size_are_scaled_and_of_another_shape_refused(tmp_path: Path):
    extractor, _ = made(tmp_path, NO_NOISE)
    large = extractor(np.zeros((60, 80, 3), np.uint8), "a").ids[3]
    assert (large[::2, ::2] == extractor(np.zeros((30, 40, 3), np.uint8), "a").ids[3]).all()
    with pytest.raises(ValueError, match=r"photograph's shape, 40 x 40, got 40 x 30"):
        extractor(np.zeros((40, 40, 3), np.uint8), "a")
    with pytest.raises(ValueError, match=r"labels must hold b\.png"):
        extractor(np.zeros((30, 40, 3), np.uint8), "b")


def test_what_cannot_be_described_is_refused(tmp_path: Path):
    labels = write_labels(tmp_path / "labels", {"a": street()})
    words = tmp_path / "words.npz"
    write_words(words, ("sky", "road"))
    with pytest.raises(ValueError, match=r"a vector for every class of .* got none for car"):
        LabelMasks(str(labels), str(words))
    with pytest.raises(FileNotFoundError, match="labels must be a folder"):
        LabelMasks(str(tmp_path / "none"), str(words))
    with pytest.raises(ValueError, match="seed must not be negative, got -1"):
        LabelMasks(str(labels), str(words), seed=-1)
    (labels / "classes.json").unlink()
    with pytest.raises(ValueError, match="labels must be"):
        LabelMasks(str(labels), str(words))


def test_a_labelled_scene_becomes_one_that_training_reads(tmp_path: Path):
    root = tmp_path / "scene"
    add_dense(root, write_scene(root))
    words = tmp_path / "words.npz"
    write_words(words, ("glass", "wall"))
    given = (f"data.root={root}", "features=labels", f"features.extractor.words={words}")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("features", overrides=[*given, "progress=false"])
    assert isinstance(instantiate(config.features.extractor), LabelMasks)
    extract(config)
    scene = load_scene(str(root))
    assert scene.vocabulary is not None  # the words went with the maps
    assert scene.vocabulary.names == ("glass", "wall")
    assert len(scene.mask_vectors) > 0
    assert scene.mask_vectors.shape[1] == 32
    read = scene.train[0].read_masks
    assert read is not None
    assert read().shape == (HEIGHT, WIDTH)
    settings = (root / "language_features" / "features.json").read_text()
    assert str(tmp_path) not in settings  # what moves a map is content, not a place
    own = root / "language_features" / "vocabulary.npz"
    write_words(own, ("glass", "wall", "lemon"))
    before = own.read_bytes()
    (root / "language_features" / f"{scene.train[0].name}_s.npy").unlink()
    extract(config)
    assert own.read_bytes() == before
