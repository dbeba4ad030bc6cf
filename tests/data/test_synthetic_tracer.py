"""What rays see: first surfaces, glass, mirrors, and labels that are exact."""

import numpy as np
import pytest
import torch

from vlgs.data.synthetic import layouts, tracer
from vlgs.data.synthetic.cameras import camera_at, moments
from vlgs.data.synthetic.objects import Material, Part, Thing
from vlgs.data.synthetic.patterns import Plain
from vlgs.data.synthetic.photographs import photograph, pixel_rays
from vlgs.data.synthetic.room import LAMP
from vlgs.data.synthetic.scene_file import find_scene
from vlgs.data.synthetic.shapes import Box, sphere
from vlgs.data.synthetic.tracer import PANE, trace
from vlgs.data.synthetic.world import NOTHING, Hits, World


def room(*things: Thing) -> World:
    return World(
        (*things, *layouts.build(find_scene("glassware"), "easy", np.random.default_rng(0))[-3:])
    )


def ball(material: Material, x: float, y: float = 0.0) -> Thing:
    return Thing("ball", (Part(sphere(0.1), material, (x, y, 0.5)),))


def look(world: World, origin, direction) -> tracer.Traced:
    direction = np.array(direction, float)[:, None] / np.linalg.norm(direction)
    return trace(world, np.array(origin, float)[:, None], direction)


@pytest.fixture(scope="module")
def world() -> World:
    return World(layouts.build(find_scene("patchwork"), "hard", np.random.default_rng(1)))


def test_culling_misses_no_hit(world):
    rng = np.random.default_rng(0)
    origin = rng.uniform((-0.9, -0.9, 0.0), (0.9, 0.9, 1.8), (3000, 3)).T
    direction = rng.normal(size=(3, 3000))
    direction /= np.linalg.norm(direction, axis=0)
    for start in (origin, origin[:, :1]):
        got = world.first_hit(start, direction, np.zeros(3000))
        want = np.full(3000, np.inf)
        for part in world.parts:
            rotation = np.array(part.rotation)
            local = rotation.T @ (start - np.array(part.center)[:, None])
            t, _ = part.shape.intersect(local, rotation.T @ direction, np.zeros(3000))
            want = np.minimum(want, t)
        np.testing.assert_allclose(got.t, want, rtol=0, atol=1e-9)
        assert (got.part != NOTHING).all()


def test_ray_through_the_centre_of_a_thing_sees_that_thing():
    things = layouts.build(find_scene("lookalikes"), "easy", np.random.default_rng(0))
    world = World(things)
    apple = next(i for i, thing in enumerate(things) if thing.name == "red apple")
    center = np.array(things[apple].parts[0].center)
    seen = look(world, center + np.array((0.0, 0.0, 1.2)), (0.01, 0.0, -1.0))
    assert world.thing_of_part[seen.first.part[0]] == apple
    camera = camera_at(0.3, np.random.default_rng(0), 120, 90)
    photo = photograph(world, camera)
    x, y, z = camera.K @ (
        camera.viewmat[:3, :3] @ torch.from_numpy(center).float() + camera.viewmat[:3, 3]
    )
    part = photo.part[int(y / z), int(x / z)]
    assert world.thing_of_part[part] == apple


def test_label_is_that_of_the_pixel_centre(world):
    camera = camera_at(0.6, np.random.default_rng(0), 64, 48)
    photo = photograph(world, camera)
    y, x = np.divmod(np.arange(64 * 48), 64)
    origin, direction = pixel_rays(camera, x + 0.5, y + 0.5)
    want = world.first_hit(origin, direction, np.zeros(x.size))
    np.testing.assert_array_equal(photo.part.ravel(), want.part)
    np.testing.assert_allclose(photo.distance.ravel(), want.t, rtol=1e-6)


