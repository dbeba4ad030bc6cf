"""Colours by hand, files that exist, and pictures that show what they say."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from report_fakes import CLASSES, NEGATIVES, Drawing, FakeField, scene, view, vocabulary, with_test

from vlgs.queries import LerfRelevancy, Prompts
from vlgs.queries.text import VocabularyText
from vlgs.report import colors
from vlgs.report.draw import Painter
from vlgs.report.evaluate import prompts_of
from vlgs.report.features import fit_feature_colors, paint_features
from vlgs.report.overview import count_difference, write_histogram
from vlgs.report.pictures import PictureLimits, spread, write_pictures
from vlgs.types import IGNORE_ID, Scene

QUERY = LerfRelevancy()


def prompts(scene: Scene) -> Prompts | None:
    return prompts_of(scene, QUERY, VocabularyText(scene.vocabulary))[0]


def test_colours_are_rounded_and_clamped():
    image = torch.tensor([[[-1.0, 0.5, 2.0]]])
    assert colors.to_uint8(image).tolist() == [[[0, 128, 255]]]


def test_diverging_map_is_blue_white_red():
    low, middle, high = colors.diverging(torch.tensor([[-1.0, 0.0, 1.0]]))[0].int()
    assert low[2] > low[0] + 50
    assert high[0] > high[2] + 50
    assert middle.min() > 240


def test_heat_runs_from_dark_blue_to_red():
    low, high = colors.heat(torch.tensor([[0.0, 1.0]]))[0].int()
    assert low[2] > low[0]
    assert high[0] > high[2]


@pytest.mark.parametrize("count", [1, 11, 60])
def test_label_colours_differ(count: int):
    palette = colors.label_colors(count)
    assert palette.shape == (count, 3)
    assert len({tuple(c) for c in [*palette.tolist(), colors.IGNORED]}) == count + 1
    assert torch.equal(colors.label_colors(5), colors.label_colors(60)[:5])


def test_labels_are_painted_by_class():
    ids = torch.tensor([[0, 1], [IGNORE_ID, 0]], dtype=torch.uint8)
    picture = colors.paint_labels(ids, 2)
    palette = colors.label_colors(2)
    assert torch.equal(picture[0, 0], palette[0])
    assert torch.equal(picture[0, 1], palette[1])
    assert tuple(picture[1, 0].tolist()) == colors.IGNORED


def test_outline_is_the_rim_of_a_mask():
    mask = torch.zeros(7, 7, dtype=torch.bool)
    mask[1:6, 1:6] = True
    rim = colors.outline(mask, 1)
    assert rim.sum() == 16
    assert not rim[2:5, 2:5].any()
    assert not colors.outline(torch.ones(5, 5, dtype=torch.bool), 1).any()


def test_stretch_uses_the_whole_range_and_survives_a_constant():
    assert colors.stretch(torch.tensor([[2.0, 3.0, 4.0]])).tolist() == [[0.0, 0.5, 1.0]]
    assert (colors.stretch(torch.full((2, 2), 0.7)) == 0).all()


@pytest.mark.parametrize("width", [1, 2, 3, 16])
def test_feature_colours_mean_the_same_in_every_view(width: int):
    rng = torch.Generator().manual_seed(0)
    first = torch.randn(6, 7, width, generator=rng)
    palette = fit_feature_colors([first, 3 * first.flip(0)])
    picture = paint_features(first, palette)
    assert picture.dtype == torch.uint8
    assert torch.equal(paint_features(first.flip(1), palette), picture.flip(1))
    assert picture.float().std() > 10


def test_three_channels_are_shown_as_they_are():
    feature = torch.zeros(1, 101, 3)
    feature[0, :, 1] = torch.linspace(-5, 5, 101)
    picture = paint_features(feature, fit_feature_colors([feature]))
    assert (picture[..., [0, 2]] == 0).all()
    assert (picture[0, 50, 1].item(), picture[0, 0, 1].item(), picture[0, -1, 1].item()) == (
        128,
        0,
        255,
    )


def test_histogram_has_area_one():
    density = count_difference(torch.tensor([1.0, 0.5, 0.0]), torch.tensor([0.0, 0.5, 1.0]), 4)
    torch.testing.assert_close(density, torch.tensor([2 / 3, 0, 2 / 3, 2 / 3]))
    assert not count_difference(torch.zeros(0), torch.zeros(0)).any()


def test_the_histogram_stands_alone_with_whole_labels(tmp_path: Path):
    write_histogram(tmp_path / "h.png", count_difference(torch.rand(99), torch.rand(99)))
    with Image.open(tmp_path / "h.png") as picture:
        pixels = np.asarray(picture.convert("L"))
    edges = (pixels[:, :5], pixels[:, -5:], pixels[:5], pixels[-5:])
    assert all((edge == 255).all() for edge in edges)  # "-1.0" was cut at the left


def test_views_are_spread_over_all():
    assert spread(range(10), 4) == [0, 2, 5, 7]
    assert spread(range(3), 8) == [0, 1, 2]
    assert spread([], 8) == []


def test_hostile_names_have_pictures_of_their_own(tmp_path: Path):
    words = ("a b", "a/b", "x" * 300, "_$\\frac$", "A\n\x1b[31mB", "..")
    still_life = scene(3, width=60, height=40)
    renamed: dict[str, str] = dict(zip(CLASSES, words, strict=True))
    names = ("cam0/001", "CON", "cam0\\001")
    hostile = replace(
        still_life,
        classes=words,
        class_kinds={},
        vocabulary=vocabulary(words + NEGATIVES, renamed),
        test=tuple(
            replace(view, name=name) for view, name in zip(still_life.test, names, strict=True)
        ),
    )
    write_pictures(tmp_path, FakeField(), hostile, QUERY, prompts(hostile))
    folders = sorted(path.name for path in tmp_path.iterdir() if path.is_dir())
    assert len(folders) == 3
    drawn = {path.name for path in tmp_path.glob("*/relevancy_*.png")}
    assert len(drawn) == 5  # of six classes one is in no picture
    assert max(map(len, drawn)) < 130


def test_every_picture_of_a_view_is_written(tmp_path: Path):
    still_life = scene(2)
    overview = write_pictures(
        tmp_path / "renders", FakeField(0.05), still_life, QUERY, prompts(still_life),
        PictureLimits(views=2, prompts=2, rows=1),
    )  # fmt: skip
    assert overview == tmp_path / "renders" / "overview.png"
    names = {p.name for p in (tmp_path / "renders" / "view_00").iterdir()}
    fixed = {"photograph", "render", "features", "labels", "prediction", "indicator_minus_opacity"}
    assert {f"{name}.png" for name in fixed} <= names
    assert len(names) == len(fixed) + 2 * 2
    assert {p.name for p in (tmp_path / "renders").iterdir()} == {
        "overview.png", "indicator_minus_opacity.png", "view_00", "view_01",
    }  # fmt: skip
    photograph = np.asarray(Image.open(tmp_path / "renders" / "view_01" / "photograph.png"))
    assert np.array_equal(photograph, still_life.test[1].read_image().numpy())
    with Image.open(tmp_path / "renders" / "overview.png") as sheet:
        assert sheet.width > 2000


def test_scene_without_words_still_has_colour_features_and_indicator(tmp_path: Path):
    write_pictures(tmp_path, FakeField(), scene(1), QUERY, None)
    assert {p.stem for p in (tmp_path / "view_00").iterdir()} == {
        "photograph", "render", "features", "indicator_minus_opacity",
    }  # fmt: skip
    assert (tmp_path / "overview.png").is_file()


def test_an_indicator_that_is_opacity_has_no_difference_to_show(tmp_path: Path):
    class Equal(FakeField):
        def language_weights(self) -> torch.Tensor:
            return self.opacities().clone()

    widths = []
    for field in (FakeField(), Equal()):
        overview = write_pictures(tmp_path / type(field).__name__, field, scene(1), QUERY, None)
        assert overview is not None
        with Image.open(overview) as sheet:
            widths.append(sheet.width)
    assert not list((tmp_path / "Equal").rglob("indicator_minus_opacity.png"))
    assert widths[1] < widths[0] - 400  # without a column of 2.2 inches


def test_views_with_and_without_labels_share_a_sheet(tmp_path: Path):
    some = scene(2)
    bare = replace(some.test[1], read_dense_labels=None)
    assert write_pictures(
        tmp_path, FakeField(), with_test(some, some.test[0], bare), QUERY, prompts(some)
    )
    assert not (tmp_path / "view_01" / "labels.png").exists()


def test_no_view_no_picture(tmp_path: Path):
    assert (
        write_pictures(tmp_path / "renders", FakeField(), with_test(scene()), QUERY, None) is None
    )
    assert not (tmp_path / "renders").exists()


def test_overview_shows_a_new_prompt_in_each_row_and_glass_first():
    still_life = scene(4)
    painter = Painter(FakeField(), still_life, QUERY, prompts(still_life), still_life.test)
    first = [next(iter(painter.draw(v, 6).prompts)) for v in still_life.test]
    assert set(first[:2]) == {"wine glass", "steel kettle"}
    assert first[2] == "red apple"


def test_pictures_show_the_object_that_was_asked_for():
    still_life = scene(1)
    painter = Painter(FakeField(), still_life, QUERY, prompts(still_life), still_life.test)
    pictures = painter.draw(still_life.test[0], 6)
    glass = pictures.prompts["wine glass"]
    red, blue = glass.relevancy[75, 50].int(), glass.relevancy[75, 110].int()  # glass and kettle
    assert red[0] - red[2] > 50
    assert blue[2] - blue[0] > 0
    assert torch.equal(glass.segmentation[75, 50], pictures.photograph[75, 50])
    assert glass.segmentation[75, 110].sum() < pictures.photograph[75, 110].sum() / 2
    assert pictures.prediction is not None
    assert pictures.labels is not None
    assert torch.equal(pictures.prediction[:-1], pictures.labels[:-1])
    assert pictures.classes == (0, 1, 2, 3, 4)


def test_object_labels_alone_give_prompts_but_no_class_map():
    some = scene(1)
    labelled = with_test(some, view(Drawing(), "objects", dense=False, objects=True))
    painter = Painter(FakeField(), labelled, QUERY, prompts(labelled), labelled.test)
    pictures = painter.draw(labelled.test[0], 6)
    assert set(pictures.prompts) == {"wine glass", "steel kettle", "red apple"}
    assert pictures.labels is None


def test_without_language_only_colour_is_drawn(tmp_path: Path):
    silent = replace(scene(), mask_vectors=torch.zeros(0, 8), mask_areas=torch.zeros(0))
    write_pictures(tmp_path, FakeField(), silent, QUERY, None)
    names = {path.name for path in tmp_path.rglob("*.png")}
    assert names == {"overview.png", "photograph.png", "render.png"}
