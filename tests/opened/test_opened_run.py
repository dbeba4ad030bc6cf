"""A run folder is opened without its data, at any time; what is no run, or a hostile one, is refused in a line."""

import json
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from safetensors.torch import load_file
from slow import with_slow
from tiny_runs import TINY, composed
from torch import Tensor

from vlgs.export.__main__ import main as export
from vlgs.fields import Field
from vlgs.fields.planes import Plane, with_planes
from vlgs.fields.several import SeveralFields
from vlgs.heads.classifier import Classifier
from vlgs.opened import OpenedRun, open_run
from vlgs.opened.files import write_field
from vlgs.query import main as query
from vlgs.render.__main__ import main as render
from vlgs.run import run
from vlgs.runs import RunFolder
from vlgs.training.checkpoint import Checkpoint, decode, encode
from vlgs.types import Scene
from vlgs.view.__main__ import main as view

FORM = "vlgs-field-1"


@pytest.fixture
def folder(finished: Path, tmp_path: Path) -> Path:
    """A copy, to be spoiled."""
    return Path(shutil.copytree(finished, tmp_path / "runs" / finished.name))


def rewrite(folder: Path, change: Callable[[dict[str, Any], dict[str, Tensor]], Any]) -> None:
    """Change the plan or the tensors of a field's file, whose digest fits again."""
    path = RunFolder(folder).field
    content = decode(path, FORM)
    change(content.meta["plan"], content.tensors)
    path.write_bytes(encode(content, FORM))


def test_it_knows_cameras_words_and_levels(opened: OpenedRun, tiny_scene: Scene):
    assert [one.name for one in opened.cameras("test")] == [v.name for v in tiny_scene.test]
    assert len(opened.cameras()) == len(tiny_scene.train) + len(tiny_scene.test)
    camera = opened.cameras("train")[0].camera
    assert torch.equal(camera.viewmat, tiny_scene.train[0].camera.viewmat)
    assert torch.equal(camera.K, tiny_scene.train[0].camera.K)
    assert (camera.width, camera.height) == (48, 36)
    assert opened.notes.classes == tiny_scene.classes
    assert tiny_scene.vocabulary is not None
    assert opened.words.known == tiny_scene.vocabulary.names
    assert (opened.step, opened.place(3)) == (None, 0)
    with pytest.raises(ValueError, match="level must be one of the run's, 3, got 1"):
        opened.place(1)


def test_words_are_asked_by_the_runs_query(opened: OpenedRun):
    asked = opened.ask(["mug", "wine glass"])
    assert asked.prompts.names == ("mug", "wine glass")
    assert asked.prompts.negatives.shape == (4, 512)
    with pytest.raises(ValueError, match=r"'mugg' \(did you mean 'mug'.*--vocabulary FILE"):
        opened.ask(["mugg"])
    with pytest.raises(ValueError, match="at least one word"):
        opened.ask([])


def test_a_field_that_answers_for_all_mask_levels_has_none_to_choose(opened: OpenedRun):
    """As LERF, which is taught by three levels and answers once."""
    taught = replace(opened, notes=replace(opened.notes, levels=(1, 2, 3)))
    assert (opened.levels, taught.levels) == ((3,), ())
    with pytest.raises(ValueError, match="none, as it answers for all at once, got 2"):
        taught.place(2)


@pytest.mark.parametrize("levels", with_slow(["separate", "joint"], ["separate"]))
def test_several_mask_levels_come_back(tmp_path: Path, levels: str):
    config = composed(*TINY, "trainer=smoke", "trainer.iterations=2", f"levels={levels}", "pictures=false", f"results={tmp_path}")  # fmt: skip
    assert run(config) == 0
    opened = open_run(next((tmp_path / "runs").iterdir()))
    assert isinstance(opened.field, SeveralFields) == (levels == "separate")
    assert (len(opened.field.levels()), opened.notes.levels) == (3, (1, 2, 3))
    assert opened.place(2) == 1


def test_colour_and_language_apart_come_back(tmp_path: Path):
    config = composed(*TINY, "trainer=smoke", "trainer.iterations=2", "sharing=none", "fusion=none", "pictures=false", f"results={tmp_path}")  # fmt: skip
    assert run(config) == 0
    opened = open_run(next((tmp_path / "runs").iterdir()))
    seen = opened.field.render(opened.cameras()[0].camera, frozenset({"color", "feature"}))
    assert seen.color is not None
    assert seen.color.any()
    assert opened.ask(["mug"]).prompts.names == ("mug",)


