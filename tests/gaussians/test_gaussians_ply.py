import os
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement
from slow import with_slow

from vlgs.gaussians import STANDARD, activate, read_ply, write_ply

PARAMETERS = tuple(STANDARD)[:8]
"""What every training has."""

OURS = Path(__file__).parents[1] / "fixtures" / "gaussians.ply"
REAL = Path(__file__).parents[2] / "../shared/data/splats/kacytran_it7000.ply"


def random_params(n: int, coefficients: int, width: int, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {
        "means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "sh0": (n, 3), "shN": (n, coefficients, 3),
        "opacity_logits": (n,), "indicator_logits": (n,), "features": (n, width),
    }  # fmt: skip
    return {name: torch.randn(shapes[name], generator=generator) for name in PARAMETERS}


@given(
    n=st.integers(0, 20),
    coefficients=st.sampled_from([0, 3, 8, 15]),
    width=st.sampled_from([1, 3, 12]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=25, deadline=None)
def test_round_trip_is_bit_equal(
    tmp_path_factory, n: int, coefficients: int, width: int, seed: int
):
    path = tmp_path_factory.mktemp("ply") / "point_cloud.ply"
    params = random_params(n, coefficients, width, seed)
    write_ply(path, params)
    back = read_ply(path)
    assert tuple(back) == PARAMETERS
    assert all(torch.equal(params[name], back[name]) for name in PARAMETERS)
    assert os.listdir(path.parent) == [path.name]


def test_layout_is_that_of_3dgs(tmp_path: Path):
    params = random_params(2, 15, 3)
    write_ply(tmp_path / "a.ply", params)
    header, _, data = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert "format binary_little_endian 1.0" in lines
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    assert names == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *[f"f_rest_{i}" for i in range(45)],
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
        *("lang_0", "lang_1", "lang_2", "indicator"),
    ]
    rows = np.frombuffer(data, "<f4").reshape(2, len(names))
    assert (rows[:, 3:6] == 0).all()
    # Channel-major: f_rest_15 is the first coefficient of green.
    assert rows[1, names.index("f_rest_15")] == params["shN"][1, 0, 1]
    assert rows[1, names.index("f_rest_44")] == params["shN"][1, 14, 2]
    assert rows[0, names.index("opacity")] == params["opacity_logits"][0]


def test_order_of_properties_does_not_matter_and_language_may_be_missing(tmp_path: Path):
    params = random_params(4, 3, 2)
    write_ply(tmp_path / "a.ply", params)
    vertices = PlyData.read(str(tmp_path / "a.ply"), mmap="c")["vertex"].data
    kept = [
        n for n in reversed(vertices.dtype.names) if not n.startswith(("lang", "indicator", "n"))
    ]
    shuffled = np.empty(4, [(name, "<f8") for name in kept])
    for name in kept:
        shuffled[name] = vertices[name]
    PlyData([PlyElement.describe(shuffled, "vertex")], text=True).write(str(tmp_path / "b.ply"))
    back = read_ply(tmp_path / "b.ply", feature_dim=5)
    for name in PARAMETERS[:6]:
        torch.testing.assert_close(back[name], params[name])
    assert torch.equal(back["indicator_logits"], back["opacity_logits"])
    assert torch.equal(back["features"], torch.zeros(4, 5))


@pytest.mark.parametrize(("path", "count"), [(OURS, 120), (REAL, 9080)])
def test_a_file_of_3dgs_comes_in_and_out(tmp_path: Path, path: Path, count: int):
    if not path.exists():
        pytest.skip("real Gaussians not at hand")
    params = read_ply(path)
    gaussians = activate(params)
    assert gaussians.shN.shape == (count, 15, 3)
    assert gaussians.scales.isfinite().all()
    write_ply(tmp_path / "out.ply", params)
    ours = PlyData.read(str(tmp_path / "out.ply"), mmap="c")["vertex"].data
    theirs = PlyData.read(str(path), mmap="c")["vertex"].data
    for name in theirs.dtype.names:
        np.testing.assert_array_equal(ours[name], theirs[name])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("shN", torch.nan, "shN must be finite, got 2 of 5 rows"),
        ("opacity_logits", torch.inf, "opacity_logits must be finite, got 2 of 5 rows"),
        ("quats", 0.0, "quats must not be zero, got 2 of 5 rows"),
    ],
)
def test_broken_gaussians_are_refused_both_ways(
    tmp_path: Path, name: str, value: float, message: str
):
    params = random_params(5, 3, 3)
    write_ply(tmp_path / "a.ply", params)
    before = (tmp_path / "a.ply").read_bytes()
    params[name][1:3] = value
    with pytest.raises(ValueError, match=message):
        write_ply(tmp_path / "a.ply", params)
    assert (tmp_path / "a.ply").read_bytes() == before

    columns = PlyData.read(str(tmp_path / "a.ply"), mmap="r")["vertex"].data.copy()
    names = {
        "shN": ["f_rest_8"],
        "opacity_logits": ["opacity"],
        "quats": [f"rot_{i}" for i in range(4)],
    }
    for column in names[name]:
        columns[column][1:3] = value
    PlyData([PlyElement.describe(columns, "vertex")]).write(str(tmp_path / "b.ply"))
    with pytest.raises(ValueError, match=f"b.ply: {message}"):
        read_ply(tmp_path / "b.ply")


