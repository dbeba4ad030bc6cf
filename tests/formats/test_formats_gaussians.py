"""Gaussians of other systems come in and go out unchanged, and nothing in their files is run."""

import os
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from vlgs.formats import (
    FORMATS,
    Imported,
    read_gaussians,
    start_from,
    write_gaussians,
)
from vlgs.formats.plain import load_plain
from vlgs.gaussians import STANDARD, attributes_of, read_ply, write_ply
from vlgs.gaussians.config import GaussiansConfig
from vlgs.gaussians.ply import PLAIN

PARAMETERS = tuple(STANDARD)[:8]
"""What every training has."""


def random_params(
    n: int = 5, coefficients: int = 15, width: int = 3, seed: int = 0
) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {
        "means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "sh0": (n, 3), "shN": (n, coefficients, 3),
        "opacity_logits": (n,), "indicator_logits": (n,), "features": (n, width),
    }  # fmt: skip
    return {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}


def imported(params: dict[str, Tensor], language: bool = True) -> Imported:
    return Imported(params, language, False, {})


@given(
    name=st.sampled_from([name for name in FORMATS if name not in ("splat", "compressed-ply")]),
    n=st.integers(0, 9),
    coefficients=st.sampled_from([0, 3, 8, 15]),
    width=st.sampled_from([3, 8]),
    seed=st.integers(0, 99),
)
@settings(max_examples=40, deadline=None)
def test_round_trips_are_bit_equal(
    tmp_path_factory: pytest.TempPathFactory,
    name: str,
    n: int,
    coefficients: int,
    width: int,
    seed: int,
):
    path = tmp_path_factory.mktemp("g") / f"a{FORMATS[name][0]}"
    params = random_params(n, coefficients, width, seed)
    lost = write_gaussians(path, imported(params), name)
    back = read_gaussians(path, width)
    geometry = [key for key in PARAMETERS if key not in ("features", "indicator_logits")]
    assert all(torch.equal(back.params[key], params[key]) for key in geometry)
    assert back.has_language == (name in ("vlgs", "feature3dgs", "langsplat"))
    if back.has_language:
        assert torch.equal(back.params["features"], params["features"])
    else:
        assert "language features" in lost
    if name == "vlgs":
        assert torch.equal(back.params["indicator_logits"], params["indicator_logits"])
    elif n:
        assert "indicators" in lost
    assert os.listdir(path.parent) == [path.name]


def reference_checkpoint(language: bool, extent: Any = 4.8) -> tuple[Any, int]:
    """As 3DGS's and LangSplat's `capture` build it, written down by hand: two Gaussians of degree 1."""
    xyz = nn.Parameter(torch.tensor([[1.0, 2, 3], [4, 5, 6]]))
    f_dc = nn.Parameter(torch.tensor([[[0.1, 0.2, 0.3]], [[0.4, 0.5, 0.6]]]))
    f_rest = nn.Parameter(torch.arange(18.0).reshape(2, 3, 3))
    scaling = nn.Parameter(torch.full((2, 3), -3.0))
    rotation = nn.Parameter(torch.tensor([[1.0, 0, 0, 0], [0, 0, 0, 2]]))
    opacity = nn.Parameter(torch.tensor([[0.5], [-0.5]]))
    feature = nn.Parameter(torch.tensor([[3.0, 0, 4], [0, 0, 0]]))
    trained = feature if language else xyz
    optimizer = torch.optim.Adam([{"params": [trained], "lr": 0.1, "name": "f"}], eps=1e-15)
    trained.sum().backward()
    optimizer.step()
    extra = (feature,) if language else ()
    statistics = (
        torch.zeros(2),
        torch.zeros(2, 1),
        torch.zeros(2, 1),
        optimizer.state_dict(),
        extent,
    )
    return (1, xyz, f_dc, f_rest, scaling, rotation, opacity, *extra, *statistics), 30_000


@pytest.mark.parametrize("language", [False, True])
@pytest.mark.parametrize("extent", [4.8, np.float64(4.8), np.float32(4.8)])
@pytest.mark.parametrize("zipped", [True, False])
def test_checkpoints_of_3dgs_and_langsplat_are_told_apart_by_length(
    tmp_path: Path, language: bool, extent: Any, zipped: bool
):
    content = reference_checkpoint(language, extent)
    torch.save(content, tmp_path / "chkpnt30000.pth", _use_new_zipfile_serialization=zipped)
    got = read_gaussians(tmp_path / "chkpnt30000.pth", feature_dim=3)
    assert got.langsplat == got.has_language == language
    values = content[0]
    assert torch.equal(got.params["means"], values[1])
    assert torch.equal(got.params["sh0"], values[2][:, 0])
    # Coefficient-major in a checkpoint, channel-major in a PLY.
    assert got.params["shN"][0, 1].tolist() == [3, 4, 5]
    assert got.params["opacity_logits"].tolist() == [0.5, -0.5]
    assert torch.equal(got.params["features"], values[7] if language else torch.zeros(2, 3))


