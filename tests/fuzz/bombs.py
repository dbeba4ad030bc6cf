"""Small files that declare or unfold to huge ones, and small ones that would take long: a fixed list over all formats."""

import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from tests.fuzz import _bombs as make
from tests.fuzz._corpus import in_a_child, read_feature_map, read_scene, write_corpus
from tests.fuzz.judge import Attack
from vlgs.convert import convert
from vlgs.data.language import read_vocabulary
from vlgs.data.lens import import_pycolmap
from vlgs.vocabulary import read_words

Read = Callable[[Path, Path], object]
"""Given the file and the folder of all that is read with it."""

Bomb = tuple[str, str, str, Read, make.Write, bool]
"""Name, unit of the corpus, file in it, what reads it, what writes it, whether it must be refused."""


def _scene(file: Path, folder: Path) -> None:
    labels = folder / "segmentations"
    read_scene(folder, labels=str(labels) if labels.is_dir() else None)


def _to_ply(file: Path, folder: Path) -> None:
    convert(file, folder / "out" / "x.ply", drop=True)


def _autoencoder(file: Path, folder: Path) -> None:
    convert(file, folder / "out" / "x.safetensors")


def _weights(file: Path, folder: Path) -> None:
    convert(file, folder / "out" / "x.pth")


def _vocabulary(file: Path, folder: Path) -> None:
    read_vocabulary(file)


def _words(file: Path, folder: Path) -> None:
    read_words(file)


def _map(file: Path, folder: Path) -> None:
    read_feature_map(folder)


_HUGE = "element vertex 999999999999"
_X = "property float x"
_CROSSED = np.random.default_rng(0).uniform(0, 18, (480, 2)).round(1).tolist()
_STAR = {"category": "plate", "segmentation": _CROSSED, "bbox": [0, 0, 18, 18]}

PLY: tuple[tuple[str, make.Write], ...] = (
    ("text, a billion vertices", make.ply("element vertex 1000000000", _X)),
    ("binary, many vertices", make.ply(_HUGE, _X, kind="binary_little_endian")),
    ("vertices without properties", make.ply(_HUGE)),
    ("long comment", make.ply("comment " + "a" * 30_000_000, "element vertex 1", _X)),
    ("many comments", make.ply(*["comment a"] * 1_000_000, "element vertex 1", _X)),
    (
        "many properties",
        make.ply("element vertex 1", *(f"property float p{i}" for i in range(99_999))),
    ),
    (
        "many elements",
        make.ply(*(f"element e{i} 99999999" for i in range(9_000)), "element vertex 1", _X),
    ),
    ("elements before", make.ply("element face 999999999999999", _X, "element vertex 1", _X)),
    (
        "lists before",
        make.ply("element face 999", "property list uint int i", "element vertex 1", _X),
    ),
    ("a line without end", make.raw(b"ply\n" + b"a" * 30_000_000)),
    ("lists in vertices", make.ply(_HUGE, _X, "property list uint int y")),
    ("a text as number", make.ply("element vertex 1", _X, tail=b"1" * 5_000_000)),
    (
        "short and long numbers",
        make.ply("element vertex 1000001", _X, tail=b"1\n" * 1_000_000 + b"1" * 1_000_000),
    ),
)

ARRAYS: tuple[tuple[str, make.Write], ...] = (
    ("large shape", make.npy_of("(4, 1000000, 1000000)")),
    ("product beyond 64 bit", make.npy_of("(4, 4611686018427387904, 4)")),
    ("many empty rows", make.npy_of("(1000000000000, 0)")),
    ("words of nothing", make.npy_of("(1000000000000,)", "<U0")),
    ("values of gigabytes", make.npy_of("(1,)", "|V4000000000")),
    ("objects", make.npy_of("(1,)", "|O")),
    ("nested header", make.npy("(" * 9_000)),
    ("header of 4 GB", make.npy("{", version=2, values=b"")),
    ("header of 5 MB", make.npy("{" + " " * 5_000_000 + "}", version=2)),
    ("negative side", make.npy_of("(-1, 4)")),
    ("many sides", make.npy_of(str((1,) * 60))),
    ("a pipe", make.pipe),
)

