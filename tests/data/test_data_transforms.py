"""transforms.json and poses_bounds.npy are the scenes that they were made from."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from colmap_scenes import HEIGHT, WIDTH, picture, surveyed, write_model, write_scene
from PIL import Image
from plyfile import PlyData, PlyElement
from tiny_runs import composed

from vlgs.check import check
from vlgs.config import instantiate
from vlgs.convert import convert
from vlgs.data.colmap import load_scene
from vlgs.data.diagnostics import SceneError, errors
from vlgs.data.sparse import read_cameras
from vlgs.types import Scene

CAMERAS: dict[str, tuple[float, ...]] = {
    "PINHOLE": (20.0, 21.0, 12.5, 8.5),
    "SIMPLE_PINHOLE": (20.0, 12.5, 8.5),
    "SIMPLE_RADIAL": (20.0, 12.5, 8.5, 0.01),
    "OPENCV": (20.0, 21.0, 12.5, 8.5, 0.01, -0.02, 0.001, 0.002),
    "OPENCV_FISHEYE": (20.0, 21.0, 12.5, 8.5, 0.01, -0.02, 0.001, 0.002),
    "FULL_OPENCV": (20.0, 21.0, 12.5, 8.5, 0.01, -0.02, 0.001, 0.002, 0.003, 0, 0, 0),
}


def moved(root: Path, target: Path, model: str) -> tuple[Scene, Scene]:
    """A COLMAP scene, and the same photographs with transforms.json."""
    write_scene(root, camera=(model, CAMERAS[model]), points=120)
    target.mkdir()
    (root / "images").rename(target / "images")
    (root / "images").symlink_to(target / "images")
    convert(root, target / "transforms.json")
    return load_scene(str(root)), load_scene(str(target))


def assert_same(got: Scene, want: Scene, atol: float = 1e-5) -> None:
    assert torch.equal(got.point_colors, want.point_colors)
    torch.testing.assert_close(got.points, want.points, atol=atol, rtol=0)
    assert [v.name for v in got.train] == [v.name for v in want.train]
    for ours, theirs in zip(got.train + got.test, want.train + want.test, strict=True):
        torch.testing.assert_close(ours.camera.viewmat, theirs.camera.viewmat, atol=atol, rtol=0)
        torch.testing.assert_close(ours.camera.K, theirs.camera.K, atol=1e-4, rtol=0)
        assert torch.equal(ours.read_image(), theirs.read_image())


@pytest.mark.parametrize("model", CAMERAS)
def test_colmap_and_its_transforms_are_one_scene(tmp_path: Path, model: str):
    want, got = moved(tmp_path / "a", tmp_path / "b", model)
    assert_same(got, want)


@pytest.mark.parametrize("name", ["colmap", "colmap-text"])
def test_transforms_become_colmap(tmp_path: Path, name: str):
    want, _ = moved(tmp_path / "a", tmp_path / "b", "OPENCV")
    (tmp_path / "b" / "sparse").mkdir()
    convert(tmp_path / "b" / "transforms.json", tmp_path / "b" / "sparse" / "0", name)
    suffix = "bin" if name == "colmap" else "txt"
    assert (tmp_path / "b" / "sparse" / "0" / f"images.{suffix}").is_file()
    assert read_cameras(tmp_path / "b" / "sparse" / "0").suffix == f".{suffix}"
    assert_same(load_scene(str(tmp_path / "b")), want)


def test_points_in_the_coordinates_of_a_map_stay_where_they_are(tmp_path: Path):
    write_scene(tmp_path / "near")
    surveyed(tmp_path / "far")
    for name, kind, atol in (("near", b"property float x", 1e-6), ("far", b"property double x", 0)):
        want = read_cameras(tmp_path / name).points
        convert(tmp_path / name, tmp_path / name / "cameras.json")
        assert kind in (tmp_path / name / "sparse_pc.ply").read_bytes()
        got = read_cameras(tmp_path / name / "cameras.json").points
        np.testing.assert_allclose(got, want, rtol=0, atol=atol)


def test_a_camera_without_a_place_in_the_format_is_named(tmp_path: Path):
    lens = ("EQUIRECTANGULAR", (24.0, 12.0))
    write_model(tmp_path / "sparse" / "0", ["a.png"], lens, (24, 12), text=True)
    with pytest.raises(ValueError, match=r"cameras must be perspective .* got EQUIRECTANGULAR"):
        convert(tmp_path, tmp_path / "cameras.json")
    assert not (tmp_path / "cameras.json").exists()


def frame(**keys: Any) -> dict[str, Any]:
    """A camera at (1, 2, 3) that looks down the world's -z with y up: OpenGL's own axes."""
    pose = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    return {"file_path": "./images/a.png", "transform_matrix": pose} | keys


def written(folder: Path, *frames: dict[str, Any], **keys: Any) -> Path:
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for number, name in enumerate("ab"):
        Image.fromarray(picture(number)).save(folder / "images" / f"{name}.png")
    path = folder / "transforms.json"
    path.write_text(json.dumps({"frames": list(frames)} | keys))
    return path


LENS = {"fl_x": 20, "fl_y": 21, "cx": 12.5, "cy": 8.5, "w": WIDTH, "h": HEIGHT}


def test_axes_are_opengls(tmp_path: Path):
    model = read_cameras(written(tmp_path, frame(), **LENS))
    # OpenCV's y and z point the other way: half a turn around x.
    assert model.images[0].quat == pytest.approx((0, 1, 0, 0), abs=1e-12)
    assert model.images[0].translation == pytest.approx((-1, 2, 3), abs=1e-12)
    assert model.images[0].name == "a.png"
    assert model.cameras[0].params == (20, 21, 12.5, 8.5)


def test_what_nerfstudio_applied_is_undone(tmp_path: Path):
    # nerfstudio's own choice: y and z swap places and the new z is turned round; the scale comes after it.
    applied = np.array([[1.0, 0, 0, 0.5], [0, 0, 1, 0], [0, -1, 0, 0.25]])
    plain = read_cameras(written(tmp_path / "a", frame(), **LENS)).images[0]
    pose = np.array(frame()["transform_matrix"], float)
    pose = np.vstack([applied, [0, 0, 0, 1]]) @ pose
    pose[:3, 3] *= 0.2
    moved_frame = frame(transform_matrix=pose.tolist())
    keys = {"applied_transform": applied.tolist(), "applied_scale": 0.2}
    back = read_cameras(written(tmp_path / "b", moved_frame, **LENS, **keys)).images[0]
    assert back.quat == pytest.approx(plain.quat, abs=1e-12)
    assert back.translation == pytest.approx(plain.translation, abs=1e-12)


def test_what_instant_ngp_leaves_out_is_filled_in(tmp_path: Path):
    other = frame(file_path="images/b")
    model = read_cameras(written(tmp_path, frame(), other, camera_angle_x=1.2, aabb_scale=4))
    (camera,) = model.cameras
    assert (camera.width, camera.height, camera.model) == (WIDTH, HEIGHT, "PINHOLE")
    focal = WIDTH / 2 / np.tan(0.6)
    assert camera.params == pytest.approx((focal, focal, WIDTH / 2, HEIGHT / 2))
    assert [image.name for image in model.images] == ["a.png", "b"]
    assert len(load_scene(str(tmp_path), split="list", test=["b"]).train) == 1


def test_intrinsics_per_frame(tmp_path: Path):
    model = read_cameras(
        written(tmp_path, frame(fl_x=30.0), frame(file_path="images/b.png"), **LENS)
    )
    assert [camera.params[0] for camera in model.cameras] == [30, 20]
    assert [image.camera_id for image in model.images] == [1, 2]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model must be one of .* got 'EQUIRECTANGULAR'"),
        ({"k4": 0.1}, "without k4 unless fisheye, got OPENCV with k4 = 0.1"),
        ({"fl_x": "wide"}, "frame 0, fl_x: value must be a number"),
        ({"fl_x": float("nan")}, "frame 0, fl_x: value must be a number"),
        ({"w": -4}, "frame 0, w: value must be a number of 1"),
        ({"applied_scale": 0}, "applied_scale: value must be a number"),
        ({"applied_transform": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}, "applied_transform: matrix"),
        ({"ply_file_path": "none.ply"}, "none.ply: ply_file_path must be a PLY"),
        ({"frames": 3}, "content must be a JSON with frames"),
        ({"frames": [{"file_path": 3}]}, "frame 0: file_path must be the path of an image"),
        ({"frames": [frame(transform_matrix="x")]}, "frame 0: matrix must be a rotation"),
        ({"frames": [frame(transform_matrix=[[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])]}, "matrix must be"),
        ({"frames": []}, "registered images must be at least 1, got 0"),
        ({"frames": [frame(file_path="../../a.png"), frame(file_path="b.png")]}, "path below the image folder"),
    ],
)  # fmt: skip
def test_faults_are_named(tmp_path: Path, keys: dict[str, Any], message: str):
    path = written(tmp_path, frame(), **(LENS | keys))
    with pytest.raises(SceneError, match=message):
        read_cameras(path)


def colored(folder: Path, kind: str, *rows: tuple[float, ...], text: bool = False) -> Path:
    """A file of a scene whose points have colours of a NumPy type."""
    columns = [(axis, "<f4") for axis in "xyz"] + [(c, kind) for c in ("red", "green", "blue")]
    points = np.array([(0, 0, 0, *row) for row in rows], columns)
    path = written(folder, frame(), **LENS, ply_file_path="points.ply")
    PlyData([PlyElement.describe(points, "vertex")], text, "<").write(str(folder / "points.ply"))
    return path


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    ("kind", "red", "want"),
    [
        ("u1", 204, 204),
        ("u1", 0, 0),
        ("f4", 0.8, 204),
        ("f8", 1.0000001, 255),
        ("f4", 203.6, 204),
        ("f4", np.nan, 0),
        ("u2", 204, 204),
        ("i4", 204, 204),
    ],
)
def test_colours_mean_what_their_file_says(
    tmp_path: Path, kind: str, red: float, want: int, text: bool
):
    path = colored(tmp_path, kind, (0, 0, 0), (red, 0, 0), text=text)
    assert read_cameras(path).point_colors.tolist() == [[0, 0, 0], [want, 0, 0]]


@pytest.mark.parametrize("kind", ["<u2", ">u2"])
def test_colours_of_sixteen_bits(tmp_path: Path, kind: str):
    path = colored(tmp_path, kind, (52_428, 100, 65_535))
    assert read_cameras(path).point_colors.tolist() == [[204, 0, 255]]
    # The reader of text does not say what type a column has.
    text = colored(tmp_path, kind, (52_428, 100, 65_535), text=True)
    with pytest.raises(SceneError, match="as ushort of a binary file, got 0 to 65535"):
        read_cameras(text)


@pytest.mark.parametrize(
    ("kind", "red", "got"),
    [
        ("f4", 300.0, "0 to 300"),
        ("f4", -0.5, "-0.5 to 1"),
        ("f8", np.inf, "0 to inf"),
        ("i2", -1, "-1 to 1"),
        ("i4", 256, "0 to 256"),
    ],
)
def test_what_is_no_colour_is_refused(tmp_path: Path, kind: str, red: float, got: str):
    path = colored(tmp_path, kind, (red, 1, 0))
    with pytest.raises(SceneError, match=rf"points\.ply: colours must be 0 to 255, .* got {got}"):
        read_cameras(path)


def test_as_a_data_source(tmp_path: Path):
    moved(tmp_path / "a", tmp_path / "b", "OPENCV")
    config = composed("data=nerfstudio", f"data.root={tmp_path / 'b'}").data
    assert len(instantiate(config).train) == 7
    assert not errors(check(config).faults)


def test_llff_poses_are_the_scene(tmp_path: Path):
    """3D-OVS as it was first released: poses_bounds.npy in place of COLMAP's files."""
    write_scene(tmp_path, camera=("SIMPLE_PINHOLE", (20.0, WIDTH / 2, HEIGHT / 2)))
    want = load_scene(str(tmp_path))
    rows = []
    for view in sorted((*want.train, *want.test), key=lambda view: view.name):
        pose = view.camera.viewmat.double().inverse()
        right, down, forward, center = pose[:3].T
        columns = torch.stack(
            [down, right, -forward, center, torch.tensor([HEIGHT, WIDTH, 20.0])], 1
        )
        rows.append([*columns.flatten().tolist(), 0.1, 10.0])
    np.save(tmp_path / "poses_bounds.npy", np.array(rows))
    for file in (tmp_path / "sparse" / "0").iterdir():
        file.unlink()
    got = load_scene(str(tmp_path))
    assert len(got.points) == 0
    for ours, theirs in zip(got.train + got.test, want.train + want.test, strict=True):
        torch.testing.assert_close(ours.camera.viewmat, theirs.camera.viewmat, atol=1e-5, rtol=0)
        torch.testing.assert_close(ours.camera.K, theirs.camera.K)
    np.save(tmp_path / "poses_bounds.npy", np.array(rows[:-1]))
    with pytest.raises(
        SceneError, match=r"finite floats \[9, 17\], a row for each image, got .*\[8, 17\]"
    ):
        load_scene(str(tmp_path))


