"""Runs killed at every call that changes their files: before it, after it, and in the middle of a write.

The same command then runs again, and everything that it leaves must be what a run that nobody killed leaves. Calls are counted where
Python makes them, below every library that a run writes with: ``open``, ``os.replace`` and the like are replaced in the child. What
strace shows of a run is this list (`calls_of`).
"""

import builtins
import csv
import gc
import hashlib
import importlib
import io
import json
import os
import random
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from tests.fuzz.judge import Attack

SIDES = ("before", "after", "half")
"""Of the call; ``half`` is for writes."""
CHANGING = {
    "fsync": "fsync", "replace": "rename", "rename": "rename", "unlink": "unlink",
    "remove": "unlink", "mkdir": "mkdir", "rmdir": "rmdir",
}  # fmt: skip
"""Functions of `os` -> what they do."""
VOLATILE = ("train_seconds", "fps_color", "fps_language", "fps_query", "peak_rss_bytes", "skips",
            "checkpoint_bytes", "machine")  # fmt: skip
"""Entries of metrics.json that differ between two runs: times, memory, and texts that name times."""
OVERRIDES = (
    "trainer=smoke", "trainer.iterations=9", "trainer.checkpoint_every=3", "trainer.log_every=2",
    "gaussians.densify={start: 2, stop: 8, every: 3, reset_every: 0}", "head.training.steps=5",
    "data.width=24", "data.height=18", "data.train_views=3", "data.test_views=1", "data.points=60",
    "progress=false", "threads=1", "fusion=self",
)  # fmt: skip
"""A run of a second or two with three checkpoints."""


@dataclass(frozen=True)
class Kill:
    """Where a process dies: at the call of that number, counted from 1."""

    call: int
    side: str = "before"


