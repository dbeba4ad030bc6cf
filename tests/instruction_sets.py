"""Which instruction sets a test of all of them runs in a process of its own."""

import pytest

from vlgs.ops import _csrc


def require_other(isa: str) -> None:
    """Skip where this build or machine has no such set, and where it is what every other test runs on."""
    if isa == _csrc.isa():
        pytest.skip("every other test runs on it")
    if isa not in _csrc.isas().split():
        pytest.skip(
            f"this build and this machine have {_csrc.isas()}; VLGS_ISAS chooses what is built"
        )