@pytest.mark.parametrize("language", [False, True])
def test_a_written_checkpoint_is_what_the_systems_restore(tmp_path: Path, language: bool):
    params = random_params()
    write_gaussians(tmp_path / "c.pth", imported(params), "langsplat" if language else "3dgs")
    values, iteration = torch.load(tmp_path / "c.pth", weights_only=True)
    assert iteration == 30_000
    assert len(values) == 13 if language else 12
    assert values[0] == 3
    assert [tuple(v.shape) for v in values[1:7]] == [
        (5, 3),
        (5, 1, 3),
        (5, 15, 3),
        (5, 3),
        (5, 4),
        (5, 1),
    ]
    assert all(isinstance(v, nn.Parameter) for v in values[1 : 8 if language else 7])
    optimizer, extent = values[-2:]
    names = (
        ["language_feature"]
        if language
        else ["xyz", "f_dc", "f_rest", "scaling", "rotation", "opacity"]
    )
    assert [group["name"] for group in optimizer["param_groups"]] == names
    assert extent == 1.0
    assert [tuple(v.shape) for v in values[-5:-2]] == [(5,), (5, 1), (5, 1)]


class Payload:
    """What an attacker would pickle."""

    def __init__(self, flag: Path):
        self.flag = flag

    def __reduce__(self):
        return os.mkdir, (str(self.flag),)


@pytest.mark.parametrize(
    "wrap", [lambda p: p, lambda p: ((p,) * 12, 1), lambda p: {"encoder.0.weight": p}]
)
def test_a_pickle_that_runs_code_is_refused_and_not_run(tmp_path: Path, wrap: Any):
    flag = tmp_path / "ran"
    content = wrap(Payload(flag))
    torch.save(content, tmp_path / "new.pth")
    torch.save(content, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    (tmp_path / "raw.pth").write_bytes(pickle.dumps(content))
    for name in ("new.pth", "old.pth", "raw.pth"):
        with pytest.raises(ValueError, match="must hold only tensors and plain values"):
            load_plain(tmp_path / name)
        with pytest.raises(ValueError, match="must hold only tensors and plain values"):
            read_gaussians(tmp_path / name)
    assert not flag.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (3, r"must be \(values, iteration\), got int"),
        (((1,) * 11, 1), "must hold 12 values .* got a tuple of 11"),
        (((1,) * 12, 1), r"xyz must be floats \[n, 3\], got int"),
        (((1,) * 12, "x"), "iteration must be a whole number, got str"),
    ],
)
def test_other_content_is_refused_by_name(tmp_path: Path, content: Any, message: str):
    torch.save(content, tmp_path / "a.pth")
    with pytest.raises(ValueError, match=message):
        read_gaussians(tmp_path / "a.pth")


def test_a_value_of_another_shape_is_named(tmp_path: Path):
    values, iteration = reference_checkpoint(True)
    wrong = [*values]
    wrong[7] = torch.zeros(3, 3)
    torch.save((tuple(wrong), iteration), tmp_path / "a.pth")
    with pytest.raises(
        ValueError, match=r"language_feature must be floats \[2, n\], got torch.float32 \[3, 3\]"
    ):
        read_gaussians(tmp_path / "a.pth")


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_a_damaged_checkpoint_never_escapes_as_another_error(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
):
    path = tmp_path_factory.mktemp("c") / "a.pth"
    write_gaussians(path, imported(random_params(2, 0)), "3dgs")
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    else:
        del content[data.draw(st.integers(0, len(content) - 1)) :]
    path.write_bytes(content)
    try:
        read_gaussians(path)
    except ValueError as error:
        assert str(path) in str(error)  # noqa: PT017 (damage that changes no value is fine)


def test_feature_3dgs_calls_its_codes_semantic(tmp_path: Path):
    params = random_params(width=128)
    write_gaussians(tmp_path / "a.ply", imported(params), "feature3dgs")
    header = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")[0].decode()
    names = [line.split()[2] for line in header.splitlines() if line.startswith("property")]
    assert names[61:63] == ["rot_3", "semantic_0"]
    assert names[-1] == "semantic_127"
    assert torch.equal(read_ply(tmp_path / "a.ply")["features"], params["features"])


