"""Learning curves: written once, evaluation left out of the time."""

from itertools import pairwise
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from omegaconf import OmegaConf

from vlgs.bench import curve, train
from vlgs.bench.curve import evaluated_at, seconds_to
from vlgs.bench.presets import composed
from vlgs.bench.record import STYLE, plain_ticks, read_record, write_record
from vlgs.identity import RESULTS_VERSION
from vlgs.skips import SKIPS
from vlgs.training.after_step import TrainedModule


def test_every_recipe_is_a_configuration_of_its_own():
    configs = {
        OmegaConf.to_yaml(composed(recipe)): label for label, recipe in train.RECIPES.items()
    }
    assert list(configs.values()) == list(train.RECIPES)


def test_all_and_no_skips_say_each_key_once():
    on, off = (train.RECIPES[name] for name in ("all skips", "no skips"))
    assert composed(on).trainer.skip.blend_weight == 0.5
    # Every blended view is rendered, of pairs without similarity too.
    assert composed(off).trainer.skip.blend_weight == -1.0
    for recipe in (on, off):
        keys = [override.partition("=")[0] for override in recipe]
        assert len(keys) == len(set(keys))
    keys = {skip.setting for skip in SKIPS if skip.switchable}
    assert {override.partition("=")[0] for override in off} == keys
    assert {override.partition("=")[0] for override in on} == keys - {"raster.transmittance_min"}


def test_photographs_are_told_where_their_language_is():
    root = Path("scene")
    further = ["data.features=maps", "query=vocab_softmax"]
    scenes = train.scene_overrides(root, 0.5, False, synthetic=False, further=further)
    assert list(scenes) == ["photographs"]
    config = composed(scenes["photographs"])
    assert (config.data.root, config.data.resize, config.data.features) == ("scene", 0.5, "maps")
    assert list(train.scene_overrides(root, 1.0, True)) == ["synthetic", "photographs"]
    with pytest.raises(ValueError, match=r"data.features=maps .* must come with --root SCENE"):
        train.scene_overrides(None, 0.5, False, further=further)
    with pytest.raises(ValueError, match=r"--no-synthetic must come with --root SCENE"):
        train.scene_overrides(None, 0.5, False, synthetic=False)
    with pytest.raises(ValueError, match="--large must come with the procedural scene"):
        train.scene_overrides(root, 0.5, quick=False, synthetic=False, large=True)


def test_a_curve_is_trained_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scenes = {"synthetic": (*train.QUICK, "trainer.iterations=6", f"results={tmp_path}")}
    rows = train.run_train(scenes, ["neither"], tmp_path, 2, 1, [0])
    assert rows[0].iterations == 6
    assert rows[0].seconds > 0
    assert rows[0].psnr is not None
    files = list((tmp_path / "train").glob("*.csv"))
    assert len(files) == 1
    assert str(tmp_path) not in files[0].read_text()
    table = read_record(files[0])
    assert list(table.iteration) == [2, 6]
    assert table.seconds.is_monotonic_increasing
    assert set(table) >= {"cpu_seconds", "psnr", "miou", "gaussians"}
    assert (tmp_path / "train.png").stat().st_size > 0

    monkeypatch.setattr(train, "fit", lambda *_: pytest.fail("trained again"))
    again = train.run_train(scenes, ["neither"], tmp_path, 2, 1, [0])
    assert again[0].seconds == pytest.approx(rows[0].seconds, rel=1e-5)


@pytest.mark.slow
def test_rows_of_other_seeds_stay_and_effects_are_paired_by_seed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    scenes = {"synthetic": (*train.QUICK, "trainer.iterations=3")}
    train.run_train(scenes, ["neither"], tmp_path, 1, 1, [0])
    train.run_train(scenes, ["neither", "no fusion"], tmp_path, 1, 1, [1, 2])
    assert "against neither, paired by seed" in capsys.readouterr().out
    table = read_record(tmp_path / "train.csv")
    assert list(zip(table.label, table.seed, strict=True)) == [
        ("neither", 0), ("neither", 1), ("no fusion", 1), ("neither", 2), ("no fusion", 2),
    ]  # fmt: skip
    again = table.to_csv(index=False)
    (tmp_path / "train.csv").write_text(again.replace(f",{RESULTS_VERSION},", ",1,"))
    train.run_train(scenes, ["neither"], tmp_path, 1, 1, [2])
    assert list(read_record(tmp_path / "train.csv").seed) == [2]


