"""A run that says what each of its parts took: `python -m vlgs.bench.startup_child OUT <arguments of vlgs.run>`.

Parts follow each other: what is inside of another part is counted there alone, and ``first step`` is when the first step begins, since the
start of the process.
"""

import functools
import json
import runpy
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


class Parts:
    """Seconds of CPU and of the clock, by part."""

    def __init__(self) -> None:
        self.seconds: dict[str, tuple[float, float]] = {}
        self._open: list[list[float]] = []
        self._start = time.perf_counter()

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, whose time without that of parts inside of it is added to `name`."""

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            self._open.append([0.0, 0.0])
            cpu, wall = time.process_time(), time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                took = time.process_time() - cpu, time.perf_counter() - wall
                inside = self._open.pop()
                before = self.seconds.get(name, (0.0, 0.0))
                own = [b + t - i for b, t, i in zip(before, took, inside, strict=True)]
                self.seconds[name] = own[0], own[1]
                if self._open:
                    outer = self._open[-1]
                    outer[0], outer[1] = outer[0] + took[0], outer[1] + took[1]

        return call

    def reach(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, at whose first call the time since the start of the process is kept."""

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            now = time.process_time(), time.perf_counter() - self._start
            self.seconds.setdefault(name, now)
            return function(*args, **kwargs)

        return call


def main() -> None:
    """Import what a run imports, put a watch around its parts, and run."""
    out, *arguments = sys.argv[1:]
    parts = Parts()
    # Imports come first here, so that what is imported can be watched; a run does them in between.
    imported = parts.timed("imports", _import_all)()
    for owner, attribute, name in (
        (imported["vlgs.experiment"].Experiment, "read_scenes", "scene"),
        (imported["vlgs.heads.autoencoder"].Autoencoder, "fit", "head"),
        (imported["vlgs.training.workshop"], "fit", "training"),
        (imported["vlgs.finish"], "evaluate", "scores"),
        (imported["vlgs.finish"], "write_pictures", "pictures"),
        (imported["vlgs.finish"], "measure_fps", "frame rates"),
    ):
        setattr(owner, attribute, parts.timed(name, getattr(owner, attribute)))
    module = imported["vlgs.training.lightning"].VLGSModule
    module.training_step = parts.reach("first step", module.training_step)
    sys.argv[1:] = arguments
    try:
        parts.timed("rest", runpy.run_module)("vlgs.run", run_name="__main__", alter_sys=True)
    finally:
        Path(out).write_text(json.dumps(parts.seconds))


def _import_all() -> dict[str, Any]:
    import vlgs.command
    from vlgs.imports import uncollected

    with uncollected():
        import vlgs.experiment
        import vlgs.finish
        import vlgs.heads.autoencoder
        import vlgs.training.lightning
        import vlgs.training.workshop  # noqa: F401

    return dict(sys.modules)


if __name__ == "__main__":
    main()
