"""Who is drawn for next: one thread draws for all browsers, for each of them only what it asked last."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from threading import Condition, RLock, Thread
from typing import Protocol, runtime_checkable

from vlgs.view.few import Stale
from vlgs.view.wish import Wish

REST = 0.08
"""Seconds without a movement after which a camera rests."""


class Stage(IntEnum):
    """How good a picture is."""

    COARSE = 0
    """Ready in time, while the camera moves."""
    SHARP = 1
    """Of full size; a word is asked at few pixels."""
    EXACT = 2
    """A word is asked at every pixel."""


@runtime_checkable
class Artist(Protocol):
    """Draws for one browser."""

    def draw(self, wish: Wish, stage: Stage, stale: Callable[[], bool]) -> bool:
        """Draw a picture and send it; returns whether the next stage would be better.

        Args:
            wish: What to draw.
            stage: How well.
            stale: Says whether something newer is wanted.

        Raises:
            Stale: If something newer is wanted, and the picture was given up.
        """
        ...


@dataclass
class _Turn:
    """What one browser waits for."""

    artist: Artist
    wish: Wish | None = None
    """The last one."""
    stage: Stage | None = None
    """What is to be drawn of it; None: nothing is left."""
    asked: float = 0.0
    """When it was asked, in seconds of the clock."""
    due: float = 0.0
    """When the stage may be drawn."""
    number: int = 0
    """How often something was asked."""
    served: float = 0.0
    """When it was last drawn for; the one that waits longest is next."""
    closed: bool = field(default=False)


class Worker:
    """Draws for browsers in turns, in a thread of its own; the newest wish of each replaces what was waiting.

    What renders elsewhere holds `alone` meanwhile.
    """

    def __init__(self) -> None:
        self.alone = RLock()
        self.failure: BaseException | None = None
        """What ended the thread, if it was not `stop`."""
        self._changed = Condition()
        self._turns: dict[int, _Turn] = {}
        self._stopped = False
        self._thread = Thread(target=self._run, name="view", daemon=True)
        self._thread.start()

    def open(self, client: int, artist: Artist) -> None:
        """Begin to draw for a browser."""
        with self._changed:
            self._turns[client] = _Turn(artist)

    def ask(self, client: int, wish: Wish, moving: bool = False) -> None:
        """Replace what a browser waits for; one that is gone is forgotten."""
        with self._changed:
            turn = self._turns.get(client)
            if turn is None:
                return
            turn.wish, turn.number = wish, turn.number + 1
            turn.stage = Stage.COARSE if moving else Stage.SHARP
            turn.asked = turn.due = time.monotonic()
            self._changed.notify()

    def ask_again(self) -> None:
        """Draw everything anew: the runs have changed."""
        with self._changed:
            wishes = {client: turn.wish for client, turn in self._turns.items()}
        for client, wish in wishes.items():
            if wish is not None:
                self.ask(client, wish)

    def close(self, client: int) -> None:
        """Draw nothing more for a browser; what is being drawn for it is given up."""
        with self._changed:
            turn = self._turns.pop(client, None)
            if turn is not None:
                turn.closed = True

    def stop(self) -> None:
        """End the thread once what it draws is given up or ready."""
        with self._changed:
            self._stopped = True
            for turn in self._turns.values():
                turn.closed = True
            self._changed.notify()
        self._thread.join(timeout=2.0)

    @property
    def waiting(self) -> int:
        """Browsers for which something is still to be drawn."""
        with self._changed:
            return sum(turn.stage is not None for turn in self._turns.values())

    def _run(self) -> None:
        try:
            while (turn := self._next()) is not None:
                self._draw(turn)
        except BaseException as error:  # the main thread raises it
            self.failure = error

    def _next(self) -> _Turn | None:
        """Waits for a turn that is due; None in the end."""
        with self._changed:
            while not self._stopped:
                left = [turn for turn in self._turns.values() if turn.stage is not None]
                now = time.monotonic()
                due = [turn for turn in left if turn.due <= now]
                if due:
                    return min(due, key=lambda turn: turn.served)
                self._changed.wait(min((turn.due - now for turn in left), default=None))
        return None

    def _draw(self, turn: _Turn) -> None:
        with self._changed:
            wish, stage, number = turn.wish, turn.stage, turn.number
        if wish is None or stage is None:
            return  # it was closed in between

        def stale() -> bool:
            return turn.closed or turn.number != number

        try:
            with self.alone:
                better = turn.artist.draw(wish, stage, stale)
        except Stale:
            better = False
        with self._changed:
            turn.served = time.monotonic()
            if not stale():
                turn.stage = Stage(stage + 1) if better else None
                turn.due = turn.asked + REST if stage is Stage.COARSE else turn.served
