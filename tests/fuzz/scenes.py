"""Odd scenes on disk: what `vlgs.check` says of each is what `vlgs.run` does with it, in the same words.

A scene is six photographs of a few coloured points, COLMAP's text files, masks with vectors, a vocabulary and labels, with one oddity.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from PIL import Image

from tests.fuzz.commands import both
from tests.fuzz.judge import Attack
from vlgs.command import check_command

NEGATIVES = ("object", "things", "stuff", "texture")
OPTIONS = (
    *("data=colmap", "data.every=3", "head.cache_dir=null", "head.training.steps=2", "threads=1"),
    *("trainer=smoke", "trainer.iterations=2", "progress=false", "pictures=false"),
)
PICTURES = ("pictures=true",)
"""Of cases whose names go to the disk, and into pictures and tables."""


@dataclass
class Odd:
    """A scene before it is written."""

    size: tuple[int, int] = (32, 24)
    names: tuple[str, ...] = tuple(f"frame_{i}.png" for i in range(6))
    focal: tuple[float, float] = (30.0, 30.0)
    center: tuple[float, float] | None = None
    points: np.ndarray = field(default_factory=lambda: _points(200))
    turned: bool = False
    """Whether the cameras look away from the points."""
    same_pose: bool = False
    translation: float = 3.0
    masks: str = "sound"
    """sound, empty, none, some, one."""
    words: tuple[str, ...] | None = ("cup", "table", *NEGATIVES)
    classes: tuple[str, ...] = ("cup", "table")
    labels: str = "dense"
    """dense, ignored, objects, none."""
    spoil: Callable[[Path], object] = lambda root: None
    """Done to the files."""


@dataclass(frozen=True)
class Case:
    """An oddity, and what becomes of it: refused, or trained."""

    name: str
    scene: Odd
    refused: bool | None = None
    """None: check and run need only agree."""
    says: str = ""
    """What the refusal, or else a warning of check, names."""
    options: tuple[str, ...] = ()


def cases() -> list[Case]:
    """All of them."""
    sound = Odd()
    return [
        Case("sound", sound, False),
        Case("object labels", replace(sound, labels="objects"), False),
        Case("no labels", replace(sound, labels="none"), False),
        Case("no language", replace(sound, masks="none", words=None, labels="none"), False),
        Case("one view", _views(1), True, "training views"),
        Case("one view, trained and tested", _views(1), False, "", ("data.split=all",)),
        Case("two views", _views(2), False),
        Case("three views", _views(3), False),
        Case("no point", replace(sound, points=_points(0)), False, "random points"),
        Case("one point", replace(sound, points=_points(1)), False, "got 1"),
        Case("two points", replace(sound, points=_points(2)), False, "got 2"),
        Case("three points", replace(sound, points=_points(3)), False, "got 3"),
        Case("points all equal", replace(sound, points=np.tile(_points(1), (50, 1))), False, "got 1 of 50"),
        Case("points at 1e30", replace(sound, points=_points(50) * 1e30), False, "left out"),
        Case("points at 1e13", replace(sound, points=_points(50) * 1e13), False, "left out"),
        Case("points at 1e9", replace(sound, points=_points(50) * 1e9), None, "world units"),
        Case("points at 1e-9", replace(sound, points=_points(50) * 1e-9), None),
        Case("one point at 1e30", replace(sound, points=_far(1e30)), False, "left out"),
        Case("one point at 1e300", replace(sound, points=_far(1e300)), True, "finite"),
        Case("one point is nan", replace(sound, points=_far(np.nan)), True, "finite"),
        Case("points on a line", replace(sound, points=_points(50) * [1, 0, 0]), False),
        Case("points behind the cameras", replace(sound, turned=True), None),
        Case("points on a camera", replace(sound, points=np.tile([[0.0, 0, -3]], (9, 1))), None),
        Case("every camera in one place", replace(sound, same_pose=True), None),
        Case("cameras at 1e30", replace(sound, translation=1e30), None),
        Case("cameras at 1e9", replace(sound, translation=1e9), None),
        Case("world of 1e-6", replace(sound, translation=3e-6, points=_points(50) * 1e-6), None, "world units"),
        Case("1 x 1", replace(sound, size=(1, 1)), None, "at least 16"),
        Case("2 x 2", replace(sound, size=(2, 2)), None, "at least 16"),
        Case("5 x 400", replace(sound, size=(5, 400)), None, "at least 16"),
        Case("10 x 10", replace(sound, size=(10, 10)), None, "at least 16"),
        Case("11 x 11", replace(sound, size=(11, 11)), None, "at least 16"),
        Case("16000 x 2", replace(sound, size=(16000, 2)), None, "at least 16"),
        Case("focal 1e-9", replace(sound, focal=(1e-9, 1e-9)), None, "focal"),
        Case("focal 1e-30", replace(sound, focal=(1e-30, 1e-30)), None, "focal"),
        Case("focal 1e9", replace(sound, focal=(1e9, 1e9)), None, "focal"),
        Case("focal 1e38", replace(sound, focal=(1e38, 1e38)), None, "focal"),
        Case("focal 0", replace(sound, focal=(0.0, 0.0)), True, "focal"),
        Case("focal -30", replace(sound, focal=(-30.0, -30.0)), True, "focal"),
        Case("focal nan", replace(sound, focal=(np.nan, np.nan)), True, "finite"),
        Case("focal of one axis", replace(sound, focal=(30.0, 1e-6)), None, "focal"),
        Case("principal point at 1e30", replace(sound, center=(1e30, 1e30)), None, "principal"),
        Case("principal point at -1e6", replace(sound, center=(-1e6, 9.0)), None, "principal"),
        Case("principal point beside", replace(sound, center=(60.0, 9.0)), None, "principal"),
        Case("one photograph is larger", _spoilt(lambda r: _resave(r, 2, (64, 48))), True, "frame_2"),
        Case("one photograph is smaller", _spoilt(lambda r: _resave(r, 1, (16, 12))), True, "frame_1"),
        Case("one photograph is upright", _spoilt(lambda r: _resave(r, 2, (24, 32))), True, "frame_2"),
        Case("one photograph is grey", _spoilt(lambda r: _convert(r, 2, "L")), False),
        Case("one photograph is missing", _spoilt(lambda r: _photo(r, 2).unlink()), True, "frame_2"),
        Case("one photograph is cut", _spoilt(lambda r: _cut(_photo(r, 2))), True, "frame_2"),
        Case("one photograph is empty", _spoilt(lambda r: _photo(r, 2).write_bytes(b"")), True, "frame_2"),
        Case("all photographs are half as large", _spoilt(_halve), None),
        Case("one class", replace(sound, classes=("cup",)), False),
        Case("no class", replace(sound, classes=()), None),
        Case("a class of 300 letters", _renamed("x" * 300), False),
        Case("a class with a slash", _renamed("a/b"), False),
        Case("a class in Chinese", _renamed("杯子"), False),
        Case("a class without letters", _renamed("..."), None),
        Case("vocabulary lacks a category", replace(sound, words=("cup", *NEGATIVES)), True, "table"),
        Case("vocabulary lacks all", replace(sound, words=("dog", *NEGATIVES)), True, "cup"),
        Case("vocabulary without negatives", replace(sound, words=("cup", "table")), True, "negatives"),
        Case("the same, asked without", replace(sound, words=("cup", "table")), False, "", ("query=vocab_softmax",)),
        Case("one word, dense labels", replace(sound, words=("cup",)), True, "table"),
        Case("one word and class", replace(sound, words=("cup",), classes=("cup",)), True, "negatives"),
        Case("one word, no labels", replace(sound, words=("cup",), labels="none"), None),
        Case("no vocabulary", replace(sound, words=None), False),
        Case("vocabulary of another width", _spoilt(lambda r: _vocabulary(r, 5)), True, "wide"),
        Case("vocabulary of zeros", _spoilt(lambda r: _vocabulary(r, 8, 0.0)), True, "zero"),
        Case("masks all empty", replace(sound, masks="empty"), True, "masks"),
        Case("one view has masks", replace(sound, masks="some"), True, "frame_"),
        Case("the same, allowed", replace(sound, masks="some"), False, "", ("data.allow_missing_masks=true",)),
        Case("one mask vector", replace(sound, masks="one"), None),
        Case("all labels ignored", replace(sound, labels="ignored"), None),
        Case("level without masks", sound, True, "level", ("data.level=1",)),
        Case("joint levels without masks", sound, None, "", ("levels=joint",)),
        Case("duplicate stems", replace(sound, names=("a.png", "a.jpg", "b.png", "c.png")), True, "unique"),
        Case("unicode names", replace(sound, names=tuple(f"ü €{i}.png" for i in range(6))), False),
        Case("names in folders", replace(sound, names=tuple(f"left/{i}.png" for i in range(6))), False),
        Case("a name that leaves", replace(sound, names=("../a.png", "b.png", "c.png")), True, "below"),
        Case("resized to nothing", sound, None, "", ("data.resize=0.001",)),
        Case("other data's autoencoder dim", sound, False, "", ("head.dim=7",)),
        Case("identity head of another width", sound, True, "embedding width", ("head=identity", "fusion=none")),
        Case("no folder", _spoilt(_remove), True, "got no"),
        Case("sharing none", sound, False, "", ("sharing=none", "fusion=none")),
        Case("lifted", sound, False, "", ("sharing=lifted", "fusion=none", "indicator=opacity")),
        Case("photographs augmented without an extractor", sound, True, "extractor", ("augment=offline",)),
        Case("a class that a terminal obeys", _renamed("\x1b[31mcup\x07"), None, "", PICTURES),
        Case("a class of two lines", _renamed("cup\n# table: 1"), None, "", PICTURES),
        Case("a class that a table computes", _renamed("=cmd|' /C calc'!A0"), False, "", PICTURES),
        Case("a class of markup", _renamed("[red]<script>\\write18{x}[/red]"), False, "", PICTURES),
        Case("a class that leaves", _renamed("../../../cup"), False, "", PICTURES),
        Case("a class of a blank", _renamed(" "), None, "", PICTURES),
        Case("a class written from right to left", _renamed("\u202egnp.puc"), None, "", PICTURES),
        Case("photographs of markup", _named("<b>{i}[red] %s"), False, "", PICTURES),
        Case("photographs of a formula", _named("=1+{i}"), False, "", PICTURES),
        Case("photographs that a terminal obeys", _named("\x1b[31m{i}"), None, "", PICTURES),
        Case("photographs of long names", _named("n" * 240 + "{i}"), None, "", PICTURES),
        Case("photographs of names in two cases", replace(sound, names=("a.png", "A.png", "b.png", "B.png")), None, "", PICTURES),
        Case("a quaternion of zeros", _spoilt(lambda r: _pose(r, "0 0 0 0 0 0 3")), True, "images.txt"),
        Case("a quaternion of 1e20", _spoilt(lambda r: _pose(r, "1e20 0 0 0 0 0 3")), None),
        Case("a quaternion of 1e-30", _spoilt(lambda r: _pose(r, "1e-30 0 0 0 0 0 3")), None),
        Case("a quaternion of 1e200", _spoilt(lambda r: _pose(r, "1e200 0 0 0 0 0 3")), None),
        Case("a distortion of 1e9", _spoilt(lambda r: _camera(r, "OPENCV 32 24 30 30 16 12 1e9 0 0 0")), None),
        Case("a distortion that folds", _spoilt(lambda r: _camera(r, "SIMPLE_RADIAL 32 24 30 16 12 -9")), None),
        Case("a fisheye of 1e3", _spoilt(lambda r: _camera(r, "OPENCV_FISHEYE 32 24 30 30 16 12 1e3 -1e3 1e3 0")), None),
        Case("a thin prism of 1e4", _spoilt(lambda r: _camera(r, "THIN_PRISM_FISHEYE 32 24 30 30 16 12 1 1 1 1 1 1 1e4 1e4")), None),
        Case("a camera of a billion pixels", _spoilt(lambda r: _camera(r, "PINHOLE 40000 30000 30 30 16 12")), None),
        Case("a camera turned by EXIF", _spoilt(_turn), None),
        Case("photographs of 16 bits", _spoilt(lambda r: _deep(r)), None),
        Case("photographs all black", _spoilt(lambda r: _paint(r, 0)), None),
        Case("photographs all white", _spoilt(lambda r: _paint(r, 255)), None),
        Case("one photograph is transparent", _spoilt(lambda r: _convert(r, 2, "RGBA")), False),
        Case("one photograph has a palette", _spoilt(lambda r: _convert(r, 2, "P")), False),
        Case("resized a hundredfold", sound, None, "", ("data.resize=100",)),
        Case("resized ten thousandfold", sound, True, "resize", ("data.resize=10000",)),
        Case("every view is held out", sound, None, "", ("data.split=llff", "data.every=1")),
        Case("every is 0", sound, True, "every", ("data.split=llff", "data.every=0")),
        Case("one view is held out twice", sound, None, "", ("data.split=list", "data.test=[frame_1,frame_1]")),
        Case("all views are held out", sound, True, "", ("data.split=list", "data.test=[frame_0,frame_1,frame_2,frame_3,frame_4,frame_5]")),
        Case("nobody is held out", sound, None, "", ("data.split=list", "data.test=[]")),
    ]  # fmt: skip


def attacks(folder: Path, seed: int, count: int) -> Iterator[Attack]:
    """A fixed list, whatever the count."""
    check_command(())  # what Hydra learns on first use, every child then has
    for number, case in enumerate(cases()):
        yield Attack(
            case.name,
            _call(folder / str(number), case),
            case.says if case.refused else "",
            bool(case.refused),
        )


def _call(folder: Path, case: Case) -> Callable[[], None]:
    def call() -> None:
        root = folder / "scène"
        write(root, case.scene)
        own = "head=identity" in case.options  # which has no cache and no training
        given = [o for o in OPTIONS if not (own and o.startswith("head."))]
        checked, ran = both([*given, *case.options, f"data.root='{root}'"], folder / "results")
        refused = ran.status not in (0, 3)
        assert not (refused and case.refused is False), f"refused: {ran.error}"
        if not refused:
            assert case.says in checked.text, f"check does not say {case.says}: {checked.text}"
        else:
            raise ValueError(ran.error)

    return call


def write(root: Path, scene: Odd) -> None:
    """All files of a scene."""
    width, height = scene.size
    center = scene.center or (width / 2, height / 2)
    model, rng = root / "sparse" / "0", np.random.default_rng(0)
    for folder in (model, root / "images", root / "language_features", root / "labels"):
        folder.mkdir(parents=True)
    numbers = " ".join(map(repr, (*map(float, scene.focal), *map(float, center))))
    (model / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {numbers}\n")
    seen = " ".join(f"1.0 1.0 {i + 1}" for i in range(min(5, len(scene.points))))
    lines = []
    for i, name in enumerate(scene.names):
        angle = np.pi * scene.turned + (0 if scene.same_pose else 0.05 * i)
        shift = 0.0 if scene.same_pose else 0.02 * i * scene.translation
        quat = f"{np.cos(angle / 2)} 0 {np.sin(angle / 2)} 0"
        lines += [f"{i + 1} {quat} {shift} 0 {scene.translation} 1 {name}", seen]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    track = " ".join(f"{i + 1} 0" for i in range(len(scene.names)))
    rows = (
        f"{i + 1} {x!r} {y!r} {z!r} 200 90 40 0.5 {track}"
        for i, (x, y, z) in enumerate(scene.points.tolist())
    )
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    for i, name in enumerate(scene.names):
        path = root / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 256, (height, width, 3), np.uint8)).save(path)
        if scene.masks != "none" and (scene.masks != "some" or i == 1):
            _write_masks(root / "language_features", path.stem, scene, i)
    _write_words(root, scene)
    scene.spoil(root)


def _write_masks(folder: Path, stem: str, scene: Odd, number: int) -> None:
    ids = np.full((4, scene.size[1], scene.size[0]), -1, np.float32)
    if scene.masks != "empty":
        ids[3] = 0
        if scene.masks != "one":
            ids[3, : max(1, scene.size[1] // 2)] = 1
    rows = np.random.default_rng(0 if scene.masks == "one" else number).normal(size=(2, 8))
    np.save(folder / f"{stem}_s.npy", ids)
    np.save(
        folder / f"{stem}_f.npy",
        (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32),
    )


def _write_words(root: Path, scene: Odd) -> None:
    if scene.words is not None and scene.masks != "none":
        vectors = np.random.default_rng(5).normal(size=(len(scene.words), 8))
        np.savez(
            root / "language_features" / "vocabulary.npz",
            names=np.array(scene.words),
            embeddings=vectors,
        )
    if scene.masks == "none":
        (root / "language_features").rmdir()
    if scene.labels == "none":
        (root / "labels").rmdir()
        return
    classes = {str(i): {"name": name} for i, name in enumerate(scene.classes)}
    if scene.labels != "objects":
        content = {"classes": classes or {"0": {"name": "x", "ignore": True}}}
        (root / "labels" / "classes.json").write_text(json.dumps(content))
    for name in scene.names[::3]:
        stem, (width, height) = Path(name).stem, scene.size
        ids = np.full(
            (height, width), 255 if scene.labels == "ignored" or not classes else 0, np.uint8
        )
        if scene.labels == "dense" and len(classes) > 1:
            ids[: height // 2] = 1
        if scene.labels == "objects":
            corners = [[0, 0], [width / 2, 0], [width / 2, height / 2], [0, height / 2]]
            box = [0, 0, width / 2, height / 2]
            shapes = [{"category": c, "segmentation": corners, "bbox": box} for c in scene.classes]
            info = {"name": f"{stem}.png", "width": width, "height": height}
            (root / "labels" / f"{stem}.json").write_text(
                json.dumps({"info": info, "objects": shapes})
            )
        else:
            Image.fromarray(ids).save(root / "labels" / f"{stem}.png")


def _points(count: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(-1, 1, (count, 3))


def _far(value: float) -> np.ndarray:
    points = _points(50)
    points[7, 1] = value
    return points


def _views(count: int) -> Odd:
    return replace(Odd(), names=tuple(f"frame_{i}.png" for i in range(count)))


def _spoilt(spoil: Callable[[Path], object]) -> Odd:
    return replace(Odd(), spoil=spoil)


def _named(pattern: str) -> Odd:
    return replace(Odd(), names=tuple(f"{pattern.format(i=i)}.png" for i in range(6)))


def _pose(root: Path, numbers: str) -> None:
    path = root / "sparse" / "0" / "images.txt"
    lines = path.read_text().split("\n")
    lines[0] = f"1 {numbers} 1 {lines[0].split()[-1]}"
    path.write_text("\n".join(lines))


def _camera(root: Path, numbers: str) -> None:
    (root / "sparse" / "0" / "cameras.txt").write_text(f"1 {numbers}\n")


def _turn(root: Path) -> None:
    image = Image.open(_photo(root, 2))
    exif = image.getexif()
    exif[0x0112] = 6
    image.save(_photo(root, 2), exif=exif)


def _deep(root: Path) -> None:
    for number in range(6):
        pixels = np.random.default_rng(number).integers(0, 65536, (24, 32), np.uint16)
        Image.fromarray(pixels).save(_photo(root, number))


def _paint(root: Path, value: int) -> None:
    for number in range(6):
        Image.new("RGB", (32, 24), (value,) * 3).save(_photo(root, number))


def _renamed(name: str) -> Odd:
    return replace(Odd(), classes=(name, "table"), words=(name, "table", *NEGATIVES))


def _photo(root: Path, number: int) -> Path:
    return root / "images" / f"frame_{number}.png"


def _resave(root: Path, number: int, size: tuple[int, int]) -> None:
    Image.open(_photo(root, number)).resize(size).save(_photo(root, number))


def _convert(root: Path, number: int, mode: str) -> None:
    Image.open(_photo(root, number)).convert(mode).save(_photo(root, number))


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-300])


def _halve(root: Path) -> None:
    for number in range(6):
        _resave(root, number, (16, 12))


def _vocabulary(root: Path, width: int, scale: float = 1.0) -> None:
    words = ("cup", "table", *NEGATIVES)
    np.savez(
        root / "language_features" / "vocabulary.npz",
        names=np.array(words),
        embeddings=scale * np.ones((len(words), width)),
    )


def _remove(root: Path) -> None:
    root.rename(root.with_name("elsewhere"))