def test_glass_covers_by_its_opacity_and_keeps_its_label():
    screen = Material(Plain((0.2, 0.6, 0.4), grain=0.0))
    wall = Thing("screen", (Part(Box((0.01, 0.5, 0.5)), screen, (0.5, 0.0, 0.5)),))
    clear = Material(Plain((1.0, 1.0, 1.0), grain=0.0), "glass", opacity=0.2)
    bare = look(room(wall), (-1, 0, 0.5), (1, 0, 0)).color
    seen = look(room(ball(clear, 0.0), wall), (-1, 0, 0.5), (1, 0, 0))
    want = bare
    for _ in range(2):  # the back of the ball, then its front, both face on
        want = 0.2 * PANE + 0.8 * want
    np.testing.assert_allclose(seen.color, want, atol=1e-9)
    assert seen.first.part[0] == 0


def test_mirror_shows_what_lies_in_the_reflected_direction():
    silver = Material(Plain((1.0, 1.0, 1.0), grain=0.0), "mirror", reflectance=1.0)
    flat = Thing("mirror", (Part(Box((0.01, 0.4, 0.4)), silver, (0.5, 0.0, 0.5)),))
    glow = Material(Plain((0.3, 0.9, 0.1), grain=0.0), "light")
    lamp = ball(glow, -0.3, 0.6)
    # From y = -0.6 the mirror at x = 0.49 is hit at y = 0, and the lamp lies at the mirrored angle.
    seen = look(room(flat, lamp), (-0.3, -0.6, 0.5), (0.79, 0.6, 0.0))
    np.testing.assert_allclose(seen.color[:, 0], (0.3, 0.9, 0.1), atol=1e-9)
    assert seen.first.part[0] == 0


def test_two_facing_mirrors_end():
    silver = Material(Plain((1.0, 1.0, 1.0), grain=0.0), "mirror", reflectance=1.0)
    pair = [
        Thing("mirror", (Part(Box((0.01, 0.4, 0.4)), silver, (x, 0.0, 0.5)),)) for x in (-0.5, 0.5)
    ]
    seen = look(room(*pair), (0, 0, 0.5), (1, 0.01, 0))
    assert np.isfinite(seen.color).all()


def test_table_is_darker_beside_a_ball_on_the_far_side_of_the_lamp():
    white = Material(Plain((1.0, 1.0, 1.0), grain=0.0))
    world = room(Thing("ball", (Part(sphere(0.1), white, (0.0, 0.0, 0.1)),)))
    shade = next(iter(world.shades.values()))
    lamp = np.array(LAMP.center[:2])
    away = -lamp / np.linalg.norm(lamp)
    points = np.stack([[*(0.08 * away), 0.0], [*(-0.4 * away), 0.0]], axis=1)
    np.testing.assert_allclose(shade.at(points), [0.0, 1.0], atol=0.02)


def test_rays_that_hit_nothing_are_black(world):
    nothing = Hits(np.array([np.inf]), np.array([NOTHING], np.uint8), np.zeros(1, np.uint8))
    color, _, _ = world.surface(nothing, np.zeros((3, 1)))
    assert (color == 0).all()


@pytest.mark.parametrize(("train", "test"), [(40, 8), (2, 1), (9, 8), (5, 0)])
def test_held_out_moments_lie_halfway_between_two_training_ones(train, test):
    seen, held = moments(train, test)
    assert len(seen) == train
    assert len(set(held)) == test
    for moment in held:
        nearest = np.sort(np.abs(seen - moment))[:2]
        np.testing.assert_allclose(nearest, 0.5 / (train - 1))


def test_cameras_stand_around_the_table_and_look_at_it():
    for moment in np.linspace(0, 1, 20):
        camera = camera_at(moment, np.random.default_rng(0), 200, 150)
        rotation = camera.viewmat[:3, :3].double()
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double(), atol=1e-6, rtol=0)
        assert torch.det(rotation) == pytest.approx(1, abs=1e-5)
        middle = camera.viewmat[:3, 3]  # the world's origin in camera axes
        assert 1.2 < middle[2] < 1.7
        assert middle[:2].norm() < 0.2
        assert (rotation[1, 2] < 0).item()  # the image's down is the world's down
