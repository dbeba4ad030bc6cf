"""Optional packages: what to install when one is asked for that is not there. Imports no torch."""

from importlib.util import find_spec


def require_extra(module: str, extra: str) -> None:
    """Do nothing if an optional package is installed.

    Args:
        module: What is imported.
        extra: Of vlgs, that brings it.

    Raises:
        ValueError: Says how to install it.
    """
    if find_spec(module) is None:
        raise ValueError(
            f"{module}: must be installed, got none; pip install 'vlgs[{extra}]' brings it"
        )
