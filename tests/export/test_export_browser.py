"""The page in a browser: what it draws beside what vlgs draws, what its buttons do, and what it leaves alone."""

import base64
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import Heard, launched, screenshot, watched
from jaxtyping import Float
from PIL import Image
from slow import with_slow
from torch import Tensor
from two_balls import HOSTILE, THINGS, opened_scene

from vlgs.export import Wanted, export
from vlgs.opened import OpenedRun
from vlgs.opened.answers import ask_view, gaussian_relevancy, ranges
from vlgs.report.colors import heat_over, to_uint8
from vlgs.types import Camera, RasterConfig

Array = np.ndarray


class Shown:
    """A page in a browser, and the run that it was made from."""

    def __init__(self, page: Any, heard: Heard, opened: OpenedRun) -> None:
        self.page, self.heard, self.opened = page, heard, opened

    def look(self, camera: Camera) -> Array:
        """What it draws from a camera."""
        said = {
            "viewmat": camera.viewmat.tolist(),
            "K": camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
        }
        url = self.page.evaluate("async (camera) => (await vlgs).look(camera)", said)
        data = base64.b64decode(url.partition(",")[2])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def quiet(self) -> bool:
        """Whether nothing went wrong, and nothing was asked of a network."""
        return self.heard == Heard()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as browser:
        yield browser


KINDS = {
    "one shape": {},
    "own shape": {"own_shape": True},
    "other constants": {"raster": RasterConfig(eps2d=0.1, near=3.8, near_sigmas=40.0)},
}
"""How the scene of a page was trained; at 3.8 units the near plane cuts through the nearer ball."""


@pytest.fixture(scope="module", params=with_slow(KINDS, ["one shape"]))
def shown(
    request: pytest.FixtureRequest, browser: Any, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Shown]:
    """A page with three words and a hostile one, at the size of a small window."""
    folder = tmp_path_factory.mktemp("page")
    opened = opened_scene(folder / "run", **KINDS[request.param])
    export(opened, folder / "page.html", Wanted(words=[*THINGS, HOSTILE]))
    with watched(browser, 700, 480) as (page, heard):
        page.goto(f"file://{folder}/page.html")
        page.locator("#controls").wait_for()
        yield Shown(page, heard, opened)


def psnr(got: Array, want: Array) -> float:
    error = np.mean((got.astype(float) - want) ** 2) / 255**2
    return float(-10 * np.log10(max(error, 1e-12)))


def answered(shown: Shown, camera: Camera, word: int) -> Float[Tensor, "h w"]:
    """Relevancy of single Gaussians, blended by the kernel: the mean over what a pixel shows."""
    opened = shown.opened
    field: Any = opened.field
    relevancy = gaussian_relevancy(field, opened.ask(THINGS))[word]
    values = torch.stack([relevancy, torch.ones_like(relevancy)], dim=1)
    total, weight = field.render_values(camera, values, field.language_weights()).unbind(2)
    return torch.where(weight > 0, total / weight, 0.0)


def test_colour_is_that_of_our_own_renderer(shown: Shown):
    shown.page.evaluate("async () => (await vlgs).ask(null)")
    for one in shown.opened.cameras():
        color = shown.opened.field.render(one.camera, frozenset({"color"})).color
        assert color is not None
        assert psnr(shown.look(one.camera), to_uint8(color).numpy()) > 40
    assert shown.quiet()


def test_a_word_shows_its_heat_over_grey_and_dims_what_does_not_answer(shown: Shown):
    camera = shown.opened.cameras("test")[0].camera
    button = shown.page.get_by_role("button", name="green ball")
    button.click()
    assert button.get_attribute("aria-pressed") == "true"
    got = shown.look(camera).astype(float)
    color = shown.opened.field.render(camera, frozenset({"color"})).color
    assert color is not None
    relevancy = answered(shown, camera, word=1)
    asked = shown.opened.ask(THINGS)
    cameras = [one.camera for one in shown.opened.held_out()]
    heat = ranges(shown.opened.field, cameras, asked)[1]
    want = heat_over(to_uint8(color), heat.shares(relevancy)).numpy()
    answers = relevancy > heat.threshold()
    want = np.where(answers.numpy()[..., None], want, 0.4 * want)
    # Rounding to 8 bits may move what is nearly a tie.
    clear = ((relevancy - heat.threshold()).abs() > 0.02).numpy()
    assert clear.mean() > 0.8
    assert psnr(got[clear], want[clear]) > 32
    button.click()  # once more takes it off
    assert button.get_attribute("aria-pressed") == "false"
    assert shown.quiet()


