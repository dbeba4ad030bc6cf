"""A process per instruction set: the kernel chooses it when it is imported."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class Child:
    """A fresh Python process that runs functions of this package, one at a time, until it is closed.

    Args:
        isa: What VLGS_ISA says there: ``v4``, ``v3`` or ``base``; None leaves it as it is.
    """

    def __init__(self, isa: str | None = None) -> None:
        self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
        with _environment("VLGS_ISA", isa):
            # The process starts with its first task, under the environment of that moment.
            self.isa = self.call(current_isa)

    def call(
        self,
        function: Callable[Arguments, Result],
        *args: Arguments.args,
        **kwargs: Arguments.kwargs,
    ) -> Result:
        """Run a function of a module there and wait for it; its exceptions are raised here."""
        return self._pool.submit(function, *args, **kwargs).result()

    def close(self) -> None:
        """End the process."""
        self._pool.shutdown()

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def current_isa() -> str:
    """The instruction set of the process that this runs in."""
    from vlgs.ops.machine import instruction_set

    return instruction_set()


def free_memory() -> int:
    """Bytes that can be allocated without swapping, as far as the system says; half of all memory where it does not."""
    try:
        with open("/proc/meminfo") as file:
            sizes = dict(line.split(":", 1) for line in file)
        return 1024 * int(sizes["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


def peak_mib() -> float:
    """Most memory that this process has held, in MiB; what `resource` says may be the parent's, from before the fork."""
    with open("/proc/self/status") as file:
        sizes = dict(line.split(":", 1) for line in file)
    return int(sizes["VmHWM"].split()[0]) / 1024


@contextmanager
def _environment(name: str, value: str | None) -> Iterator[None]:
    before = os.environ.get(name)
    if value is not None:
        os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = before
