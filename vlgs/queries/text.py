"""From words to text embeddings: a table of known words, or the text tower of CLIP or SigLIP."""

import difflib
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.extras import require_extra
from vlgs.types import Vocabulary

CLIP_MODEL = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"
"""The weights of LERF and LangSplat (OpenCLIP ViT-B-16, laion2b_s34b_b88k), as Hugging Face names them."""


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
        FileNotFoundError: On first use, if the weights are not on this machine.
        ValueError: On first use, if the model has no text tower, or its width differs from the vocabulary's.
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
        if self.vocabulary is not None and vectors.shape[1] != self.vocabulary.vectors.shape[1]:
            raise ValueError(
                f"text: vectors of {self.model} must be as wide as the scene's vocabulary "
                f"({self.vocabulary.vectors.shape[1]}), got {vectors.shape[1]}"
            )
        return torch.nn.functional.normalize(vectors.float(), dim=-1)

    def _load(self) -> tuple[Any, Any]:
        if self._loaded is None:
            require_extra("transformers", "features")
            from transformers import AutoModel, AutoTokenizer  # 2.6 s, and an optional dependency

            try:
                tokenizer = AutoTokenizer.from_pretrained(self.model, local_files_only=True)
                model = AutoModel.from_pretrained(self.model, local_files_only=True)
            except OSError as error:
                raise FileNotFoundError(
                    f"text: weights must be on this machine, got none for {self.model!r}; run "
                    f"`hf download {self.model}` where there is a network and copy ~/.cache/huggingface, or set "
                    "text.model=<folder with config.json, tokenizer.json and model.safetensors>, or text=vocabulary"
                ) from error
            if not hasattr(model, "get_text_features"):
                raise ValueError(
                    f"text: {self.model} must have a text tower as CLIP and SigLIP do, got a {model.config.model_type}"
                )
            self._loaded = tokenizer, model.eval()
        return self._loaded


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
