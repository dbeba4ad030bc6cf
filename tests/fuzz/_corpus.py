"""One small honest file of every format that the project reads, and the public function that reads it."""

import io
import json
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from PIL import Image

from vlgs.check import check
from vlgs.convert import convert
from vlgs.data.diagnostics import SceneError, errors
from vlgs.features.encoders import DenseMaps
from vlgs.features.folder import FeatureFolder
from vlgs.features.weights import Pretrained
from vlgs.heads.autoencoder import Autoencoder, AutoencoderTraining
from vlgs.vocabulary import read_words

WIDTH, HEIGHT, WIDE = 24, 18, 8
STEMS = ("a", "b", "c")
WORDS = ("plate", "cup", "green tea", "object", "things", "stuff", "texture")


@dataclass(frozen=True)
class Honest:
    """A file of the corpus."""

    path: Path
    """Below the corpus."""
    unit: str
    """Folder of all that is read with it."""
    read: Callable[[Path], object]
    """Given the unit's folder, perhaps with the file in another state."""
    names_itself: bool
    """Whether an error must name this file; files of a scene may contradict each other, then it names one of them."""


def read_scene(folder: Path, **options: object) -> None:
    """What `python -m vlgs.check` does; the first error is raised."""
    defaults = {"split": "llff", "every": 3, "labels": None, "features": None, "vocabulary": None}
    source = {"_target_": "vlgs.data.colmap.load_scene", "root": str(folder), **defaults, **options}
    report = check(OmegaConf.create(source))
    for fault in errors(report.faults):
        raise SceneError(fault)


def write_corpus(folder: Path) -> list[Honest]:
    """Write all of it and say what reads each file."""
    units: dict[str, tuple[Callable[[Path], None], Callable[[Path], object], bool]] = {
        "colmap": (_colmap_binary, read_scene, False),
        "colmap_text": (_colmap_text, lambda f: read_scene(f, vocabulary=str(f / "v.json")), False),
        "nerfstudio": (_nerfstudio, read_scene, False),
        "llff": (_llff, lambda f: read_scene(f, labels=str(f / "segmentations")), False),
        "ply": (_ply, lambda f: convert(f / "a.ply", f / "out.ply", drop=True), True),
        "ply_text": (_ply_text, lambda f: convert(f / "t.ply", f / "out.ply"), True),
        "splat": (_splat, lambda f: convert(f / "a.splat", f / "out.ply"), True),
        "3dgs": (_checkpoint(12), lambda f: convert(f / "c.pth", f / "out.ply"), True),
        "langsplat": (_checkpoint(13), lambda f: convert(f / "c.pth", f / "out.ply"), True),
        "autoencoder": (
            _autoencoder,
            lambda f: convert(f / "best_ckpt.pth", f / "o.safetensors"),
            True,
        ),
        "weights": (_weights, lambda f: convert(f / "w.safetensors", f / "out.pth"), True),
        "words": (_words, lambda f: read_words(f / "words.txt"), True),
        "maps": (_feature_map, read_feature_map, True),
        "settings": (_settings, _read_settings, False),
        "processor": (_processor, _read_processor, True),
        "head_cache": (_head_cache, _fit_from_cache, True),
        "photographs_cache": (_photograph_from_cache, _photograph_from_cache, True),
    }
    found = []
    for name, (write, read, names_itself) in units.items():
        (folder / name).mkdir(parents=True)
        in_a_child(lambda write=write, name=name: write(folder / name))
        for path in sorted((folder / name).rglob("*")):
            if path.is_file():
                found.append(Honest(path.relative_to(folder), name, read, names_itself))
    return found


def in_a_child(work: Callable[[], object]) -> None:
    """The parent of all attacks must not have computed with torch: its threads do not live on in a fork."""
    child = os.fork()
    if child == 0:
        try:
            work()
        except BaseException as error:
            os.write(2, f"corpus: {error!r}\n".encode())
            os._exit(1)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        raise RuntimeError("the corpus could not be written")


def _photographs(folder: Path, suffix: str, **options: Any) -> None:
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    for stem in STEMS:
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"{stem}.{suffix}", **options)


def _language(folder: Path) -> None:
    folder.mkdir()
    rng = np.random.default_rng(1)
    for stem in STEMS:
        ids = np.stack([np.full((HEIGHT, WIDTH), i) for i in range(4)]).astype(np.float32)
        ids[:, :3] = -1
        vectors = rng.normal(size=(4, WIDE)).astype(np.float32)
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        np.save(folder / f"{stem}_s.npy", ids)
        np.save(folder / f"{stem}_f.npy", vectors)


def _pose(number: int) -> tuple[float, ...]:
    angle = 0.1 * number
    return (np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0, 0.1 * number, 0.2, 3.0)


