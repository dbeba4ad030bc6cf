"""What views and Gaussians answer, against naive loops."""

import pytest
import torch

from vlgs.fields import HasGaussians
from vlgs.metrics.segment import blend, smooth
from vlgs.opened import OpenedRun, open_run
from vlgs.opened.answers import Range, ask_view, ranges, select_gaussians, tie
from vlgs.queries import LerfRelevancy, VocabSoftmax
from vlgs.report.answer import answer_view


def test_a_view_answers_with_the_relevancy_that_is_segmented(opened: OpenedRun):
    asked, camera = opened.ask(["mug", "lemon"]), opened.cameras("test")[0].camera
    found = ask_view(opened.field, camera, asked)
    answer = answer_view(opened.field, camera, asked.prompts)
    assert answer.cosines is not None
    assert answer.negatives is not None
    raw = torch.sigmoid(10 * (answer.cosines[0] - answer.negatives[0].amax(dim=0)))
    assert torch.allclose(found.relevancy[0], blend(raw, smooth(raw)), atol=1e-6)
    assert found.score(1) == found.relevancy[0, 1].max()
    again = ask_view(opened.field, camera, asked, opened.field.render(camera, frozenset({"color", "feature"})))  # fmt: skip
    assert torch.equal(again.relevancy, found.relevancy)


def test_ranges_are_those_of_the_scene(opened: OpenedRun):
    asked = opened.ask(["mug", "lemon"])
    cameras = [one.camera for one in opened.held_out()]
    maps = torch.stack([ask_view(opened.field, c, asked).relevancy[0] for c in cameras])
    for word, got in enumerate(ranges(opened.field, cameras, asked)):
        assert (got.low, got.high) == (maps[:, word].min(), maps[:, word].max())
        assert got.tie == 0.5


def test_a_threshold_lies_in_the_range_and_not_below_a_tie():
    assert Range(0.2, 1.0, 0.5).threshold() == pytest.approx(0.76)
    assert Range(0.1, 0.3, 0.5).threshold() == 0.5, "nothing in the scene answers"
    assert Range(0.2, 0.2, 0.1).shares(torch.tensor([0.2, 0.3])).tolist() == [0.0, 1.0]
    assert tie(LerfRelevancy(), 7) == 0.5
    assert tie(VocabSoftmax(), 4) == 0.25


def test_gaussians_that_answer_are_relevant_and_drawn(opened: OpenedRun):
    field = opened.field
    assert isinstance(field, HasGaussians)
    asked = opened.ask(["mug", "lemon"])
    prompts = asked.prompts
    words = torch.cat([prompts.text, prompts.negatives])
    cosines = field.gaussian_similarity(words)[0]
    relevancy = asked.query.relevancy(cosines[:2], cosines[2:])[1]
    threshold = float(relevancy.median())
    of, chosen = select_gaussians(field, asked, 1, threshold)
    assert of is field
    for row in range(len(chosen)):
        drawn = min(field.opacities()[row], field.language_weights()[row]) >= 1 / 255
        assert chosen[row] == (relevancy[row] > threshold and drawn)
    assert 0 < chosen.sum() < len(chosen)


def test_words_compete_where_the_vocabulary_has_no_negatives(finished, tmp_path):
    import numpy as np

    file = tmp_path / "words.npz"
    np.savez(file, names=np.array(["zebra", "okapi"]), embeddings=np.eye(2, 512, dtype=np.float32))
    with_more = open_run(finished, vocabulary=file)
    assert with_more.words.known[:2] == ("zebra", "okapi")
    assert with_more.ask(["zebra"]).note == ""
    vocabulary = with_more.notes.vocabulary
    assert vocabulary is not None
    keep = [i for i, n in enumerate(vocabulary.names) if n not in LerfRelevancy().negatives]
    from vlgs.opened.words import Words
    from vlgs.types import Vocabulary

    fewer = Vocabulary(tuple(vocabulary.names[i] for i in keep), vocabulary.vectors[keep])
    asked = Words.of(fewer, {}, None, None, "{}").ask(LerfRelevancy(), ["mug", "lemon"])
    assert isinstance(asked.query, VocabSoftmax)
    assert "compete with each other" in asked.note