def test_planes_that_a_query_learned_come_back(folder: Path, opened: OpenedRun):
    words = torch.eye(512)[:2]
    planes = [Plane(torch.randn(512), 0.25), Plane(torch.randn(512), -1.5)]
    field: Field = with_planes(opened.field, words, planes)
    write_field(RunFolder(folder), field, 5)
    back, camera = open_run(folder).field, opened.cameras()[0].camera
    asked = torch.cat([words, torch.eye(512)[7:8]])
    assert torch.equal(back.similarity(camera, asked), field.similarity(camera, asked))
    assert not torch.equal(back.similarity(camera, asked), opened.field.similarity(camera, asked))


def test_a_run_that_trains_is_shown_as_of_its_last_checkpoint(folder: Path, opened: OpenedRun):
    run_folder = RunFolder(folder)
    run_folder.field.unlink()
    run_folder.metrics.unlink()
    training, camera = open_run(folder), opened.cameras()[0].camera
    assert training.step == 60
    outputs = frozenset({"color", "feature"})
    one, other = (field.render(camera, outputs) for field in (training.field, opened.field))
    assert one.color is not None
    assert other.color is not None
    assert torch.equal(one.color, other.color)
    shutil.rmtree(run_folder.checkpoint)
    with pytest.raises(ValueError, match=r"must have a trained scene .* or a checkpoint"):
        open_run(folder)


def test_what_is_no_run_is_refused(tmp_path: Path, folder: Path):
    with pytest.raises(ValueError, match=r"must be the folder of a run, with config\.yaml in it"):
        open_run(tmp_path)
    run_folder = RunFolder(folder)
    content = decode(run_folder.field, FORM)
    run_folder.field.write_bytes(encode(content, "vlgs-field-2"))
    with pytest.raises(
        ValueError, match="format vlgs-field-1, got 'vlgs-field-2'; another version"
    ):
        open_run(folder)
    data = bytearray(encode(content, FORM))
    data[-5] ^= 1
    run_folder.field.write_bytes(data)
    with pytest.raises(ValueError, match="does not match its digest"):
        open_run(folder)
    run_folder.scene.unlink()
    with pytest.raises(ValueError, match=r"scene\.safetensors: must be there, got none"):
        open_run(folder)
    run_folder.config.write_text("fusion: {_target_: os.system}\n")
    with pytest.raises(ValueError, match="config"):
        open_run(folder)


@pytest.mark.parametrize(
    "text",
    [
        *("", "words\n", "{", "[1]", "fusion: 3\n", "fusion: [a\n", "a: &x [*x]\n"),
        *("data: {_target_: 3}\n", "fusion: {_target_: vlgs.fusion.gone.Gone}\n"),
    ],
)
def test_a_configuration_that_is_none_is_one_line_with_its_file(folder: Path, text: str):
    RunFolder(folder).config.write_text(text)
    with pytest.raises(ValueError, match=r"runs/\w+/config\.yaml: ") as said:
        open_run(folder)
    assert "\n" not in str(said.value)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"query": None}, "got none of query"),
        ({"text": None}, "got none of text"),
        ({"query": {"_target_": "vlgs.queries.Relevancy"}}, "query._target_ must be a class"),
        ({"query": {"temperature": "hot"}}, "query: temperature must be a finite number"),
    ],
)
def test_a_value_that_cannot_be_is_told_with_its_file(
    folder: Path, changed: dict[str, Any], message: str
):
    file = RunFolder(folder).config
    content = yaml.safe_load(file.read_text())
    for key, value in changed.items():
        content[key] = {**content[key], **value} if value else value
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=rf"runs/\w+/config\.yaml: .*{message}"):
        open_run(folder)


LAB = """from vlgs.fusion.attention import SelfAttention


class Same(SelfAttention):
    pass
"""


