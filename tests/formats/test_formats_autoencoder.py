"""LangSplat's autoencoder is ours, and its language maps are compressed by it."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn.functional import normalize

from vlgs.convert import convert
from vlgs.data.language import find_mask_files, read_mask_ids, read_mask_vectors, write_mask_files
from vlgs.formats import (
    compress_language,
    load_weights,
    read_autoencoder,
    write_autoencoder,
)
from vlgs.heads.autoencoder import Autoencoder, AutoencoderTraining


class LangSplats(nn.Module):
    """LangSplat's network, layer by layer: linear, then batch norm, ReLU and linear; the decoder without batch norm."""

    def __init__(self, encoder=(256, 128, 64, 32, 3), decoder=(16, 32, 64, 128, 256, 256, 512)):
        super().__init__()
        layers: list[nn.Module] = []
        for i, width in enumerate(encoder):
            before = 512 if i == 0 else encoder[i - 1]
            if i:
                layers += [nn.BatchNorm1d(before), nn.ReLU()]
            layers.append(nn.Linear(before, width))
        self.encoder = nn.ModuleList(layers)
        layers = []
        for i, width in enumerate(decoder):
            before = encoder[-1] if i == 0 else decoder[i - 1]
            if i:
                layers.append(nn.ReLU())
            layers.append(nn.Linear(before, width))
        self.decoder = nn.ModuleList(layers)

    def encode(self, x):
        for layer in self.encoder:
            x = layer(x)
        return normalize(x, dim=-1)

    def decode(self, x):
        for layer in self.decoder:
            x = layer(x)
        return normalize(x, dim=-1)


def trained() -> LangSplats:
    """With running statistics that are not the initial ones."""
    torch.manual_seed(0)
    net = LangSplats()
    with torch.no_grad():
        net.encode(torch.randn(64, 512))
    return net.eval()


def embeddings(n: int = 40) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return normalize(torch.randn(n, 512, generator=generator) + 1.5, dim=1)


def test_langsplats_weights_give_langsplats_codes(tmp_path: Path):
    net = trained()
    torch.save(net.state_dict(), tmp_path / "best_ckpt.pth")
    head = read_autoencoder(tmp_path / "best_ckpt.pth")
    assert (head.dim, head.encoder_widths) == (3, (256, 128, 64, 32))
    assert head.decoder_widths == (16, 32, 64, 128, 256, 256)
    x = embeddings()
    with torch.no_grad():
        assert torch.equal(head.encode(x), net.encode(x))
        codes = torch.randn(7, 3)  # blends of codes are not normalised before decoding
        assert torch.equal(head.decode(codes), net.decode(codes))


@pytest.mark.parametrize("center", [False, True])
def test_our_weights_are_langsplats(tmp_path: Path, center: bool):
    head = Autoencoder(center=center, training=AutoencoderTraining(steps=20))
    x = embeddings()
    head.fit(x, torch.ones(len(x)))
    write_autoencoder(tmp_path / "best_ckpt.pth", head)
    net = LangSplats().eval()
    net.load_state_dict(torch.load(tmp_path / "best_ckpt.pth", weights_only=True))  # strict
    with torch.no_grad():
        # The mean moves into the biases: 512 products summed in another order.
        torch.testing.assert_close(net.encode(x), head.encode(x), atol=2e-5, rtol=0)
        codes = head.encode(x)
        torch.testing.assert_close(net.decode(codes), head.decode(codes), atol=2e-6, rtol=0)


def test_other_widths_and_our_own_file_come_back(tmp_path: Path):
    head = Autoencoder(4, (32,), (16, 8), training=AutoencoderTraining(steps=20))
    head.fit(embeddings(), torch.ones(40))
    write_autoencoder(tmp_path / "a.pth", head)
    convert(tmp_path / "a.pth", tmp_path / "a.safetensors")
    back = read_autoencoder(tmp_path / "a.safetensors")
    assert (back.dim, back.encoder_widths, back.decoder_widths) == (4, (32,), (16, 8))
    convert(tmp_path / "a.safetensors", tmp_path / "b.pth")
    before, after = (torch.load(tmp_path / n, weights_only=True) for n in ("a.pth", "b.pth"))
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_a_head_takes_weights_in_place_of_a_fit(tmp_path: Path):
    net = trained()
    torch.save(net.state_dict(), tmp_path / "best_ckpt.pth")
    head = Autoencoder(weights=str(tmp_path / "best_ckpt.pth"))
    load_weights(head, tmp_path / "best_ckpt.pth")
    with torch.no_grad():
        assert torch.equal(head.encode(embeddings()), net.encode(embeddings()))
    with pytest.raises(
        ValueError, match=r"widths must be \(\(8,\), 3, \(8,\)\) as configured, got"
    ):
        load_weights(Autoencoder(3, (8,), (8,)), tmp_path / "best_ckpt.pth")


