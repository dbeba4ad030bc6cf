"""Vectors of words for an opened run: from its own vocabulary, a file of further words, or the text tower of CLIP or SigLIP."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.data.language import read_vocabulary
from vlgs.opened.word_cache import CachedText
from vlgs.queries import Query, Questions, encode_prompts
from vlgs.queries.relevancy import VocabSoftmax
from vlgs.queries.text import ClipText, VocabularyText
from vlgs.types import Vocabulary


@dataclass(frozen=True)
class Words:
    """A `vlgs.queries.TextEncoder` that looks in several places, one after the other. All must be of one embedding space."""

    tables: Sequence[VocabularyText]
    tower: CachedText | None
    """Asked for what no table has."""

    @classmethod
    def of(
        cls,
        own: Vocabulary | None,
        config: Any,
        further: Path | None,
        model: str | None,
        template: str,
    ) -> "Words":
        """What a run has, and what a command adds.

        Args:
            own: Of the run.
            config: ``text`` of its configuration.
            further: A file of words and vectors, which comes first.
            model: Name or folder of a text tower; None: that of the configuration, if it has one.
            template: Around what the tower encodes.

        Raises:
            ValueError: If the file is damaged, or its vectors have another width than the run's.
            OSError: If there is no such file.
        """
        added = None if further is None else read_vocabulary(further)
        if added is not None and own is not None and added.vectors.shape[1] != own.vectors.shape[1]:
            raise ValueError(
                f"vocabulary: vectors of {further} must be as wide as those of the run ({own.vectors.shape[1]}), got {added.vectors.shape[1]}"
            )
        known = [VocabularyText(table) for table in (added, own) if table is not None]
        model = model or config.get("model")
        first = known[0].vocabulary if known else None
        tower = None if model is None else CachedText(ClipText(first, str(model)), template)
        return cls(known, tower)

    @property
    def known(self) -> tuple[str, ...]:
        """Words of the tables."""
        tables = (table.vocabulary for table in self.tables)
        names = (name for table in tables if table is not None for name in table.names)
        return tuple(dict.fromkeys(names))

    def encode(self, names: Sequence[str]) -> Float[Tensor, "k e"]:
        """See `vlgs.queries.TextEncoder`.

        Raises:
            ValueError: If a word is in no table and there is no text tower; says what could encode it.
            OSError: If the weights of the tower are not on this machine.
        """
        rows: dict[str, Tensor] = {}
        for table in self.tables:
            assert table.vocabulary is not None  # `of`
            mine = [n for n in names if n not in rows and n in table.vocabulary.names]
            rows |= zip(mine, table.encode(mine), strict=True) if mine else ()
        rest = [name for name in dict.fromkeys(names) if name not in rows]
        if rest and self.tower is not None:
            rows |= zip(rest, self.tower.encode(rest), strict=True)
        elif rest:
            raise ValueError(self._explain(rest))
        return torch.stack([rows[name] for name in names])

    def ask(self, query: Query, names: Sequence[str]) -> Questions:
        """See `vlgs.opened.OpenedRun.ask`."""
        try:
            return Questions(encode_prompts(query, self, names), query)
        except ValueError:
            if not names or not query.negatives:
                raise
            prompts = encode_prompts(VocabSoftmax(), self, names)
        lacking = ", ".join(query.negatives)
        note = f"words compete with each other, as nothing here encodes {lacking}"
        return Questions(prompts, VocabSoftmax(), note)

    def _explain(self, rest: Sequence[str]) -> str:
        remedy = (
            "--vocabulary FILE (`python -m vlgs.vocabulary` makes one where there are weights) or --text MODEL, a name in the local "
            "Hugging Face cache or a folder, can encode it"
        )
        if not self.tables:
            return f"text: {rest[0]!r} must be encoded, got neither a vocabulary nor a text tower; {remedy}"
        both = Vocabulary(self.known, torch.zeros(len(self.known), 1))
        try:
            VocabularyText(both).encode(rest)
        except ValueError as error:
            return f"{error}; {remedy}"
        raise AssertionError("a word of the tables is encoded by them")