def test_a_splat_row_written_by_hand(tmp_path: Path):
    row = struct.pack("<6f8B", 1, -2, 3, 0.5, 1, 2, 255, 0, 51, 128, 255, 128, 128, 0)
    (tmp_path / "a.splat").write_bytes(row * 2)
    got = read_gaussians(tmp_path / "a.splat").params
    assert got["means"].tolist() == [[1, -2, 3]] * 2
    torch.testing.assert_close(got["log_scales"][0].exp(), torch.tensor([0.5, 1, 2]))
    color = 0.5 + 0.28209479 * got["sh0"][0]
    torch.testing.assert_close(color, torch.tensor([1, 0, 0.2]))
    torch.testing.assert_close(got["opacity_logits"][0].sigmoid(), torch.tensor(128 / 255))
    assert got["quats"][0].tolist() == [127 / 128, 0, 0, -1]
    assert got["shN"].shape == (2, 0, 3)


@given(
    rows=st.lists(
        st.tuples(*[st.floats(-1e3, 1e3, width=32)] * 3, *[st.floats(2**-10, 1e3, width=32)] * 3,
                  *[st.integers(0, 255)] * 4),
        min_size=1, max_size=8,
    ),
    seed=st.integers(0, 999),
)  # fmt: skip
@settings(max_examples=50, deadline=None)
def test_a_splat_file_that_goes_through_us_keeps_its_bytes(
    tmp_path_factory: pytest.TempPathFactory, rows: list, seed: int
):
    folder = tmp_path_factory.mktemp("s")
    quats = np.random.default_rng(seed).normal(size=(len(rows), 4))
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True) * 128 + 128
    quats = quats.clip(0, 255).astype(np.uint8)  # the usual converters cut, they do not round
    packed = [
        struct.pack("<6f4B", *row) + quat.tobytes() for row, quat in zip(rows, quats, strict=True)
    ]
    (folder / "a.splat").write_bytes(b"".join(packed))
    write_gaussians(folder / "b.splat", read_gaussians(folder / "a.splat"), "splat")
    before = np.frombuffer((folder / "a.splat").read_bytes(), np.uint8).reshape(-1, 32)
    after = np.frombuffer((folder / "b.splat").read_bytes(), np.uint8).reshape(-1, 32)
    np.testing.assert_array_equal(before[:, :12], after[:, :12])
    np.testing.assert_array_equal(before[:, 24:28], after[:, 24:28])
    np.testing.assert_array_equal(before[:, 28:], after[:, 28:])
    scales = [np.frombuffer(rows[:, 12:24].tobytes(), "<f4") for rows in (before, after)]
    np.testing.assert_allclose(*scales, rtol=2e-6)


def test_what_a_splat_keeps_of_gaussians(tmp_path: Path):
    params = random_params(200)
    lost = write_gaussians(tmp_path / "a.splat", imported(params), "splat")
    bright = "colours above 1, of 21 Gaussians"
    assert lost == (
        *("spherical harmonics above degree 0", bright),
        *("language features", "indicators"),
    )
    got = read_gaussians(tmp_path / "a.splat").params
    assert torch.equal(got["means"], params["means"])
    opacity = got["opacity_logits"].sigmoid() - params["opacity_logits"].sigmoid()
    assert opacity.abs().max() <= 0.5 / 255 + 1e-6
    colors = [(0.5 + 0.28209479 * p["sh0"]).clamp(0, 1) for p in (got, params)]
    assert (colors[0] - colors[1]).abs().max() <= 0.5 / 255 + 1e-6
    unit = [p["quats"] / p["quats"].norm(dim=1, keepdim=True) for p in (got, params)]
    assert (unit[0] - unit[1]).abs().max() <= 2 / 128


def test_broken_rows_are_counted_and_refused_or_dropped(tmp_path: Path):
    whole = struct.pack("<6f8B", 1, 2, 3, 1, 1, 1, 9, 9, 9, 9, 255, 128, 128, 128)
    padding = bytes(32)  # what a truncated export is filled with: scale 0
    lost = struct.pack("<6f8B", float("nan"), 2, 3, 1, 1, 1, 9, 9, 9, 9, 255, 128, 128, 128)
    turned = struct.pack("<6f8B", 1, 2, 3, 1, 1, 1, 9, 9, 9, 9, 128, 128, 128, 128)
    (tmp_path / "a.splat").write_bytes(whole + padding * 3 + lost + turned + whole)
    with pytest.raises(ValueError, match=r"a\.splat: means must be finite, got 1 of 7 rows"):
        read_gaussians(tmp_path / "a.splat")
    got = read_gaussians(tmp_path / "a.splat", drop=True)
    assert len(got.params["means"]) == 2
    assert got.dropped == {
        "means must be finite": 1, "log_scales must be finite": 3, "quats must not be zero": 1,
    }  # fmt: skip
    huge = struct.pack("<6f8B", 1, 2, 3, 1e30, 1, 1, 9, 9, 9, 9, 255, 128, 128, 128)
    (tmp_path / "h.splat").write_bytes(whole + huge)
    with pytest.raises(
        ValueError, match=r"h\.splat: log_scales must be at most 40, got 1 of 2 rows"
    ):
        read_gaussians(tmp_path / "h.splat")
    (tmp_path / "b.splat").write_bytes(whole + b"more")
    with pytest.raises(
        ValueError, match=r"must be rows of 32 bytes, got 36 bytes, 4 too many at byte 32"
    ):
        read_gaussians(tmp_path / "b.splat")


