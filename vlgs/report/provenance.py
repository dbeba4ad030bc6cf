"""Which code on which machine made a result."""

import os
import platform
import subprocess
from pathlib import Path

import torch

from vlgs.ops.machine import instruction_set

PACKAGE = Path(__file__).parents[1]


def machine() -> dict[str, str | int]:
    """CPU model, instruction set of the kernels, logical cores this process may use, threads of torch, versions."""
    return {
        "cpu": _cpu_model(),
        "isa": instruction_set(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count() or 1,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
    }


def commit(package: Path = PACKAGE) -> str | None:
    """Commit of the checkout that the package is imported from, with ``+dirty`` if its code or configuration has changed.

    None if the package is not tracked there: an installed wheel inside someone's repository is not that repository's commit.
    """
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    head = _git(package, "rev-parse", "HEAD")
    if head is None:
        return None
    changed = _git(package, "status", "--porcelain", "--", ".", "../csrc", "../conf")
    return f"{head}+dirty" if changed else head


def same_code(one: str | None, other: str | None, package: Path = PACKAGE) -> bool:
    """Whether two results of `commit` mean the same code and configuration; uncommitted changes never do."""
    if one is None or other is None or "+dirty" in one + other:
        return False
    return _git(package, "diff", "--quiet", one, other, "--", ".", "../csrc", "../conf") is not None


def _git(folder: Path, *arguments: str) -> str | None:
    """Output of a git command, None if it fails or there is no git."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments],
            capture_output=True, text=True, timeout=10, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _cpu_model(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """The CPU's name; the kernel has it on Linux, elsewhere `platform` knows what there is to know."""
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()
