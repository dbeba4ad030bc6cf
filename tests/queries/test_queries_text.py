"""Words to vectors: tables with helpful errors, and CLIP's text tower on tiny random weights without a network."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_models import save_clip, save_siglip

from vlgs.queries import LerfRelevancy, TextEncoder, VocabSoftmax, encode_prompts
from vlgs.queries.text import ClipText, VocabularyText
from vlgs.types import Vocabulary

WORDS = ("wine glass", "steel kettle", "red apple", "Pikachu")


def table(names: tuple[str, ...] = WORDS) -> Vocabulary:
    return Vocabulary(names, torch.eye(len(names), 8))


def test_vocabulary_gives_rows_in_the_order_asked():
    got = VocabularyText(table()).encode(["red apple", "wine glass", "red apple"])
    assert torch.equal(got, torch.eye(4, 8)[[2, 0, 2]])


def test_unknown_word_is_named_with_close_matches_and_all_words():
    with pytest.raises(
        ValueError, match=r"got 'pikachu' and 1 more \(did you mean 'Pikachu'\?\)"
    ) as e:
        VocabularyText(table()).encode(["pikachu", "red apple", "zzz"])
    assert "it has: wine glass, steel kettle, red apple, Pikachu" in str(e.value)


def test_long_vocabulary_is_cut():
    names = tuple(f"word{i}" for i in range(300))
    with pytest.raises(ValueError, match=r"word19, \.\.\. \(300 words\)$"):
        VocabularyText(Vocabulary(names, torch.ones(300, 2))).encode(["zzz"])


def test_scene_without_vocabulary_says_what_to_do():
    with pytest.raises(ValueError, match=r"set data\.vocabulary=<file> or text=clip"):
        VocabularyText(None).encode(["red apple"])


def test_prompts_come_with_the_negatives_of_the_query():
    negatives = ("object", "things", "stuff", "texture")
    got = encode_prompts(LerfRelevancy(), VocabularyText(table(WORDS + negatives)), WORDS)
    assert got.names == WORDS
    assert torch.equal(torch.cat([got.text, got.negatives]), torch.eye(8))
    assert encode_prompts(VocabSoftmax(), VocabularyText(table()), WORDS).negatives.shape == (0, 8)


def test_missing_negatives_point_to_the_query_without_any():
    with pytest.raises(ValueError, match=r"'object' and 3 more.*query=vocab_softmax"):
        encode_prompts(LerfRelevancy(), VocabularyText(table()), WORDS)


def test_a_missing_prompt_is_not_blamed_on_the_negatives():
    with pytest.raises(ValueError, match="got 'zebra'") as e:
        encode_prompts(LerfRelevancy(), VocabularyText(table()), ["zebra"])
    assert "vocab_softmax" not in str(e.value)


def test_no_prompts_are_refused():
    with pytest.raises(ValueError, match="at least one word"):
        encode_prompts(VocabSoftmax(), VocabularyText(table()), [])


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A CLIP model of a few thousand random weights and a tokenizer of single letters."""
    folder = tmp_path_factory.mktemp("clip")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        save_clip(folder)
    return folder


def test_clip_gives_projected_unit_vectors(clip_folder: Path):
    encoder = ClipText(model=str(clip_folder))
    got = encoder.encode(["apple", "wine glass"])
    assert got.shape == (2, 12)  # the projection's width, not the tower's
    torch.testing.assert_close(got.norm(dim=-1), torch.ones(2))
    torch.testing.assert_close(encoder.encode(["apple"])[0], got[0])  # padding leaves no trace
    assert (got[0] - got[1]).abs().max() > 1e-3
    assert not got.requires_grad


def test_clip_agrees_with_the_towers_own_parts(clip_folder: Path):
    pytest.importorskip("transformers")
    from transformers import CLIPModel, CLIPTokenizer

    clip = CLIPModel.from_pretrained(clip_folder).eval()
    tokens = CLIPTokenizer.from_pretrained(clip_folder)(["apple"], return_tensors="pt")
    with torch.no_grad():
        projected = clip.text_projection(clip.text_model(**tokens).pooler_output)
    want = torch.nn.functional.normalize(projected, dim=-1)
    torch.testing.assert_close(ClipText(model=str(clip_folder)).encode(["apple"]), want)


def test_clip_of_another_width_than_the_scene_is_refused(clip_folder: Path):
    with pytest.raises(ValueError, match=r"as wide as the scene's vocabulary \(8\), got 12"):
        ClipText(table(), str(clip_folder)).encode(["apple"])


