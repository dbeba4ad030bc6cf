"""A light of a scene's own, whose shadows fall on things, and photographs of unequal exposure."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vlgs.data.synthetic import SceneSettings, capture, layouts, load_scene
from vlgs.data.synthetic.lights import Light, light_on_table
from vlgs.data.synthetic.objects import Material, Part, Thing
from vlgs.data.synthetic.patterns import Plain
from vlgs.data.synthetic.photographs import exposures
from vlgs.data.synthetic.room import LAMP, floor, table, wall
from vlgs.data.synthetic.scene_file import find_scene
from vlgs.data.synthetic.shapes import Box
from vlgs.data.synthetic.tracer import trace
from vlgs.data.synthetic.world import World

SMALL: dict[str, Any] = {"width": 48, "height": 36, "train_views": 6, "test_views": 2, "points": 50}
OPAQUE = Material(Plain((0.2, 0.2, 0.2)))
CLEAR = Material(Plain((1.0, 1.0, 1.0)), "glass", opacity=0.2)
OVERHEAD = light_on_table((0.0, 0.0, 1.5), 0.3, power=0.4, ambient=0.3)


def block(material: Material, center: tuple[float, float, float], *half: float) -> Thing:
    x, y, z = half
    return Thing("block", (Part(Box((x, y, z)), material, center),))


@functools.cache
def screened(light: Light, screen: Material) -> World:
    """A block with a top at height 0.2, and a screen over x > 0 halfway up to a light at 1.5."""
    grey = Material(Plain((0.8, 0.8, 0.8), grain=0.0))
    things = (
        block(grey, (0.0, 0.0, 0.1), 0.4, 0.1, 0.1),
        block(screen, (0.3, 0.0, 0.85), 0.3, 0.5, 0.001),
    )
    return World((*things, table(), wall(light), floor()), light)


def brightness(light: Light, screen: Material, x: float) -> float:
    """Of the block's top at (x, 0), relative to its colour."""
    start = np.array([[x], [-0.6], [0.5]])
    towards = np.array([[x], [0.0], [0.2]]) - start
    seen = trace(screened(light, screen), start, towards / np.linalg.norm(towards))
    assert seen.first.part[0] == 0
    return float(seen.color[0, 0]) / 0.8


def left_of(x: float, radius: float) -> float:
    """Share of a disc around the origin that lies at less than x."""
    s = np.clip(x / radius, -1, 1)
    return float(0.5 + (np.arcsin(s) + s * np.sqrt(1 - s * s)) / np.pi)


@pytest.mark.parametrize("x", [-0.32, -0.2, -0.1, -0.03, 0.04, 0.15, 0.25, 0.32])
def test_a_screen_over_half_the_light_leaves_the_other_half(x: float):
    """The ray to a point g of the light passes the screen's height at (x + g) / 2: light comes from where g < -x."""
    facing = 1.3 / np.hypot(1.3, x)
    share = (brightness(OVERHEAD, OPAQUE, x) - 0.4) / (0.4 * facing)
    count = (OVERHEAD.points()[:, 0] < -x).mean()
    # The screen is 2 mm thick; no point of the light lies that near to its shadow's edge here.
    assert share == pytest.approx(count, abs=1e-9)
    assert share == pytest.approx(left_of(-x, 0.3), abs=0.06)
    through = count + (1 - count) * 0.7
    assert brightness(OVERHEAD, CLEAR, x) == pytest.approx(0.4 + 0.4 * facing * through, abs=1e-9)


def test_the_lamp_at_the_ceiling_casts_no_shadow_on_things():
    center = np.array(LAMP.center)
    for x in (-0.3, 0.3):
        towards = center - (x, 0.0, 0.2)
        lit = towards[2] / np.linalg.norm(towards)
        assert brightness(LAMP, OPAQUE, x) == pytest.approx(0.6 + 0.55 * lit)


def test_points_of_a_light_are_a_disc_that_looks_at_the_table():
    light = light_on_table((1.6, -0.8, 1.2), 0.3, 0.5, 0.5)
    offset = light.points() - light.center
    assert np.abs(offset @ np.array(light.center)).max() < 1e-12
    assert np.linalg.norm(offset, axis=1).max() == pytest.approx(0.3, rel=0.02)
    assert np.abs(offset.mean(axis=0)).max() < 0.02
    np.testing.assert_allclose(np.array(light.axes).T @ np.array(light.axes), np.eye(3), atol=1e-12)