def _colmap_binary(root: Path) -> None:
    sparse = root / "sparse" / "0"
    sparse.mkdir(parents=True)
    _photographs(root / "images", "png")
    _language(root / "language_features")
    vectors = np.random.default_rng(2).normal(size=(len(WORDS), WIDE))
    names = root / "language_features" / "vocabulary.npz"
    np.savez_compressed(names, names=np.array(WORDS), embeddings=vectors)
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, WIDTH, HEIGHT, 20.0, 21.0, 12.0, 9.0)
    (sparse / "cameras.bin").write_bytes(camera)
    images, points = [struct.pack("<Q", len(STEMS))], [struct.pack("<Q", 20)]
    for number, stem in enumerate(STEMS, start=1):
        images.append(struct.pack("<I7dI", number, *_pose(number), 1) + f"{stem}.png\0".encode())
        images.append(struct.pack("<QddqddQ", 2, 3.0, 4.0, 1, 5.0, 6.0, 2**64 - 1))
    for number, xyz in enumerate(np.random.default_rng(3).normal(size=(20, 3)), start=1):
        points.append(struct.pack("<Q3d3BdQII", number, *xyz, 1, 2, 3, 0.5, 1, 1, 0))
    (sparse / "images.bin").write_bytes(b"".join(images))
    (sparse / "points3D.bin").write_bytes(b"".join(points))
    (root / "labels").mkdir()
    listed = {str(i): {"name": name, "kind": "other"} for i, name in enumerate(WORDS[:3])}
    (root / "labels" / "classes.json").write_text(json.dumps({"classes": listed}))
    ids = np.random.default_rng(4).integers(0, 3, (HEIGHT, WIDTH), np.uint8)
    Image.fromarray(ids).save(root / "labels" / "a.png")


def _colmap_text(root: Path) -> None:
    sparse = root / "sparse"
    sparse.mkdir()
    _photographs(root / "images", "jpg", progressive=True)
    parameters = f"{WIDTH} {HEIGHT} 20 21 12 9 0.01 0 0 0"
    (sparse / "cameras.txt").write_text(f"# cameras\n1 OPENCV {parameters}\n")
    lines = ["# images"]
    for number, stem in enumerate(STEMS, start=1):
        lines.append(f"{number} {' '.join(map(str, _pose(number)))} 1 {stem}.jpg\n3.0 4.0 1 5 6 -1")
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    rows = np.random.default_rng(3).normal(size=(20, 3)).tolist()
    text = [f"{i} {x} {y} {z} 1 2 3 0.5 1 0" for i, (x, y, z) in enumerate(rows, start=1)]
    (sparse / "points3D.txt").write_text("\n".join(text) + "\n")
    (root / "labels").mkdir()
    square = [[2, 3], [8, 3], [8.5, 6], [2, 6]]
    objects = [
        {"category": name, "segmentation": square, "bbox": [2, 3, 8.5, 6]} for name in WORDS[:2]
    ]
    info = {"name": "a.jpg", "width": WIDTH, "height": HEIGHT}
    (root / "labels" / "a.json").write_text(json.dumps({"info": info, "objects": objects}))
    rng = np.random.default_rng(2)
    (root / "v.json").write_text(json.dumps({w: rng.normal(size=WIDE).tolist() for w in WORDS}))


def _nerfstudio(root: Path) -> None:
    _photographs(root / "images", "webp", lossless=True)
    frames = []
    for number, stem in enumerate(STEMS):
        matrix = np.eye(4)
        matrix[0, 3] = 0.1 * number
        frames.append({"file_path": f"images/{stem}.webp", "transform_matrix": matrix.tolist()})
    content = {"fl_x": 20.0, "k1": 0.01, "ply_file_path": "sparse_pc.ply", "frames": frames}
    (root / "transforms.json").write_text(json.dumps(content, indent=1))
    points = np.random.default_rng(3).normal(size=(20, 3)).tolist()
    names = [f"property float {axis}" for axis in "xyz"]
    names += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    rows = [f"{x} {y} {z} 10 20 30" for x, y, z in points]
    header = ["ply", "format ascii 1.0", "comment made", "element vertex 20", *names, "end_header"]
    (root / "sparse_pc.ply").write_text("\n".join([*header, *rows]) + "\n")
    masks = root / "labels" / "plate" / "masks"
    masks.mkdir(parents=True)
    Image.fromarray(np.eye(HEIGHT, WIDTH, dtype=np.uint8) * 255).save(masks / "a.png")


