"""Runs that still train: opened again when there is a newer checkpoint."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from vlgs.opened import OpenedRun
from vlgs.runs import RunFolder
from vlgs.view.shown import Shown


class Watch:
    """Looks for newer checkpoints of runs that are not finished.

    Args:
        runs: Replaced in this list where there is a newer one.
        open_again: Opens the run of a folder.
    """

    def __init__(self, runs: list[Shown], open_again: Callable[[Path], OpenedRun]) -> None:
        self.runs = runs
        self.open_again = open_again
        self._seen = [_files(shown.run.path) for shown in runs]

    def poll(self) -> bool:
        """Open what is newer; returns whether anything was."""
        changed = [self._poll(index) for index in range(len(self.runs))]
        return any(changed)

    def _poll(self, index: int) -> bool:
        shown = self.runs[index]
        if shown.run.step is None:
            return False
        files = _files(shown.run.path)
        if files == self._seen[index]:
            return False
        try:
            run = self.open_again(shown.run.path)
        except (ValueError, OSError):
            return False  # it is being written, or has gone: what was read stays
        self._seen[index] = files
        # Words keep their vectors, and a text tower that was read stays.
        self.runs[index] = Shown(replace(run, words=shown.run.words), shown.asked)
        return True


def _files(folder: Path) -> Sequence[tuple[str, int]]:
    """Checkpoints of a run and its field, with when they were written."""
    found = [*folder.rglob("step_*.safetensors"), RunFolder(folder).field]
    stamps = []
    for path in sorted(found):
        try:
            stamps.append((str(path), path.stat().st_mtime_ns))
        except FileNotFoundError:
            continue  # an older checkpoint that was just removed
    return stamps
