"""Scenes that a user writes: the example of conf/data/README.md is trained, and what is wrong in a file is refused by name."""

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import pytest
from tiny_runs import TINY, composed

from vlgs.check import check
from vlgs.data.diagnostics import SceneError
from vlgs.data.synthetic import load_scene
from vlgs.data.synthetic.scene_file import SCENES, find_scene
from vlgs.data.untrusted.nodes import read_yaml
from vlgs.run import run

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = re.findall(
    r"^```yaml\n(.*?)^```$", (ROOT / "conf/data/README.md").read_text(), re.M | re.S
)[0]
SMALL: dict[str, Any] = {
    "width": 48,
    "height": 36,
    "train_views": 4,
    "test_views": 2,
    "points": 100,
}
CUP = "props: {cup: {parts: [{sphere: {radius: 0.1}, matte: {color: red}}]}}\n"
PLACED = "objects: [{prop: cup, at: [0, 0]}]\n"


@pytest.mark.usefixtures("unchecked")
def test_the_example_of_the_manual_is_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    Path("breakfast.yaml").write_text(EXAMPLE)
    smoke = ("trainer=smoke", "trainer.iterations=10", "pictures=false", "results=results")
    assert run(composed("data=synthetic", "data.scene=breakfast.yaml", *TINY, *smoke)) == 0
    (written,) = Path("results/runs").glob("*/metrics.json")
    metrics = json.loads(written.read_text())
    assert metrics["scene"] == "breakfast"
    assert {"egg cup", "glass of juice", "steel pot"} <= set(metrics["per_category"])
    assert metrics["miou_translucent_reflective"] is not None


@pytest.mark.usefixtures("unchecked")
def test_content_counts_and_the_file_does_not(tmp_path: Path):
    one, other, moved = (tmp_path / name for name in ("one.yaml", "other.yml", "moved.yaml"))
    one.write_text(CUP + PLACED)
    other.write_text("# The same.\n" + PLACED + CUP)
    moved.write_text(CUP + PLACED.replace("[0, 0]", "[0, 0.1]"))
    scenes = [load_scene(str(path), **SMALL) for path in (one, other, moved)]
    assert [scene.name for scene in scenes] == ["one", "other", "moved"]
    prints = [scene.fingerprint for scene in scenes]
    assert prints[0] == prints[1] != prints[2]
    masks = [view.read_masks for scene in scenes for view in scene.train[:1]]
    assert all(masks)
    images = [scene.train[0].read_image() for scene in scenes]
    assert images[0].equal(images[1])
    assert not images[0].equal(images[2])


def test_objects_are_those_of_another_scene_and_more(tmp_path: Path):
    path = tmp_path / "more.yaml"
    path.write_text(f"like: mirrors\nstage: sky\n{CUP}{PLACED}")
    more, mirrors = find_scene(str(path)), find_scene("mirrors")
    assert more.objects[:-1] == mirrors.objects
    assert more.hard == mirrors.hard
    assert more.objects[-1].thing.name == "cup"
    assert more.stage == "sky"


def part(text: str) -> str:
    return f"props: {{cup: {{parts: [{{{text}}}]}}}}\n{PLACED}"