@dataclass
class Calls:
    """Counts the calls that change files in a folder; installed in a forked child, which may die of it."""

    folder: Path
    kill: Kill | None = None
    seen: list[str] = field(default_factory=list)
    """What was called on what, in order."""

    def install(self) -> None:
        """Put this between the process and its files."""
        for name, what in CHANGING.items():
            setattr(os, name, self._counted(getattr(os, name), what))
        builtins.open = io.open = self._opening(io.open)

    def count(
        self, what: str, call: Callable[[], Any], half: Callable[[], Any] | None = None
    ) -> Any:
        """Do a call, if this process lives on; `half` is how a half of it is done."""
        self.seen.append(re.sub(r"\.\d+-[0-9a-f]{8}\.tmp", ".tmp", what))
        side = self.kill.side if self.kill and self.kill.call == len(self.seen) else ""
        if side == "half" and half is not None:
            half()
        if side in ("before", "half"):
            os.kill(os.getpid(), signal.SIGKILL)
        try:
            return call()
        finally:
            if side == "after":
                os.kill(os.getpid(), signal.SIGKILL)

    def name(self, file: object) -> str | None:
        """Path below the folder; None of another file."""
        path = os.readlink(f"/proc/self/fd/{file}") if isinstance(file, int) else file
        if not isinstance(path, (str, os.PathLike)):
            return None
        full = os.path.abspath(os.fspath(path))
        inside = full == str(self.folder) or full.startswith(f"{self.folder}/")
        return os.path.relpath(full, self.folder) if inside else None

    def _counted(self, function: Callable[..., Any], what: str) -> Callable[..., Any]:
        def counted(file: Any, *rest: Any, **named: Any) -> Any:
            name = self.name(file) if "dir_fd" not in named else None
            if name is None:
                return function(file, *rest, **named)
            return self.count(f"{what} {name}", lambda: function(file, *rest, **named))

        return counted

    def _opening(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def opening(
            file: Any, mode: str = "r", buffering: int = -1, *rest: Any, **named: Any
        ) -> Any:
            if not set(mode) & set("wax+") or isinstance(file, int) or self.name(file) is None:
                return function(file, mode, buffering, *rest, **named)
            raw = _Raw(self, file, mode)
            buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
            return buffered if "b" in mode else io.TextIOWrapper(buffered, *rest, **named)

        return opening


class _Raw(io.FileIO):
    """A file whose system calls are counted."""

    def __init__(self, calls: Calls, file: Any, mode: str) -> None:
        self.calls, self.what = calls, calls.name(file)
        start = super().__init__
        calls.count(f"open {self.what}", lambda: start(file, re.sub("[bt]", "", mode)))

    def write(self, data: Any, /) -> int:
        write, half = super().write, bytes(memoryview(data)[: len(data) // 2])
        return self.calls.count(f"write {self.what}", lambda: write(data), lambda: write(half))

    def truncate(self, size: int | None = None, /) -> int:
        cut = super().truncate
        return self.calls.count(f"truncate {self.what}", lambda: cut(size))


def attacks(folder: Path, seed: int, count: int) -> Iterator[Attack]:
    """Kills at every call, and pairs of kills of which the second is in the resume; half of fewer lie around the last save."""
    config = _composed()
    whole = folder / "whole" / "results"
    calls = calls_of(config, whole)
    wanted = left_by(whole)
    for number, kills in enumerate(chosen(calls, seed, count)):
        results = folder / str(number) / "results"
        words = ", then ".join(f"{kill.side} call {kill.call}" for kill in kills)
        name = f"killed {words} ({calls[kills[0].call - 1]})"
        yield Attack(name, lambda r=results, k=kills: _attack(config, r, k, wanted))


def chosen(calls: Sequence[str], seed: int, count: int) -> list[tuple[Kill, ...]]:
    """Which kills there are, or `count` of them."""
    single: list[tuple[Kill, ...]] = [
        (Kill(number, side),)
        for number, call in enumerate(calls, start=1)
        for side in SIDES
        if side != "half" or call.startswith("write")
    ]
    rng = random.Random(seed)
    pairs = [
        (*rng.choice(single), Kill(rng.randint(1, len(calls)), rng.choice(SIDES[:2])))
        for _ in range(len(single) // 4)
    ]
    every = single + pairs
    if count >= len(every):
        return every
    last = max(
        number
        for number, call in enumerate(calls, 1)
        if call.startswith("rename") and "step_" in call
    )
    near = sorted(single, key=lambda kills: abs(kills[0].call - last))[: count // 2]
    return (
        near
        + [kills for kills in rng.sample(every, count) if kills not in near][: count - len(near)]
    )


def calls_of(config: DictConfig, results: Path) -> list[str]:
    """Run without a kill; what was called."""
    told = results.parent / "calls.json"
    results.mkdir(parents=True)
    assert _run(config, results, None, told) == 0, "the run that nobody kills must end well"
    calls, modules = json.loads(told.read_text())
    for name in modules:  # all that a run imports on its way, so that children need not
        with suppress(ImportError):
            importlib.import_module(name)
    gc.collect()
    gc.freeze()  # memory that children do not touch is not copied
    return calls


def left_by(results: Path) -> dict[str, str]:
    """File -> digest of what may not differ between two runs; every file that a run leaves is there."""
    files = sorted(path for path in results.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(results)): _digest(path) for path in files}


def _attack(
    config: DictConfig, results: Path, kills: Sequence[Kill], wanted: dict[str, str]
) -> None:
    results.mkdir(parents=True)
    for number, kill in enumerate(kills):
        status = _run(config, results, kill)
        ends = (-signal.SIGKILL, 0)[
            : 1 + number
        ]  # a resume may have fewer calls than the second kill waits for
        assert status in ends, f"a killed run ended with {status}"
    status = _run(config, results, None)
    assert status == 0, f"the run after it ended with {status}"
    found = left_by(results)
    wrong = sorted(name for name in {*found, *wanted} if found.get(name) != wanted.get(name))
    assert not wrong, f"these files differ from those of a whole run: {', '.join(wrong)}"


def _run(config: DictConfig, results: Path, kill: Kill | None, told: Path | None = None) -> int:
    """One run in a forked child; its exit status, negative for a signal."""
    from vlgs.report.timing import measure_fps
    from vlgs.run import run

    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status = 1
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # its table of results
        calls = Calls(results, kill)
        calls.install()
        measure_fps.__defaults__ = (0.0, 3)  # frame rates are not compared
        config = config.copy()
        config.results = str(results)
        status = run(config)
        if told is not None:
            told.write_text(json.dumps([calls.seen, sorted(sys.modules)]))
    finally:
        os._exit(status)


def _composed() -> DictConfig:
    from hydra import compose, initialize_config_dir

    from vlgs.config import CONF

    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=list(OVERRIDES))


def _digest(path: Path) -> str:
    data = path.read_bytes()
    if path.name == "metrics.json":
        metrics = {key: value for key, value in json.loads(data).items() if key not in VOLATILE}
        data = json.dumps(metrics).encode()
    elif path.name == "log.csv":
        data = repr([row[:-1] for row in csv.reader(data.decode().splitlines())]).encode()
    elif path.suffix == ".safetensors":
        from safetensors.torch import load

        tensors = sorted(load(data).items())
        data = b"".join(key.encode() + value.numpy().tobytes() for key, value in tensors)
    return hashlib.sha256(data).hexdigest()
