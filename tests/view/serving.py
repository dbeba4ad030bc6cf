"""The viewer as a process of its own, as users start it."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Serving:
    """A viewer that waits for browsers."""

    process: subprocess.Popen[str]
    url: str

    def interrupt(self) -> tuple[int, str]:
        """Ctrl-C; its exit status and what it said of errors."""
        self.process.send_signal(signal.SIGINT)
        try:
            _, errors = self.process.communicate(timeout=30)
        except subprocess.TimeoutExpired:  # what its threads do says why
            self.process.send_signal(signal.SIGABRT)
            _, errors = self.process.communicate(timeout=30)
            pytest.fail(f"it goes on after Ctrl-C:\n{errors}")
        return self.process.returncode, errors


@contextmanager
def serving(*arguments: str) -> Iterator[Serving]:
    """`python -m vlgs.view` with a port that is free, until the end of the block."""
    pytest.importorskip("viser", reason="needs viser: pip install 'vlgs[viewer]'")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    # Where pytest runs in the background of a shell, what it starts would ignore Ctrl-C as it does itself.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        [sys.executable, "-X", "faulthandler", "-m", "vlgs.view", *arguments, "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=ROOT,
    )
    signal.signal(signal.SIGINT, before)
    with process:
        try:
            assert process.stdout is not None
            said = process.stdout.readline()
            assert " shows " in said, process.communicate(timeout=30)[1]
            yield Serving(process, said.partition(" ")[0])
        finally:
            process.kill()
