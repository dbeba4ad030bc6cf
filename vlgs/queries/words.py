"""The words that can be asked of a scene: its classes or, without labels, its vocabulary."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vlgs.queries.prompts import Prompts, encode_prompts
from vlgs.queries.relevancy import VocabSoftmax
from vlgs.queries.text import TextEncoder
from vlgs.types import Scene

if TYPE_CHECKING:
    from vlgs.queries import Query


@dataclass(frozen=True)
class Questions:
    """Words that are asked, and how."""

    prompts: Prompts
    query: "Query"
    note: str = ""
    """What a reader of the answers should know; empty where there is nothing to say."""


def words_of(scene: Scene, query: "Query") -> tuple[str, ...]:
    """The classes of a scene; without any, the words of its vocabulary that the query does not compare with anyway."""
    if scene.classes or scene.vocabulary is None:
        return scene.classes
    names = scene.vocabulary.names
    return tuple(name for name in names if name not in query.negatives) or names


def encode_questions(query: "Query", text: TextEncoder, scene: Scene) -> Questions:
    """Encode what can be asked of a scene; call it before training, so that a missing word costs no run.

    A vocabulary of a scene without labels may lack the query's negatives. Nothing is scored there, so its words compete with each
    other instead, and the note says so.

    Raises:
        ValueError: If there is no word, or the encoder lacks one.
    """
    words = words_of(scene, query)
    try:
        return Questions(encode_prompts(query, text, words), query)
    except ValueError:
        if scene.classes or not words or not query.negatives:
            raise
    others = VocabSoftmax()
    note = f"words compete with each other, as the vocabulary lacks {', '.join(query.negatives)}"
    if len(words) == 1:
        note += "; a single word has nothing to compete with, and its picture is blank"
    return Questions(encode_prompts(others, text, words), others, note)
