"""From words to text embeddings: a table of known words, or the text tower of CLIP or SigLIP."""

import difflib
import pickle
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.extras import require_extra
from vlgs.text import visible
from vlgs.types import Vocabulary

CLIP_MODEL = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"
"""The weights of LERF and LangSplat (OpenCLIP ViT-B-16, laion2b_s34b_b88k), as Hugging Face names them."""

_TOKENIZERS = (
    ("tokenizer.json",),
    ("vocab.json", "merges.txt"),
    ("vocab.txt",),
    ("spiece.model",),
    ("tokenizer.model",),
)
"""Files that a tokenizer is read from: all of one line."""


@runtime_checkable
class TextEncoder(Protocol):
    """The interface of a text encoder: words to unit vectors. Options under conf/text are called with ``vocabulary=scene.vocabulary``."""

    def encode(self, names: Sequence[str]) -> Float[Tensor, "k e"]:
        """One unit vector per word, in the order given.

        Raises:
            ValueError: If a word cannot be encoded.
        """
        ...


class VocabularyText:
    """Looks words up in a vocabulary; needs no network and no weights.

    Args:
        vocabulary: Words and vectors, usually `Scene.vocabulary`; None is an encoder that knows no word and says so.
    """

    def __init__(self, vocabulary: Vocabulary | None) -> None:
        self.vocabulary = vocabulary
        self._row = {n: i for i, n in enumerate(vocabulary.names)} if vocabulary else {}

    def encode(self, names: Sequence[str]) -> Float[Tensor, "k e"]:
        """Vectors of known words; a word must be spelled as the vocabulary has it.

        Raises:
            ValueError: If a word is unknown; the error names it, close matches and what there is.
        """
        if self.vocabulary is None:
            raise ValueError(
                "text: the scene must bring a vocabulary, got none; set data.vocabulary=<file> or text=clip"
            )
        unknown = [name for name in names if name not in self._row]
        if unknown:
            raise ValueError(self._explain(unknown))
        return self.vocabulary.vectors[[self._row[name] for name in names]]

    def _explain(self, unknown: list[str]) -> str:
        known = tuple(self._row)
        folded = {name.casefold(): name for name in known}
        close = [
            folded[match]
            for match in difflib.get_close_matches(unknown[0].casefold(), folded, n=3, cutoff=0.6)
        ]
        hint = f" (did you mean {', '.join(map(repr, close))}?)" if close else ""
        more = f" and {len(unknown) - 1} more" if len(unknown) > 1 else ""
        shown = ", ".join(known[:20]) + (f", ... ({len(known)} words)" if len(known) > 20 else "")
        return f"text: every word must be in the vocabulary, got {unknown[0]!r}{more}{hint}; it has: {shown}"


class ClipText:
    """A text tower through transformers, from local files only: raw words, no template.

    CLIP's, or that of SigLIP and SigLIP 2. Those were trained on lower case, always padded to their full length on the right and
    without a mask, and look at the last position alone, so that words come to them in just this way. Nothing is loaded before the
    first word is encoded.

    Args:
        model: Name in the local Hugging Face cache, or a folder with config, tokenizer and weights.
        vocabulary: The scene's words, if any. They are not used for encoding, but they live in the embedding space of the
            scene's masks, so their width must be the model's.

    Raises:
        FileNotFoundError: On first use, if the weights or the tokenizer are not on this machine.
        ValueError: On first use, if files are damaged, the model has no text tower, or its width differs from the vocabulary's.
    """

    def __init__(self, vocabulary: Vocabulary | None = None, model: str = CLIP_MODEL) -> None:
        self.model = model
        self.vocabulary = vocabulary
        self._loaded: tuple[Any, Any] | None = None

    def encode(self, names: Sequence[str]) -> Float[Tensor, "k e"]:
        """Unit text embeddings of any words."""
        tokenizer, model = self._load()
        with torch.no_grad():
            out = model.get_text_features(**_tokens(tokenizer, model, names))
        vectors = (
            out if isinstance(out, Tensor) else out.pooler_output
        )  # the latter since transformers 5
        self.require_width(vectors.shape[1])
        return torch.nn.functional.normalize(vectors.float(), dim=-1)

    def require_width(self, width: int) -> None:
        """Do nothing if vectors of this width can be compared with the vocabulary's.

        Raises:
            ValueError: If they cannot.
        """
        if self.vocabulary is not None and width != self.vocabulary.vectors.shape[1]:
            raise ValueError(
                f"text: vectors of {self.model} must be as wide as the scene's vocabulary "
                f"({self.vocabulary.vectors.shape[1]}), got {width}"
            )

    def _load(self) -> tuple[Any, Any]:
        if self._loaded is None:
            require_extra("transformers", "features")
            from transformers import AutoModel, AutoTokenizer  # 2.6 s, and an optional dependency

            folder = find_model(self.model)
            if folder is None:
                raise FileNotFoundError(
                    f"text: weights must be on this machine, got none for {self.model!r}; run "
                    f"`hf download {self.model}` where there is a network and copy ~/.cache/huggingface, or set "
                    "text.model=<folder with config.json, tokenizer.json and model.safetensors>, or text=vocabulary"
                )
            _require_files(folder)
            with one_load_error(folder, "a model and its tokenizer"):
                tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
            model = load_whole(AutoModel, folder, "a whole model")
            if not hasattr(model, "get_text_features"):
                raise ValueError(
                    f"text: {self.model} must have a text tower as CLIP and SigLIP do, got a {model.config.model_type}"
                )
            self._loaded = tokenizer, model.eval()
        return self._loaded


