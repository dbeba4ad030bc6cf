"""Undistortion and resizing: photographs, labels and masks go through one mapping, and it is the right one."""

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from vlgs.data.diagnostics import SceneError
from vlgs.data.lens import (
    Lens,
    covers_all,
    make_lens,
    move_boxes,
    nearest_pixels,
    sampling_grid,
    shrink_pixels,
    undistort_pixels,
)
from vlgs.data.sparse.model import CAMERA_MODELS, SparseCamera

SIZE = (64, 48)
LENSES = {
    "SIMPLE_RADIAL": (60.0, 33.0, 23.0, 0.08),
    "RADIAL": (60.0, 33.0, 23.0, -0.12, 0.03),
    "OPENCV": (60.0, 57.0, 33.0, 23.0, -0.1, 0.02, 0.004, -0.003),
    "OPENCV_FISHEYE": (60.0, 57.0, 33.0, 23.0, 0.02, -0.01, 0.002, -0.001),
}


def camera(model: str, params: tuple[float, ...] | None = None) -> SparseCamera:
    return SparseCamera(1, model, *SIZE, params or LENSES[model])


def lens(model: str, resize: float = 1.0, file_size: tuple[int, int] = SIZE) -> Lens:
    return make_lens(camera(model), file_size, resize, "cameras.bin")


def distort(model: str, x: float, y: float) -> tuple[float, float]:
    """File position of a ray (x, y, 1), by the formulas of COLMAP's and OpenCV's manuals."""
    p = LENSES[model]
    r2 = x * x + y * y
    if model == "SIMPLE_RADIAL":
        return p[0] * x * (1 + p[3] * r2) + p[1], p[0] * y * (1 + p[3] * r2) + p[2]
    if model == "RADIAL":
        radial = 1 + p[3] * r2 + p[4] * r2**2
        return p[0] * x * radial + p[1], p[0] * y * radial + p[2]
    if model == "OPENCV":
        k1, k2, p1, p2 = p[4:]
        radial = 1 + k1 * r2 + k2 * r2**2
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    else:
        r = math.sqrt(r2)
        t = math.atan(r)
        td = t * (1 + p[4] * t**2 + p[5] * t**4 + p[6] * t**6 + p[7] * t**8)
        u, v = (x * td / r, y * td / r) if r else (x, y)
    return p[0] * u + p[2], p[1] * v + p[3]


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("resize", [1.0, 0.5])
@settings(max_examples=30, deadline=None)
@given(u=st.floats(0, 1), v=st.floats(0, 1))
def test_mapping_is_the_analytic_one(model: str, resize: float, u: float, v: float):
    warp = lens(model, resize)
    xy = np.array([[u, v]]) * warp.size
    K = warp.intrinsics()
    ray = (xy[0] - K[:2, 2]) / K.diagonal()[:2]
    np.testing.assert_allclose(warp.to_file(xy)[0], distort(model, *ray), atol=1e-9)
    np.testing.assert_allclose(warp.from_file(warp.to_file(xy)), xy, atol=1e-6)


@pytest.mark.parametrize("model", LENSES)
def test_photographs_and_labels_move_together(model: str):
    """The file's pixels are its own coordinates: what arrives tells where it came from."""
    warp = lens(model)
    width, height = SIZE
    ys, xs = np.mgrid[0:height, 0:width]
    coordinates = torch.from_numpy(np.stack([3 * xs, 5 * ys, 0 * xs], axis=2).astype(np.uint8))
    bilinear = undistort_pixels(coordinates, sampling_grid(warp)).double()
    index = nearest_pixels(warp, SIZE)
    assert (index >= 0).all() == covers_all(warp)
    inside = index >= 0
    column, row = index % width, index // width
    # Nearest is off by at most half a pixel a side; the bilinear value was rounded to whole units.
    assert (bilinear[..., 0] / 3 - column)[inside].abs().max() <= 0.5 + 0.5 / 3 + 1e-4
    assert (bilinear[..., 1] / 5 - row)[inside].abs().max() <= 0.5 + 0.5 / 5 + 1e-4