AXES = {"sheared": [[0.3, 1, 0], [-1, 0, 0.4], [0, 0, 1]], "long": [[0, 3, 0], [-3, 0, 0], [0, 0, 3]],
        "mirrored": [[0, 1, 0], [1, 0, 0], [0, 0, 1]], "beyond": [[0, 1e300, 0], [1e300, 0, 0], [0, 0, 1]]}  # fmt: skip


@pytest.mark.parametrize("axes", AXES)
def test_llff_axes_that_are_no_rotation_are_named(tmp_path: Path, axes: str):
    (tmp_path / "images").mkdir()
    rows = []
    for i, turn in enumerate(([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], AXES[axes])):
        Image.fromarray(picture(i)).save(tmp_path / "images" / f"{i}.png")
        matrix = np.column_stack([np.array(turn, float), [i, 0, 0], [HEIGHT, WIDTH, 20.0]])
        rows.append([*matrix.ravel(), 0.1, 10.0])
    np.save(tmp_path / "poses_bounds.npy", np.array(rows))
    with pytest.raises(SceneError, match="row 1: axes must be down, right and back, of length 1"):
        read_cameras(tmp_path)


def test_photographs_of_half_the_size_that_a_distorted_lens_is_written_for(tmp_path: Path):
    root = Path(__file__).parents[1] / "fixtures" / "photographs"
    shutil.copytree(root / "images", tmp_path / "images")
    shutil.copy(root / "transforms.json", tmp_path)
    scene, colmaps = load_scene(str(tmp_path)), load_scene(str(root))
    assert len(scene.points) == 0
    for ours, theirs in zip(scene.train, colmaps.train, strict=True):
        torch.testing.assert_close(ours.camera.viewmat, theirs.camera.viewmat, atol=1e-5, rtol=0)
        torch.testing.assert_close(ours.camera.K, theirs.camera.K)
        assert torch.equal(ours.read_image(), theirs.read_image())