def test_damaged_files_are_refused_by_name(tmp_path: Path):
    path = tmp_path / "bad.ply"
    write_ply(path, random_params(6, 15, 3))
    whole = path.read_bytes()
    damaged = [
        b"",
        b"ply",
        b"\x00\xff garbage" * 40,
        whole[:-1],
        whole[: len(whole) // 2],
        whole[:100],
    ]
    for data in damaged:
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"bad\.ply: must be a complete PLY"):
            read_ply(path)


@pytest.mark.parametrize("value", with_slow([0x00, 0x7F, 0xFF], [0x00, 0x7F]))
def test_a_damaged_byte_is_refused_by_name_or_leaves_finite_numbers(tmp_path: Path, value: int):
    path = tmp_path / "a.ply"
    write_ply(path, random_params(2, 0, 1))
    whole = path.read_bytes()
    for position in range(len(whole)):
        path.write_bytes(whole[:position] + bytes([value]) + whole[position + 1 :])
        read, refusal = {}, ""
        try:
            read = read_ply(path)
        except ValueError as error:
            refusal = str(error)
        assert "a.ply" in refusal or read
        assert all(value.isfinite().all() for value in read.values())


def test_other_ply_files_are_refused(tmp_path: Path):
    path = tmp_path / "mesh.ply"
    points = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    PlyData([PlyElement.describe(points, "vertex")]).write(str(path))
    with pytest.raises(ValueError, match=r"mesh\.ply: vertex must have the numeric property"):
        read_ply(path)
    PlyData([PlyElement.describe(points, "point")]).write(str(path))
    with pytest.raises(ValueError, match="must have an element vertex"):
        read_ply(path)
    lists = np.empty(3, [("x", object)])
    lists["x"] = [np.zeros(2, "f4")] * 3
    PlyData([PlyElement.describe(lists, "vertex")]).write(str(path))
    with pytest.raises(ValueError, match="must have the numeric property"):
        read_ply(path)
    odd = np.zeros(3, [("f_rest_0", "<f4")])
    PlyData([PlyElement.describe(odd, "vertex")]).write(str(path))
    with pytest.raises(ValueError, match="f_rest properties must be 0, 9, 24 or 45, got 1"):
        read_ply(path)


def test_missing_files(tmp_path: Path):
    with pytest.raises(FileNotFoundError):
        read_ply(tmp_path / "none.ply")
    with pytest.raises(FileNotFoundError):
        write_ply(tmp_path / "none" / "a.ply", random_params(1, 0, 1))
