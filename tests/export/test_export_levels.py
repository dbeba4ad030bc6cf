"""Which mask level answers a word of a page, and with which weight."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from two_balls import THINGS, opened_scene

from vlgs.export.content import answer
from vlgs.fields.several import SeveralFields
from vlgs.fields.splat import SplatModel
from vlgs.fields.trained import SplatField
from vlgs.indicator import Learned, PerLevel
from vlgs.opened import OpenedRun


def with_levels(path: Path, own_weights: bool) -> OpenedRun:
    """Two levels of one set of Gaussians: the first knows the balls, the second the table, each has a vague word for the rest."""
    opened = opened_scene(path)
    model = opened.field.model  # type: ignore[attr-defined]
    params = {name: value.detach().clone() for name, value in model.splats.items()}
    codes = params["features"]
    table = torch.arange(len(codes)) >= 2 * len(codes) // 3
    vague = torch.ones_like(codes) / 2
    first = torch.where(table[:, None], vague, codes)
    second = torch.where(table[:, None], codes, vague)
    params["features"] = torch.cat([first, second], dim=1)
    if own_weights:
        logits = params["indicator_logits"]
        params["indicator_logits"] = torch.stack([logits, logits - 1], dim=1)
    indicator = PerLevel() if own_weights else Learned()
    model = SplatModel(params, model.fusion, indicator, model.head, model.raster, sh_degree=3)
    notes = replace(opened.notes, levels=(1, 2))
    return replace(opened, field=SplatField(model.requires_grad_(False)), notes=notes)


@pytest.mark.parametrize("own_weights", [False, True])
def test_levels_of_the_same_gaussians_answer_their_own_words(tmp_path: Path, own_weights: bool):
    opened = with_levels(tmp_path, own_weights)
    content = answer(opened, THINGS)
    red, green, table = content.words
    n = content.count
    assert red.relevancy[: n // 3].min() > 0.9
    assert green.relevancy[: n // 3].max() < 0.5
    assert table.relevancy[2 * n // 3 :].min() > 0.9
    assert [word.weight for word in content.words] == [0, 0, int(own_weights)]
    levels = [level.language_weights() for level in opened.field.levels()]  # type: ignore[attr-defined]
    assert content.weights[table.weight].equal(levels[1])
    assert len(content.weights) == 1 + own_weights
    # One level for all, if one is wanted: the second does not know the balls.
    assert answer(opened, THINGS, level=1).words[0].relevancy.max() < 0.6
    assert content.notes == []


def test_of_levels_with_gaussians_of_their_own_one_answers_all(tmp_path: Path):
    joint = with_levels(tmp_path, own_weights=False)
    fields = []
    for level, count in ((0, 300), (1, 480)):
        model = joint.field.model  # type: ignore[attr-defined]
        params = {name: value.detach()[-count:].clone() for name, value in model.splats.items()}
        params["features"] = params["features"].chunk(2, dim=1)[level].clone()
        own = SplatModel(params, model.fusion, Learned(), model.head, model.raster, sh_degree=3)
        fields.append(SplatField(own.requires_grad_(False)))
    opened = replace(joint, field=SeveralFields(fields))
    content = answer(opened, THINGS)  # two of three words are those of the first
    assert content.count == 300
    assert content.notes == ["the Gaussians of mask level 1, which answers all words"]
    assert (
        answer(opened, ()).count == 480
    )  # without words those of whole objects, as pictures show them
