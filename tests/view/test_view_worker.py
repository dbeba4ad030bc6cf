"""Who is drawn for, and when: the newest wish of each browser, in turns, and nothing for one that is gone."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from threading import Event

import pytest

from vlgs.view.eye import Eye
from vlgs.view.few import Stale
from vlgs.view.wish import Wish
from vlgs.view.worker import REST, Stage, Worker

WISH = Wish(Eye((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, 4, 3))


def wished(word: str) -> Wish:
    return replace(WISH, word=word)


@dataclass
class Painter:
    """Notes what it draws; waits while it is `held`."""

    drawn: list[tuple[str, Stage, float]] = field(default_factory=list)
    free: Event = field(default_factory=Event)
    begun: Event = field(default_factory=Event)
    stale: Callable[[], bool] = lambda: False

    def draw(self, wish: Wish, stage: Stage, stale: Callable[[], bool]) -> bool:
        self.stale = stale
        self.begun.set()
        assert self.free.wait(5)
        if stale():
            raise Stale
        self.drawn.append((wish.word, stage, time.monotonic()))
        return stage is not Stage.EXACT

    def names(self) -> list[tuple[str, Stage]]:
        return [(word, stage) for word, stage, _ in self.drawn]


@pytest.fixture
def worker():
    made = Worker()
    yield made
    made.stop()


def painter(worker: Worker, client: int, held: bool = False) -> Painter:
    made = Painter()
    if not held:
        made.free.set()
    worker.open(client, made)
    return made


def settle(worker: Worker) -> None:
    until = time.monotonic() + 5
    while worker.waiting and time.monotonic() < until:
        time.sleep(0.005)
    assert not worker.waiting


def test_a_picture_gets_better_once_the_camera_rests(worker: Worker):
    one = painter(worker, 0)
    began = time.monotonic()
    worker.ask(0, wished("a"), moving=True)
    settle(worker)
    assert one.names() == [("a", Stage.COARSE), ("a", Stage.SHARP), ("a", Stage.EXACT)]
    coarse, sharp = one.drawn[0][2] - began, one.drawn[1][2] - began
    assert coarse < REST <= sharp


def test_another_word_on_a_resting_camera_is_never_coarse(worker: Worker):
    one = painter(worker, 0)
    worker.ask(0, wished("a"))
    settle(worker)
    assert one.names() == [("a", Stage.SHARP), ("a", Stage.EXACT)]


def test_of_many_wishes_the_last_is_drawn(worker: Worker):
    one = painter(worker, 0, held=True)
    worker.ask(0, wished("a"), moving=True)
    assert one.begun.wait(5)
    for word in "bcde":
        worker.ask(0, wished(word), moving=True)
    assert one.stale()  # what is being drawn can know that it is no longer wanted
    one.free.set()
    settle(worker)
    assert {word for word, _ in one.names()} == {"e"}


def test_a_moving_camera_does_not_become_sharp(worker: Worker):
    one = painter(worker, 0)
    for index in range(8):
        worker.ask(0, wished(str(index)), moving=True)
        time.sleep(REST / 4)
    settle(worker)
    stages = [stage for _, stage in one.names()]
    assert stages[:-2] == [Stage.COARSE] * (len(stages) - 2)
    assert one.names()[-2:] == [("7", Stage.SHARP), ("7", Stage.EXACT)]


def test_browsers_take_turns(worker: Worker):
    first, second = painter(worker, 0, held=True), painter(worker, 1)
    worker.ask(0, wished("a"))
    assert first.begun.wait(5)
    worker.ask(1, wished("b"))
    first.free.set()
    settle(worker)
    assert first.names() == [("a", Stage.SHARP), ("a", Stage.EXACT)]
    assert second.names() == [("b", Stage.SHARP), ("b", Stage.EXACT)]
    assert first.drawn[0][2] < second.drawn[0][2] < first.drawn[1][2] < second.drawn[1][2]


def test_nothing_is_drawn_for_a_closed_browser(worker: Worker):
    gone, stays = painter(worker, 0, held=True), painter(worker, 1)
    worker.ask(0, wished("a"))
    assert gone.begun.wait(5)
    worker.close(0)
    assert gone.stale()
    gone.free.set()
    worker.ask(0, wished("b"))
    worker.ask(1, wished("c"))
    settle(worker)
    assert gone.drawn == []
    assert stays.names()[0] == ("c", Stage.SHARP)


def test_runs_that_changed_are_drawn_again(worker: Worker):
    one, silent = painter(worker, 0), painter(worker, 1)
    worker.ask(0, wished("a"))
    settle(worker)
    worker.ask_again()
    settle(worker)
    assert one.names() == 2 * [("a", Stage.SHARP), ("a", Stage.EXACT)]
    assert silent.drawn == []


def test_a_failure_ends_the_thread_and_is_kept():
    class Broken:
        def draw(self, wish: Wish, stage: Stage, stale: Callable[[], bool]) -> bool:
            raise ZeroDivisionError

    worker = Worker()
    worker.open(0, Broken())
    worker.ask(0, WISH)
    worker._thread.join(5)
    assert isinstance(worker.failure, ZeroDivisionError)
