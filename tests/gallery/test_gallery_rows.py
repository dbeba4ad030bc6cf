"""Which views and words are drawn, by hand; and what is read of the scores of a run."""

import json
from collections.abc import Mapping
from pathlib import Path

import pytest

from vlgs.gallery.rows import Answered, ScoredRow, choose_views, choose_word, read_row
from vlgs.runs import RunFolder


def row(
    psnr: Mapping[str, float | None],
    answers: Mapping[str, tuple[float | None, float]] | None = None,
) -> ScoredRow:
    per_view = {view: {"psnr": value} for view, value in psnr.items()}
    scored = {("a", word): Answered(*one) for word, one in (answers or {}).items()}
    return ScoredRow("row", RunFolder(Path("x")), {"per_view": per_view}, scored)


def test_views_are_the_lowest_and_the_highest_by_mean_over_the_rows_with_colour():
    rows = [
        row({"a": 20.0, "b": 30.0, "c": 25.0}),
        row({"a": 30.0, "b": 10.0, "c": 26.0}),  # alone its lowest would be b and its highest a
        row({"a": None, "b": None, "c": None}),
    ]
    assert choose_views(rows) == {"lowest": "b", "highest": "c"}  # 25, 20, 25.5
    rows[0].metrics["per_view"]["d"] = {"psnr": 1.0}  # of one row alone
    assert choose_views(rows) == {"lowest": "b", "highest": "c"}
    assert choose_views([row({"a": 20.0, "b": None})]) == {"lowest": "a"}
    assert choose_views([row({"a": None})]) == choose_views([row({})]) == choose_views([]) == {}


def test_the_word_is_the_one_on_which_rows_differ_most_and_that_can_be_seen():
    first = row(
        {}, {"mug": (0.5, 0.1), "lid": (0.9, 0.1), "speck": (1.0, 0.002), "wall": (1.0, 0.3)}
    )
    other = row(
        {}, {"mug": (0.7, 0.1), "lid": (0.2, 0.1), "speck": (0.0, 0.002), "wall": (0.0, 0.3)}
    )
    assert choose_word([first, other], "a") == "lid"
    assert choose_word([first, other, row({})], "a") == "lid"  # one without language
    assert choose_word([first, other], "b") is None
    assert choose_word([first, other, row({}, {"mug": (0.0, 0.1)})], "a") == "mug"  # known to all
    assert choose_word([first], "a") == "lid"  # all alike: the first in the alphabet
    assert choose_word([row({}, {"mug": (None, 0.1)})], "a") is None


def query(**more: object) -> dict[str, object]:
    entry = {"protocol": "dense@1/synthetic", "view": "a", "category": "mug", "iou": 0.5}
    return {**entry, "true_pixels": 10, "pixels": 100, **more}


def test_scores_of_words_are_those_of_the_headline(tmp_path: Path):
    queries = [query(), query(protocol="lerf_ovs@1/synthetic", iou=0.9), query(category="lid", true_pixels=0)]  # fmt: skip
    (tmp_path / "queries.json").write_text(json.dumps(queries))
    metrics = {"protocol": "dense@1/synthetic labels=mine", "per_view": {"a": {"psnr": 20.0}}}
    found = read_row("row", RunFolder(tmp_path), metrics)
    assert found.answers == {("a", "mug"): Answered(0.5, 0.1)}
    assert found.psnr("a") == 20.0
    assert found.psnr("b") is None


@pytest.mark.parametrize(
    "content", ["", "3", "{}", "[3]", "[{}]", "[" * 100_000, json.dumps([query(iou="x")]), json.dumps([query(view=3)]), "\udcff"]
)  # fmt: skip
def test_damaged_scores_are_named(tmp_path: Path, content: str):
    path = tmp_path / "queries.json"
    path.write_text(content, errors="surrogateescape")
    metrics = {"protocol": "dense@1/synthetic", "per_view": {}}
    if content == "{}":  # no entry at all
        assert read_row("row", RunFolder(tmp_path), metrics).answers == {}
        return
    with pytest.raises(ValueError, match=rf"{path}: must be a list of scored words .*; delete it"):
        read_row("row", RunFolder(tmp_path), metrics)
    with pytest.raises(ValueError, match=r"metrics\.json: per_view\.a must hold a psnr, got"):
        read_row("row", RunFolder(tmp_path), {"per_view": {"a": {"psnr": "high"}}})
