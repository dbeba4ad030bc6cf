"""What the compiled kernels say of the machine that they run on."""

from vlgs import _csrc


def instruction_set() -> str:
    """The set in use: ``v4`` (AVX-512), ``v3`` (AVX2 and FMA) or ``base``; VLGS_ISA lowers it."""
    return _csrc.isa()


def instruction_sets() -> list[str]:
    """Those that this build has and this machine runs, best first."""
    return _csrc.isas().split()


def peak_fma(packs: int) -> int:
    """Do at least so many multiply-adds of sixteen floats and nothing else; returns how many were done."""
    return _csrc.peak_fma(packs)
