import platform
import resource

import pytest
import torch

from vlgs.ops.machine import freed_memory_kept

WIDE = 20 << 20  # numbers: more than glibc keeps by itself
PAGES = WIDE * 4 // resource.getpagesize()


def faults_of_maps(count: int) -> int:
    """Pages that the system has to clear for so many maps, one after the other."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(count):
        torch.zeros(WIDE)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is another")
def test_pages_of_a_freed_map_are_used_again_while_memory_is_kept():
    with freed_memory_kept():
        faults_of_maps(1)
        # A small block that somebody else puts into a freed map makes the next map a new one: seen twice in eight.
        assert faults_of_maps(24) < 12 * PAGES
        kept = resident()
    assert resident() < kept - 60  # of 80 at least


def resident() -> int:
    """MiB."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() >> 20
