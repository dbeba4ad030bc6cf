"""Crops and vectors: worked by hand, and against transformers' own preprocessing."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_models import save_clip, save_sam, save_siglip

from vlgs.features.encoders import DenseMaps, ImageEncoder, square_crop
from vlgs.features.masks import Mask
from vlgs.features.superpixels import Superpixels
from vlgs.features.weights import Pretrained

CLIP = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"


def noise(height: int = 30, width: int = 40) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def test_a_crop_is_the_mask_alone_in_the_middle_of_a_black_square():
    image = noise()
    mask = Mask(5, 6, np.array([[True, False], [True, True], [True, True], [False, True]]))
    crop = square_crop(image, mask, 4, antialias=False)
    want = np.zeros((4, 4, 3), np.uint8)
    want[:, 1:3] = image[6:10, 5:7] * mask.pixels[..., None]
    np.testing.assert_allclose(crop.permute(1, 2, 0).numpy() * 255, want, atol=1e-4)


def test_averaging_lowers_the_noise_of_a_crop_that_shrinks():
    image, mask = noise(64, 64), Mask(0, 0, np.ones((64, 64), bool))
    plain, averaged = (square_crop(image, mask, 8, antialias=a) for a in (False, True))
    assert averaged.std() < 0.5 * plain.std()


def test_vectors_are_clips_own(weights: Path):
    pytest.importorskip("transformers")
    from transformers import CLIPModel

    image, mask = noise(), Mask(3, 2, np.ones((16, 16), bool))
    encoder = ImageEncoder(Pretrained(name=CLIP, weights=str(weights)), batch=2)
    got = encoder(image, [mask] * 5, "a")
    assert got.shape == (5, 12)
    clip = CLIPModel.from_pretrained(weights / "CLIP-ViT-B-16-laion2B-s34B-b88K").eval()
    pixels = torch.from_numpy(image[2:18, 3:19]).permute(2, 0, 1)[None] / 255
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    with torch.no_grad():
        tower = clip.vision_model((pixels - mean[:, None, None]) / std[:, None, None])
        want = clip.visual_projection(tower.pooler_output)
    np.testing.assert_allclose(got, want.expand(5, -1).numpy(), rtol=1e-4, atol=1e-5)
    assert encoder(image, [], "a").shape == (0, 12)


@pytest.mark.parametrize("kind", ["siglip", "dinov2"])
def test_other_towers_of_transformers_encode_too(tmp_path: Path, kind: str):
    import json

    pytest.importorskip("transformers")
    from transformers import Dinov2Config, Dinov2Model, SiglipConfig, SiglipModel

    small = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    vision = {**small, "image_size": 16, "patch_size": 4}
    if kind == "siglip":
        text = {**small, "intermediate_size": 16, "vocab_size": 8, "max_position_embeddings": 8}
        config = SiglipConfig(text_config=text, vision_config={**vision, "intermediate_size": 16})
        model = SiglipModel(config)
    else:
        model = Dinov2Model(Dinov2Config.from_dict(vision))
    model.save_pretrained(tmp_path / "model")
    settings = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3, "size": {"height": 16}}
    (tmp_path / "model" / "preprocessor_config.json").write_text(json.dumps(settings))
    encoder = ImageEncoder(Pretrained(name="lab/model", weights=str(tmp_path)))
    got = encoder(noise(), [Mask(0, 0, np.ones((9, 5), bool))], "a")
    assert got.shape == (1, 16)
    assert np.isfinite(got).all()


@pytest.mark.parametrize("layout", ["hwc", "chw"])
def test_dense_maps_are_averaged_over_the_mask(tmp_path: Path, layout: str):
    cells = np.random.default_rng(1).normal(size=(3, 4, 6)).astype(np.float32)
    np.save(tmp_path / "a.npy", cells if layout == "hwc" else cells.transpose(2, 0, 1))
    image = noise(6, 8)  # two by two pixels a cell
    mask = Mask(1, 0, np.array([[True, True], [True, True], [False, True]]))
    got = DenseMaps(str(tmp_path), layout=layout)(image, [mask], "a")
    want = (2 * cells[0, 0] + 2 * cells[0, 1] + cells[1, 1]) / 5
    np.testing.assert_allclose(got[0], want, rtol=1e-5)


def test_dense_maps_that_cannot_be_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="layout must be hwc or chw, got 'whc'"):
        DenseMaps(str(tmp_path), layout="whc")
    with pytest.raises(ValueError, match=r"pattern must contain \{stem\}"):
        DenseMaps(str(tmp_path), pattern="a.npy")
    maps = DenseMaps(str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"a\.npy must be the feature map of photograph a"):
        maps(noise(), [], "a")
    with pytest.raises(FileNotFoundError, match=r"a\{x\}\.npy must be the feature map"):
        DenseMaps(str(tmp_path), pattern="{stem}{x}.npy")(noise(), [], "a")
    np.save(tmp_path / "a.npy", np.zeros((3, 4)))
    with pytest.raises(ValueError, match=r"must be floats \[h, w, c\], got float64 \[3, 4\]"):
        maps(noise(), [], "a")


def test_superpixels_tile_the_photograph_and_follow_an_edge():
    image = np.full((40, 60, 3), 30, np.uint8)
    image[:, 33:] = 220  # not on a border of the grid's cells
    default, *levels = Superpixels(per_side=(12, 6, 3), compactness=1.0)(image)
    assert len(default) == sum(map(len, levels))
    assert [len(level) for level in levels] == sorted(map(len, levels), reverse=True)
    for level in levels:
        covered = np.zeros(image.shape[:2], int)
        for mask in level:
            covered[mask.window] += mask.pixels
            colors = image[mask.window][mask.pixels]
            assert len(np.unique(colors)) == 1  # none lies across the edge
        assert (covered == 1).all()


def test_siglip_of_many_sizes_is_refused(tmp_path: Path):
    save_siglip(tmp_path / "model", flexible=True)
    encoder = ImageEncoder(Pretrained(name="lab/model", weights=str(tmp_path)))
    with pytest.raises(ValueError, match=r"must take images of one size.*NaFlex"):
        encoder(noise(), [Mask(0, 0, np.ones((3, 3), bool))], "a")


def test_missing_weights_say_what_to_download_and_where(tmp_path: Path):
    encoder = ImageEncoder(Pretrained(name=CLIP, weights=str(tmp_path)))
    with pytest.raises(
        FileNotFoundError, match=r"no config\.json, no preprocessor_config\.json, no"
    ) as e:
        encoder.identity()
    assert f"hf download {CLIP}" in str(e.value)
    assert "features.weights=WEIGHTS" in str(e.value)


def test_weights_that_are_no_model_are_refused(tmp_path: Path):
    pytest.importorskip("transformers")
    folder = tmp_path / "model"
    folder.mkdir()
    settings = '{"image_mean": [0,0,0], "image_std": [1,1,1], "size": 4}'
    (folder / "preprocessor_config.json").write_text(settings)
    (folder / "config.json").write_text('{"model_type": "clip"}')
    (folder / "model.safetensors").write_bytes(b"nothing")
    encoder = ImageEncoder(Pretrained(name="lab/model", weights=str(tmp_path)))
    with pytest.raises(ValueError, match="files must be a whole model of lab/model"):
        encoder(noise(), [Mask(0, 0, np.ones((1, 1), bool))], "a")


@pytest.mark.parametrize(
    ("model", "part"),
    [("clip", "vision_model"), ("clip", "text_projection"), ("sam", "mask_decoder")],
)
def test_weights_that_lack_a_part_are_refused(tmp_path: Path, model: str, part: str):
    pytest.importorskip("transformers")
    from transformers import AutoModel, SamModel

    {"clip": save_clip, "sam": save_sam}[model](tmp_path / model)
    pretrained = Pretrained(name=f"lab/{model}", weights=str(tmp_path))
    kind = {"clip": AutoModel, "sam": SamModel}[model]
    pretrained.load(kind)  # weights that are tied or computed are in no file
    file = tmp_path / model / "model.safetensors"
    held = {name: rows for name, rows in load_file(file).items() if not name.startswith(part)}
    save_file(held, file, metadata={"format": "pt"})
    with pytest.raises(ValueError, match=rf"a whole model of lab/{model}, got no weights {part}"):
        pretrained.load(kind)


def test_a_missing_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr("vlgs.extras.find_spec", lambda _: None)
    encoder = ImageEncoder(Pretrained(name="lab/model", weights=str(tmp_path)))
    with pytest.raises(ValueError, match=r"transformers: must be installed.*vlgs\[features\]"):
        encoder(noise(), [Mask(0, 0, np.ones((1, 1), bool))], "a")
    with pytest.raises(ValueError, match=r"huggingface_hub: must be installed.*vlgs\[features\]"):
        ImageEncoder(Pretrained(name="lab/model")).identity()
