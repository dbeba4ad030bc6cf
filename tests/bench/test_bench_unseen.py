"""The yardstick of unseen views: a row per run, trained once."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.colmap_scenes import write_scene
from vlgs.bench import unseen
from vlgs.bench.__main__ import main
from vlgs.bench.lonely import share_lonely, view_weights
from vlgs.bench.presets import train_a_little
from vlgs.bench.record import read_record, write_record
from vlgs.bench.unseen import QUICK, make_tasks, summary
from vlgs.bench.unseen_row import UnseenRow


def test_a_run_is_trained_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    command = ["unseen", "--quick", "--scenes", "mirrors_sky", "--out", str(tmp_path)]
    short = ["--override", "trainer.iterations=6", "data.cache=null", "head.training.steps=8"]
    assert main([*command, *short]) == 0
    table = read_record(tmp_path / "unseen.csv")
    assert list(table.scene) == ["mirrors_sky"]
    assert (table.worst <= table.psnr).all()
    assert table.lonely.between(0, 1).all()
    assert (tmp_path / "unseen.png").stat().st_size > 0
    header = (tmp_path / "unseen.csv").read_text().splitlines()
    assert {"# commit", "# cpu", "# command"} <= {line.partition(":")[0] for line in header}

    monkeypatch.setattr(unseen, "run_stages", lambda *_: pytest.fail("trained again"))
    assert main([*command, *short]) == 0
    assert len(read_record(tmp_path / "unseen.csv")) == 1


@pytest.mark.slow
def test_methods_of_several_stages_are_measured_too(tmp_path: Path):
    command = [
        "unseen",
        "--quick",
        "--scenes",
        "mirrors_sky",
        "--views",
        "4",
        "--out",
        str(tmp_path),
    ]
    few = ["trainer.iterations=6", "data.cache=null"]
    assert main([*command, "--recipe", "best", "--override", "method=best", *few]) == 0
    (row,) = read_record(tmp_path / "unseen.csv").itertuples()
    assert row.recipe == "best"
    assert 0 <= float(row.miou) <= 1  # type: ignore[arg-type]


def test_spread_is_over_seeds_and_worst_over_views():
    row = UnseenRow("a", "20 views", "default", 0, "r", 2, None, 30.0, 25.0, "v", 0.9, 0.5, None, 0.0, 100, 1.0)  # fmt: skip
    other = replace(row, seed=1, run="s", psnr=31.0, worst=22.0, miou=0.6)
    (line,) = summary([row, other])
    assert (line.seeds, line.psnr_spread) == (2, 1.0)
    assert line.miou_spread == pytest.approx(0.1)
    assert (line.means["psnr"], line.means["worst"]) == (30.5, 22.0)
    assert line.means["miou_lerf_ovs"] is None


def test_names_of_digits_come_back_as_they_were(tmp_path: Path):
    row = UnseenRow("fox", "a tenth", "default", 0, "1e5", 3, "12", 30, 27, "0110", 0.9, None, None, 0, 9, 1)  # fmt: skip
    write_record(tmp_path / "unseen.csv", [row], {})
    assert unseen._read(tmp_path / "unseen.csv") == [row]


def test_photographs_that_are_not_there_are_left_out(tmp_path: Path):
    tasks = make_tasks(["mirrors_sky", "fox"], [20], tmp_path, 0.5, quick=False)
    assert [task.scene for task in tasks] == ["mirrors_sky"]
    with pytest.raises(ValueError, match="scenes must be at least one that is there"):
        make_tasks(["fox"], [20], tmp_path, 0.5, quick=False)


def test_photographs_are_held_out_as_asked(tmp_path: Path):
    write_scene(tmp_path / "fox")

    def held(*splits: str) -> list[str]:
        tasks = make_tasks(["fox"], [], tmp_path, 1.0, quick=False, splits=splits)
        return [task.split for task in tasks]

    assert (held("a tenth"), held("every 8th")) == (["a tenth"], ["every 8th"])
    assert held("a tenth", "every 8th") == ["every 8th", "a tenth"]
    with pytest.raises(ValueError, match=r"splits must be among .*, got .'every 9th'"):
        held("every 9th")


def test_lonely_gaussians_are_those_that_training_views_do_not_see():
    views = ["data.train_views=4", "data.test_views=2", "data.cache=null"]
    head = ["head.cache_dir=null", "head.training.steps=8"]
    trained = train_a_little([*QUICK, *views, *head], 1)
    model, scene = trained.module.model, trained.scene
    camera = scene.train[0].camera
    weights = view_weights(model, camera)
    alpha = model.render(camera, language=False).alpha_color
    assert alpha is not None
    torch.testing.assert_close(weights.sum(), alpha.sum(), rtol=1e-4, atol=0)
    alone = replace(scene, train=scene.train[:1])
    # One training view makes every Gaussian lonely; what is not covered at all does not count.
    assert share_lonely(model, scene) <= share_lonely(model, alone)
    assert share_lonely(model, alone) > 0.1


def test_recipes_beside_the_first_take_turns_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def skip(task: object, label: str, overrides: list[str], seed: int, *_: object) -> None:
        turns.append((seed, label, *overrides))

    turns: list[tuple[int | str, ...]] = []
    monkeypatch.setattr(unseen, "_row", skip)
    monkeypatch.setattr(unseen, "draw_unseen", lambda *_: None)
    command = ["unseen", "--scenes", "mirrors_sky", "--views", "4", "--seeds", "0", "1"]
    command += ["--recipe", "one", "--override", "a=1", "--beside", "two", "a=2", "b=3"]
    command += ["--beside", "c=4", "c=4", "--out"]
    assert main([*command, str(tmp_path)]) == 0
    once = [("one", "a=1"), ("two", "a=2", "b=3"), ("c=4", "c=4")]
    assert turns == [(seed, *recipe) for seed in (0, 1) for recipe in once]
    for wrong in (["two", "a=5"], ["one", "a=5"], ["trainer=fast"]):
        assert main([*command, str(tmp_path), "--beside", *wrong]) != 0
        assert f"its own and what it changes, got '{wrong[0]}'" in capsys.readouterr().err
