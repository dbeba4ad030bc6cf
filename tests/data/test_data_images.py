"""Photographs of every kind that cameras and tools leave behind."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_scenes import picture, write_scene
from PIL import Image

from vlgs.data.colmap import load_scene, survey
from vlgs.data.diagnostics import SceneError
from vlgs.data.images import is_copy_of, open_photograph, read_photograph
from vlgs.data.source import ColmapSource

SIZE = (6, 4)


def load(path: Path, size: tuple[int, int] = SIZE) -> torch.Tensor:
    return read_photograph(open_photograph(path, size))


def save(path: Path, pixels: np.ndarray, exif: Image.Exif | None = None) -> Path:
    Image.fromarray(pixels).save(path, exif=exif or Image.Exif())
    return path


def test_colour_comes_back_as_stored(tmp_path: Path):
    pixels = picture(0, *SIZE)
    loaded = load(save(tmp_path / "a.png", pixels))
    assert loaded.dtype == torch.uint8
    np.testing.assert_array_equal(loaded.numpy(), pixels)


def test_grey_has_three_equal_channels(tmp_path: Path):
    grey = picture(0, *SIZE)[..., 0]
    np.testing.assert_array_equal(
        load(save(tmp_path / "a.png", grey)), np.repeat(grey[..., None], 3, 2)
    )


def test_sixteen_bits_are_rounded_to_eight(tmp_path: Path):
    grey = np.array([[0, 128, 129, 257, 65406, 65535]] * 4, np.uint16)  # 257 = 65535 / 255
    loaded = load(save(tmp_path / "a.png", grey))
    assert loaded[0, :, 0].tolist() == [0, 0, 1, 1, 254, 255]


def test_transparency_lies_on_black(tmp_path: Path):
    rgba = np.full((4, 6, 4), 200, np.uint8)
    rgba[..., 3] = [0, 51, 102, 153, 204, 255]
    loaded = load(save(tmp_path / "a.png", rgba))
    assert loaded[0, :, 1].tolist() == [0, 40, 80, 120, 160, 200]


def test_a_palette_is_looked_up(tmp_path: Path):
    image = Image.fromarray(picture(0, *SIZE)).quantize(4)
    image.save(tmp_path / "a.png")
    np.testing.assert_array_equal(load(tmp_path / "a.png"), np.asarray(image.convert("RGB")))


def tagged(path: Path, pixels: np.ndarray, orientation: int) -> Path:
    exif = Image.Exif()
    exif[0x0112] = orientation
    return save(path, pixels, exif=exif)


def test_orientation_is_ignored_where_the_stored_pixels_fit(tmp_path: Path):
    """COLMAP does not look at it either."""
    pixels = picture(0, *SIZE)
    path = tagged(tmp_path / "a.png", pixels, 6)
    assert open_photograph(path, SIZE).tagged
    np.testing.assert_array_equal(load(path), pixels)


def test_orientation_is_applied_where_only_the_turned_pixels_fit(tmp_path: Path):
    pixels = picture(0, *SIZE)
    path = tagged(
        tmp_path / "a.png", pixels, 6
    )  # 6: turn by 90 degrees clockwise to see it upright
    np.testing.assert_array_equal(load(path, (4, 6)), np.rot90(pixels, -1))


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_truncated_and_empty_files_are_named(tmp_path: Path, suffix: str):
    path = save(tmp_path / f"a.{suffix}", picture(0, 64, 64))
    whole = path.read_bytes()
    for size in (0, 1, 20, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:size])
        with pytest.raises(
            SceneError, match=rf"a\.{suffix}: content must be a whole image, got {size} bytes"
        ):
            load(path, (64, 64))


def test_another_shape_names_file_and_both_sizes(tmp_path: Path):
    path = save(tmp_path / "a.png", picture(0, *SIZE))
    with pytest.raises(SceneError, match=r"a\.png: size must be 8 x 4 as its camera.*got 6 x 4"):
        load(path, (8, 4))


def test_floats_are_refused(tmp_path: Path):
    path = save(tmp_path / "a.tiff", np.zeros((4, 6), np.float32))
    with pytest.raises(SceneError, match="pixels must be 8 or 16 bit integers, got mode F"):
        load(path)


@pytest.mark.parametrize(
    ("size", "camera", "expected"),
    [
        ((800, 600), (800, 600), True),
        ((1237, 822), (4946, 3286), True),  # images_4 of Mip-NeRF 360's garden
        ((1236, 821), (4946, 3286), True),
        ((1600, 1200), (800, 600), True),
        ((600, 800), (800, 600), False),
        ((493, 365), (492, 364), False),
        ((492, 365), (492, 364), False),
        ((400, 310), (800, 600), False),
    ],
)
def test_scaled_copies_are_told_from_crops(
    size: tuple[int, int], camera: tuple[int, int], expected: bool
):
    assert is_copy_of(size, camera) == expected


def test_transparent_pixels_are_a_warning_and_an_opaque_channel_is_not(tmp_path: Path):
    names = write_scene(tmp_path / "opaque", n=12, points=1000)
    for name in names:
        path = tmp_path / "opaque" / "images" / f"{name}.png"
        with Image.open(path) as image:
            image.convert("RGBA").save(path)
    shutil.copytree(tmp_path / "opaque", tmp_path / "cut out")
    path = tmp_path / "cut out" / "images" / f"{names[0]}.png"
    with Image.open(path) as image:
        image.putpixel((3, 4), (255, 255, 255, 0))
        image.save(path)
    assert not survey(ColmapSource(root=str(tmp_path / "opaque"))).faults
    (fault,) = survey(ColmapSource(root=str(tmp_path / "cut out"))).faults
    assert fault.severity == "warning"
    assert f"got transparent pixels in {names[0]}.png (an alpha channel in 12 of 12)" in str(fault)
    assert "they are laid on black" in fault.advice


def test_a_run_says_the_warnings_of_its_scene_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    write_scene(tmp_path, n=3, points=1000)
    for _ in range(3):
        load_scene(str(tmp_path))
    (said,) = [record.getMessage() for record in caplog.records]
    assert said.startswith(f"warning: {tmp_path}: training views should be at least 6, got 2 of 3")
