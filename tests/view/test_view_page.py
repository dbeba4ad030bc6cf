"""The viewer in a real browser: a typed word, moved camera and pressed button, and the pixels that come of them."""

import io
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Heard, launched, screenshot, watched
from PIL import Image
from plyfile import PlyData
from serving import Serving, serving

from vlgs.opened import open_run
from vlgs.opened.answers import ask_view
from vlgs.view.eye import Eye, eye_of
from vlgs.view.paint import paint
from vlgs.view.shown import Effort, Shown
from vlgs.view.wish import Wish

WIDTH, HEIGHT = 900, 400
CORNER = (np.s_[150:300], np.s_[60:300])
"""Rows and columns of the picture on which nothing of the page lies."""


@dataclass
class Page:
    """The viewer on the screen."""

    page: Any
    heard: Heard

    def picture(self) -> np.ndarray:
        """The pixels of the scene, with what lies over its corners."""
        return screenshot(self.page.locator("canvas").first)

    def settled(self, seconds: float = 60) -> np.ndarray:
        """The picture once it no longer changes."""
        before, until = self.picture(), time.monotonic() + seconds
        while time.monotonic() < until:
            time.sleep(0.5)
            now = self.picture()
            if (
                now.shape == before.shape
                and np.abs(now.astype(int) - before).max() < 3
                and now[CORNER].std() > 1
            ):
                return now
            before = now
        raise AssertionError("the picture never settles")

    def ask(self, word: str) -> None:
        area = self.page.locator("textarea").first
        area.fill("")
        area.type(word + "\n")

    def choose(self, index: int, option: str) -> None:
        """An option of a list; they are counted from the top, after one in the page's own settings."""
        self.page.locator("input[aria-haspopup=listbox]").nth(1 + index).click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def wait_for(self, text: str) -> None:
        self.page.get_by_text(text).first.wait_for(timeout=60_000)


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[Serving]:
    with serving(str(folder)) as one:
        yield one


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as one:
        yield one


@pytest.fixture
def page(server: Serving, browser: Any) -> Iterator[Page]:
    with watched(browser, WIDTH, HEIGHT, accept_downloads=True) as (made, heard):
        made.goto(server.url)
        made.wait_for_selector("canvas")
        one = Page(made, heard)
        one.wait_for("Gaussians")
        # viser tells a browser without a graphics card so, on top of the picture.
        made.add_style_tag(content=".mantine-Notifications-root { display: none }")
        yield one
        assert heard.errors == []
        assert all(server.url.partition("//")[2] in address for address in heard.asked)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    error = np.square(one[CORNER] / 255.0 - other[CORNER] / 255.0).mean()
    return float(-10 * np.log10(max(error, 1e-12)))


def first_eye(shown: Shown, picture: np.ndarray) -> Eye:
    """Where a browser looks from when it comes: all of the photograph's height is seen."""
    camera = shown.run.held_out()[0].camera
    eye = eye_of(camera, 2 * camera.width, camera.height)
    return replace(eye, width=picture.shape[1], height=picture.shape[0])


def test_the_page_shows_what_we_render(page: Page, shown: Shown):
    picture = page.settled()
    eye = first_eye(shown, picture)
    want = paint([shown], Wish(eye), eye.camera(), Effort()).pixels.numpy()
    assert psnr(picture, want) >= 30
    flipped = want[:, ::-1]
    assert psnr(picture, flipped) < 25


def test_a_typed_word_changes_the_picture_where_the_object_is(page: Page, shown: Shown):
    before = page.settled()
    page.choose(1, "mask")
    page.ask("mug")
    page.wait_for("mug: 0")
    after = page.settled()
    eye = first_eye(shown, after)
    answer = ask_view(shown.run.field, eye.camera(), shown.learn("mug"))
    mask = answer.relevancy[0, 0] > shown.range("mug", None).threshold(0.7)
    there = mask.numpy()[CORNER]
    changed = np.abs(after[CORNER].astype(int) - before[CORNER]).max(axis=2) > 24
    # A mask leaves the object as it was and turns all else grey and dark.
    assert there.any()
    assert changed[there].mean() < 0.1
    assert changed[~there].mean() > 0.8
    want = paint([shown], Wish(eye, "mask", "mug"), eye.camera(), Effort()).pixels.numpy()
    assert psnr(after, want) >= 25


@pytest.mark.slow
def test_an_unknown_word_is_answered_in_words(page: Page):
    before = page.settled()
    page.ask("zeppelin")
    page.wait_for("error:")
    page.wait_for("--vocabulary FILE")
    assert np.abs(page.settled()[CORNER].astype(int) - before[CORNER]).max() < 3
    page.ask("mug")
    page.wait_for("mug: 0")


@pytest.mark.slow
def test_a_photographs_camera_can_be_jumped_to(page: Page, shown: Shown):
    before = page.settled()
    view = shown.run.cameras("train")[3]
    page.choose(2, f"train {view.name}")
    after = page.settled()
    eye = eye_of(view.camera, after.shape[1], after.shape[0])
    want = paint([shown], Wish(eye), eye.camera(), Effort()).pixels.numpy()
    assert psnr(after, want) >= 30
    assert psnr(before, want) < 25


@pytest.mark.slow
def test_the_picture_and_the_gaussians_of_a_word_are_downloaded(page: Page, shown: Shown):
    page.ask("mug")
    page.wait_for("mug: 0")
    picture = page.settled()
    with page.page.expect_download() as download:
        page.page.get_by_role("button", name="Save picture").click()
    assert download.value.suggested_filename == "mug.png"
    saved = np.asarray(Image.open(io.BytesIO(Path(download.value.path()).read_bytes())))
    assert saved.shape == picture.shape
    assert psnr(picture, saved) >= 30
    with page.page.expect_download() as download:
        page.page.get_by_role("button", name="Save Gaussians").click()
    assert download.value.suggested_filename == "mug.ply"
    vertices = PlyData.read(download.value.path())["vertex"]
    assert shown.count is not None
    assert 0 < len(vertices) < shown.count


@pytest.mark.slow
def test_two_browsers_have_a_picture_each_and_a_closed_one_ends(
    server: Serving, browser: Any, page: Page, shown: Shown
):
    before = page.settled()
    with watched(browser, WIDTH, HEIGHT) as (made, _):
        made.goto(server.url)
        other = Page(made, page.heard)
        other.wait_for("Gaussians")
        other.ask("lemon")
        other.wait_for("lemon: 0")
        assert psnr(other.settled(), before) < 25
        assert np.abs(page.settled()[CORNER].astype(int) - before[CORNER]).max() < 3
    page.ask("mug")  # the server goes on for the one that stays
    page.wait_for("mug: 0")


@pytest.mark.slow
def test_two_runs_are_shown_in_one_picture(browser: Any, folder: Path):
    with (
        serving(str(folder), str(folder)) as both,
        watched(browser, WIDTH, HEIGHT) as (made, heard),
    ):
        made.goto(both.url)
        page = Page(made, heard)
        page.wait_for("Gaussians")
        picture = page.settled()
        shown = Shown(open_run(folder))
        eye = first_eye(shown, picture)
        wish = Wish(eye, layout="divided")
        want = paint([shown, shown], wish, eye.camera(), Effort()).pixels.numpy()
        assert psnr(picture, want) >= 25
        middle = picture[CORNER[0], picture.shape[1] // 2 - 1]
        assert middle.min() > 180  # the line between the two
        assert heard.errors == []
