"""Runs one attack in a child process and says whether the project met it rightly.

Right is: it worked, or it ended in one error that says who refuses what; within 10 s of CPU and 1 GB of memory, and never by a
traceback of something else. Children are forked from a parent that has imported the project but computed nothing, so that
thousands of attacks take minutes.
"""

import importlib
import json
import os
import re
import resource
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vlgs.report.provenance import PACKAGE

SECONDS = 10.0
ENDLESS = 300
"""A busy machine takes its time."""
MEGABYTES = 1000.0

NAMED = re.compile(r"^(error: )?[^:\n]+: .+", re.DOTALL)
"""``<who>: <what> must be <expected>, got <actual>``, loosely: somebody says something."""


@dataclass(frozen=True)
class Attack:
    """Something hostile that the project is given."""

    name: str
    """What was done, in words."""
    call: Callable[[], object]
    """Calls a public function or a `main`; what it returns does not matter."""
    must_say: str = ""
    """What an error must contain: the name of the file, the key."""
    must_refuse: bool = False
    """Whether taking it without an error is wrong."""
    prepare: Callable[[], object] = lambda: None
    """What must be done before, for an attack that is tried; its time and memory do not count."""
    endless: int = ENDLESS
    """Seconds by the clock after which a child that waits for something is ended."""


@dataclass(frozen=True)
class AttackOutcome:
    """What became of an attack."""

    name: str
    right: bool
    said: str
    """The error, or what is wrong with it."""
    seconds: float
    """CPU time."""
    megabytes: float
    """Growth of the peak memory."""


def run_attack(attack: Attack) -> AttackOutcome:
    """Prepare, fork, attack, judge."""
    attack.prepare()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with tempfile.TemporaryFile() as pipe:
        child = os.fork()
        if child == 0:
            _child(attack, pipe.fileno())
        _, status, usage = os.wait4(child, 0)
        pipe.seek(0)
        try:
            kind, said, imported = json.load(pipe)
        except json.JSONDecodeError:
            ended = f"the process ended with {os.waitstatus_to_exitcode(status)}"
            kind, said, imported = "died", ended, []
    seconds = usage.ru_utime + usage.ru_stime
    megabytes = max(0, usage.ru_maxrss - before) / 1024
    _import(imported)
    return AttackOutcome(
        attack.name, *_judge(attack, kind, said, seconds, megabytes), seconds, megabytes
    )


def _judge(
    attack: Attack, kind: str, said: str, seconds: float, megabytes: float
) -> tuple[bool, str]:
    if kind == "died":
        return False, said
    if kind == "crashed":
        return False, f"not an error of ours: {said}"
    if seconds > SECONDS or megabytes > MEGABYTES:
        return False, f"took {seconds:.1f} s and {megabytes:.0f} MB: {said}"
    if kind == "worked":
        return not attack.must_refuse, "worked" + (" but must not" if attack.must_refuse else "")
    if not NAMED.match(said) or "Traceback" in said:
        return False, f"does not say who: {said}"
    if attack.must_say not in said:
        return False, f"does not name {attack.must_say}: {said}"
    return True, said


def _import(names: list[str]) -> None:
    """What one child has imported on its way, the next ones have from their parent."""
    for name in names:
        with suppress(ImportError):
            importlib.import_module(name)


def _trusted() -> list[str]:
    """Modules of this project and of what is installed; not those that an attack brought along."""
    places = (f"{PACKAGE}/", f"{sys.prefix}/lib/", f"{sys.base_prefix}/lib/")
    files = ((name, getattr(module, "__file__", None)) for name, module in sys.modules.items())
    found = [name for name, file in files if file and file.startswith(places)]
    return [name for name in found if not name.startswith(("pycolmap", "__m"))]


def _child(attack: Attack, out: int) -> None:
    """Attack and tell; never returns."""
    before = set(sys.modules)
    resource.setrlimit(resource.RLIMIT_CPU, (int(4 * SECONDS), int(4 * SECONDS)))
    signal.alarm(attack.endless)
    with tempfile.TemporaryFile() as noise:
        os.dup2(noise.fileno(), sys.stdout.fileno())
        os.dup2(noise.fileno(), sys.stderr.fileno())
        try:
            attack.call()
            told = ("worked", "")
        except (ValueError, OSError, FloatingPointError) as error:
            told = ("refused", str(error))
        except SystemExit as stop:
            noise.seek(0)
            words = noise.read().decode(errors="replace").strip()
            code = stop.code
            told = (
                ("worked", "")
                if not code
                else ("refused", code if isinstance(code, str) else words)
            )
        except BaseException:
            told = ("crashed", traceback.format_exc(limit=-3))
    with os.fdopen(os.dup(out), "w") as file:
        json.dump([*told, [name for name in _trusted() if name not in before]], file)
    os._exit(0)


def scratch() -> Path:
    """A new folder for the files of a family."""
    return Path(tempfile.mkdtemp(prefix="vlgs-fuzz-"))
