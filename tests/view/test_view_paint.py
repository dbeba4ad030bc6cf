"""What is drawn is what the field says when it is asked directly; what was rendered for a camera is not rendered again."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.fields import Field, FieldImages, HasGaussians, depth_of, gaussians_of
from vlgs.fields.several import SeveralFields
from vlgs.gaussians import read_ply
from vlgs.opened.answers import ask_view, ranges, select_gaussians
from vlgs.report import colors
from vlgs.report.indicator import indicator_difference
from vlgs.types import Camera
from vlgs.view.eye import Eye, part
from vlgs.view.few import Stale, few_pixels
from vlgs.view.paint import paint
from vlgs.view.save import answering_ply
from vlgs.view.session import Frame, Session, describe
from vlgs.view.shown import Effort, Shown
from vlgs.view.wish import OUTPUTS, Wish
from vlgs.view.worker import Stage

ALL = Effort(keep=True)


def refuse(reason: str) -> None:
    raise AssertionError(reason)


def rendered(field: Field, camera: Camera) -> Float[Tensor, "h w 3"]:
    color = field.render(camera, frozenset({"color"})).color
    assert color is not None
    return color


def test_all_outputs_are_offered(shown: Shown):
    assert shown.outputs == OUTPUTS
    assert shown.count == gaussians_count(shown.run.field)
    two = Shown(replace(shown.run, field=Joint(shown.run.field)))
    assert two.gaussians is not None
    assert len(two.gaussians) == 2
    assert two.count == shown.count  # two levels of the same Gaussians


def gaussians_count(field: Field) -> int:
    gaussians = gaussians_of(field)
    assert gaussians is not None
    return len(gaussians[0].opacities())


def test_outputs_without_words_are_those_of_the_field(shown: Shown, eye: Eye):
    field, camera = shown.run.field, eye.camera()
    pixels = paint([shown], Wish(eye), camera, ALL).pixels
    assert torch.equal(pixels, colors.to_uint8(rendered(field, camera)))

    pixels = paint([shown], Wish(eye, "indicator - opacity"), camera, ALL).pixels
    gaussians = gaussians_of(field)
    assert gaussians is not None
    assert torch.equal(pixels, colors.diverging(indicator_difference(gaussians[0], camera)))

    depth = depth_of(field, camera)
    low, high = shown.depths()
    pixels = paint([shown], Wish(eye, "depth"), camera, ALL).pixels
    assert torch.equal(
        pixels, colors.heat(1 - (depth - low) / (high - low)) * (depth > 0)[..., None]
    )
    assert low > 0

    feature = field.render(camera, frozenset({"feature"})).feature
    assert feature is not None
    pixels = paint([shown], Wish(eye, "language"), camera, ALL).pixels
    bounds = shown.colors(0)
    want = (feature[0] @ bounds.axes - bounds.low) / (bounds.high - bounds.low)
    assert (pixels.float() - 255 * want.clamp(0, 1)).abs().max() < 1


def test_words_are_answered_as_by_ask_view(shown: Shown, eye: Eye):
    camera, word = eye.camera(), "mug"
    answer = ask_view(shown.run.field, camera, shown.learn(word))
    wish = Wish(eye, "relevancy", word, opacity=0.5)
    picture = paint([shown], wish, camera, ALL)
    bounds = shown.range(word, None)
    color = colors.to_uint8(answer.color)
    heat = colors.heat_over(color, bounds.shares(answer.relevancy[0, 0]), 0.5)
    assert (picture.pixels.int() - heat.int()).abs().max() <= 1  # bands are another sum
    (answered,) = picture.answers
    assert answered is not None
    assert answered.score == pytest.approx(answer.score(0), abs=1e-5)
    assert not answered.approximate

    mask = answer.relevancy[0, 0] > bounds.threshold(0.6)
    assert mask.any()
    assert not mask.all()
    pixels = paint([shown], replace(wish, output="mask", share=0.6), camera, ALL).pixels
    assert torch.equal(pixels[mask], color[mask])
    grey = (color.float() @ torch.tensor([0.299, 0.587, 0.114]))[~mask]
    assert (pixels[~mask].float() - 0.5 * grey[:, None]).abs().max() <= 0.51


def test_a_range_is_near_that_of_the_query_command(shown: Shown):
    asked = shown.learn("mug")
    (want,) = ranges(shown.run.field, [one.camera for one in shown.run.held_out()], asked)
    got = shown.range("mug", None)
    assert (got.low, got.high, got.tie) == pytest.approx((want.low, want.high, want.tie), abs=0.02)


def test_few_pixels_answer_nearly_as_all_do(shown: Shown, eye: Eye):
    shown.learn("mug")
    camera = eye.camera()
    exact = shown.relevancy(camera, "mug", ALL)
    few = shown.relevancy(camera, "mug", Effort(2000, keep=True))
    assert 0 < (few - exact).abs().mean() < 0.005


def test_each_mask_level_answers_for_itself(shown: Shown, eye: Eye):
    """Also where only one of them is chosen; both levels are the same here, and a place is that of the data's number."""
    two = Shown(
        replace(
            shown.run,
            field=Joint(shown.run.field),
            notes=replace(shown.run.notes, levels=(2, 3)),
        )
    )
    two.learn("mug")
    shown.learn("mug")
    one = shown.relevancy(eye.camera(), "mug", ALL)
    both = two.relevancy(eye.camera(), "mug", ALL)
    assert torch.equal(both, one.expand(2, -1, -1))
    few = two.relevancy(eye.camera(), "mug", Effort(4000, keep=True))
    assert 0 < (few - both).abs().mean() < 0.005
    (answered,) = paint([two], Wish(eye, "mask", "mug", level=3), eye.camera(), ALL).answers
    assert answered is not None
    assert answered.level == 1
    assert (two.place(2), two.place(1), two.place(None)) == (0, None, None)
    assert shown.place(2) is None