def test_culling_misses_no_shadow():
    scene = find_scene("sunroom")
    world = World(layouts.build(scene, "hard", np.random.default_rng(0)), scene.light)
    rng = np.random.default_rng(1)
    point = rng.uniform((-0.7, -0.7, 0.01), (0.7, 0.7, 0.3), (400, 3)).T
    goals = scene.light.points().T
    want = np.zeros(point.shape[1])
    for goal in goals.T:
        towards = goal[:, None] - point
        length = np.linalg.norm(towards, axis=0)
        through = np.ones(point.shape[1])
        for thing in world.things[:-2]:
            for part in thing.parts:
                rotation = np.array(part.rotation)
                start = rotation.T @ (point - np.array(part.center)[:, None])
                ahead = rotation.T @ (towards / length)
                t, _ = part.shape.intersect(start, ahead, np.zeros(point.shape[1]))
                through[t < length] *= 0.7 if part.material.kind == "glass" else 0.0
        want += through / goals.shape[1]
    got = world.counted_share(point)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)
    assert 20 < ((want > 0.1) & (want < 0.9)).sum() < 200  # some are in half shadow


@pytest.mark.parametrize("count", [2, 7, 40])
def test_gains_of_photographs_are_1_on_average(count: int):
    gains = exposures(0.4, count, np.random.default_rng(0))
    assert gains.mean() == pytest.approx(1, abs=1e-15)
    steps = np.diff(np.sort(np.log2(gains)))
    np.testing.assert_allclose(steps, 0.8 / count)
    assert (exposures(0.0, count, np.random.default_rng(0)) == 1).all()


def images(scene: Path, seed: int = 0, cache: str | None = None) -> list[torch.Tensor]:
    """Six training photographs, then two held-out ones."""
    loaded = load_scene(str(scene), **SMALL, seed=seed, cache=cache)
    return [view.read_image().double() for view in (*loaded.train, *loaded.test)]


def test_training_photographs_have_gains_and_held_out_ones_have_none(tmp_path: Path):
    even, uneven = tmp_path / "even.yaml", tmp_path / "uneven.yaml"
    even.write_text("objects: [{prop: tomato, at: [0, 0]}]\n")
    uneven.write_text(even.read_text() + "exposure: 0.4\n")
    drawn = []
    for seed in (0, 1):
        cache = str(tmp_path / "cache")
        plain, bright = images(even, seed), images(uneven, seed, cache)
        capture._kept.cache_clear()
        again = images(uneven, seed, cache)
        assert all(torch.equal(a, b) for a, b in zip(bright, again, strict=True))
        assert all(torch.equal(a, b) for a, b in zip(bright[6:], plain[6:], strict=True))
        gains = []
        for a, b in zip(bright[:6], plain[:6], strict=True):
            gains.append(float(a[a < 250].sum() / b[a < 250].sum()))
            assert (a - (gains[-1] * b).clamp(max=255)).abs().max() < 1.5  # both are rounded
        assert np.mean(gains) == pytest.approx(1, abs=0.003)
        assert max(gains) / min(gains) == pytest.approx(2 ** (0.8 * 5 / 6), rel=0.01)
        drawn.append(np.argsort(gains).tolist())
    assert drawn[0] != drawn[1]


def test_scenes_without_a_light_and_an_exposure_are_what_they_were():
    known = {
        "wirework": "85bbe00a5db85e4a6ebfd4a614cb2dd5",
        "glassware_sky": "7578f491a19a6f58bb903954e14a8622",
        "patchwork_wall": "1be4a83b8105ece7e49912efe2a586fa",
    }
    for name, fingerprint in known.items():
        settings = SceneSettings(find_scene(name), "easy", 100, 75, 4, 2, 0, 500)
        assert settings.fingerprint(3) == fingerprint


def test_a_light_and_an_exposure_are_keys_of_a_file_and_of_what_is_like_it(tmp_path: Path):
    sunny = find_scene("sunroom")
    assert find_scene("sunroom_even").light == sunny.light != LAMP
    assert (sunny.exposure, find_scene("sunroom_even").exposure) == (0.4, 0)
    path = tmp_path / "mine.yaml"
    path.write_text("like: rows\nlight: {at: [-2.25, 2.25, 1.85], radius: 0.3}\nexposure: 1\n")
    mine = find_scene(str(path))
    assert mine.exposure == 1
    assert (mine.light.center, mine.light.power) == ((-2.25, 2.25, 1.85), LAMP.power)
    assert mine.light.on_things
