"""The compressed PLY of PlayCanvas and SuperSplat, decoded here bit by bit."""

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from vlgs.convert import convert
from vlgs.formats import Imported, write_gaussians
from vlgs.formats.compressed import morton_order, write_compressed
from vlgs.gaussians import write_ply

C0 = 0.28209479177387814


def some_gaussians(n: int, harmonics: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(n)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    return {
        "means": 3 * draw(n, 3),
        "quats": draw(n, 4),
        "log_scales": draw(n, 3) - 2,
        "sh0": draw(n, 3),
        "shN": draw(n, harmonics, 3).clamp(-3.9, 3.9),
        "opacity_logits": 2 * draw(n),
        "indicator_logits": draw(n),
        "features": torch.zeros(n, 3),
    }


def decoded(path: Path) -> tuple[list[str], list[dict[str, list[float]]]]:
    """The header's lines, and what each Gaussian is: the format as PlayCanvas's engine reads it."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    counts = {
        line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element ")
    }
    width = sum(line.startswith("property uchar f_rest_") for line in lines)
    chunks = list(struct.iter_unpack("<18f", body[: 72 * counts["chunk"]]))
    body = body[72 * counts["chunk"] :]
    words = list(struct.iter_unpack("<4I", body[: 16 * counts["vertex"]]))
    rest = body[16 * counts["vertex"] :]
    assert len(rest) == width * counts["vertex"]
    gaussians = []
    for index, (position, rotation, scale, color) in enumerate(words):
        chunk = chunks[index // 256]

        def three(word: int, at: int, chunk: tuple[float, ...] = chunk) -> list[float]:
            shares = [(word >> 21) / 2047, (word >> 11 & 1023) / 1023, (word & 2047) / 2047]
            return [
                chunk[at + k] + (chunk[at + 3 + k] - chunk[at + k]) * shares[k] for k in range(3)
            ]

        others = [((rotation >> shift & 1023) / 1023 - 0.5) * 2**0.5 for shift in (20, 10, 0)]
        others.insert(rotation >> 30, max(0.0, 1 - sum(o * o for o in others)) ** 0.5)
        rgb = [(color >> shift & 255) / 255 for shift in (24, 16, 8)]
        own = rest[width * index : width * (index + 1)]
        gaussians.append({
            "mean": three(position, 0),
            "quat": others,
            "log_scale": three(scale, 6),
            "sh0": [(chunk[12 + k] + (chunk[15 + k] - chunk[12 + k]) * rgb[k] - 0.5) / C0 for k in range(3)],
            "opacity": [(color & 255) / 255],
            "rest": [((byte + 0.5) / 256 - 0.5) * 8 for byte in own],
        })  # fmt: skip
    return lines, gaussians


@pytest.mark.parametrize(("n", "harmonics"), [(1, 0), (256, 3), (700, 15)])
def test_what_is_read_back_is_off_by_half_a_step_at_most(tmp_path: Path, n: int, harmonics: int):
    params = some_gaussians(n, harmonics)
    write_compressed(tmp_path / "a.compressed.ply", params)
    _, gaussians = decoded(tmp_path / "a.compressed.ply")
    rows = morton_order(params["means"])
    sorted_ = {
        name: value[torch.from_numpy(rows)].double().numpy() for name, value in params.items()
    }
    got = {name: np.array([g[name] for g in gaussians]) for name in gaussians[0]}
    for start in range(0, n, 256):
        own = slice(start, start + 256)
        for name, ours, steps in (
            ("mean", "means", (2047, 1023, 2047)),
            ("log_scale", "log_scales", (2047, 1023, 2047)),
            ("sh0", "sh0", (255, 255, 255)),
        ):
            want = sorted_[ours][own]
            half = np.ptp(want, axis=0) / np.array(steps) / 2 + 1e-6
            assert (np.abs(got[name][own] - want) <= half).all(), name
    opacity = 1 / (1 + np.exp(-sorted_["opacity_logits"]))
    assert np.abs(got["opacity"][:, 0] - opacity).max() <= 0.5 / 255 + 1e-9
    want = sorted_["quats"] / np.linalg.norm(sorted_["quats"], axis=1, keepdims=True)
    assert np.abs((got["quat"] * want).sum(axis=1)).min() > 1 - 2e-6
    if harmonics:
        want = sorted_["shN"].transpose(0, 2, 1).reshape(n, -1)  # all of red, of green, of blue
        assert np.abs(got["rest"] - want).max() <= 4 / 256 + 1e-9


def test_one_gaussian_by_hand(tmp_path: Path):
    params = some_gaussians(2, 0)
    params["means"] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 4.0]])
    # Half a turn about x, written with the other sign; then the identity.
    params["quats"] = torch.tensor([[0.0, -3.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]])
    params["log_scales"] = torch.tensor([[0.0, 0.0, 30.0], [0.0, -1.0, 0.0]])
    params["sh0"] = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]) / C0
    params["opacity_logits"] = torch.tensor([100.0, 0.0])
    write_compressed(tmp_path / "a.compressed.ply", params)
    data = (tmp_path / "a.compressed.ply").read_bytes().partition(b"end_header\n")[2]
    bounds = [0, 0, 0, 1, 2, 4, 0, -1, 0, 0, 0, 20, 0.5, 0.5, 0.5, 0.5, 1.5, 0.5]
    assert struct.unpack("<18f", data[:72]) == pytest.approx(bounds)
    middle = 512 << 20 | 512 << 10 | 512
    first = (0, 1 << 30 | middle, 1023 << 11 | 2047, 255 << 16 | 255)
    second = (2047 << 21 | 1023 << 11 | 2047, middle, 0, 128)
    assert list(struct.iter_unpack("<4I", data[72:])) == [first, second]


def test_the_header_is_what_readers_look_for(tmp_path: Path):
    params = some_gaussians(300, 3)
    imported = Imported(params, True, False, {})
    lost = write_gaussians(tmp_path / "a.compressed.ply", imported, "compressed-ply")
    assert lost == ("language features", "indicators")
    lines, _ = decoded(tmp_path / "a.compressed.ply")
    bounds = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    scales = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
    colors = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
    packed = ("position", "rotation", "scale", "color")
    assert lines == [
        "ply",
        "format binary_little_endian 1.0",
        "element chunk 2",
        *(f"property float {name}" for name in (*bounds, *scales, *colors)),
        "element vertex 300",
        *(f"property uint packed_{name}" for name in packed),
        "element sh 300",
        *(f"property uchar f_rest_{k}" for k in range(9)),
    ]


def test_convert_writes_it_by_its_suffix(tmp_path: Path):
    write_ply(tmp_path / "a.ply", some_gaussians(5, 0))
    said = convert(tmp_path / "a.ply", tmp_path / "b.compressed.ply")
    assert said[0].endswith(
        "b.compressed.ply: 5 Gaussians as PlayCanvas's compressed PLY, 16 bytes a Gaussian"
    )
    assert len(decoded(tmp_path / "b.compressed.ply")[1]) == 5


def test_no_gaussian_is_a_file_without_rows(tmp_path: Path):
    write_compressed(tmp_path / "a.compressed.ply", some_gaussians(0, 3))
    lines, gaussians = decoded(tmp_path / "a.compressed.ply")
    assert gaussians == []
    assert {"element chunk 0", "element vertex 0", "element sh 0"} <= set(lines)
