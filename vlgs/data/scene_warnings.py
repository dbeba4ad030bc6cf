"""Warnings about scenes that can be used but are probably not as intended. `vlgs.check` lists them, `vlgs.run` logs them."""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.data.diagnostics import Fault, listing, warning
from vlgs.types import Scene, View

_NEAR = 0.01
"""World units before a camera within which nothing is drawn (`RasterConfig.near`)."""

_TOO_CLOSE = 0.01
"""Share of a view's median depth; a point nearer than this fills the image."""

_FAR = 1e12
"""Coordinate beyond which a point is left out (`vlgs.gaussians.init.MAX_COORDINATE`)."""

_SMALL = 16
"""Pixels on the shorter side below which SSIM's window of 11 sees borders more than image."""

_FOCAL = (0.02, 500.0)
"""Focal lengths in image widths: fields of view of 175 and 0.1 degrees."""


def plausibility_warnings(scene: Scene, views: Sequence[View]) -> Iterator[Fault]:
    """Warnings about cameras, points, the scale of the world, labels that no test view has, and classes that differ in spelling only."""
    yield from _camera_warnings(views)
    yield from _point_warnings(scene)
    yield from _scale_warnings(scene, views)
    labelled = {v.name for v in views if v.read_dense_labels or v.read_object_labels}
    tested = labelled & {v.name for v in scene.test}
    if labelled and scene.test and not tested:
        what = f"labelled views should be tested, got {len(labelled)} of which none is held out"
        yield warning(scene.name, what, "nothing is scored: set data.split=holdout")
    by_key: dict[str, list[str]] = {}
    for name in scene.classes:
        by_key.setdefault("".join(filter(str.isalnum, name.casefold())), []).append(name)
    if twice := [name for names in by_key.values() if len(names) > 1 for name in names]:
        what = f"classes should differ in more than spelling, got {listing(map(repr, twice))}"
        yield warning(scene.name, what, "each is scored as a class of its own")


def _camera_warnings(views: Sequence[View]) -> Iterator[Fault]:
    """Image sizes, focal lengths and principal points that no photograph has."""
    small, focal, center = [], [], []
    for view in views:
        camera = view.camera
        (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
        if min(camera.width, camera.height) < _SMALL:
            small.append(f"{view.name} ({camera.width} x {camera.height})")
        if not all(_FOCAL[0] <= f / camera.width <= _FOCAL[1] for f in (fx, fy)):
            focal.append(f"{view.name} ({fx:.3g})")
        if not (abs(cx / camera.width - 0.5) <= 1 and abs(cy / camera.height - 0.5) <= 1):
            center.append(f"{view.name} ({cx:.3g}, {cy:.3g})")
    if small:
        what = f"images should be at least {_SMALL} pixels wide and high, got {listing(small, 3)}"
        yield warning("cameras", what, "scores of so few pixels mean little")
    if focal:
        low, high = _FOCAL
        what = f"focal lengths should be {low:g} to {high:g} image widths, got {listing(focal, 3)}"
        yield warning("cameras", what, "look at the cameras of the sparse model")
    if center:
        what = f"principal points should lie near the image, got {listing(center, 3)}"
        yield warning("cameras", what, "look at the cameras of the sparse model")


def _point_warnings(scene: Scene) -> Iterator[Fault]:
    """Points too far away to be used, or too few different ones to begin with."""
    if len(scene.points) == 0:
        what = "sparse points should be at least 1, got 0"
        yield warning(scene.name, what, "training begins with random points")
        return
    usable = (scene.points.abs() <= _FAR).all(dim=1)
    if not usable.all():
        what = f"sparse points should lie within {_FAR:g} world units, got {int((~usable).sum())} of {len(usable)} that do not"
        yield warning(scene.name, what, "these are left out")
    distinct = len(torch.unique(scene.points[usable], dim=0))
    if distinct < min(4, len(usable)):
        what = f"sparse points should be at least 4 different ones, got {distinct} of {len(usable)}"
        yield warning(scene.name, what, "little can grow from so few")


def _scale_warnings(scene: Scene, views: Sequence[View]) -> Iterator[Fault]:
    """Depths of the sparse points, view by view."""
    medians, close, blind = [], [], []
    for view in views:
        depth = _visible_depths(scene.points, view)
        if not len(depth):
            blind.append(view.name)
            continue
        medians.append(depth.median())
        if (depth < _TOO_CLOSE * medians[-1]).any():
            close.append(view.name)
    if not medians:
        return
    median = float(torch.stack(medians).median())
    if not 10 * _NEAR <= median <= 1e5:
        what = f"median depth of the points should be {10 * _NEAR} to 100000 world units, got {median:.3g}"
        advice = f"what is nearer than {_NEAR} is not drawn: scale the model"
        yield warning(scene.name, what, advice)
    if close:
        what = f"points should keep 1 % of a view's median depth from its camera, got nearer ones in {listing(close, 5)}"
        yield warning(scene.name, what, "their Gaussians begin as blobs before the lens")
    if blind:
        what = f"views should see a sparse point, got none in {listing(blind, 5)}"
        yield warning(scene.name, what, "wrong pose, or nothing was triangulated there")


def _visible_depths(points: Float[Tensor, "p 3"], view: View) -> Float[Tensor, " v"]:
    """Depths of the points that project into the image."""
    camera = view.camera
    x = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    x = x[x[:, 2] > 0]
    pixel = x @ camera.K.T
    xy = pixel[:, :2] / pixel[:, 2:]
    inside = (xy >= 0).all(dim=1) & (xy < torch.tensor([camera.width, camera.height])).all(dim=1)
    return x[inside, 2]