def test_the_fox_of_instant_ngp(shared: Path, tmp_path: Path):
    fox = shared / "data" / "fox"
    (tmp_path / "images").symlink_to(fox / "images")
    content = json.loads((fox / "transforms_fullres.json").read_text())
    # Made for 1080 x 1920 with a distorted lens; 50 of its 67 photographs are at hand, at half the size.
    content["frames"] = [f for f in content["frames"] if (fox / f["file_path"]).is_file()]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    scene = load_scene(str(tmp_path))
    assert len(scene.train) + len(scene.test) == 50
    view = scene.train[0]
    assert abs(view.camera.width - 540) < 20
    assert view.read_image().shape[:2] == (view.camera.height, view.camera.width)


def test_paths_lead_to_the_photographs_from_wherever_the_file_lies(tmp_path: Path):
    root = tmp_path / "scene"
    write_scene(root)
    target = tmp_path / "elsewhere" / "deep" / "cameras.json"
    target.parent.mkdir(parents=True)
    assert not any(line.startswith("beware") for line in convert(root, target))
    frames = json.loads(target.read_text())["frames"]
    assert len(frames) > 1
    for frame in frames:
        assert (target.parent / frame["file_path"]).resolve().parent == (root / "images").resolve()
        assert (target.parent / frame["file_path"]).is_file()
    assert convert(root / "sparse" / "0", target)[1:] == []
    assert json.loads(target.read_text())["frames"] == frames
    (root / "images").rename(root / "gone")
    assert any(line.startswith("beware: no photographs found") for line in convert(root, target))


def test_points_of_something_else_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    root, target = tmp_path / "scene", tmp_path / "cameras.json"
    write_scene(root)
    points = tmp_path / "sparse_pc.ply"
    points.write_bytes(b"mine")
    with pytest.raises(ValueError, match=r"sparse_pc\.ply beside it must not be there"):
        convert(root, target)
    assert points.read_bytes() == b"mine"
    assert not target.exists()
    points.unlink()

    def full(path: Path, data: bytes) -> None:
        if path == target:
            raise OSError(28, "No space left on device", str(path))
        path.write_bytes(data)

    with monkeypatch.context() as patch:
        patch.setattr("vlgs.data.sparse.transforms.write_atomically", full)
        with pytest.raises(OSError, match="No space"):
            convert(root, target)
    assert not points.exists()
    convert(root, target)
    convert(root, target)  # its own
