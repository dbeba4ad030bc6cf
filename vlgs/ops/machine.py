"""What the compiled kernels say of the machine that they run on, and what they ask of it."""

from collections.abc import Iterator
from contextlib import contextmanager

from vlgs.ops import _csrc


def instruction_set() -> str:
    """The set in use: ``v4`` (AVX-512), ``v3`` (AVX2 and FMA) or ``base``; VLGS_ISA lowers it."""
    return _csrc.isa()


def instruction_sets() -> list[str]:
    """Those that this build has and this machine runs, best first."""
    return _csrc.isas().split()


def peak_fma(packs: int) -> int:
    """Do at least so many multiply-adds of sixteen floats and nothing else; returns how many were done."""
    return _csrc.peak_fma(packs)


@contextmanager
def freed_memory_kept() -> Iterator[None]:
    """For as long as the context lasts, memory that is freed is kept for the next who asks (csrc/freed_memory.h).

    Every step of a training asks for the same sizes again. Maps of 512 numbers per pixel are large enough that the C library would
    return them to the system each time: that took two thirds of the time of ``method=feature3dgs``. What is free at the end is returned.
    """
    _csrc.keep_freed_memory(True)
    try:
        yield
    finally:
        _csrc.keep_freed_memory(False)