WRONG = {
    "colour: {}": "must be a mapping with the keys like, stage, light, exposure, colors, props, objects, hard, got 'colour'",
    "[]": "must be a mapping, got []",
    CUP: "must be a scene with objects, or like another",
    "like: kitchen": "like: must be one of glassware",
    f"stage: moon\n{CUP}{PLACED}": "stage: must be one of room, ring, sky, wall, got 'moon'",
    "like: mirrors\nlight: 1": "light: must be a mapping, got 1",
    "like: mirrors\nlight: {at: [1, 0, 1]}": "light: must be a mapping with the key radius, got ['at']",
    "like: mirrors\nlight: {at: [1, 0, 1], radius: 0.2, color: red}": "light: must be a mapping with the keys at, radius, power, ambient, got 'color'",
    "like: mirrors\nlight: {at: [1, 0, 0], radius: 0.2}": "light.at[2]: must be a number from 0.3 to 1.85, got 0",
    "like: mirrors\nlight: {at: [1, 0, 1], radius: 0}": "light.radius: must be a number from 0.01 to 0.6, got 0",
    "like: mirrors\nlight: {at: [1, 0, 1], radius: 0.2, power: 2}": "light.power: must be a number from 0 to 1, got 2",
    "like: mirrors\nexposure: -1": "exposure: must be a number from 0 to 2, got -1",
    "like: mirrors\nexposure: [0.4]": "exposure: must be a number from 0 to 2, got [0.4]",
    "objects: [{prop: cup, at: [0, 0]}]": "objects[0].prop: must be one of",
    CUP + "objects: [{prop: cup, at: [0.6, 0.6]}]": "objects[0].at: must be on the table",
    CUP + "objects: [{prop: cup, at: [0, 1]}]": "objects[0].at[1]: must be a number from -0.72 to 0.72, got 1",
    CUP + "objects: [{prop: cup, at: 0}]": "objects[0].at: must be a list of 2, got 0",
    CUP + "objects: [{prop: cup}]": "objects[0]: must be a mapping with the key at",
    CUP.replace("cup", "sky") + PLACED: "props.sky: must be a class without blanks around it and none of",
    CUP.replace("{parts", "{class: 7, parts") + PLACED: "props.cup.class: must be a class of 1 to 64",
    CUP.replace("{parts", "{kind: odd, parts") + PLACED: "props.cup.kind: must be one of other",
    part("sphere: {radius: 0.1}"): "props.cup.parts[0]: must be a mapping with one of the keys matte, glass, mirror, got []",
    part("sphere: {radius: 9}, glass: {}"): "props.cup.parts[0].sphere.radius: must be a number from 0.001 to 0.5, got 9",
    part("sphere: {radius: .nan}, glass: {}"): "must be a number from 0.001 to 0.5, got nan",
    part("sphere: {radius: true}, glass: {}"): "must be a number from 0.001 to 0.5, got True",
    part("sphere: {radius: 1.0e-2x}, glass: {}"): "must be a number from 0.001 to 0.5, got '1.0e-2x'",
    part("sphere: {size: 1}, glass: {}"): "props.cup.parts[0].sphere: must be a mapping with the keys radius, got 'size'",
    part("torus: {major: 0.1, minor: 0.2}, glass: {}"): "torus: must be a torus whose tube",
    part("cone: {bottom: 0, top: 0, height: 0.1}, glass: {}"): "cone: must be a cone with a radius above 0",
    part("turned: {heights: [0, 0, 0], radii: [0.1, 0.1, 0.1]}, glass: {}"): "turned: must be turned at rising heights",
    part("cylinder: {radius: 0.1, height: 0.1, open_top: 1}, glass: {}"): "open_top: must be true or false, got 1",
    part("sphere: {radius: 0.1}, glass: {color: pink}"): "glass.color: must be one of red, orange",
    part("sphere: {radius: 0.1}, glass: {color: [1, 2, 3]}"): "glass.color[1]: must be a number from 0 to 1, got 2",
    part("sphere: {radius: 0.1}, matte: {}"): "matte: must be matte with one of the keys color, plain",
    part("sphere: {radius: 0.1}, glass: {}, turn: {x: 1, y: 2}"): "turn: must be a turn about one axis",
    "like: patchwork\n" + part("sphere: {radius: 0.1}, glass: {}").replace("{parts", "{class: mug, kind: translucent_reflective, parts"):
        "things of one class are of one kind, got 'mug'",
    CUP + CUP: "line 2: must have every key once, got 'props'",
    "a: &a [1]\nb: *a": "line 2: must have no aliases, got *a",
    "[" * 500: "must have at most 20 levels",
    "a: !!python/object/apply:os.getcwd []": "line 1: must be YAML, got: could not determine a constructor",
    "a: [": "line 2: must be YAML, got:",
    "a: 2001-99-99": "must be YAML, got: month must be in 1..12",
    CUP + f"objects: [{', '.join(['{prop: cup, at: [0, 0]}'] * 241)}]": "objects: must be a list of 0 to 240, got",
    "x: " + "y" * (1 << 20): "must have at most 1048576 characters",
}  # fmt: skip


@pytest.mark.parametrize(("text", "said"), WRONG.items(), ids=range(len(WRONG)))
def test_what_is_wrong_is_named(tmp_path: Path, text: str, said: str):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(SceneError) as error:
        find_scene(str(path))
    assert str(path) in str(error.value)
    assert said in str(error.value)
    assert len(str(error.value)) < 1000


def test_a_file_that_is_no_text_is_named(tmp_path: Path):
    path = tmp_path / "mine.yaml"
    path.write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(SceneError, match=f"{path}, byte 0: content must be UTF-8 text"):
        check(composed("data=synthetic", f"data.scene={path}", *TINY).data)


def test_the_scenes_of_the_package_are_what_they_were():
    """Their fingerprints do not see their files: raise VERSION in vlgs/data/synthetic/settings.py where one is changed."""
    later, sun = ("rows", "smallware", "wirework"), ("sunroom", "sunroom_even")
    first = [name for name in SCENES if name not in later + sun]
    assert (len(first), digest_of("props.yaml", *first)) == (16, "d2f395a7085ce840")
    assert digest_of(*later) == "6b5547b79ed7df5c"
    assert digest_of(*sun) == "d99c72c228b7e2f9"


def digest_of(*names: str) -> str:
    folder = ROOT / "vlgs/data/synthetic"
    files = [name if name.endswith(".yaml") else f"scenes/{name}.yaml" for name in names]
    text = json.dumps([read_yaml(folder / file).value for file in files], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
