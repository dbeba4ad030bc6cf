"""A warm parent: one process that has imported what every run imports, and forks a child for each. `python -m vlgs.ablate.warm` is that process.

Of a run on this machine the parent saves the start, which is work that no run differs in: imports, and the tables of Hydra's grammar. A
child is a process as `python -m vlgs.run` is one: a session of its own, its output in its log, an exit status, memory that is its own as soon as it
writes to it. The parent trains nothing, reads no scene and starts no thread, because threads of OpenMP that ran before a fork are missing
after it, and a child would wait for them without end.

They talk in lines: a request (JSON: arguments of `vlgs.run`, and the log) is answered with the child's number, and later with its status.
"""

import json
import os
import runpy
import select
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

MODULE = "vlgs.run"
"""What a child runs, as `python -m` would."""

SHARED = (
    *("vlgs.command", "vlgs.experiment", "vlgs.prepare", "vlgs.finish", "vlgs.report.summary"),
    *("vlgs.data.synthetic", "vlgs.heads.autoencoder", "vlgs.data.scene_warnings"),
    *("matplotlib.figure", "matplotlib.backends.backend_agg", "matplotlib.patheffects"),
    *("kornia.metrics", "PIL.PngImagePlugin", "scipy.spatial", "torch.optim"),
)
"""Modules that every run of a sweep imports, some of them late."""


class WarmRun:
    """A run in a child of a warm parent; `subprocess.Popen`, as far as a job needs it."""

    def __init__(self, parent: "WarmParent") -> None:
        self.returncode: int | None = None
        """Exit status, negative for the signal that killed it; None while it runs, and where its parent died."""
        self._parent = parent
        self._child = 0
        self._told = False

    @property
    def begun(self) -> bool:
        """Whether it was forked; not so where its parent died before."""
        return self._child > 0

    def wait(self, timeout: float) -> None:
        """Return when the run or its parent has ended.

        Raises:
            TimeoutExpired: If neither has, after so many seconds.
        """
        until = time.monotonic() + timeout
        while (line := self._parent.hear(until)) is not None:
            if not self._child:
                self._child = int(line)
                if self._told:
                    self.terminate()
            else:
                self.returncode = int(line)
                return
        if self._parent.alive:
            raise subprocess.TimeoutExpired(MODULE, timeout)

    def terminate(self) -> None:
        """Ask the run to save and stop, as soon as it has begun."""
        self._told = True
        # The parent leaves a child that has ended unburied until the next request, so that its number is no other process's.
        if self._child and self._parent.alive and self.returncode is None:
            os.kill(self._child, signal.SIGTERM)


class WarmParent:
    """A handle on the process that forks; it ends with the process that holds this, however that ends."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, MODULE, *SHARED],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # what is wrong with the installation, a run that starts cold says in its log
            env=os.environ | {"COLUMNS": "120"},
            start_new_session=True,
            bufsize=0,
        )
        self._heard = b""
        self.alive = True
        """Whether it could be talked to so far."""

    @property
    def pid(self) -> int:
        """Its number."""
        return self._process.pid

    def start(self, arguments: Sequence[str], log: Path) -> WarmRun | None:
        """Begin a run, one at a time; None where the parent is dead.

        Args:
            arguments: Of `vlgs.run`.
            log: What it writes is appended to this file.
        """
        request = json.dumps({"arguments": list(arguments), "log": str(log)}) + "\n"
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(request.encode())
        except BrokenPipeError:
            self.alive = False
            return None
        return WarmRun(self)

    def hear(self, until: float) -> str | None:
        """The next line of an answer; None where none came in time, or the parent is dead."""
        answers = self._process.stdout
        assert answers is not None
        while b"\n" not in self._heard:
            ready, _, _ = select.select([answers], [], [], max(0, until - time.monotonic()))
            if not ready:
                return None
            chunk = os.read(answers.fileno(), 4096)
            if not chunk:
                self.alive = False
                return None
            self._heard += chunk
        line, _, self._heard = self._heard.partition(b"\n")
        return line.decode()

    def close(self) -> None:
        """Let it end; a run that it has begun goes on."""
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()
        self._process.wait()


def main() -> None:
    """Import what is named, then fork a child for every request; in a child, be the module that is named first."""
    module, *shared = sys.argv[1:]
    say = os.dup(1)
    os.dup2(2, 1)  # what an import prints is no answer
    for name in shared:
        import_module(name)
    _compose_once()
    arguments = _serve(say)
    if arguments is not None:
        sys.argv[1:] = arguments
        runpy.run_module(module, run_name="__main__", alter_sys=True)


def _compose_once() -> None:
    """The parser of Hydra's grammar learns from what it reads, and our tables of options are read from files once."""
    from vlgs.command import composed
    from vlgs.config import check_config

    check_config(composed(["trainer=benchmark", "data.scene=glassware", "trainer.iterations=1"]))


def _serve(say: int) -> list[str] | None:
    """Answer requests until there are none; then, and where nobody listens any more, None. In a child: its arguments."""
    import gc

    gc.collect()
    gc.freeze()  # the collector would write to pages that are shared
    unburied = 0
    for line in sys.stdin.buffer:
        if unburied:
            os.waitpid(unburied, 0)
        request = json.loads(line)
        child = os.fork()
        if not child:
            os.close(say)
            _become(Path(request["log"]))
            return request["arguments"]
        unburied = child
        try:
            os.write(say, f"{child}\n".encode())
            ended = os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
            assert ended is not None
            status = ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status
            os.write(say, f"{status}\n".encode())
        except BrokenPipeError:
            return None
    if unburied:
        os.waitpid(unburied, 0)
    return None


def _become(log: Path) -> None:
    """Make this child a process of its own: session, input and output."""
    os.setsid()
    nothing, file = os.open(os.devnull, os.O_RDONLY), os.open(log, os.O_WRONLY | os.O_APPEND)
    for source, targets in ((nothing, (0,)), (file, (1, 2))):
        for target in targets:
            os.dup2(source, target)
        os.close(source)


if __name__ == "__main__":
    main()