def _llff(root: Path) -> None:
    _photographs(root / "images", "tif", compression="tiff_lzw")
    rows = np.zeros((len(STEMS), 17))
    for number, row in enumerate(rows):
        matrix = np.zeros((3, 5))
        matrix[:, 0], matrix[:, 1], matrix[:, 2] = (0, -1, 0), (1, 0, 0), (0, 0, 1)
        matrix[:, 3], matrix[:, 4] = (0.1 * number, 0, 0), (HEIGHT, WIDTH, 20.0)
        row[:15], row[15:] = matrix.ravel(), (1, 9)
    np.save(root / "poses_bounds.npy", rows)
    folder = root / "segmentations"
    (folder / "a").mkdir(parents=True)
    (folder / "classes.txt").write_text("plate\ncup\n", encoding="utf-8-sig")
    Image.fromarray(np.eye(HEIGHT, WIDTH) > 0).save(folder / "a" / "plate.png")


_PLY = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    *("lang_0", "lang_1", "lang_2", "indicator"),
)


def _ply_header(kind: str) -> str:
    names = "".join(f"property float {name}\n" for name in _PLY)
    return f"ply\nformat {kind} 1.0\ncomment made\nelement vertex 7\n{names}end_header\n"


def _ply(root: Path) -> None:
    rows = np.random.default_rng(0).normal(size=(7, len(_PLY))).astype("<f4")
    header = _ply_header("binary_little_endian").encode()
    (root / "a.ply").write_bytes(header + rows.tobytes())


def _ply_text(root: Path) -> None:
    stream = io.StringIO()
    np.savetxt(stream, np.random.default_rng(0).normal(size=(7, len(_PLY))))
    (root / "t.ply").write_text(_ply_header("ascii") + stream.getvalue())


def _splat(root: Path) -> None:
    rows = np.random.default_rng(0).uniform(0.1, 1, (7, 8)).astype("<f4")
    (root / "a.splat").write_bytes(rows.tobytes())


def _checkpoint(values: int) -> Callable[[Path], None]:
    def write(root: Path) -> None:
        _ply(root)
        name = "langsplat" if values == 13 else "3dgs"
        convert(root / "a.ply", root / "c.pth", name)
        (root / "a.ply").unlink()

    return write


def _head(root: Path | None) -> Autoencoder:
    training = AutoencoderTraining(steps=2, batch=2)
    return Autoencoder(
        encoder_widths=(6, 4), decoder_widths=(4, 6), training=training, cache_dir=root
    )


def _head_cache(root: Path) -> None:
    _fit_from_cache(root)


def _fit_from_cache(root: Path) -> None:
    """Whatever the cache holds, the weights are those of a fit."""
    import torch

    found, fitted = _head(root), _head(None)
    for head in (found, fitted):
        head.fit(torch.eye(WIDE), torch.ones(WIDE))
    wanted = fitted.state_dict()
    assert all(torch.equal(value, wanted[key]) for key, value in found.state_dict().items())


def _photograph_from_cache(root: Path) -> None:
    """Whatever the cache holds, the photographs are those that were taken."""
    import torch

    from vlgs.data.synthetic import load_scene

    found, traced = (
        load_scene(width=16, height=16, train_views=2, test_views=1, points=20, cache=cache)
        for cache in (str(root), None)
    )
    for one, other in zip(found.train, traced.train, strict=True):
        assert torch.equal(one.read_image(), other.read_image())


def _weights(root: Path) -> None:
    _head_cache(root)
    next(root.glob("*.safetensors")).rename(root / "w.safetensors")


def _autoencoder(root: Path) -> None:
    _weights(root)
    convert(root / "w.safetensors", root / "best_ckpt.pth")
    (root / "w.safetensors").unlink()


def _words(root: Path) -> None:
    (root / "words.txt").write_text("# words\nTasse\nGrüner Tee\n\nplate\n", encoding="utf-8")


def _feature_map(root: Path) -> None:
    np.save(root / "a.npy", np.random.default_rng(0).normal(size=(4, 5, 6)).astype(np.float32))


def read_feature_map(root: Path) -> None:
    from vlgs.features.masks import Mask

    maps = DenseMaps(str(root), pattern="{stem}.npy")
    mask = Mask(0, 0, np.ones((HEIGHT, WIDTH), bool))
    maps(np.zeros((HEIGHT, WIDTH, 3), np.uint8), [mask], "a")


def _settings(root: Path) -> None:
    (root / "features.json").write_text(json.dumps({"version": 1, "extractor": {"batch": [1, 2]}}))


def _read_settings(root: Path) -> None:
    FeatureFolder(root).require_same({"version": 1, "extractor": {"batch": [1, 2]}})


def _processor(root: Path) -> None:
    model = root / "model"
    model.mkdir()
    for name in ("config.json", "model.safetensors"):
        (model / name).write_text("{}")
    content = {"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.5]}
    (model / "preprocessor_config.json").write_text(json.dumps(content))


def _read_processor(root: Path) -> None:
    Pretrained(name="x/model", weights=str(root)).preprocessing()
