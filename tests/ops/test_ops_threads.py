"""The kernel's own threads: several callers at once, a fork, an end while they wait."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from vlgs.ops.view_color import view_color

ROWS = 20_000  # work for several threads

FORKS = f"""
import os, sys, torch
from vlgs.ops.view_color import view_color

g = torch.Generator().manual_seed(0)
color, means, shN = torch.rand({ROWS}, 3, generator=g), torch.randn({ROWS}, 3, generator=g), torch.randn({ROWS}, 3, 3, generator=g)

def seen(threads):
    torch.set_num_threads(threads)
    return view_color(color, shN, means, torch.zeros(3), 1).numpy().tobytes()

alone = seen(1)
same = seen(2) == alone
for depth in range(3):  # a child, its child, and that one's
    if os.fork():
        _, status = os.wait()
        os._exit(status != 0 or not same)
    same = same and seen(3) == alone and seen(2) == alone
    same = same and len(os.listdir("/proc/self/task")) >= 3
sys.exit(not same)
"""


def colors(threads: int, seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    color, means = torch.rand(ROWS, 3, generator=g), torch.randn(ROWS, 3, generator=g)
    shN = torch.randn(ROWS, 3, 3, generator=g)
    torch.set_num_threads(threads)
    return view_color(color, shN, means, torch.zeros(3), 1)


def test_callers_at_once_get_what_one_alone_gets():
    before = torch.get_num_threads()
    try:
        alone = [colors(1, seed) for seed in range(4)]
        with ThreadPoolExecutor(4) as callers:
            for _ in range(5):
                assert all(map(torch.equal, callers.map(colors, (1, 2, 3, 4), range(4)), alone))
    finally:
        torch.set_num_threads(before)


@pytest.mark.skipif(sys.platform != "linux", reason="it counts threads in /proc")
def test_children_of_a_process_whose_threads_wait_have_threads_of_their_own():
    child = subprocess.run([sys.executable, "-c", FORKS], timeout=60, check=False)
    assert child.returncode == 0