def test_pixels_of_one_cell_share_an_answer():
    codes = torch.tensor(
        [[[0.0, 0.0], [1.0, 1.0], [0.001, 0.0]], [[1.0, 0.999], [0.0, 1.0], [0, 1]]]
    )
    few = few_pixels(codes, 6)
    assert len(few.pixels) == 3
    flat = codes.flatten(0, 1)
    assert (flat[few.pixels][few.stands_in.flatten()] - flat).abs().max() < 0.01


def test_codes_that_are_all_different_are_asked_on_a_grid():
    codes = torch.rand(12, 10, 40, generator=torch.Generator().manual_seed(0))
    few = few_pixels(codes, 30)
    assert few.pixels.tolist() == [10 * y + x for y in range(0, 12, 2) for x in range(0, 10, 2)]
    assert few.stands_in[5, 7] == 2 * 5 + 3  # pixel (6, 4), in the third row and fourth column


class Joint(SeveralFields):
    """Two mask levels of one set of Gaussians."""

    def __init__(self, field: Field) -> None:
        super().__init__([field, field])


class Counting:
    """A field that counts what is asked of it."""

    def __init__(self, field: Field) -> None:
        self.field = field
        self.has_language = field.has_language
        self.outputs = field.outputs
        self.rendered: list[frozenset[str]] = []
        self.asked = 0

    def levels(self) -> Sequence[Field]:
        return (self,)

    def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
        self.rendered.append(outputs)
        return self.field.render(camera, outputs)

    def similarity(self, camera: Camera, words: Tensor, seen=None, pixels=None) -> Tensor:
        assert seen is not None  # nothing is rendered for a word alone
        self.asked += camera.height * camera.width if pixels is None else len(pixels)
        return self.field.similarity(camera, words, seen, pixels)


def test_another_word_or_threshold_renders_nothing(shown: Shown, eye: Eye):
    field = Counting(shown.run.field)
    watched = Shown(replace(shown.run, field=field))
    frames: list[Frame] = []
    session = Session([watched], frames.append, refuse)
    watched.learn("mug")
    watched.learn("lemon")
    wish = Wish(eye, "relevancy", "mug")
    for _ in range(3):
        session.draw(wish, Stage.EXACT, lambda: False)
    rendered = len(field.rendered)
    session.draw(replace(wish, word="lemon"), Stage.EXACT, lambda: False)
    assert len(field.rendered) == rendered
    asked = field.asked
    session.draw(replace(wish, share=0.2, output="mask"), Stage.EXACT, lambda: False)
    session.draw(replace(wish, opacity=0.1), Stage.EXACT, lambda: False)
    assert (len(field.rendered), field.asked) == (rendered, asked)


def test_what_is_no_longer_wanted_is_given_up(shown: Shown, eye: Eye):
    shown.learn("mug")
    with pytest.raises(Stale):
        paint([shown], Wish(eye, "mask", "mug"), eye.camera(), Effort(stale=lambda: True))
    rays = Shown(replace(shown.run, field=Counting(shown.run.field)))  # it names no Gaussians
    tall = replace(eye, width=2048, height=8)
    with pytest.raises(Stale):
        paint([rays], Wish(tall), tall.camera(), Effort(stale=lambda: True))


def test_a_field_without_gaussians_is_rendered_in_bands(shown: Shown, eye: Eye):
    field = Counting(shown.run.field)
    rays = Shown(replace(shown.run, field=field))
    wide = replace(eye, width=2048, height=10)
    pixels = paint([rays], Wish(wide), wide.camera(), ALL).pixels
    assert len(field.rendered) == 10  # each of 2048 pixels
    want = colors.to_uint8(rendered(shown.run.field, wide.camera()))
    assert (pixels.int() - want.int()).abs().float().mean() < 0.5
    assert rays.count is None
    assert "indicator - opacity" not in rays.outputs