def find_model(model: str) -> Path | None:
    """Folder of a model on this machine; None where there is none.

    Args:
        model: As of `ClipText`.
    """
    if Path(model).is_dir():
        return Path(model)
    require_extra("huggingface_hub", "features")
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import LocalEntryNotFoundError

    try:
        return Path(snapshot_download(model, local_files_only=True))
    except (LocalEntryNotFoundError, ValueError):  # the latter: a name that cannot be of the hub
        return None


def load_whole(auto: Any, folder: Path, what: str, **options: Any) -> Any:
    """A model of which no weights are missing: transformers draws those at random, others each time.

    Args:
        auto: A transformers class with ``from_pretrained``.
        folder: Of configuration and weights.
        what: The files must be, for the error.
        options: Of ``from_pretrained``.

    Raises:
        ValueError: If the files do not hold such a model, or not all of it.
    """
    with one_load_error(folder, what):
        model, info = auto.from_pretrained(
            folder, local_files_only=True, output_loading_info=True, **options
        )
    if missing := sorted(info["missing_keys"]):
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ValueError(f"{folder}: files must be {what}, got no weights {missing[0]}{more}")
    return model


@contextmanager
def one_load_error(folder: Path, what: str) -> Iterator[None]:
    """Turn all that transformers raises for damaged files into one error that names the folder.

    Raises:
        ValueError: If the files are not `what`.
    """
    from huggingface_hub.errors import StrictDataclassError
    from safetensors import SafetensorError

    try:
        yield
    except (
        OSError, ImportError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, EOFError,
        pickle.UnpicklingError, SafetensorError, StrictDataclassError,
    ) as error:  # fmt: skip
        got = visible(" ".join(f"{type(error).__name__}: {error}".split()))
        raise ValueError(f"{folder}: files must be {what}, got {got}") from error


def _require_files(folder: Path) -> None:
    """Do nothing if all files of a text tower are there; without those of a tokenizer transformers makes up one that knows no word.

    Raises:
        FileNotFoundError: If one is missing.
    """
    missing = [] if (folder / "config.json").is_file() else ["config.json"]
    if not any(all((folder / name).is_file() for name in names) for names in _TOKENIZERS):
        missing.append("tokenizer.json")
    if not any(path for end in ("safetensors", "bin") for path in folder.glob(f"*.{end}")):
        missing.append("model.safetensors")
    if missing:
        raise FileNotFoundError(
            f"text: {folder} must hold config.json, tokenizer.json and model.safetensors, got no {', no '.join(missing)}; "
            "`hf download` brings what is missing where there is a network"
        )


def _tokens(tokenizer: Any, model: Any, names: Sequence[str]) -> dict[str, Tensor]:
    """What a text tower takes, padded as it was trained."""
    if not model.config.model_type.startswith("siglip"):
        return dict(tokenizer(list(names), padding=True, truncation=True, return_tensors="pt"))
    tokenizer.padding_side = "right"
    tokens = tokenizer(
        [name.lower() for name in names],
        padding="max_length",
        max_length=model.config.text_config.max_position_embeddings,
        truncation=True,
        return_tensors="pt",
    )
    return {"input_ids": tokens["input_ids"]}
