"""A view that is asked for scores and again for pictures is answered once, as long as there is room."""

from dataclasses import replace

import torch
from report_fakes import FakeField, scene, vocabulary

from vlgs.queries import LerfRelevancy, Prompts, encode_prompts
from vlgs.queries.text import VocabularyText
from vlgs.report import answer
from vlgs.report.answer import KeptAnswers
from vlgs.types import Scene

QUERY = LerfRelevancy()


def asked(labelled: Scene) -> Prompts:
    return encode_prompts(QUERY, VocabularyText(vocabulary()), labelled.classes)


def test_the_same_question_is_answered_once():
    labelled, field = scene(2), FakeField()
    kept = KeptAnswers(labelled.test[:1])
    first, second = (view.camera for view in labelled.test)
    got = kept.answer(field, first, asked(labelled))
    # Equal prompts that were encoded again are the same question.
    assert kept.answer(field, first, asked(labelled)) is got
    other = replace(asked(labelled), text=-asked(labelled).text)
    assert kept.answer(field, first, other) is not got
    assert kept.answer(FakeField(), first, asked(labelled)) is not got
    assert kept.answer(field, first, None).cosines is None
    # Of views that are asked once nothing is kept.
    got = kept.answer(field, second, asked(labelled))
    assert kept.answer(field, second, asked(labelled)) is not got
    want = answer.answer_view(field, second, asked(labelled))
    assert torch.equal(got.color, want.color)
    assert got.cosines is not None
    assert want.cosines is not None
    assert torch.equal(got.cosines, want.cosines)


def test_no_more_is_kept_than_there_is_room_for():
    labelled, field = scene(2), FakeField()
    first, second = (view.camera for view in labelled.test)
    one = answer.answer_view(field, first, None)
    assert one.feature is not None
    kept = KeptAnswers(labelled.test, most=one.color.nbytes + one.feature.nbytes)
    got = kept.answer(field, first, None)
    assert kept.answer(field, first, None) is got
    got = kept.answer(field, second, None)
    assert kept.answer(field, second, None) is not got
