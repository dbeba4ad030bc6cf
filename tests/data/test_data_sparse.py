"""COLMAP's files: what pycolmap writes is read exactly, and nothing that is damaged is read at all."""

import dataclasses
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from colmap_scenes import PINHOLE, pycolmap, write_model
from hypothesis import given, settings
from hypothesis import strategies as st

from vlgs.data.diagnostics import SceneError, errors
from vlgs.data.sparse import binary, find_sparse, model_faults, read_sparse, text
from vlgs.data.sparse.model import CAMERA_MODELS, PARAMETERS

READERS = {
    "cameras": binary.read_cameras,
    "images": binary.read_images,
    "points3D": binary.read_points,
}
NAMES = ["b.png", "a.png"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sparse")
    write_model(folder, NAMES, points=3)
    return folder


def test_reads_what_pycolmap_wrote(folder: Path):
    model = read_sparse(folder, ".bin")
    truth = write_model(folder, NAMES, points=3)
    (camera,) = model.cameras
    assert (camera.model, camera.width, camera.height, camera.params) == (
        *PINHOLE[:1],
        24,
        18,
        PINHOLE[1],
    )
    for image in model.images:
        expected = truth.images[image.image_id]
        pose = expected.cam_from_world()
        assert image.name == expected.name
        assert image.observations == 3
        np.testing.assert_array_equal(np.roll(pose.rotation.quat, 1), image.quat)
        np.testing.assert_array_equal(pose.translation, image.translation)
    for i, point_id in enumerate(model.point_ids):
        np.testing.assert_array_equal(truth.points3D[int(point_id)].xyz, model.points[i])
        np.testing.assert_array_equal(truth.points3D[int(point_id)].color, model.point_colors[i])
    assert not errors(model_faults(model))


def test_text_and_binary_agree(tmp_path: Path):
    write_model(tmp_path / "b", NAMES)
    write_model(tmp_path / "t", NAMES, text=True)
    a, b = read_sparse(tmp_path / "b", ".bin"), read_sparse(tmp_path / "t", ".txt")
    assert a.cameras == b.cameras
    assert sorted(a.images, key=lambda i: i.image_id) == sorted(b.images, key=lambda i: i.image_id)
    order_a, order_b = np.argsort(a.point_ids), np.argsort(b.point_ids)
    np.testing.assert_array_equal(a.points[order_a], b.points[order_b])
    np.testing.assert_array_equal(a.point_colors[order_a], b.point_colors[order_b])


def test_knows_the_camera_models_of_pycolmap():
    models = {n: m for n, m in pycolmap.CameraModelId.__members__.items() if n != "INVALID"}
    for name, member in models.items():
        assert CAMERA_MODELS[int(member)][0] == name
        if name != "EQUIRECTANGULAR":
            camera = pycolmap.Camera.create_from_model_name(1, name, 10.0, 8, 6)
            assert PARAMETERS[name] == len(camera.params)


@pytest.mark.parametrize("stem", READERS)
def test_truncation_at_every_byte_is_an_error(folder: Path, tmp_path: Path, stem: str):
    whole = (folder / f"{stem}.bin").read_bytes()
    path = tmp_path / f"{stem}.bin"
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        with pytest.raises(SceneError, match=rf"{stem}\.bin, byte \d+: .* must be .*, got"):
            READERS[stem](path)
    path.write_bytes(whole + b"\0")
    with pytest.raises(SceneError, match="bytes after the last record must be 0, got 1"):
        READERS[stem](path)


@pytest.mark.parametrize("stem", READERS)
@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_flipped_bits_never_escape(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, stem: str, data: st.DataObject
):
    content = bytearray((folder / f"{stem}.bin").read_bytes())
    for bit in data.draw(st.lists(st.integers(0, 8 * len(content) - 1), min_size=1, max_size=4)):
        content[bit // 8] ^= 1 << bit % 8
    damaged = tmp_path_factory.mktemp("flip")
    for other in READERS:
        source = bytes(content) if other == stem else (folder / f"{other}.bin").read_bytes()
        (damaged / f"{other}.bin").write_bytes(source)
    try:
        model = read_sparse(damaged, ".bin")
    except SceneError:
        return
    if not errors(model_faults(model)):
        assert np.isfinite(model.points.astype(np.float32)).all()
        assert all(
            np.isfinite(i.quat).all() and np.isfinite(i.translation).all() for i in model.images
        )


@pytest.mark.parametrize(
    ("stem", "at"), [("cameras", 0), ("images", 0), ("points3D", 0), ("points3D", 51)]
)
@pytest.mark.parametrize("count", [2**63, 2**64 - 1, 2**32])
def test_a_huge_count_costs_no_memory(folder: Path, tmp_path: Path, stem: str, at: int, count: int):
    content = bytearray((folder / f"{stem}.bin").read_bytes())
    content[at : at + 8] = struct.pack("<Q", count)
    path = tmp_path / f"{stem}.bin"
    path.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(
            SceneError, match=f"byte {at}: number of .* must be at most .*, got {count}"
        ):
            READERS[stem](path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_unknown_camera_model_is_named(folder: Path, tmp_path: Path):
    content = bytearray((folder / "cameras.bin").read_bytes())
    content[12:16] = struct.pack("<i", 99)
    (tmp_path / "cameras.bin").write_bytes(content)
    with pytest.raises(
        SceneError, match=r"byte 12: camera model id must be one of 0 SIMPLE_PINHOLE.*got 99"
    ):
        binary.read_cameras(tmp_path / "cameras.bin")


def rewritten(folder: Path, tmp_path: Path, name: str = "a.png", **fields: float) -> Path:
    """Text files of a one-image model, with values of the image line replaced by position."""
    write_model(tmp_path, [name], text=True)
    path = tmp_path / "images.txt"
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    words = lines[first].split()
    for position, value in fields.items():
        words[int(position[1:])] = str(value)
    lines[first] = " ".join(words)
    path.write_text("\n".join(lines) + "\n")
    return tmp_path


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"w1": "nan"}, "image 'a.png': pose must be finite"),
        ({"w6": "inf"}, "image 'a.png': pose must be finite"),
        ({"w6": "1e200"}, "image 'a.png': pose must be finite"),
        ({"w1": 0.0, "w2": 0.0, "w3": 0.0, "w4": 0.0}, "rotation must be a unit quaternion"),
        ({"w8": 7}, "image 'a.png': camera id must be one of 1, got 7"),
        ({"w9": "../../etc/passwd"}, "name must be a path below the image folder"),
        ({"w9": "/etc/passwd"}, "name must be a path below the image folder"),
        ({"w9": "..\\secret.png"}, "name must be a path below the image folder"),
        ({"w9": "C:\\secret.png"}, "name must be a path below the image folder"),
    ],
)
def test_faulty_images_are_named(folder: Path, tmp_path: Path, fields: dict, message: str):
    model = read_sparse(rewritten(folder, tmp_path, **fields), ".txt")
    found = errors(model_faults(model))
    assert len(found) == 1
    assert message in str(found[0])