IMAGES: tuple[tuple[str, make.Write], ...] = (
    ("PNG of 127 megapixels", make.flat("RGB", (13000, 9750), "PNG", compress_level=1)),
    ("PNG with transparency", make.flat("RGBA", (9000, 6750), "PNG", compress_level=1)),
    ("PNG that declares 60000", make.png(60000, 45000)),
    ("PNG that declares 4 billion", make.png(2**31 - 1, 2**31 - 1)),
    ("PNG with a text", make.png(24, 18, make.unfolding_chunk(b"zTXt", b"a\0\0"))),
    ("PNG with a profile", make.png(24, 18, make.unfolding_chunk(b"iCCP", b"a\0\0"))),
    ("JPEG that declares 127 megapixels", make.declaring_jpeg),
    ("JPEG of many scans", make.jpeg_of_many_scans),
    ("TIFF of 120 megapixels", make.flat("RGB", (12000, 9000), "TIFF", compression="tiff_deflate")),
    ("WebP of 190 megapixels", make.flat("RGB", (16000, 12000), "WEBP", lossless=True, quality=0, method=0)),
    ("BMP that declares much", make.raw(b"BM" + bytes(8) + b"\x36\0\0\0\x28\0\0\0" + b"\0\0\2\0\0\x80\1\0\1\0\x18\0" + bytes(24))),
    ("PostScript", make.raw(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 24 18\n%%EndComments\nquit\n")),
    ("a pipe", make.pipe),
)  # fmt: skip

BOMBS: tuple[Bomb, ...] = (
    *((f"PLY: {name}", "ply", "a.ply", _to_ply, write, True) for name, write in PLY),
    *(
        (f"PLY of points: {name}", "nerfstudio", "sparse_pc.ply", _scene, write, True)
        for name, write in PLY[:4]
    ),
    *(
        (f"ids: {name}", "colmap", "language_features/b_s.npy", _scene, write, True)
        for name, write in ARRAYS[:-1]
    ),
    *(
        (f"vectors: {name}", "colmap", "language_features/b_f.npy", _scene, write, True)
        for name, write in ARRAYS[:-1]
    ),
    *((f"feature map: {name}", "maps", "a.npy", _map, write, True) for name, write in ARRAYS[:-1]),
    *(
        (f"poses: {name}", "llff", "poses_bounds.npy", _scene, write, True)
        for name, write in ARRAYS[:-1]
    ),
    *((f"photograph: {name}", "colmap", "images/b.png", _scene, w, True) for name, w in IMAGES[:-1]),
    *(
        (f"mask: {name}", "llff", "segmentations/a/plate.png", _scene, write, True)
        for name, write in IMAGES[:-1]
    ),
    *(
        (f"mask of a prompt: {name}", "nerfstudio", "labels/plate/masks/a.png", _scene, write, True)
        for name, write in IMAGES[:3]
    ),
    *((f"class ids: {name}", "colmap", "labels/a.png", _scene, w, True) for name, w in IMAGES[:3]),
    ("photograph of 16 megapixels", "colmap", "images/b.png", _scene, make.flat("RGB", (4728, 3546), "PNG"), False),
    ("the same behind a lens", "colmap_text", "images/b.jpg", _scene, make.flat("RGB", (4728, 3546), "JPEG"), False),
    ("mask of 48 megapixels", "llff", "segmentations/a/plate.png", _scene, make.flat("L", (8000, 6000), "PNG"), False),
    ("npz: 400 MB of zeros", "words", "v.npz", _vocabulary, make.unfolding_npz, True),
    ("npz: the same as bzip2", "words", "v.npz", _vocabulary, lambda p: make.unfolding_npz(p, zipfile.ZIP_BZIP2), True),
    ("npz: declares 3 GB", "words", "v.npz", _vocabulary, make.declaring_npz, True),
    ("npz: names of 30 million letters", "words", "v.npz", _vocabulary, make.wide_name_npz, True),
    ("npz: a billion empty names", "words", "v.npz", _vocabulary, make.many_names_npz, True),
    ("npz: many members", "words", "v.npz", _vocabulary, make.many_members_npz, True),
    ("JSON words: nested", "words", "v.json", _vocabulary, make.raw("[" * 3_000_000), True),
    ("JSON words: empty vectors", "words", "v.json", _vocabulary, make.as_json(lambda: {str(i): [] for i in range(200_000)}), True),
    ("JSON words: long number", "words", "v.json", _vocabulary, make.raw('{"a": [' + "1" * 3_000_000 + "]}"), True),
    ("JSON words: vectors of vectors", "words", "v.json", _vocabulary, make.as_json(lambda: {str(i): [[[[0]]]] * i for i in range(900)}), True),
    ("words: many", "words", "words.txt", _words, make.raw("\n".join(map(str, range(300_000)))), False),
    ("words: many twice", "words", "words.txt", _words, make.raw("\n".join(map(str, range(200_000))) * 2), True),
    ("words: one of megabytes", "words", "words.txt", _words, make.raw("a" * 5_000_000), False),
    ("cameras: count", "colmap", "sparse/0/cameras.bin", _scene, make.raw(b"\xff" * 100), True),
    ("cameras: many", "colmap", "sparse/0/cameras.bin", _scene, make.many_cameras, False),
    ("images: count", "colmap", "sparse/0/images.bin", _scene, make.raw(b"\xff" * 100), True),
    ("images: unknown cameras", "colmap", "sparse/0/images.bin", _scene, make.images_of_unknown_cameras, True),
    ("images: a name without end", "colmap", "sparse/0/images.bin", _scene, make.raw(b"\1" + bytes(71) + b"a" * 3_000_000), True),
    ("points: count", "colmap", "sparse/0/points3D.bin", _scene, make.raw(b"\xff" * 100), True),
    ("points: tracks", "colmap", "sparse/0/points3D.bin", _scene, make.raw(b"\1" + bytes(50) + b"\xff" * 80), True),
    ("text cameras: one line", "colmap_text", "sparse/cameras.txt", _scene, make.raw("1 " * 1_500_000), True),
    ("text images: long number", "colmap_text", "sparse/images.txt", _scene, make.raw("1" * 3_000_000 + "\n\n"), True),
    ("text points: many", "colmap_text", "sparse/points3D.txt", _scene, make.raw("".join(f"{i} 0 0 1 1 2 3 1\n" for i in range(150_000))), False),
    ("transforms: deep paths", "nerfstudio", "transforms.json", _scene, make.frames(700, "a/" * 2_000), True),
    ("transforms: keys for all frames", "nerfstudio", "transforms.json", _scene, make.frames(10_000, shared={f"k{i}": 0 for i in range(50_000)}), True),
    ("transforms: nested", "nerfstudio", "transforms.json", _scene, make.raw('{"frames":' + "[" * 3_000_000), True),
    ("transforms: a device for a photograph", "nerfstudio", "transforms.json", _scene, make.as_json(lambda: {"fl_x": 1.0, "frames": [{"file_path": "/dev/zero", "transform_matrix": np.eye(4).tolist()}]}), True),
    ("labels: a pipe", "colmap_text", "labels/b.json", _scene, make.pipe, True),
    ("labels: 100 000 corners", "colmap_text", "labels/a.json", _scene, make.labels(lambda: [make.circle(100_000)]), False),
    ("labels: 8 000 of one class", "colmap_text", "labels/a.json", _scene, make.labels(lambda: make.squares(8_000, 1)), False),
    ("labels: 20 000 objects", "colmap_text", "labels/a.json", _scene, make.labels(lambda: make.squares(20_000, 20_000)), False),
    ("labels: crossings", "colmap_text", "labels/a.json", _scene, make.labels(lambda: [_STAR] * 500), False),
    ("labels: of 4 billion pixels", "colmap_text", "labels/a.json", _scene, make.labels(lambda: make.squares(9, 9), 65536, 49152), True),
    ("labels: 3 000 classes at 4 megapixels", "colmap_text", "labels/a.json", _scene, make.labels(lambda: make.squares(3_000, 3_000), 2304, 1728), True),
    ("labels: nested", "colmap_text", "labels/a.json", _scene, make.raw("[" * 3_000_000), True),
    ("classes: 100 000", "colmap", "labels/classes.json", _scene, make.as_json(lambda: {"classes": {str(i): {"name": str(i)} for i in range(100_000)}}), True),
    ("class lines: 500 000", "llff", "segmentations/classes.txt", _scene, make.raw("plate\n" + "\n".join(map(str, range(500_000)))), False),
    ("pth: an array of one number", "3dgs", "c.pth", _to_ply, make.pth_of_call(bytearray, 5_000_000_000), True),
    ("pth: place in the memo", "3dgs", "c.pth", _to_ply, make.pth_of_memo, True),
    ("pth: long pickle", "3dgs", "c.pth", _to_ply, make.pth_of_texts, True),
    ("pth: NumPy type", "3dgs", "c.pth", _to_ply, make.pth_of_call(np.dtype, "V2000000000"), True),
    ("pth: folded", "autoencoder", "best_ckpt.pth", _autoencoder, make.folded, True),
    ("pth: stretched tensor", "autoencoder", "best_ckpt.pth", _autoencoder, make.saved(make.stretched), True),
    ("pth: empty matrices", "autoencoder", "best_ckpt.pth", _autoencoder, make.saved(make.empty_matrices), True),
    ("pth: older format", "autoencoder", "best_ckpt.pth", _autoencoder, make.legacy, True),
    ("safetensors: empty matrices", "weights", "w.safetensors", _weights, make.safetensors, True),
    ("safetensors: long header", "weights", "w.safetensors", _weights, make.raw((90_000_000).to_bytes(8, "little") + b"{" + b" " * 9_000_000), True),
    ("safetensors: header of 2**63", "weights", "w.safetensors", _weights, make.raw(b"\xff" * 64), True),
)  # fmt: skip


def attacks(folder: Path, seed: int, count: int) -> Iterator[Attack]:
    """The list; `seed` and `count` have no say."""
    import_pycolmap()  # once, and not in every child
    Image.init()
    write_corpus(folder / "corpus")
    for bomb in BOMBS:
        yield attack(folder, bomb)


def attack(folder: Path, bomb: Bomb) -> Attack:
    """One bomb, laid among honest files."""
    name, unit, file, read, write, must_refuse = bomb
    there = folder / "attack" / unit
    path = there / file

    def lay() -> None:
        shutil.rmtree(folder / "attack", ignore_errors=True)
        shutil.copytree(folder / "corpus" / unit, there)
        (there / "out").mkdir()
        path.unlink(missing_ok=True)
        in_a_child(lambda: write(path))

    return Attack(name, lambda: read(path, there), path.name, must_refuse, prepare=lay)
