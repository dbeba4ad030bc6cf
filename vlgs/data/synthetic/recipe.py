"""The settings that determine a procedural scene."""

import hashlib
from dataclasses import astuple, dataclass, field, replace

from vlgs.data.synthetic import outdoors
from vlgs.data.synthetic.layouts import DIFFICULTIES, SCENES, STAGED
from vlgs.data.synthetic.masks import Faults

VERSION = 1
"""Part of every fingerprint; raise it with any change that moves a pixel, a label, a point or a vector."""
MAX_VIEWS = 9999
"""Largest number of training views. The label faults of further, rendered views are drawn with higher numbers."""


@dataclass(frozen=True)
class Recipe:
    """All parameters but the mask level; `load_scene` says what they mean."""

    scene: str = "glassware"
    difficulty: str = "easy"
    width: int = 200
    height: int = 150
    train_views: int = 40
    test_views: int = 8
    seed: int = 0
    points: int = 4000
    faults: Faults = field(default_factory=Faults)

    def __post_init__(self):
        for name, value, options in (
            ("scene", self.scene, (*SCENES, *STAGED)),
            ("difficulty", self.difficulty, DIFFICULTIES),
        ):
            if value not in options:
                raise ValueError(
                    f"synthetic: {name} must be one of {', '.join(options)}, got {value!r}"
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
        """Hash of the parameters, with faults as they come out, and of the generator's version."""
        resolved = replace(self, faults=self.faults.resolve(self.difficulty))
        text = f"vlgs.data.synthetic {VERSION} {astuple(resolved)} {level}"
        if self.scene in STAGED:
            text += f" outdoors {outdoors.VERSION}"
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
