"""Frame rates from a clock that the test owns."""

import pytest
import torch
from report_fakes import FakeField, scene

from vlgs.fields import FieldImages
from vlgs.queries import LerfRelevancy, Prompts, Query, VocabSoftmax
from vlgs.queries.text import VocabularyText
from vlgs.report import timing
from vlgs.report.evaluate import prompts_of
from vlgs.types import Camera


class Clock:
    """Stands still until somebody works."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now


class TimedField(FakeField):
    """Takes 10 ms for colour and 30 ms for language; the first view ever takes 7 s longer."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock, self.renders = clock, 0

    def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
        taken = 0.01 * ("color" in outputs) + 0.03 * ("feature" in outputs)
        self.clock.now += taken + 7.0 * (self.renders == 0)
        self.renders += 1
        return super().render(camera, outputs)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(timing, "time", clock)
    return clock


def prompts(query: Query) -> Prompts | None:
    still_life = scene(2)
    return prompts_of(still_life, query, VocabularyText(still_life.vocabulary))[0]


def test_rates_are_medians_without_warm_up(clock: Clock):
    query = LerfRelevancy()
    cameras = [view.camera for view in scene(2).test]
    got = timing.measure_fps(TimedField(clock), cameras, query, prompts(query), repeats=5)
    assert got.fps_color == pytest.approx(100)
    assert got.fps_language == pytest.approx(1 / 0.03)
    assert got.fps_query == pytest.approx(1 / 0.04)


def test_the_budget_ends_a_measurement_but_not_before_three_views(clock: Clock):
    field = TimedField(clock)
    cameras = [view.camera for view in scene(1).test]
    timing.measure_fps(field, cameras, LerfRelevancy(), None, seconds=0.0)
    assert field.renders == 2 * (1 + 3)


def test_without_prompts_or_cameras_nothing_is_timed(clock: Clock):
    cameras = [view.camera for view in scene(1).test]
    got = timing.measure_fps(TimedField(clock), cameras, LerfRelevancy(), None, repeats=3)
    assert got.fps_query is None
    assert got.fps_color is not None
    assert timing.measure_fps(FakeField(), [], LerfRelevancy(), None) == timing.Timing(
        None, None, None
    )


@pytest.mark.parametrize(("query", "asked"), [(LerfRelevancy(), 1), (VocabSoftmax(), 6)])
def test_only_a_query_that_needs_all_prompts_gets_them(
    query: Query, asked: int, clock: Clock, monkeypatch: pytest.MonkeyPatch
):
    seen = []
    relevancy = type(query).relevancy

    def spy(self: Query, prompts: torch.Tensor, negatives: torch.Tensor) -> torch.Tensor:
        seen.append(len(prompts))
        return relevancy(self, prompts, negatives)

    monkeypatch.setattr(type(query), "relevancy", spy)
    cameras = [view.camera for view in scene(1).test]
    timing.measure_fps(TimedField(clock), cameras, query, prompts(query), repeats=3)
    assert set(seen) == {asked}


def test_the_language_of_a_scene_without_any_is_not_timed(clock: Clock):
    cameras = [view.camera for view in scene(2).test]
    got = timing.measure_fps(TimedField(clock), cameras, LerfRelevancy(), None, language=False)
    assert got.fps_color == pytest.approx(100)
    assert got.fps_language is got.fps_query is None