@pytest.fixture
def owned(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A run with a fusion of a package of one's own."""
    (folder.parent / "my_lab.py").write_text(LAB)
    monkeypatch.syspath_prepend(folder.parent)
    config = RunFolder(folder).config
    text = config.read_text()
    assert "vlgs.fusion.attention.SelfAttention" in text
    config.write_text(text.replace("vlgs.fusion.attention.SelfAttention", "my_lab.Same"))
    rewrite(folder, lambda plan, _: plan.update(fusion="my_lab.Same"))
    yield folder
    sys.modules.pop("my_lab", None)


def test_a_part_of_ones_own_is_made_where_the_command_line_trusts_its_package(
    owned: Path, opened: OpenedRun
):
    config = RunFolder(owned).config
    config.write_text(config.read_text().replace("plugins: []", "plugins: [my_lab]"))
    with pytest.raises(ValueError, match=r"fusion\._target_ must be .*: --plugins my_lab$"):
        open_run(owned)  # the file's word is nobody's
    assert "my_lab" not in sys.modules
    with pytest.raises(ValueError, match="plugins: no_lab must be importable, from the current"):
        open_run(owned, plugins=["no_lab"])
    with pytest.raises(ValueError, match=r"plugins must be packages of your own.*got 'os'"):
        open_run(owned, plugins=["os"])
    back, camera = open_run(owned, plugins=["my_lab"]).field, opened.cameras()[0].camera
    one, other = (field.render(camera, frozenset({"color"})) for field in (back, opened.field))
    assert one.color is not None
    assert other.color is not None
    assert torch.equal(one.color, other.color)


@pytest.mark.parametrize(
    ("name", "main"), [("query", query), ("render", render), ("export", export), ("view", view)]
)
def test_every_command_takes_packages_that_it_may_trust(
    name: str, main: Callable[[list[str]], None], owned: Path, tmp_path: Path
):
    words = {"query": ["mug", "--no-pictures"], "render": ["--out", str(tmp_path / "r")]}
    words |= {"export": [str(tmp_path / "o.ply")], "view": ["--picture", str(tmp_path / "v.png")]}
    given = [str(owned), *words[name]]
    with pytest.raises(SystemExit, match=r"--plugins my_lab$"):
        main(given)
    main([*given, "--plugins", "my_lab"])


def set_kind(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    plan["kind"] = "pickle"


def set_fusion(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    plan["fusion"] = "os.system"


def set_head(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    plan["head"] = f"{Classifier.__module__}.Classifier"


def drop_opacities(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    del tensors["splats.opacity_logits"]


def cut_means(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    tensors["splats.means"] = tensors["splats.means"][:-1].clone()


def make_nan(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    tensors["splats.means"][0, 0] = torch.nan


def widen_codes(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    tensors["splats.features"] = torch.zeros(len(tensors["splats.means"]), 4)


def raise_degree(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    plan["sh_degree"] = 10**9


def forget_attributes(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    del plan["attributes"]


def no_list(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    plan["attributes"] = 7


def strange_raster(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    plan["raster"] = {**plan["raster"], "near": -1.0}


def huge_grid(plan: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    grid = {"levels": 64, "features": 64, "coarsest": 16, "finest": 1 << 20, "log2_table": 24}
    plan.clear()
    plan |= {
        "kind": "radiance", "radiance": {"grid": grid, "cells": 8}, "samples": 4, "scales": [],
        "scale": 1.0, "spacing": {"near": 0.1, "far": 2.0},
    }  # fmt: skip
    tensors |= {"frame.center": torch.zeros(3), "frame.points": torch.zeros(0, 3)}


@pytest.mark.parametrize(
    "change",
    [set_kind, set_fusion, set_head, drop_opacities, cut_means, make_nan, widen_codes, raise_degree,
     forget_attributes, no_list, strange_raster, huge_grid],
)  # fmt: skip
def test_a_hostile_field_is_one_error(folder: Path, change: Any):
    rewrite(folder, change)
    with pytest.raises(ValueError, match=r"field\.safetensors: "):
        open_run(folder)


@pytest.mark.parametrize(
    ("key", "value"),
    [("views", 3), ("splits", ["train"]), ("levels", []), ("words", ["a"]), ("classes", [1])],
)
def test_hostile_notes_are_one_error(folder: Path, key: str, value: Any):
    path = RunFolder(folder).scene
    content = decode(path, "vlgs-scene-1")
    meta = {**content.meta, key: value}
    path.write_bytes(encode(Checkpoint(0, content.tensors, meta), "vlgs-scene-1"))
    with pytest.raises(ValueError, match=r"scene\.safetensors: "):
        open_run(folder)


def test_files_are_plain_tensors_for_others(finished: Path):
    tensors = load_file(RunFolder(finished).field)
    assert tensors["splats.means"].shape[1] == 3
    json.dumps(decode(RunFolder(finished).field, FORM).meta)


PHOTOGRAPHS = Path(__file__).parents[1] / "fixtures" / "photographs"


def test_photographs_without_language_are_looked_at_and_not_asked(tmp_path: Path):
    silent = ("data=colmap", f"data.root={PHOTOGRAPHS}", "data.resize=0.25")
    config = composed(
        *silent, "trainer=smoke", "trainer.iterations=3", "progress=false", f"results={tmp_path}"
    )
    assert run(config) == 0
    opened = open_run(next((tmp_path / "runs").iterdir()), within=0.01)
    assert not opened.field.has_language
    camera = opened.cameras("test")[0].camera
    color = opened.field.render(camera, frozenset({"color"})).color
    assert color is not None
    assert color.shape == (camera.height, camera.width, 3)
    with pytest.raises(ValueError, match="cannot be asked for words"):
        opened.ask(["mug"])