OURS = Path(__file__).parents[1] / "fixtures"
REAL = Path(__file__).parents[3] / "shared" / "data" / "splats"


@pytest.mark.parametrize(
    "source",
    [
        *(OURS / "gaussians.splat", OURS / "gaussians.ply"),
        *(REAL / "juleelee_model.splat", REAL / "kacytran_it7000.ply"),
    ],
    ids=lambda path: path.name,
)
def test_files_of_other_programs_go_through_every_format(tmp_path: Path, source: Path):
    if not source.exists():
        pytest.skip("needs the real data beside the checkout")
    read = read_gaussians(source, drop=True)
    for target in ("3dgs-ply", "3dgs", "splat"):
        path = tmp_path / f"a{FORMATS[target][0]}"
        write_gaussians(path, read, target)
        back = read_gaussians(path).params
        kept = ("means",) if target == "splat" else ("means", "quats", "sh0", "shN", "log_scales")
        assert all(torch.equal(back[key], read.params[key]) for key in kept)


def test_a_run_starts_from_any_of_these(tmp_path: Path):
    values, iteration = reference_checkpoint(True)
    torch.save((values, iteration), tmp_path / "a.pth")
    params = start_from(tmp_path / "a.pth", attributes_of(GaussiansConfig(sh_degree=2), 3))
    assert params["shN"].shape == (2, 8, 3)
    assert torch.equal(params["shN"][:, :3], values[3])
    assert (params["shN"][:, 3:] == 0).all()
    # LangSplat renders f / (|f| + 1e-9).
    feature = values[7].detach()
    rendered = feature / (feature.norm(dim=1, keepdim=True) + 1e-9)
    torch.testing.assert_close(params["features"], rendered)
    assert params["features"][0].tolist() != feature[0].tolist()
    assert start_from(tmp_path / "a.pth", attributes_of(GaussiansConfig(sh_degree=0), 8))[
        "features"
    ].shape == (2, 8)
    write_ply(tmp_path / "empty.ply", random_params(0))
    with pytest.raises(ValueError, match="must hold Gaussians, got none"):
        start_from(tmp_path / "empty.ply", attributes_of(GaussiansConfig(), 3))


def test_weights_of_a_codebook_come_back_as_they_were_drawn(tmp_path: Path):
    """A point cloud has codes after activation; a training that activates them once more would flatten them."""
    config = GaussiansConfig(codes="sparse", codes_kept=2)
    row = attributes_of(config, 10, parts=2)["features"]
    params = random_params(5)
    weights = row.activate(3 * torch.randn(5, 10, generator=torch.Generator().manual_seed(0)))
    write_ply(tmp_path / "drawn.ply", params | {"features": weights}, notes=(PLAIN,))
    started = start_from(tmp_path / "drawn.ply", attributes_of(config, 10, parts=2))["features"]
    torch.testing.assert_close(row.activate(started), weights, rtol=1e-6, atol=1e-7)
    assert (row.activate(started) > 0).sum() == 5 * 2 * 2
    assert not row.activate(weights).allclose(weights, atol=0.05)
    for codes in (
        -weights,
        weights * 1.1,
        torch.full((5, 10), 0.2),
        weights * (torch.arange(10) > 4),
    ):
        write_ply(tmp_path / "other.ply", params | {"features": codes}, notes=(PLAIN,))
        with pytest.raises(
            ValueError, match=r"weights of at most 2 entries .* in 5 of 5 Gaussians"
        ):
            start_from(tmp_path / "other.ply", attributes_of(config, 10, parts=2))
    write_ply(tmp_path / "none.ply", params | {"features": 0 * weights}, notes=(PLAIN,))
    without = start_from(tmp_path / "none.ply", attributes_of(config, 10, parts=2))["features"]
    assert not without.any(), "a file without language starts as any other"