def test_a_word_leaves_its_object_in_colour_and_nothing_else(shown: Shown):
    camera = shown.opened.cameras("test")[0].camera
    shown.page.evaluate("async () => (await vlgs).ask(null)")
    plain = shown.look(camera).astype(float)
    shown.page.get_by_role("button", name="red ball").click()
    shown.page.get_by_label("colour", exact=True).check()
    cut = shown.look(camera).astype(float)
    asked = shown.opened.ask(THINGS)
    heat = ranges(shown.opened.field, [camera], asked)[0]
    relevancy = ask_view(shown.opened.field, camera, asked).relevancy[0, 0]
    mask = (relevancy > heat.threshold()).numpy()
    assert 0.03 < mask.mean() < 0.3
    kept = np.abs(cut - plain).max(axis=2) <= 1
    bright = plain.max(axis=2) > 30
    assert kept[mask & bright].mean() > 0.8
    assert kept[~mask & bright].mean() < 0.05

    slider = shown.page.locator("#threshold")
    slider.evaluate("(it) => { it.value = it.min; it.dispatchEvent(new Event('input')); }")
    low = np.abs(shown.look(camera) - plain).max(axis=2) <= 1
    slider.evaluate("(it) => { it.value = it.max; it.dispatchEvent(new Event('input')); }")
    high = np.abs(shown.look(camera) - plain).max(axis=2) <= 1
    assert low[bright].mean() > 0.95
    assert high[bright].mean() < 0.05
    assert shown.page.locator("#value").inner_text() == shown.page.evaluate(
        "() => document.getElementById('threshold').valueAsNumber.toFixed(3)"
    )
    shown.page.get_by_label("heat", exact=True).check()
    assert shown.quiet()


# They know nothing of how the scene was trained.
@pytest.mark.parametrize("shown", with_slow(KINDS, set(KINDS) - {"own shape"}), indirect=True)
def test_hand_and_keys_move_the_picture_and_cameras_bring_it_back(shown: Shown):
    page = shown.page
    page.evaluate("async () => (await vlgs).ask(null)")
    canvas = page.locator("#canvas")
    rested = "() => new Promise((done) => setTimeout(done, 700))"

    def picture() -> Array:
        page.evaluate(rested)  # the picture is drawn with all pixels again
        return screenshot(canvas)[4:-4, 4:-4].astype(
            float
        )  # without the outline of what has the focus

    first = picture()
    page.mouse.move(200, 200)
    page.mouse.down()
    page.mouse.move(260, 220, steps=3)
    page.mouse.up()
    turned = picture()
    assert psnr(turned, first) < 25
    page.keyboard.press("r")
    assert psnr(picture(), first) > 45
    page.mouse.wheel(0, 300)
    assert psnr(picture(), first) < 30
    page.get_by_role("button", name="Next camera").click()
    assert (
        page.locator("#cameras").evaluate("(it) => it.selectedOptions[0].text") == "view_0 (train)"
    )
    page.get_by_role("button", name="Camera before").click()
    assert psnr(picture(), first) > 45
    page.keyboard.press("2")
    assert page.locator("#status").inner_text().endswith("asked for green ball.")
    page.keyboard.press("Escape")
    assert "asked" not in page.locator("#status").inner_text()
    assert shown.quiet()


def test_a_hostile_word_stays_text(shown: Shown):
    page = shown.page
    assert page.title() == "two balls"
    assert page.locator("img").count() == 1  # the picture of the scene
    button = page.get_by_role("button", name=HOSTILE)
    button.click()
    assert button.inner_text() == HOSTILE
    button.click()
    assert shown.quiet()


def test_without_webgl_there_is_a_picture_and_a_sentence(tmp_path: Path):
    export(opened_scene(tmp_path / "run", name=HOSTILE), tmp_path / "page.html", Wanted())
    with launched(graphics=False) as browser, watched(browser, 390, 844) as (page, heard):
        page.goto(f"file://{tmp_path}/page.html")
        page.get_by_text("WebGL 2").wait_for()
        assert page.title() == HOSTILE
        assert page.locator("#picture").evaluate("(it) => it.complete && it.naturalWidth") == 96
        assert not page.locator("#controls").is_visible()
        assert heard == Heard()
