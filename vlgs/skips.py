"""The work that the code may leave out. The benchmark measures this table and the documentation prints it.

A skip is *exact* (the same numbers, to the bit or to float order), *bounded* (off by at most what `Skip.bound` says) or
*statistical*. A skip without a switch always pays and changes nothing; it is listed because it explains the speed.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Value = bool | float | None


@dataclass(frozen=True)
class Skip:
    """One piece of work that need not be done."""

    name: str
    setting: str
    """Dotted key of the configuration; empty where the skip cannot be turned off."""
    on: Value
    """Value of the key with which the work is left out."""
    off: Value
    """Value of the key with which it is done."""
    default: Literal["on", "off"]
    """Whether the work is left out where a run does not set the key."""
    kind: Literal["exact", "bounded", "statistical"]
    bound: str
    """Exact: ``same bits`` or ``<= 1e-6``. Bounded: the formula in words."""
    what: str
    """One sentence: what is not computed."""
    source: str

    @property
    def switchable(self) -> bool:
        """Whether there is a key that turns the skip off, so that its saving can be measured."""
        return bool(self.setting)

    def override(self, on: bool) -> str:
        """The Hydra override that turns it on or off.

        Example:
            >>> named("tile_test").override(on=False)
            'raster.tile_test=false'
        """
        if not self.switchable:
            raise ValueError(f"skip {self.name}: must have a switch to be turned, got none")
        value = self.on if on else self.off
        return f"{self.setting}={str(value).lower() if isinstance(value, bool) else value}"


def _always(name: str, bound: str, what: str, source: str) -> Skip:
    return Skip(name, "", None, None, "on", "exact", bound, what, source)


SKIPS: tuple[Skip, ...] = (
    Skip(
        "tile_test", "raster.tile_test", True, False, "on", "exact", "same bits",
        "A Gaussian is not listed in a tile of its bounding box that its ellipse does not reach.",
        "Speedy-Splat 2412.00578 (AccuTile)",
    ),
    Skip(
        "block_masks", "raster.block_masks", True, False, "on", "exact", "same bits",
        "A Gaussian is not weighed in a 4x4 block of a tile that its ellipse does not reach.",
        "row intervals, csrc/README.md",
    ),
    Skip(
        "opacity_extent", "raster.opacity_extent", True, False, "on", "exact", "same bits",
        "The ellipse ends where weight times falloff is alpha_min; off: where a weight of 1 would be.",
        "StopThePop 2402.00525, B.2",
    ),
    Skip(
        "shared_chain", "raster.share_chains", True, False, "on", "exact", "<= 1e-6",
        "Groups blended with one weight tensor share one alpha and transmittance (indicator=opacity).",
        "vlgs",
    ),
    Skip(
        "early_stop", "raster.transmittance_min", 1e-4, 0.0, "on", "bounded",
        "stop=after: transmittance_min * largest value; stop=before: that / (1 - alpha_max)",
        "What lies behind a pixel's transmittance_min is not blended; per group, and a block ends when all its groups have.",
        "3DGS; the bound: tests/README.md, N10",
    ),
    Skip(
        "blend_zero", "trainer.skip.blend_weight", 0.0, -1.0, "on", "exact", "same bits",
        "The blended view is not rendered where lambda * SSIM(I1, I2) is 0.",
        "Eq. 11, SSIM clamped at 0",
    ),
    Skip(
        "blend_small", "trainer.skip.blend_weight", 0.5, 0.0, "off", "bounded",
        "the loss changes by at most blend_weight * MSE of the blended view",
        "The blended view is not rendered where lambda * SSIM(I1, I2) <= blend_weight.",
        "Eq. 11",
    ),
    Skip(
        "blend_reuse", "trainer.skip.blend_reuse", 0.01, 0.0, "off", "bounded",
        "the camera is off by at most blend_reuse * the distance and the angle between the two views",
        "The blended view is not rendered where min(k, 1 - k) < blend_reuse: the real view's language stands for it, for densification too.",
        "42 % of Beta(0.2, 0.2) lie within 0.01 of an end",
    ),
    Skip(
        "frozen_weights", "trainer.skip.frozen_weights", True, False, "on", "exact", "<= 1e-6",
        "With frozen geometry (trainer.freeze) lists and blending weights of a view are kept, and a render is a sparse product.",
        "LangSplat trains features on frozen 3DGS; the rest is vlgs",
    ),
    _always(
        "culling", "same bits",
        "Gaussians behind the camera, beside the image or below alpha_min in every group are neither sorted nor listed.",
        "3DGS",
    ),
    _always(
        "unneeded_gradients", "same bits",
        "Gradients that nothing asks for are not formed: of frozen parameters, of a group whose image the loss does not use.",
        "autograd",
    ),
    _always(
        "frozen_color", "same bits",
        "With frozen weights the colour image of a view is kept too where nothing that it depends on is trained.",
        "vlgs",
    ),
    _always(
        "unused_modality", "same bits",
        "A blended view renders language alone, a view without language its colour alone; a scene without language is not fused either.",
        "Eq. 12",
    ),
    _always(
        "similarity_cache", "same bits",
        "SSIM(I1, I2) is a constant of a pair and computed once.",
        "Eq. 11",
    ),
    _always(
        "sh_degree", "same bits",
        "Spherical harmonics of degrees that have not joined yet are not evaluated.",
        "3DGS",
    ),
    _always(
        "unmasked_pixels", "same bits",
        "Pixels without a mask form no language error.",
        "LangSplat",
    ),
    _always(
        "known_runs", "same bits",
        "A run that exists is reported, not repeated (on_existing=resume).",
        "the run id hashes all that can move a number",
    ),
    _always(
        "known_models", "same bits",
        "Of a run that differs from a finished one in query, protocol or text alone the models are taken, not trained again.",
        "nothing asks for these before the last step",
    ),
)  # fmt: skip
"""In the order of the documentation: rasterizer, training, what has no switch."""


def named(name: str) -> Skip:
    """The skip of that name.

    Raises:
        ValueError: If there is none.
    """
    for skip in SKIPS:
        if skip.name == name:
            return skip
    raise ValueError(f"skips: name must be one of {[s.name for s in SKIPS]}, got {name!r}")


def turn(names: Iterable[str], on: bool) -> tuple[str, ...]:
    """The Hydra overrides that turn several skips on or off together.

    Raises:
        ValueError: If two of them want different values of one key.

    Example:
        >>> turn(["tile_test", "frozen_weights"], on=True)
        ('raster.tile_test=true', 'trainer.skip.frozen_weights=true')
    """
    chosen: dict[str, str] = {}
    for skip in map(named, names):
        override = skip.override(on)
        if chosen.setdefault(skip.setting, override) != override:
            raise ValueError(
                f"skips: {skip.setting} must have one value, got {chosen[skip.setting]} and {override} of {skip.name}"
            )
    return tuple(chosen.values())


def markdown_table() -> str:
    """`SKIPS` as conf/README.md shows them."""
    rows = []
    for s in SKIPS:
        switch = f"`{s.setting}`: {_value(s.on)} / {_value(s.off)}" if s.switchable else "always on"
        default = s.default if s.switchable else "on"
        rows.append(f"| `{s.name}` | {switch} | {default} | {s.kind}, {s.bound} | {s.what} |")
    head = (
        "| skip | switch: on / off | default | class | what is left out |\n|---|---|---|---|---|\n"
    )
    return head + "\n".join(rows)


def _value(value: Value) -> str:
    return str(value).lower() if isinstance(value, bool) else f"{value:g}"