def test_repeated_ids_and_names_are_faults(tmp_path: Path):
    write_model(tmp_path, ["a.png", "b.png"], text=True)
    for stem in ("cameras", "images", "points3D"):
        path = tmp_path / f"{stem}.txt"
        path.write_text(path.read_text() + path.read_text())
    found = [str(fault) for fault in errors(model_faults(read_sparse(tmp_path, ".txt")))]
    for what in ("camera ids", "image ids", "image names", "point ids"):
        assert sum(f"{what} must be unique" in fault for fault in found) == 1


@pytest.mark.parametrize(
    ("stem", "line", "message"),
    [
        ("cameras", "1 PINHOLE 24 18 20 20 12", "must have 4 parameters for PINHOLE, got 3"),
        ("cameras", "1 WIDE 24 18 20", "camera model must be one of SIMPLE_PINHOLE"),
        ("cameras", "1 PINHOLE x 18 20 20 12 9", "invalid literal"),
        ("cameras", "-1 PINHOLE 24 18 20 20 12 9", "must be 0 to"),
        ("images", "1 1 0 0 0 0 0 0", "image must be 10 words, got 8"),
        ("points3D", "1 0 0 0 300 0 0 1", "must be 0 to 255, got 300"),
        ("points3D", "1 0 0 0 30 0 0 1 5", "8 words and pairs of a track, got 9"),
    ],
)
def test_text_errors_name_the_line(tmp_path: Path, stem: str, line: str, message: str):
    read = {"cameras": text.read_cameras, "images": text.read_images, "points3D": text.read_points}
    path = tmp_path / f"{stem}.txt"
    path.write_text(f"# comment\n{line}\n\n")
    with pytest.raises(SceneError, match=rf"{stem}\.txt, line 2: .*{message}"):
        read[stem](path)


def test_an_image_without_points_keeps_its_empty_line(tmp_path: Path):
    path = tmp_path / "images.txt"
    path.write_text("1 1 0 0 0 0 0 0 1 a b.png\n\n2 1 0 0 0 0 0 0 1 c.png\n1 2 -1 3 4 8\n")
    images = text.read_images(path)
    assert [(i.name, i.observations) for i in images] == [("a b.png", 0), ("c.png", 1)]


def test_binary_comes_before_text_and_zero_before_the_folder_above(tmp_path: Path):
    assert find_sparse(tmp_path) is None
    write_model(tmp_path / "sparse", NAMES, text=True)
    assert find_sparse(tmp_path) == (tmp_path / "sparse", ".txt")
    write_model(tmp_path / "sparse" / "0", NAMES, text=True)
    assert find_sparse(tmp_path) == (tmp_path / "sparse" / "0", ".txt")
    write_model(tmp_path / "sparse" / "0", NAMES)
    assert find_sparse(tmp_path) == (tmp_path / "sparse" / "0", ".bin")


def test_a_view_without_points_and_a_thin_model_are_warnings(tmp_path: Path):
    write_model(tmp_path, NAMES)
    model = read_sparse(tmp_path, ".bin")
    blind = dataclasses.replace(model.images[0], observations=0)
    model = dataclasses.replace(model, images=(blind, *model.images[1:]))
    found = list(model_faults(model))
    assert {fault.severity for fault in found} == {"warning"}
    assert any(f"{blind.name!r}: sparse points seen must be at least 1" in str(f) for f in found)
    assert any("sparse points should be in the thousands, got 6" in str(f) for f in found)
