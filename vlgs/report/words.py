"""Chooses the words that the pictures ask in a scene without labels."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields import Field
from vlgs.queries import (
    Prompts,
    Query,
    Questions,
    TextEncoder,
    encode_questions,
)
from vlgs.report.evaluate import prompts_of
from vlgs.report.pictures import PictureLimits, spread
from vlgs.types import Scene

_SHARE = 1e-3
"""Share of the pixels; words that are the best one on fewer pixels are taken last."""

_VALUES = 1 << 24
"""Cosines that are held at once, 64 MB: of few pixels with many words, and of many with few."""


def questions_of(
    field: Field,
    scene: Scene,
    query: Query,
    text: TextEncoder | None,
    limits: PictureLimits = PictureLimits(),  # noqa: B008
) -> Questions | None:
    """What the pictures of a trained scene ask: its classes; without labels, the words of its vocabulary that answer best.

    Args:
        field: The trained scene.
        scene: Its views, classes and vocabulary.
        query: How relevancy is computed.
        text: Encodes words; None where nothing can be asked.
        limits: How many views are looked at, and how many words are taken.
    """
    if text is None:
        return None
    if scene.classes:
        prompts, _ = prompts_of(scene, query, text)
        return None if prompts is None else Questions(prompts, query)
    questions = encode_questions(query, text, scene)
    names = questions.prompts.names
    if len(names) <= limits.words:
        note = f"the pictures ask for {', '.join(names)}"
    else:
        order = rank_words(field, scene, questions, limits.views)[: limits.words]
        questions = replace(questions, prompts=_take(questions.prompts, order))
        note = (
            f"the pictures ask for {', '.join(questions.prompts.names)}: the {len(order)} of {len(names):,} words of the "
            f"vocabulary that answer best; {len(names) - len(order):,} are left out"
        )
    return replace(questions, note="; ".join(filter(None, [note, questions.note])))


@torch.no_grad()
def rank_words(field: Field, scene: Scene, questions: Questions, views: int) -> list[int]:
    """Rows of the prompts, best answer first; of several mask levels the last, of whole objects, is asked.

    A word answers as well as it is relevant on the pixels where no other word has a larger cosine. One that wins next to no pixel
    comes after those that do.
    """
    prompts, query = questions.prompts, questions.query
    words = torch.cat([prompts.text, prompts.negatives])
    asked = spread(scene.test or scene.train, views)
    pixels = max(1, _VALUES // (len(words) * max(1, len(asked))))
    samples, whole = [], field.levels()[-1]
    for view in asked:
        count = view.camera.width * view.camera.height
        some = torch.arange(0, count, -(-count // pixels))
        samples.append(whole.similarity(view.camera, words, pixels=some)[0, :, 0])
    cosines = torch.cat(samples, dim=1)  # [k + m, pixels]
    cosines = cosines[:, (cosines != 0).any(dim=0)]  # without language there is no answer
    own, negatives = cosines.split([len(prompts.text), len(prompts.negatives)])
    return _rank(own, query.relevancy(own, negatives))


def _rank(cosines: Float[Tensor, "k p"], relevancy: Float[Tensor, "k p"]) -> list[int]:
    k, p = cosines.shape
    if not p:
        return list(range(k))
    best = cosines.argmax(dim=0)
    won = torch.bincount(best, minlength=k)
    there = relevancy.gather(0, best[None])[0]
    mean = torch.zeros(k).index_add_(0, best, there) / won.clamp_min(1)
    wins = won >= max(1, _SHARE * p)
    answer = torch.where(wins, mean, relevancy.amax(dim=1))
    keys = zip(wins.tolist(), answer.tolist(), strict=True)
    return [row for row, _ in sorted(enumerate(keys), key=lambda pair: pair[1], reverse=True)]


def _take(prompts: Prompts, rows: Sequence[int]) -> Prompts:
    return Prompts(
        tuple(prompts.names[row] for row in rows), prompts.text[list(rows)], prompts.negatives
    )