def test_two_runs_share_one_picture(shown: Shown, eye: Eye):
    camera = eye.camera()
    other = Shown(shown.run)
    other.learn("mug")
    wish = Wish(eye, layout="divided", division=0.25)
    picture = paint([shown, other], wish, camera, ALL)
    left = rendered(shown.run.field, part(camera, 0, 20))
    right = rendered(shown.run.field, part(camera, 20, 80))
    assert torch.equal(picture.pixels[:, :19], colors.to_uint8(left)[:, :19])
    assert torch.equal(picture.pixels[:, 21:], colors.to_uint8(right)[:, 1:])
    assert (picture.pixels[:, 19:21] == 255).all()
    beside = paint([shown, other], replace(wish, layout="beside"), camera, ALL).pixels
    middle = colors.to_uint8(rendered(shown.run.field, part(camera, 20, 60)))
    assert torch.equal(beside[:, :39], middle[:, :39])
    assert torch.equal(beside[:, 41:], middle[:, 1:])
    alone = paint([shown, other], replace(wish, division=1.0), camera, ALL).pixels
    assert torch.equal(alone, colors.to_uint8(rendered(shown.run.field, camera)))


def test_two_browsers_do_not_disturb_each_other(shown: Shown, eye: Eye):
    """Each has its own camera, word and output, and a session of its own; what is kept of the one is not shown to the other."""
    frames: tuple[list[Frame], list[Frame]] = ([], [])
    one, two = (Session([shown], own.append, refuse) for own in frames)
    shown.learn("mug")
    shown.learn("lemon")
    aside = replace(eye, position=(*eye.position[:2], eye.position[2] + 0.2))
    first, second = Wish(eye, "mask", "mug"), Wish(aside, "relevancy", "lemon")
    for _ in range(2):
        one.draw(first, Stage.EXACT, lambda: False)
        two.draw(second, Stage.EXACT, lambda: False)
    alone = Shown(shown.run)
    for wish, own in ((first, frames[0]), (second, frames[1])):
        alone.learn(wish.word)
        want = paint([alone], wish, wish.eye.camera(), ALL).pixels
        assert all(torch.equal(frame.picture.pixels, want) for frame in own)


def test_the_status_says_what_is_shown(shown: Shown, eye: Eye):
    frames: list[Frame] = []
    session = Session([shown], frames.append, refuse)
    shown.learn("mug")
    wish = Wish(eye, "mask", "mug")
    assert session.draw(wish, Stage.SHARP, lambda: False) is False  # so few pixels are all asked
    lines = describe([shown], wish, frames[0])
    assert lines[0] == f"{shown.run.path.name}: {shown.count:,} Gaussians"
    assert lines[1].startswith("80x56, ")
    (answered,) = frames[0].picture.answers
    assert answered is not None
    assert lines[2] == f"mug: {answered.score:.3f}, level 3"
    training = Shown(replace(shown.run, step=700))
    assert describe([training], wish, frames[0])[0].endswith("step 700 of a run that still trains")


def test_a_word_that_cannot_be_encoded_is_refused_in_words(shown: Shown):
    with pytest.raises(ValueError, match="--vocabulary FILE"):
        shown.learn("zeppelin")
    assert "zeppelin" not in shown.asked


def test_a_picture_that_cannot_be_drawn_is_a_message(shown: Shown, eye: Eye):
    said: list[str] = []
    session = Session([shown], lambda _: pytest.fail("it was drawn"), said.append)
    nowhere = replace(eye, position=(float("nan"), 0.0, 0.0))
    assert session.draw(Wish(nowhere), Stage.SHARP, lambda: False) is False
    assert len(said) == 1
    assert "must be" in said[0]


def test_what_answers_is_saved(shown: Shown, eye: Eye, tmp_path: Path):
    shown.learn("mug")
    wish = Wish(eye, "mask", "mug", share=0.5)
    content, count = answering_ply(shown, wish)
    path = tmp_path / "mug.ply"
    path.write_bytes(content)
    saved, every = read_ply(path), shown.run.field
    threshold = shown.range("mug", None).threshold(0.5)
    _, chosen = select_gaussians(every, shown.asked["mug"], 0, threshold, None)
    assert isinstance(every, HasGaussians)
    cloud = every.point_cloud([one.camera for one in shown.run.cameras("train")])
    assert 0 < count == int(chosen.sum()) < len(chosen)
    assert torch.equal(saved["means"], cloud.params["means"][chosen])
    with pytest.raises(ValueError, match="none above a relevancy of"):
        answering_ply(shown, replace(wish, share=9.0))
    with pytest.raises(ValueError, match="a word must be asked"):
        answering_ply(shown, Wish(eye))
