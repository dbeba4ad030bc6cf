"""What an option of a run asks of the options beside it. Every option says it for itself. Imports no torch."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Demand:
    """A property that the option of another group must have.

    An option lists its demands in an attribute `demands`. It has a property if its attribute of that name is true, which is best said
    once, for the class: ``untrained: ClassVar[bool] = True``. What says nothing asks for nothing and has no property, so that a part of
    a plugin is refused where it might not fit, until it says that it does.
    """

    asker: str
    """The option that asks, as on a command line: ``sharing=none``."""
    group: str
    """Whose option is asked: ``fusion``."""
    needed: str
    """Name of the property."""
    why: str = ""
    """Ends the message: ``as nothing trains it``."""


def unmet(options: Mapping[str, object]) -> Iterator[Demand]:
    """The demands that the chosen options do not meet, in the order of the options.

    Args:
        options: Group -> what was constructed for it.
    """
    for option in options.values():
        for demand in getattr(option, "demands", ()):
            if not has(options[demand.group], demand.needed):
                yield demand


def has(option: object, needed: str) -> bool:
    """Whether an option, or all options of a class, or one of several parts with names, have a property."""
    if isinstance(option, Mapping):
        return any(has(part, needed) for part in option.values())
    return getattr(option, needed, False) is True
