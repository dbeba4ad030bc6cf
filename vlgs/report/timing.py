"""Frames per second of a trained scene at the size of its data."""

import itertools
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch

from vlgs.fields import Field
from vlgs.queries import Prompts, Query
from vlgs.report.answer import answer_view
from vlgs.types import Camera


@dataclass(frozen=True)
class Timing:
    """Views per second: 1 / median time of a view; None where nothing could be timed."""

    fps_color: float | None
    """Colour render alone."""
    fps_language: float | None
    """Language render alone."""
    fps_query: float | None
    """Both renders, decoding of every pixel, and the relevancy map of one prompt."""


@torch.no_grad()
def measure_fps(
    field: Field,
    cameras: Sequence[Camera],
    query: Query,
    prompts: Prompts | None,
    language: bool = True,
    seconds: float = 1.0,
    repeats: int = 30,
) -> Timing:
    """Time renders and queries; warm-up is left out, and cameras take turns.

    Of several mask levels the last, of whole objects, is timed. A query that judges prompts against each other is timed with all
    of them, one that does not with the first.

    Args:
        field: The trained scene.
        cameras: Usually those of the held-out views.
        query: How relevancy is computed.
        prompts: The scene's classes; without them queries are not timed.
        language: Whether the scene has language; the render of what was never trained is not timed.
        seconds: Budget for all three figures together. It ends a measurement early, but never before three views.
        repeats: Views per figure within the budget.
    """
    if not cameras:
        return Timing(None, None, None)
    whole, budget = field.levels()[-1], seconds / 3

    def fps(work: Callable[[Camera], object]) -> float:
        return 1 / _median_seconds(work, itertools.cycle(cameras), budget, repeats)

    def ask(camera: Camera, prompts: Prompts) -> None:
        answer = answer_view(whole, camera, prompts)
        assert answer.cosines is not None  # there are prompts
        assert answer.negatives is not None
        query.relevancy(answer.cosines[0], answer.negatives[0])

    fps_language = fps_query = None
    if language and "feature" in whole.outputs:
        fps_language = fps(lambda camera: whole.render(camera, frozenset({"feature"})))
    if prompts is not None:
        one = prompts if query.needs_all_prompts else _first(prompts)
        fps_query = fps(lambda camera: ask(camera, one))
    fps_color = fps(lambda camera: whole.render(camera, frozenset({"color"})))
    return Timing(fps_color, fps_language, fps_query)


def _median_seconds(
    work: Callable[[Camera], object], cameras: Iterator[Camera], budget: float, repeats: int
) -> float:
    work(next(cameras))
    times: list[float] = []
    while len(times) < 3 or (len(times) < repeats and sum(times) < budget):
        camera = next(cameras)
        start = time.perf_counter()
        work(camera)
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def _first(prompts: Prompts) -> Prompts:
    return Prompts(prompts.names[:1], prompts.text[:1], prompts.negatives)