@pytest.mark.parametrize("flexible", [False, True])
def test_siglip_pools_the_last_of_a_full_row_of_lower_case(tmp_path: Path, flexible: bool):
    pytest.importorskip("transformers")
    from transformers import AutoModel, AutoTokenizer

    save_siglip(tmp_path, flexible)
    encoder = ClipText(model=str(tmp_path))
    got = encoder.encode(["Apple", "wine glass"])
    assert got.shape == (2, 16)
    torch.testing.assert_close(encoder.encode(["apple"])[0], got[0])  # lower case, and no batch
    assert (got[0] - got[1]).abs().max() > 1e-3
    ids = AutoTokenizer.from_pretrained(tmp_path)("apple")["input_ids"]
    row = torch.tensor([ids + [0] * (20 - len(ids))])  # the padding is a token like others
    tower = AutoModel.from_pretrained(tmp_path).eval().text_model
    with torch.no_grad():
        want = tower(input_ids=row).pooler_output
    torch.testing.assert_close(got[:1], torch.nn.functional.normalize(want, dim=-1))


def test_a_model_without_words_is_refused(tmp_path: Path):
    pytest.importorskip("transformers")
    from transformers import Dinov2Config, Dinov2Model

    save_clip(tmp_path)  # its tokenizer stays
    small = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "image_size": 16}
    Dinov2Model(Dinov2Config.from_dict({**small, "patch_size": 4})).save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=r"must have a text tower .* got a dinov2"):
        ClipText(model=str(tmp_path)).encode(["apple"])


def test_missing_weights_are_explained(tmp_path: Path):
    pytest.importorskip("transformers")
    encoder = ClipText(model=str(tmp_path / "nothing"))  # loads nothing before it is asked
    with pytest.raises(FileNotFoundError, match=r"text\.model=<folder"):
        encoder.encode(["apple"])


@pytest.mark.parametrize("kept", [(), ("vocab.json",), ("tokenizer_config.json",)])
def test_a_folder_without_a_tokenizer_is_refused(tmp_path: Path, kept: tuple[str, ...]):
    save_clip(tmp_path)
    for name in {"tokenizer.json", "tokenizer_config.json"} - set(kept):
        (tmp_path / name).unlink()
    if "vocab.json" in kept:  # without merges.txt
        (tmp_path / "vocab.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match=r"got no tokenizer\.json;") as e:
        ClipText(model=str(tmp_path)).encode(["mug", "bear"])
    assert str(e.value).startswith(f"text: {tmp_path} must hold config.json")


def test_a_tokenizer_of_two_files_will_do(tmp_path: Path):
    save_clip(tmp_path)
    want = ClipText(model=str(tmp_path)).encode(["mug", "bear"])
    file = tmp_path / "tokenizer.json"
    vocabulary = json.loads(file.read_text())["model"]["vocab"]
    (tmp_path / "vocab.json").write_text(json.dumps(vocabulary))
    (tmp_path / "merges.txt").write_text("#version: 0.2\n")
    file.unlink()
    torch.testing.assert_close(ClipText(model=str(tmp_path)).encode(["mug", "bear"]), want)


def test_weights_that_lack_a_tower_are_refused(tmp_path: Path):
    save_clip(tmp_path)
    file = tmp_path / "model.safetensors"
    whole = load_file(file)
    held = {name: rows for name, rows in whole.items() if not name.startswith("text")}
    save_file(held, file, metadata={"format": "pt"})
    first = "text_model.embeddings.position_embedding.weight"
    with pytest.raises(ValueError, match=f"must be a whole model, got no weights {first} and 20 m"):
        ClipText(model=str(tmp_path)).encode(["mug"])
    numbers = {"text_model.embeddings.position_ids": torch.arange(77)[None]}  # of older files
    save_file(whole | numbers, file, metadata={"format": "pt"})
    assert ClipText(model=str(tmp_path)).encode(["mug"]).shape == (1, 12)


def half(content: bytes) -> bytes:
    return content[: len(content) // 2]


def wider(content: bytes) -> bytes:
    config = json.loads(content)
    config["text_config"]["hidden_size"] = 32
    return json.dumps(config).encode()


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("model.safetensors", half),
        ("model.safetensors", lambda _: b""),
        ("config.json", half),
        ("config.json", wider),
        ("config.json", lambda _: b"[]"),
        ("config.json", lambda _: b'{"model_type": "nosuch"}'),
        ("config.json", lambda _: b'{"model_type": "clip", "projection_dim": "wide"}'),
        ("tokenizer.json", half),
        ("tokenizer.json", lambda _: b"{}"),
        ("tokenizer.json", lambda _: b"null"),
        ("tokenizer_config.json", half),
        ("pytorch_model.bin", lambda _: b""),
        ("pytorch_model.bin", lambda _: b'cos\nsystem\n(S"true"\ntR.'),
    ],
)
def test_damaged_files_are_one_error(tmp_path: Path, name: str, damage: Callable[[bytes], bytes]):
    save_clip(tmp_path)
    file = tmp_path / name
    if name.endswith(".bin"):
        (tmp_path / "model.safetensors").rename(file)
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(ValueError, match=r": files must be a .*model.*, got \w+:") as e:
        ClipText(model=str(tmp_path)).encode(["mug"])
    assert str(e.value).startswith(str(tmp_path))
    assert "\n" not in str(e.value)


def test_encoders_keep_the_contract():
    assert isinstance(VocabularyText(table()), TextEncoder)
    assert isinstance(ClipText(), TextEncoder)
