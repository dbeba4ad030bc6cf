"""SAM and CLIP of a few thousand random weights, in a folder laid out as the real ones are."""

import json
from pathlib import Path

import pytest
import torch

MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]


def save_sam(folder: Path) -> None:
    pytest.importorskip("transformers")
    from transformers import SamConfig, SamModel

    config = SamConfig(
        vision_config={
            "hidden_size": 16, "output_channels": 16, "num_hidden_layers": 1, "num_attention_heads": 2,
            "image_size": 64, "patch_size": 8, "window_size": 4, "global_attn_indexes": [0],
            "num_pos_feats": 8, "mlp_dim": 16, "initializer_range": 0.5,
        },
        prompt_encoder_config={
            "hidden_size": 16, "image_size": 64, "patch_size": 8, "mask_input_channels": 4,
        },
        mask_decoder_config={
            "hidden_size": 16, "mlp_dim": 16, "num_attention_heads": 2, "iou_head_hidden_dim": 16,
        },
    )  # fmt: skip
    model = SamModel(config)
    with torch.no_grad():  # the usual initial weights give masks that are the same everywhere
        for name, parameter in model.named_parameters():
            if parameter.ndim > 1:
                gain = 40.0 if "hypernetworks" in name and "proj_out" in name else 3.0
                parameter.copy_(torch.randn(parameter.shape) * gain / parameter[0].numel() ** 0.5)
    model.save_pretrained(folder)
    settings = {"image_mean": MEAN, "image_std": STD, "size": {"longest_edge": 64}}
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))


def save_clip(folder: Path) -> None:
    pytest.importorskip("transformers")
    from transformers import CLIPConfig, CLIPModel, CLIPTokenizer

    letters = [chr(c) for c in range(ord("a"), ord("z") + 1)]
    tokens = [*letters, *(f"{c}</w>" for c in letters), "<|startoftext|>", "<|endoftext|>"]
    tokenizer = CLIPTokenizer(vocab={t: i for i, t in enumerate(tokens)}, merges=[])
    tokenizer.save_pretrained(folder)
    small = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1}
    config = CLIPConfig(
        text_config={
            **small, "num_attention_heads": 2, "vocab_size": len(tokens),
            "bos_token_id": 52, "eos_token_id": 53, "pad_token_id": 53,
        },
        vision_config={**small, "num_attention_heads": 2, "image_size": 16, "patch_size": 4},
        projection_dim=12,
    )  # fmt: skip
    CLIPModel(config).save_pretrained(folder)
    settings = {"image_mean": MEAN, "image_std": STD, "crop_size": {"height": 16, "width": 16}}
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))


def save_siglip(folder: Path, flexible: bool = False) -> None:
    """SigLIP 2: of one image size, which transformers calls siglip, or its flexible kind, siglip2."""
    pytest.importorskip("transformers")
    from transformers import (
        Siglip2Config,
        Siglip2Model,
        Siglip2Tokenizer,
        SiglipConfig,
        SiglipModel,
    )

    letters = [chr(c) for c in range(ord("a"), ord("z") + 1)]
    tokens = ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>", "▁", *letters]
    tokenizer = Siglip2Tokenizer(vocab={t: i for i, t in enumerate(tokens)}, merges=[])
    tokenizer.save_pretrained(folder)
    small = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1}
    text = {
        **small, "num_attention_heads": 2, "vocab_size": len(tokens), "max_position_embeddings": 20,
        "projection_size": 16,
    }  # fmt: skip
    vision = {**small, "num_attention_heads": 2, "patch_size": 4}
    if flexible:
        vision["num_patches"] = 16
        model = Siglip2Model(Siglip2Config(text_config=text, vision_config=vision))
    else:
        vision["image_size"] = 16
        model = SiglipModel(SiglipConfig(text_config=text, vision_config=vision))
    with torch.no_grad():  # embeddings start so small that all words are one
        model.text_model.embeddings.token_embedding.weight.normal_()
    model.save_pretrained(folder)
    settings = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3, "size": {"height": 16}}
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))


def save_models(folder: Path) -> Path:
    """Both, under the names that `vlgs.features` looks for."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        save_sam(folder / "sam-vit-huge")
        save_clip(folder / "CLIP-ViT-B-16-laion2B-s34B-b88K")
    return folder
