"""The settings that determine a procedural scene."""

import hashlib
from dataclasses import astuple, dataclass, field

from vlgs.data.synthetic import lights, outdoors
from vlgs.data.synthetic.layouts import DIFFICULTIES
from vlgs.data.synthetic.masks import LabelNoise
from vlgs.data.synthetic.room import LAMP
from vlgs.data.synthetic.scene_file import SceneFile, find_scene

VERSION = 1
"""Part of every fingerprint; raise it with any change that moves a pixel, a label, a point or a vector."""
MAX_VIEWS = 9999
"""Largest number of training views. The label faults of further, rendered views are drawn with higher numbers."""


@dataclass(frozen=True)
class SceneSettings:
    """All parameters but the mask level; `load_scene` says what they mean."""

    scene: SceneFile = field(default_factory=lambda: find_scene("glassware"))
    difficulty: str = "easy"
    width: int = 200
    height: int = 150
    train_views: int = 40
    test_views: int = 8
    seed: int = 0
    points: int = 4000
    faults: LabelNoise = field(default_factory=LabelNoise)

    def __post_init__(self):
        if self.difficulty not in DIFFICULTIES:
            raise ValueError(
                f"synthetic: difficulty must be one of {', '.join(DIFFICULTIES)}, got {self.difficulty!r}"
            )
        for name, low, high in (
            ("width", 16, 8192),
            ("height", 16, 8192),
            ("train_views", 2, MAX_VIEWS),
            ("test_views", 0, self.train_views - 1),
            ("seed", 0, 2**63 - 1),
            ("points", 0, 10**7),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(
                    f"synthetic: {name} must be in [{low}, {high}], got {getattr(self, name)}"
                )

    def fingerprint(self, level: int) -> str:
        """Hash of the parameters, the content of a scene file among them, with faults as they come out, and of the generator's version."""
        sizes = (self.width, self.height, self.train_views, self.test_views)
        *faults, shared = astuple(self.faults.resolve(self.difficulty))
        content = (self.scene.key, self.difficulty, *sizes, self.seed, self.points, tuple(faults))
        text = f"vlgs.data.synthetic {VERSION} {content} {level}"
        if shared and level != 3:  # whole things have the fates that the others share
            text += f" shared {shared}"
        if self.scene.outdoors:
            text += f" outdoors {outdoors.VERSION}"
        if self.scene.light != LAMP or self.scene.exposure:
            text += f" lights {lights.VERSION}"
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
