"""Scenes that are written down: things made of simple shapes, and where they stand on the table (conf/data/README.md)."""

import functools
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from vlgs.data.synthetic.language import NEGATIVES
from vlgs.data.synthetic.lights import Light, light_on_table
from vlgs.data.synthetic.objects import OTHER, TRANSLUCENT_REFLECTIVE, Thing
from vlgs.data.synthetic.outdoors import STAGES
from vlgs.data.synthetic.parts import Colors, read_color, read_part
from vlgs.data.synthetic.room import LAMP, TABLE_RADIUS
from vlgs.data.untrusted.nodes import Node, read_yaml

_FOLDER = Path(__file__).parent
SCENES = tuple(sorted(path.stem for path in (_FOLDER / "scenes").glob("*.yaml")))
"""Names of the scenes that come with the package."""
MOST_PARTS = 240
"""Of a scene with all its things: one byte numbers them, those of the surroundings too."""
_KEYS = ("like", "stage", "light", "exposure", "colors", "props", "objects", "hard")
_SPANS = ((-2.25, 2.25), (-2.25, 2.25), (0.3, 1.85))
"""Where in the room a light may be: x, y and z."""
RESERVED = ("wooden table", "wall", "tiled floor", "sky", *NEGATIVES)
"""Classes of the surroundings, and the words that every question is compared with."""


@dataclass(frozen=True)
class Spot:
    """A thing and its place on the table."""

    thing: Thing
    x: float
    y: float
    degrees: float
    """About the vertical."""


@dataclass(frozen=True)
class SceneFile:
    """What stands on the table, and what surrounds it."""

    name: str
    key: str
    """Tells scenes apart: the name of one that comes with the package, a hash of the content of any other."""
    stage: str
    """``room``, or one of `vlgs.data.synthetic.outdoors.STAGES`."""
    objects: tuple[Spot, ...]
    hard: tuple[Spot, ...]
    """What stands there too where it is to be hard."""
    light: Light = LAMP
    exposure: float = 0.0
    """Photographs differ by up to so many stops to either side (`vlgs.data.synthetic.photographs.exposures`)."""

    @property
    def outdoors(self) -> bool:
        """Whether it is photographed from a ring or an arc."""
        return self.stage in STAGES


def find_scene(scene: str) -> SceneFile:
    """The scene of a name, or of a file.

    Raises:
        ValueError: If there is none of that name, or the file is wrong (a `SceneError`, which says where).
    """
    if scene in SCENES:
        return _shipped(scene)
    if not scene.endswith((".yaml", ".yml")):
        names = ", ".join(SCENES)
        raise ValueError(
            f"synthetic: scene must be one of {names}, or the path of a .yaml file, got {scene!r}"
        )
    path = Path(scene)
    try:
        node = read_yaml(path)
    except FileNotFoundError:
        raise ValueError(f"synthetic: scene must be a file that exists, got {scene}") from None
    read = _read_scene(node, path.stem)
    text = json.dumps(node.value, sort_keys=True)
    return replace(read, key=hashlib.blake2b(text.encode(), digest_size=16).hexdigest())


@functools.cache
def _shipped(name: str) -> SceneFile:
    return _read_scene(read_yaml(_FOLDER / "scenes" / f"{name}.yaml"), name)


@functools.cache
def _library() -> tuple[Colors, Mapping[str, Thing]]:
    entries = read_yaml(_FOLDER / "props.yaml").mapping()
    colors = _palette(entries["colors"], {})
    return colors, _props(entries["props"], colors)


def _read_scene(node: Node, name: str) -> SceneFile:
    entries = node.entries(_KEYS)
    base = SceneFile(name, name, "room", (), ())
    if "like" in entries:
        base = replace(_shipped(entries["like"].option(SCENES)), name=name, key=name)
    colors, props = _library()
    if "colors" in entries:
        colors = _palette(entries["colors"], colors)
    if "props" in entries:
        props = {**props, **_props(entries["props"], colors)}
    objects, hard = (_spots(entries[k], props) if k in entries else () for k in ("objects", "hard"))
    stage = entries["stage"].option(("room", *STAGES)) if "stage" in entries else base.stage
    read = replace(
        base,
        stage=stage,
        objects=base.objects + objects,
        hard=base.hard + hard,
        light=_light(entries["light"]) if "light" in entries else base.light,
        exposure=entries["exposure"].number(0, 2) if "exposure" in entries else base.exposure,
    )
    if not read.objects:
        raise node.wrong("a scene with objects, or like another", list(entries))
    things = [spot.thing for spot in read.objects + read.hard]
    if (parts := sum(len(thing.parts) for thing in things)) > MOST_PARTS:
        raise node.wrong(f"a scene of at most {MOST_PARTS} parts", parts)
    kinds = {thing.name: thing.kind for thing in things}
    for thing in things:
        if kinds[thing.name] != thing.kind:
            raise node.wrong("a scene whose things of one class are of one kind", thing.name)
    return read


def _light(node: Node) -> Light:
    entries = node.entries(("at", "radius", "power", "ambient"), ("at", "radius"))
    items = entries["at"].items(3, 3)
    x, y, z = (item.number(*span) for item, span in zip(items, _SPANS, strict=True))
    shares = {key: entries[key].number(0, 1) for key in ("power", "ambient") if key in entries}
    given = {"power": LAMP.power, "ambient": LAMP.ambient} | shares
    return light_on_table((x, y, z), entries["radius"].number(0.01, 0.6), **given)


def _spots(node: Node, props: Mapping[str, Thing]) -> tuple[Spot, ...]:
    spots = []
    for item in node.items(0, MOST_PARTS):
        entries = item.entries(("prop", "at", "turn"), ("prop", "at"))
        thing = props[entries["prop"].option(props)]
        x, y = entries["at"].numbers(2, -TABLE_RADIUS, TABLE_RADIUS)
        if x * x + y * y > TABLE_RADIUS**2:
            raise entries["at"].wrong(f"on the table, {TABLE_RADIUS} from its middle at most")
        degrees = entries["turn"].number(-360, 360) if "turn" in entries else 0.0
        spots.append(Spot(thing, x, y, degrees))
    return tuple(spots)


def _palette(node: Node, known: Colors) -> Colors:
    return {**known, **{name: read_color(entry, {}) for name, entry in node.mapping().items()}}


def _props(node: Node, colors: Colors) -> dict[str, Thing]:
    return {name: _thing(name, entry, colors) for name, entry in node.mapping().items()}


def _thing(prop: str, node: Node, colors: Colors) -> Thing:
    entries = node.entries(("class", "kind", "parts"), ("parts",))
    word = entries.get("class", Node(node.file, node.place, prop.replace("_", " ")))
    name = word.value
    if not isinstance(name, str) or not 0 < len(name) <= 64 or not name.isprintable():
        raise word.wrong("a class of 1 to 64 printable characters")
    if name != name.strip() or name.lower() in RESERVED:
        raise word.wrong(f"a class without blanks around it and none of {', '.join(RESERVED)}")
    kinds = (OTHER, TRANSLUCENT_REFLECTIVE)
    kind = entries["kind"].option(kinds) if "kind" in entries else OTHER
    parts = [read_part(item, colors) for item in entries["parts"].items(1, MOST_PARTS)]
    return Thing(name, tuple(parts), kind)
