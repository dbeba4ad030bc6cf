"""What can be wrong with a scene on disk: a list for `vlgs.check`, one error for `load_scene`."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong, where it is, and what to do about it."""

    file: str
    """The file or folder at fault."""
    what: str
    """``<what> must be <expected>, got <actual>``."""
    advice: str = ""
    """What to do, as an imperative; empty where `what` says it already."""
    where: str = ""
    """Place inside the file: ``byte 42``, ``line 7``."""
    severity: Literal["error", "warning"] = "error"
    """An error keeps the scene from being loaded."""

    def __str__(self) -> str:
        place = f"{self.file}, {self.where}" if self.where else self.file
        return f"{place}: {self.what}" + (f"; {self.advice}" if self.advice else "")


class SceneError(ValueError):
    """A scene that cannot be used as it is. `fault` is the first thing wrong, `more` counts the rest."""

    def __init__(self, fault: Fault, more: int = 0):
        tail = f" (and {more} more: run python -m vlgs.check)" if more else ""
        super().__init__(f"{fault}{tail}")
        self.fault = fault
        self.more = more

    def __reduce__(self) -> tuple[type["SceneError"], tuple[Fault, int]]:
        return SceneError, (self.fault, self.more)


class FaultList(list[Fault]):
    """Everything found so far."""

    def take(self, result: tuple[T, Iterable[Fault]]) -> T:
        """Return the first value of a reader's result, and add the second, its faults, to the list."""
        value, found = result
        self.extend(found)
        return value


def warning(file: object, what: str, advice: str = "", where: str = "") -> Fault:
    """Make a fault that does not keep the scene from being loaded."""
    return Fault(str(file), what, advice, where, "warning")


def errors(faults: Iterable[Fault]) -> tuple[Fault, ...]:
    """The faults that keep a scene from being loaded."""
    return tuple(fault for fault in faults if fault.severity == "error")


def require_sound(faults: Iterable[Fault]) -> None:
    """Do nothing if no fault is an error.

    Raises:
        SceneError: The first error, with the number of the others.
    """
    if found := errors(faults):
        raise SceneError(found[0], len(found) - 1)


def listing(names: Iterable[str], limit: int = 10) -> str:
    """Names for an error message: all of them, or the first few and how many are left.

    Example:
        >>> listing(["b", "a", "c"], limit=2)
        'b, a and 1 more'
    """
    names = list(names)
    text = ", ".join(names[:limit])
    return f"{text} and {len(names) - limit} more" if len(names) > limit else text or "none"
