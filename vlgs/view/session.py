"""What one browser sees: draws its wishes and says what it drew."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from vlgs.view.pace import SMALLEST, Pace
from vlgs.view.paint import Picture, paint
from vlgs.view.shown import Effort, Shown
from vlgs.view.wish import ASKING, Layout, Output, Wish
from vlgs.view.worker import Stage

_BUDGETS = {Stage.COARSE: 0.04, Stage.SHARP: 1.0}
"""Seconds for a picture. While the camera moves: 15 pictures a second, and what a browser and the way to it need.
When it rests only fields of rays are made to keep to it; Gaussians are drawn at full size."""
_MOST = {Stage.COARSE: 1 << 11, Stage.SHARP: 1 << 13}
"""Pixels at which Gaussians are asked for a word, of all mask levels together; all in the end."""
_MOST_RAYS = 1 << 11
"""Likewise of a field of rays, which takes a millisecond for each (LERF asks at 30 scales), in one piece that cannot be given up."""


@dataclass(frozen=True)
class Frame:
    """A picture on its way to a browser."""

    picture: Picture
    stage: Stage
    seconds: float
    """What drawing took."""


class Session:
    """Draws for one browser; see `vlgs.view.worker.Artist`.

    Args:
        runs: One or two; who holds the list may replace them.
        show: Sends a picture.
        complain: Says why there is none.
    """

    def __init__(
        self,
        runs: list[Shown],
        show: Callable[[Frame], None],
        complain: Callable[[str], None],
    ) -> None:
        self.runs = runs
        self.show = show
        self.complain = complain
        self._paces: dict[tuple[Stage, Output, Layout, bool], Pace] = {}

    def draw(self, wish: Wish, stage: Stage, stale: Callable[[], bool]) -> bool:
        """See `vlgs.view.worker.Artist`."""
        runs, quick = list(self.runs), all(run.gaussians for run in self.runs)
        if stage is Stage.COARSE and not quick and wish.output in ASKING:
            wish = replace(wish, output="render")  # rays are too slow to be asked in time
        eye, pace = wish.eye, self._pace(wish, stage, quick)
        full = stage is Stage.EXACT or (quick and stage is Stage.SHARP)
        scale = 1.0 if full else pace.scale(eye.width * eye.height)
        camera = eye.camera(*(max(round(side * scale), 1) for side in (eye.width, eye.height)))
        effort = Effort(_most(stage, quick), scale, stage is not Stage.COARSE, stale)
        began = time.perf_counter()
        try:
            picture = paint(runs, wish, camera, effort)
        except ValueError as error:  # such as a view that needs more memory than it may take
            self.complain(str(error))
            return False
        seconds = time.perf_counter() - began
        pace.took(camera.width * camera.height, seconds)
        self.show(Frame(picture, stage, seconds))
        approximate = quick and any(one is not None and one.approximate for one in picture.answers)
        return stage is Stage.COARSE or (stage is Stage.SHARP and (scale < 1 or approximate))

    def full(self, wish: Wish) -> Picture:
        """The picture of a wish at its full size, as good as it can be."""
        runs = list(self.runs)
        effort = Effort(_most(Stage.EXACT, all(run.gaussians for run in runs)), keep=True)
        return paint(runs, wish, wish.eye.camera(), effort)

    def _pace(self, wish: Wish, stage: Stage, quick: bool) -> Pace:
        key = (stage, wish.output, wish.layout, bool(wish.word))
        if key not in self._paces:
            self._paces[key] = Pace(_BUDGETS.get(stage, 0.0), 0.5 if quick else SMALLEST)
        return self._paces[key]


def _most(stage: Stage, quick: bool) -> int | None:
    """Pixels at which a word is asked; None: all."""
    return _MOST.get(stage) if quick else _MOST_RAYS


def describe(runs: Sequence[Shown], wish: Wish, frame: Frame) -> list[str]:
    """Lines that say what a picture shows: Gaussians, time and size, and how a word is answered."""
    h, w, _ = frame.picture.pixels.shape
    lines = []
    for run in runs if wish.layout != "one" else runs[:1]:
        step = "" if run.run.step is None else f", step {run.run.step} of a run that still trains"
        count = "no Gaussians" if run.count is None else f"{run.count:,} Gaussians"
        lines.append(f"{run.run.path.name}: {count}{step}")
    lines.append(f"{w}x{h}, {1000 * frame.seconds:.0f} ms")
    for answered, run in zip(frame.picture.answers, runs, strict=False):
        if answered is None:
            continue
        about = "about " if answered.approximate else ""
        level = f", level {run.run.levels[answered.level]}" if run.run.levels else ""
        lines.append(f"{wish.word}: {about}{answered.score:.3f}{level}")
    return lines
