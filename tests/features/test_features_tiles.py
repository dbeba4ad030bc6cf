"""Tiles of several sizes: their vectors, and the means over sizes, against plain loops with an encoder whose answers are known."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from colmap_scenes import write_scene
from hydra import compose, initialize_config_dir

from vlgs.config import CONF, instantiate
from vlgs.data.colmap import load_scene
from vlgs.features import Extractor, Mask
from vlgs.features.__main__ import extract
from vlgs.features.tiles import TilePyramid, cells, resample


class Corner:
    """Says where a tile is and how large, and remembers what it saw."""

    def __init__(self) -> None:
        self.seen: list[Mask] = []

    def identity(self) -> dict[str, str]:
        return {"encoder": "corner"}

    def __call__(self, image: np.ndarray, masks: Sequence[Mask], stem: str) -> np.ndarray:
        self.seen += masks
        rows = [[*mask.box, 50 + image[mask.window][mask.pixels].mean()] for mask in masks]
        return np.array(rows, np.float32)


def photograph(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def tile_at(y: float, x: float, side: int, image: np.ndarray) -> np.ndarray:
    """What `Corner` says of the tile around a place."""
    height, width, _ = image.shape
    top = int(np.clip(round(y - side / 2), 0, height - side))
    left = int(np.clip(round(x - side / 2), 0, width - side))
    seen = image[top : top + side, left : left + side]
    return unit(np.array([left, top, left + side, top + side, 50 + seen.mean()]))


@pytest.mark.parametrize(("height", "width"), [(40, 60), (37, 53), (53, 37)])
def test_a_cell_has_the_vector_of_the_tile_around_its_middle(height: int, width: int):
    image, encoder = photograph(height, width), Corner()
    got = TilePyramid(encoder, [0.2, 0.5], 0.5, [[], [0], [], [1]])(image, "a")
    assert (got.ids[[0, 2]] == -1).all()
    assert got.ids[1].min() == 0
    assert got.ids[3].min() == got.ids[1].max() + 1
    assert got.ids.max() == len(got.vectors) - 1
    for level, share in ((1, 0.2), (3, 0.5)):
        side = round(share * min(height, width))
        rows, columns = (int(np.ceil(n / (0.5 * side))) for n in (height, width))
        assert len(np.unique(got.ids[level])) == rows * columns
        for y in range(0, height, 3):
            for x in range(0, width, 3):
                row, column = int((y + 0.5) * rows / height), int((x + 0.5) * columns / width)
                place = ((row + 0.5) * height / rows, (column + 0.5) * width / columns)
                want = tile_at(*place, side, image)
                np.testing.assert_allclose(got.vectors[got.ids[level, y, x]], want, rtol=1e-5)
    for mask in encoder.seen:
        x1, y1, x2, y2 = mask.box
        assert x2 - x1 == y2 - y1
        assert min(x1, y1) >= 0
        assert x2 <= width
        assert y2 <= height


def test_a_level_of_several_sizes_has_their_mean():
    """Coarse grids are looked at between their cells, by a loop of four corners; beyond the last middle they stay as they are."""
    image, sides = photograph(37, 53), [0.2, 0.35, 0.6]
    alone = [TilePyramid(Corner(), [side], 0.5, [[0], [], [], []])(image, "a") for side in sides]
    counts = [[int(np.ceil(n / (0.5 * round(s * 37)))) for n in (37, 53)] for s in sides]
    grids = [a.vectors.reshape(*shape, -1) for a, shape in zip(alone, counts, strict=True)]
    got = TilePyramid(Corner(), sides, 0.5, [[2, 0, 1], [], [], [1, 2]])(image, "a")
    fine, middle = counts[0], counts[1]

    def between(grid: np.ndarray, y: float, x: float) -> np.ndarray:
        rows, columns = grid.shape[:2]
        v = min(max(y * rows - 0.5, 0), rows - 1)
        u = min(max(x * columns - 0.5, 0), columns - 1)
        total = np.zeros(grid.shape[2])
        for r in range(rows):
            for c in range(columns):
                total += max(0, 1 - abs(r - v)) * max(0, 1 - abs(c - u)) * grid[r, c]
        return total

    for first, shape, used in ((0, fine, (0, 1, 2)), (fine[0] * fine[1], middle, (1, 2))):
        for row in range(shape[0]):
            for column in range(shape[1]):
                place = ((row + 0.5) / shape[0], (column + 0.5) / shape[1])
                want = unit(np.mean([between(grids[n], *place) for n in used], axis=0))
                vector = got.vectors[first + row * shape[1] + column]
                np.testing.assert_allclose(vector, want, rtol=1e-4)
    assert got.ids[3].max() == len(got.vectors) - 1


def test_grids_of_one_cell_and_of_the_same_shape():
    grid = np.random.default_rng(1).random((3, 4, 2), np.float32)
    np.testing.assert_allclose(resample(grid, (3, 4)), grid)
    np.testing.assert_allclose(
        resample(grid[:1, :1], (2, 2)), np.broadcast_to(grid[:1, :1], (2, 2, 2))
    )
    assert cells((3, 5), (3, 5)).tolist() == np.arange(15).reshape(3, 5).tolist()
    got = TilePyramid(Corner(), [1.0], 1.0, [[0], [], [], []])(photograph(1, 1), "a")
    assert got.ids[0].tolist() == [[0]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sides": [0.5, 0.2]}, r"sides must rise .* got \[0\.5, 0\.2\] and 0\.5"),
        ({"stride": 0.0}, "stride, be above 0 and at most 1"),
        ({"sides": [0.2, 1.5]}, "at most 1"),
        ({"sides": [0.2]}, "levels must be 4 lists of numbers of sides, 0 to 0"),
        ({"levels": [[0], [1]]}, "levels must be 4 lists"),
        ({"levels": [[], [], [], []]}, "levels must be 4 lists"),
    ],
)
def test_what_is_no_pyramid_is_refused(arguments: dict, message: str):
    with pytest.raises(ValueError, match=message):
        TilePyramid(Corner(), **arguments)


def test_vectors_without_a_direction_are_refused():
    class Nothing(Corner):
        def __call__(self, image: np.ndarray, masks: Sequence[Mask], stem: str) -> np.ndarray:
            return np.zeros((len(masks), 3), np.float32)

    with pytest.raises(ValueError, match="vectors of a must be finite and not zero"):
        TilePyramid(Nothing())(photograph(20, 30), "a")


def test_photographs_become_tiles_that_every_method_reads(tmp_path: Path, weights: Path):
    root = tmp_path / "scene"
    write_scene(root, size=(70, 50))
    given = (f"data.root={root}", "features=tiles", f"features.weights={weights}", "progress=false")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("features", overrides=[*given, "features.extractor.stride=1.0"])
    assert isinstance(instantiate(config.features.extractor), Extractor)
    extract(config)
    for level, sizes in enumerate([(7, 0.05), (2, 0.05), (3, 0.2), (2, 0.425)]):
        scene = load_scene(str(root), level=level)
        side = round(sizes[1] * 50)
        per_view = int(np.ceil(50 / side)) * int(np.ceil(70 / side))
        assert len(scene.mask_vectors) == per_view * len(scene.train)
        read = scene.train[0].read_masks
        assert read is not None
        assert (read() >= 0).all()