def test_sizes_of_a_scene_are_apart_and_a_recipe_looks_alike_on_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def row(size: str, label: str, run: str) -> train.Summary:
        point = curve.CurvePoint("fox", label, 6, 1.0, 1.0, 20.0, None, 9)
        if run != "gone":
            write_record(tmp_path / "train" / f"fox-{run}.csv", [point], {})
        return train.Summary(
            "fox", size, label, "", 0, run, RESULTS_VERSION, 6, 1.0, 1.0, 20.0, None, 9,
            19.0, 1.0, 1.0, None, None, None,
        )  # fmt: skip

    figures: list[Figure] = []
    monkeypatch.setattr(train, "write_figure", lambda _, figure: figures.append(figure))
    before = [
        row("8x6", "photos", "12345678"),
        row("8x6", "default", "b"),
        row("4x3", "fast", "gone"),
    ]
    write_record(tmp_path / "train.csv", before, {})
    rows = train.with_others(tmp_path / "train.csv", [row("4x3", "default", "c")])
    assert [(r.size, r.label, r.run) for r in rows] == [
        ("8x6", "photos", "12345678"), ("8x6", "default", "b"), ("4x3", "fast", "gone"), ("4x3", "default", "c"),
    ]  # fmt: skip
    train.draw_train(tmp_path / "train", rows)
    panels = figures[0].axes
    assert [p.get_title(loc="left") for p in panels[::2]] == ["fox, 8x6", "fox, 4x3"]
    (_, large), (small,) = (p.get_lines() for p in panels[::2])
    assert large.get_color() == small.get_color()
    assert [text.get_text() for text in panels[1].texts] == ["not scored"]


def test_evaluation_is_not_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    clock = iter(range(1000))
    monkeypatch.setattr(curve.time, "perf_counter", lambda: float(next(clock)))
    right = curve.score

    def slow(*trained):
        for _ in range(100):
            next(clock)
        return right(*trained)

    monkeypatch.setattr(curve, "score", slow)
    scenes = {"synthetic": (*train.QUICK, "trainer.iterations=4")}
    rows = train.run_train(scenes, ["neither"], tmp_path, 4, 1, [0])
    # The fake clock also ticks for TrainingClock, between the two readings of an iteration: 2 or 3 each, never 100.
    assert rows[0].seconds <= 4 * 4


def test_the_first_crossing_counts():
    assert seconds_to(25.0, [10.0, 20.0, 30.0], [20.0, 30.0, 10.0]) == pytest.approx(15.0)
    assert seconds_to(25.0, [10.0, 20.0], [26.0, 30.0]) == 10.0
    assert seconds_to(31.0, [10.0, 20.0], [26.0, 30.0]) is None
    assert seconds_to(None, [10.0], [26.0]) is None
    assert seconds_to(1.0, [10.0, 20.0], [None, 2.0]) == 20.0


def test_the_last_iteration_is_evaluated():
    for iterations in (1, 7, 1500):
        assert max(evaluated_at(iterations, 8)) == iterations
        assert min(evaluated_at(iterations, 8)) >= 1


@pytest.mark.slow
def test_a_training_that_was_stopped_goes_on_with_its_clocks_and_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    scenes = {"large": (*train.QUICK, "trainer.iterations=9", "trainer.checkpoint_every=1")}
    evaluate, stopped_at = curve.Curve.evaluate, []

    def killed(self: curve.Curve, module: TrainedModule) -> None:
        if module.next_step == stopped_at[-1]:
            raise RuntimeError("killed")
        evaluate(self, module)

    monkeypatch.setattr(curve.Curve, "evaluate", killed)
    for stop in (1, 5, 9):  # each after its checkpoint, before its evaluation
        stopped_at.append(stop)
        with pytest.raises(RuntimeError, match="killed"):
            train.run_train(scenes, ["neither"], tmp_path, 3, 1, [0])
    monkeypatch.setattr(curve.Curve, "evaluate", evaluate)
    rows = train.run_train(scenes, ["neither"], tmp_path, 3, 1, [0])
    assert rows[0].scene == "glassware_large"
    (file,) = (tmp_path / "train").iterdir()
    table = read_record(file)
    assert list(table.iteration) == [1, 4, 9]
    assert table.seconds.is_monotonic_increasing
    whole = train.run_train(scenes, ["neither"], tmp_path / "whole", 3, 1, [0])
    assert (rows[0].psnr, rows[0].miou) == (whole[0].psnr, whole[0].miou)


@pytest.mark.parametrize("ends", [(5, 90), (30, 8000), (5, 10_000)])
def test_labels_of_the_seconds_do_not_run_into_each_other(ends: tuple[float, float]):
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with rc_context(STYLE):
        figure = Figure(figsize=(8.0, 2.9), layout="constrained")
        canvas = FigureCanvasAgg(figure)
        panel, _ = figure.subplots(1, 2)
        panel.plot(ends, (1.0, 2.0))
        panel.set_xscale("log")
        plain_ticks(panel.xaxis)
        canvas.draw()
        labels = [label for label in panel.get_xticklabels() if label.get_text()]
        boxes = [label.get_window_extent() for label in labels]
    low, high = panel.get_xlim()
    drawn = [
        box
        for label, box in zip(labels, boxes, strict=True)
        if low <= label.get_position()[0] <= high
    ]
    assert len(drawn) >= 2
    assert all(left.x1 < right.x0 for left, right in pairwise(drawn))