def test_a_coarser_map_is_sampled_at_the_same_places():
    warp = lens("OPENCV")
    fine, coarse = nearest_pixels(warp, SIZE), nearest_pixels(warp, (SIZE[0] // 2, SIZE[1] // 2))
    assert torch.equal(coarse % 32, (fine % 64) // 2)
    assert torch.equal(coarse // 32, (fine // 64) // 2)


def test_outside_the_file_there_is_nothing():
    bent = SparseCamera(1, "SIMPLE_RADIAL", *SIZE, (60.0, 32.0, 24.0, 0.0))
    wide = SparseCamera(1, "PINHOLE", 80, 60, (60.0, 60.0, 40.0, 30.0))
    warp = Lens(wide, bent, SIZE, (80, 60))
    index = nearest_pixels(warp, SIZE)
    assert not covers_all(warp)
    assert (index[:, :8] == -1).all()
    assert (index[6:54, 8:72] >= 0).all()
    assert (index >= 0).sum() == 64 * 48


def test_a_pinhole_is_left_alone():
    warp = make_lens(camera("PINHOLE", (60.0, 57.0, 33.0, 23.0)), SIZE, 1.0, "")
    assert warp.distorted is None
    assert covers_all(warp)
    np.testing.assert_array_equal(warp.intrinsics(), [[60, 0, 33], [0, 57, 23], [0, 0, 1]])
    assert torch.equal(nearest_pixels(warp, SIZE).flatten(), torch.arange(64 * 48))


def test_scaled_files_and_resizing_scale_each_axis():
    warp = make_lens(camera("SIMPLE_PINHOLE", (60.0, 33.0, 23.0)), (128, 96), 0.25, "")
    assert warp.size == (32, 24)
    np.testing.assert_allclose(warp.intrinsics(), [[30, 0, 16.5], [0, 30, 11.5], [0, 0, 1]])


def test_shrinking_averages_areas():
    pixels = torch.arange(48, dtype=torch.uint8).reshape(4, 4, 3)
    small = shrink_pixels(pixels, (2, 2))
    expected = pixels.double().reshape(2, 2, 2, 2, 3).mean(dim=(1, 3))
    assert (small.double() - expected).abs().max() <= 1  # Pillow rounds rows, then columns


def test_boxes_follow_their_pixels():
    warp = make_lens(camera("PINHOLE", (60.0, 57.0, 33.0, 23.0)), SIZE, 0.5, "")
    boxes = np.array([[4.0, 6, 20, 30], [20, 30, 4, 6]])
    np.testing.assert_array_equal(move_boxes(boxes, SIZE, warp), [[2, 3, 9, 14]] * 2)
    bent = lens("OPENCV")
    (moved,) = move_boxes(np.array([[10.0, 8, 40, 30]]), SIZE, bent)
    corners = bent.from_file(np.array([[10.0, 8], [41, 8], [41, 31], [10, 31]]))
    assert (moved[:2] - 0.5 <= corners.min(axis=0)).all()
    assert (moved[2:] + 1.5 >= corners.max(axis=0)).all()


@pytest.mark.parametrize("resize", [1.0, 0.5, 0.25, 0.125])
@pytest.mark.parametrize("finer", [1, 2])
def test_a_box_holds_the_pixels_that_a_mask_of_it_has(resize: float, finer: int):
    warp = make_lens(camera("PINHOLE", (60.0, 57.0, 33.0, 23.0)), SIZE, resize, "")
    size = (SIZE[0] * finer, SIZE[1] * finer)
    nearest = nearest_pixels(warp, size).numpy()
    for x1, y1, x2, y2 in [
        (3, 4, 20, 17),
        (5.5, 6.2, 30.9, 31),
        (10.2, 4, 10.8, 9),
        (0, 0, 63, 47),
    ]:
        mask = np.zeros(size[::-1], bool)
        mask[math.ceil(y1) : math.floor(y2) + 1, math.ceil(x1) : math.floor(x2) + 1] = True
        (box,) = move_boxes(np.array([[x1, y1, x2, y2]], float), size, warp)
        y, x = np.indices(nearest.shape)
        inside = (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])
        np.testing.assert_array_equal(inside, mask.ravel()[nearest])


def test_a_box_that_the_lens_cannot_show_holds_no_pixel():
    barrel = make_lens(camera("SIMPLE_RADIAL", (60.0, 32.0, 24.0, -0.3)), SIZE, 1.0, "")
    boxes = np.array([[5000.0, 5000, 6000, 6000], [30, 20, 34, 28]])
    moved = move_boxes(boxes, SIZE, barrel)
    assert np.isnan(moved[0]).all()
    assert np.isfinite(moved[1]).all()


@pytest.mark.parametrize(("model", "n_params"), CAMERA_MODELS.values())
def test_every_model_is_undistorted_or_refused_by_name(model: str, n_params: int):
    one_focal = n_params == 3 or model.startswith("SIMPLE") or model in ("RADIAL", "RADIAL_FISHEYE")
    params = (60.0, 32.0, 24.0) if one_focal else (60.0, 60.0, 32.0, 24.0)
    params += {"FOV": (0.1,), "EUCM": (0.5, 1.0)}.get(model, ()) + (0.0,) * n_params
    if model == "EQUIRECTANGULAR":
        params = (64.0, 48.0)
        with pytest.raises(
            SceneError, match=r"camera 1: model must be .*undistorted, got EQUIRECTANGULAR"
        ):
            make_lens(camera(model, params), SIZE, 1.0, "cameras.bin")
        return
    warp = make_lens(camera(model, params[:n_params]), SIZE, 1.0, "cameras.bin")
    center = warp.to_file(warp.intrinsics()[None, :2, 2])
    np.testing.assert_allclose(center, [[32, 24]], atol=1e-9)


@pytest.mark.parametrize("k", [1e300, -50.0])
def test_parameters_that_describe_no_lens_are_refused(k: float):
    broken = camera("SIMPLE_RADIAL", (60.0, 33.0, 23.0, k))
    with pytest.raises(
        SceneError, match=r"cameras\.bin: camera 1: parameters must describe an invertible lens"
    ):
        make_lens(broken, SIZE, 1.0, "cameras.bin")


def test_pngs_are_written_after_pycolmap_was_loaded():
    """pycolmap imported before Pillow corrupts the heap; the order is fixed by `vlgs.data.lens`."""
    program = """
import numpy as np, io, sys
from vlgs.data.lens import import_pycolmap
import_pycolmap()
order = list(sys.modules)
assert order.index("PIL.Image") < order.index("pycolmap")
from PIL import Image
for i in range(40):
    Image.fromarray(np.full((300, 400, 3), i, np.uint8)).save(io.BytesIO(), "PNG")
print("alive")
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=50, check=False
    )
    assert (done.returncode, done.stdout) == (0, "alive\n"), done.stderr
