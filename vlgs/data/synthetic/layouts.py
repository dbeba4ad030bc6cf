"""Everything of a scene in the world frame: what stands on the table, and what surrounds it."""

import numpy as np

from vlgs.data.synthetic.objects import Thing, place
from vlgs.data.synthetic.outdoors import surroundings
from vlgs.data.synthetic.room import FLOOR, floor, table, wall
from vlgs.data.synthetic.scene_file import SceneFile

DIFFICULTIES = ("easy", "hard")


def build(scene: SceneFile, difficulty: str, rng: np.random.Generator) -> tuple[Thing, ...]:
    """The things of a scene in the world frame: what stands on the table first, then table, wall and floor.

    Another seed moves every thing by up to 1 cm and turns it by up to 12 degrees: a sibling of the scene, not a copy.
    """
    spots = scene.objects + (scene.hard if difficulty == "hard" else ())
    things = []
    for spot in spots:
        dx, dy, turned = (rng.uniform(-1, 1, 3) * (0.01, 0.01, 12.0)).tolist()
        things.append(place(spot.thing, spot.x + dx, spot.y + dy, spot.degrees + turned))
    if scene.stage in ("room", "ring"):
        return (*things, table(), wall(scene.light), floor())
    return (*things, table(), *surroundings(scene.stage, FLOOR))
