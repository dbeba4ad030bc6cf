"""A scene that nobody labelled: words of its vocabulary are asked in the pictures, and nothing is scored."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from report_fakes import CLASSES, EMBEDDING, NEGATIVES, FakeField, scene, vocabulary
from tiny_runs import TINY, composed

from vlgs.data.export import write_scene
from vlgs.data.synthetic import SceneSettings, language_levels
from vlgs.queries import LerfRelevancy, VocabSoftmax, encode_questions, words_of
from vlgs.queries.text import VocabularyText
from vlgs.report.pictures import PictureLimits, write_pictures
from vlgs.report.words import questions_of
from vlgs.run import run
from vlgs.types import Scene, Vocabulary

QUERY = LerfRelevancy()
SHOWN = set(CLASSES) - {"absent"}


def unlabelled(words: tuple[str, ...] = CLASSES + NEGATIVES) -> Scene:
    return replace(scene(2, dense=False), classes=(), vocabulary=vocabulary(words))


def many(count: int) -> Vocabulary:
    """The still life's words among `count` others that nothing in it looks like."""
    known = vocabulary()
    odd = torch.randn(count, EMBEDDING, generator=torch.Generator().manual_seed(5))
    odd[:, 0] = 0
    vectors = torch.cat([odd, known.vectors])
    names = (*(f"word {i}" for i in range(count)), *known.names)
    return Vocabulary(names, torch.nn.functional.normalize(vectors, dim=-1))


def test_the_vocabulary_is_asked_without_what_words_are_compared_with():
    assert words_of(unlabelled(), QUERY) == CLASSES
    assert words_of(unlabelled(), VocabSoftmax()) == CLASSES + NEGATIVES
    assert words_of(unlabelled(NEGATIVES), QUERY) == NEGATIVES
    assert words_of(scene(), QUERY) == CLASSES
    assert words_of(replace(unlabelled(), vocabulary=None), QUERY) == ()


def test_of_many_words_those_that_answer_best_are_asked_and_the_rest_is_counted():
    where = replace(unlabelled(), vocabulary=many(1200))
    text = VocabularyText(where.vocabulary)
    asked = questions_of(FakeField(0.02), where, QUERY, text, PictureLimits(words=5))
    assert asked is not None
    assert set(asked.prompts.names) == SHOWN
    assert (
        "the 5 of 1,206 words of the vocabulary that answer best; 1,201 are left out" in asked.note
    )
    for name, row in zip(asked.prompts.names, asked.prompts.text, strict=True):
        assert torch.equal(row, text.encode([name])[0])


def test_a_short_vocabulary_is_asked_in_its_own_order():
    where = unlabelled()
    asked = questions_of(FakeField(), where, QUERY, VocabularyText(where.vocabulary))
    assert asked is not None
    assert asked.prompts.names == CLASSES
    assert asked.note == f"the pictures ask for {', '.join(CLASSES)}"


def test_without_negatives_words_compete_with_each_other_and_the_note_says_so():
    where = unlabelled(CLASSES)
    asked = encode_questions(QUERY, VocabularyText(where.vocabulary), where)
    assert isinstance(asked.query, VocabSoftmax)
    assert asked.note == (
        "words compete with each other, as the vocabulary lacks object, things, stuff, texture"
    )
    one = unlabelled(CLASSES[:1])
    assert (
        "its picture is blank" in encode_questions(QUERY, VocabularyText(one.vocabulary), one).note
    )
    with pytest.raises(ValueError, match=r"must know the negatives.*query=vocab_softmax"):
        encode_questions(QUERY, VocabularyText(vocabulary(CLASSES)), scene())


def test_each_word_has_a_heat_map_that_is_cold_where_the_word_is_not(tmp_path: Path):
    where = unlabelled()
    asked = questions_of(FakeField(), where, QUERY, VocabularyText(where.vocabulary))
    assert asked is not None
    write_pictures(tmp_path, FakeField(), where, asked.query, asked.prompts)
    drawn = {path.stem for path in (tmp_path / "view_00").iterdir()}
    assert {f"relevancy_{name.replace(' ', '_')}" for name in CLASSES} <= drawn
    assert "prediction" in drawn
    assert not drawn & {"labels", "segmentation_wall"}
    glass = Image.open(tmp_path / "view_00" / "relevancy_wine_glass.png")
    pixels = np.asarray(glass).astype(int)
    assert pixels[75, 50, 0] - pixels[75, 50, 2] > 50  # glass
    assert pixels[75, 110, 2] > pixels[75, 110, 0]  # kettle
    with Image.open(tmp_path / "overview.png") as sheet:
        assert sheet.width > 10 * 400  # photograph, render, features, best word, six words, l - o


def test_photographs_with_language_and_a_vocabulary_are_asked_by_a_run(
    tmp_path: Path, tiny_scene: Scene
):
    drawn, root = tiny_scene, tmp_path / "scene"
    settings = SceneSettings(width=48, height=36, train_views=6, test_views=2, points=400)
    write_scene(drawn, root, language_levels(settings))
    shutil.rmtree(root / "labels")
    shutil.rmtree(root / "label")
    kept = [entry for entry in TINY if not entry.startswith("data.")]
    overrides = (
        *kept, "data=colmap", f"data.root={root}", "data.split=list", "pictures=true",
        f"data.test=[{','.join(view.name for view in drawn.test)}]",
        "trainer=smoke", "trainer.iterations=5", f"results={tmp_path / 'results'}",
    )  # fmt: skip
    assert run(composed(*overrides)) == 0
    (folder,) = (tmp_path / "results" / "runs").iterdir()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["miou"] is None
    assert metrics["fps_query"] > 0
    assert metrics["reasons"]["miou"] == "the scene has no labels"
    assert metrics["reasons"]["words"].startswith("the pictures ask for wine glass, ")
    view = folder / "renders" / drawn.test[0].name
    assert len(list(view.glob("relevancy_*.png"))) == len(drawn.classes)
