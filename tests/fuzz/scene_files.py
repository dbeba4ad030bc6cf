"""Scene files of others (conf/data/README.md): numbers, words and lines of a good one exchanged, and small files that unfold."""

import random
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from tests.fuzz.judge import Attack
from vlgs.data.synthetic import load_scene
from vlgs.data.synthetic.scene_file import SCENES

GOOD = """\
like: mirrors
stage: ring
light: {at: [1.2, -0.5, 1.1], radius: 0.3, power: 0.7, ambient: 0.4}
exposure: 0.5
colors: {teal: [0.1, 0.5, 0.5]}
props:
  egg_cup:
    class: egg cup
    kind: other
    parts:
      - {cone: {bottom: 0.03, top: 0.05, height: 0.09}, matte: {bands: {colors: [teal, red], period: 0.03}, gloss: 0.2}}
      - {turned: {heights: [0, 0.04, 0.085], radii: [0.05, 0.095, 0.12]}, glass: {color: teal, opacity: 0.3}}
      - {torus: {major: 0.05, minor: 0.01}, mirror: {reflectance: 0.5}, center: [0, 0, 0.1], turn: {y: 30}}
      - {box: {half: [0.1, 0.1, 0.1]}, matte: {cells: {colors: [red, blue], size: [0.02, 0.02, 0.02]}}}
      - {ellipsoid: {radius: 0.04, half_height: 0.05}, matte: {gradient: {low: red, high: blue, start: 0, end: 0.1}}}
objects:
  - {prop: egg_cup, at: [-0.15, -0.3], turn: 20}
  - {prop: steel_pot, at: [0.1, 0.2]}
hard: [{prop: red_apple, at: [-0.3, 0.1]}]
"""
ODD = (
    *("0", "-1", "1e308", "-1e308", "5e-324", ".nan", ".inf", "1_000", "0x10", "1:30", "2001-01-01"),
    *("null", "true", "[]", "{}", "''", "'\\0'", '"\\u202e"', "9" * 5000, "~", "<<", "? a", "- - -"),
    *("&a [*a]", "*a", "!!python/name:os.system", "!!binary a", "wall", "object", "/etc/passwd"),
)  # fmt: skip
BOMBS = {
    "aliases": "a: &a [1, 1]\n" + "".join(f"b{i}: &b{i} [*a, *a]\n" for i in range(40)),
    "merges": "a: &a {b: 1}\nprops: {<<: *a}\n",
    "deep lists": "[" * 100_000,
    "deep mappings": "{a: " * 100_000,
    "deep sequences": "- " * 100_000,
    "many keys": "props: {" + ", ".join(f"k{i}: {{}}" for i in range(70_000)) + "}",
    "many props": "props:\n" + "".join(
        f"  p{i}: {{parts: [{{sphere: {{radius: 0.1}}, glass: {{}}}}]}}\n" for i in range(15_000)),
    "many objects": "objects: [" + "{prop: lemon, at: [0, 0]}, " * 30_000 + "]",
    "large": "# " + "x" * (8 << 20),
    "zeros": "\0" * (1 << 20),
}  # fmt: skip


def attacks(folder: Path, seed: int, count: int) -> Iterator[Attack]:
    """The bombs, then `count` files with one to three values of the good one exchanged."""
    rng = random.Random(seed)
    assert "mirrors" in SCENES
    for name, text in BOMBS.items():
        path = folder / f"{name.replace(' ', '_')}.yaml"
        path.write_text(text)
        yield Attack(name, partial(_load, path), path.name, must_refuse=True)
    for number in range(count):
        text, done = GOOD, []
        for _ in range(rng.randint(1, 3)):
            places = [m.span() for m in re.finditer(r"[\w.-]+", text)]
            start, end = rng.choice(places)
            word = rng.choice((*ODD, text[slice(*rng.choice(places))]))
            done.append(f"{text[start:end][:20]} -> {word[:20]}")
            text = text[:start] + word + text[end:]
        path = folder / f"scene_{number}.yaml"
        path.write_text(text)
        yield Attack("; ".join(done), partial(_load, path), path.name)


def _load(path: Path) -> None:
    load_scene(str(path), "hard", 16, 16, train_views=2, test_views=1, points=20)