def test_weights_that_do_not_fit_are_named(tmp_path: Path):
    def fails(state: object, message: str) -> None:
        torch.save(state, tmp_path / "a.pth")
        with pytest.raises(ValueError, match=message):
            read_autoencoder(tmp_path / "a.pth")

    state = trained().state_dict()
    fails([1], "must be a state dict of tensors, got a list")
    fails({}, "of two layers or more, got 0 and 0 widths")
    fails({**state, "decoder.0.weight": torch.zeros(16, 5)}, "decoder must undo")
    fails(
        {k: v for k, v in state.items() if k != "encoder.1.running_mean"}, "encoder.1.running_mean"
    )
    fails(
        {**state, "encoder.3.bias": torch.full((128,), torch.nan)}, r"finite, got encoder\.3\.bias"
    )
    with pytest.raises(FileNotFoundError, match="file must exist"):
        read_autoencoder(tmp_path / "none.pth")


def write_view(folder: Path, stem: str) -> tuple[np.ndarray, np.ndarray]:
    """Two masks a level, ids that run on from level to level, and a hole."""
    ids = np.repeat(np.arange(8).reshape(4, 2, 1), 3, axis=2).astype(np.float32)
    ids[:, 0, 0] = -1
    vectors = embeddings(8).numpy()
    write_mask_files(folder, stem, ids, vectors)
    return ids, vectors


def test_language_files_are_langsplats(tmp_path: Path):
    ids, vectors = write_view(tmp_path, "frame_00001")
    raw_ids, raw = (np.load(tmp_path / f"frame_00001_{suffix}.npy") for suffix in "sf")
    assert (raw_ids.dtype, raw_ids.shape, raw.dtype, raw.shape) == (
        np.float32,
        (4, 2, 3),
        np.float32,
        (8, 512),
    )
    np.testing.assert_array_equal(raw_ids, ids)
    np.testing.assert_array_equal(raw, vectors)
    files = find_mask_files(tmp_path, "frame_00001")
    assert files is not None
    # Level 2 begins after the rows of levels 0 and 1; -1 stays -1 and never means the last row.
    assert read_mask_ids(files, 2, 8).tolist() == [[-1, 4, 4], [5, 5, 5]]


def test_language_maps_become_dim3(tmp_path: Path):
    source, target = tmp_path / "language_features", tmp_path / "language_features_dim3"
    source.mkdir()
    views = {stem: write_view(source, stem) for stem in ("frame_00001", "frame_00002")}
    net = trained()
    torch.save(net.state_dict(), tmp_path / "best_ckpt.pth")
    (line,) = convert(source, target, head=tmp_path / "best_ckpt.pth")
    assert line.endswith("language codes of 2 views")
    for stem, (ids, vectors) in views.items():
        np.testing.assert_array_equal(np.load(target / f"{stem}_s.npy"), ids)
        with torch.no_grad():
            codes = net.encode(torch.from_numpy(vectors)).numpy()
        np.testing.assert_allclose(np.load(target / f"{stem}_f.npy"), codes, atol=1e-6)
        files = find_mask_files(target, stem)
        assert files is not None
        assert read_mask_vectors(files).shape == (8, 3)


def test_faults_of_language_folders(tmp_path: Path):
    head = Autoencoder(3, (8,), (8,), training=AutoencoderTraining(steps=20))
    head.fit(normalize(torch.randn(9, 16), dim=1), torch.ones(9))
    with pytest.raises(
        FileNotFoundError, match=r"must hold <stem>_s\.npy and <stem>_f\.npy, got nothing"
    ):
        compress_language(tmp_path, tmp_path / "out", head)
    write_view(tmp_path, "a")
    with pytest.raises(ValueError, match="vectors must be as wide as the autoencoder's input"):
        compress_language(tmp_path, tmp_path / "out", head)
    (tmp_path / "a_f.npy").unlink()
    with pytest.raises(FileNotFoundError, match="got a of it"):
        compress_language(tmp_path, tmp_path / "out", head)
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    write_view(tmp_path / "out", "b")
    write_view(tmp_path, "a")
    with pytest.raises(ValueError, match="OUT must be a new or empty folder"):
        compress_language(tmp_path, tmp_path / "out", head)
