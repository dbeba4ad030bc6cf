"""Answers of every way are timed beside their renders, and their errors are those of their tables."""

from pathlib import Path

import pytest
import torch

from vlgs.bench.presets import train_a_little
from vlgs.bench.query import answer, run_query, trained_scene
from vlgs.bench.record import read_record
from vlgs.bench.train import QUICK
from vlgs.fields.comparing import CELLS
from vlgs.heads.linear import Linear
from vlgs.opened.answers import ask_view


@pytest.mark.slow
def test_every_way_has_its_time_and_its_error(tmp_path: Path):
    trained = train_a_little([*QUICK, "head.cache_dir=null", "head.training.steps=20"], steps=1)
    rows = run_query(trained, (200, 36, 30), [1], 2, tmp_path, seed=0)
    table = read_record(tmp_path / "query.csv")
    assert (tmp_path / "query.png").stat().st_size > 0
    tables = [f"table {cell:g}" for cell in CELLS]
    for name, scene in table.groupby("scene", sort=False):
        assert list(scene.way) == ["decoded", "folded", *tables, "table 0.03125, smoothed"], name
        assert (scene.answer_ms > 0).all()
        assert scene.ratio.values == pytest.approx(scene.answer_ms / scene.render_ms, rel=1e-4)
        error = scene.set_index("way").cosine_error
        assert error["decoded"] == 0
        assert error["folded"] < 1e-5
        assert error[tables[0]] > error[tables[-1]]
        assert scene.nodes.notna().tolist() == [False, False, *[True] * (len(CELLS) + 1)]
        assert (scene.relevancy_error >= scene.relevancy_error_999).all()
    assert {row.gaussians for row in rows if row.scene.startswith("workload")} == {200}

    asked = trained_scene(trained)
    camera, prompts = asked.cameras[0], asked.questions.prompts
    relevancy, cosine = answer(asked, asked.field, camera)
    alone = asked.field.similarity(camera, prompts.text)[0, 0]
    torch.testing.assert_close(alone, cosine, rtol=0, atol=1e-6)
    smoothed = ask_view(asked.field, camera, asked.questions).relevancy[0, 0]
    assert float(relevancy.mean()) == pytest.approx(float(smoothed.mean()), abs=0.05)

    trained.module.model.head = Linear(128)
    with pytest.raises(ValueError, match="codes of 3 numbers and a head that folds, got 128"):
        trained_scene(trained)
