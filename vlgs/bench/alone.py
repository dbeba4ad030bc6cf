"""Fusion and Adam alone, by threads: the two parts of an iteration whose time depends on the number of Gaussians only."""

import os
import time
from collections.abc import Callable, Sequence
from functools import partial

import torch
from rich.table import Table
from torch import Tensor

from vlgs.bench.clock import Spread, spread, take_turns, time_pass
from vlgs.fusion.attention import SelfAttention

CODE = 3
"""Width of a language code."""
WIDTHS = {
    "means": 3, "quats": 4, "log_scales": 3, "sh0": 3, "shN": 45, "opacity_logits": 1,
    "indicator_logits": 1, "features": CODE,
}  # fmt: skip
"""Numbers per Gaussian and parameter, with harmonics of degree 3."""

Timer = Callable[[], tuple[float, float]]
"""Does the work once; returns wall and CPU milliseconds."""


def measure_alone(
    gaussians: int, threads: Sequence[int], repeats: int, seed: int
) -> dict[tuple[str, int], Spread]:
    """Part and number of threads -> its times; all of them take turns."""
    before = torch.get_num_threads()
    parts = {
        "fusion=self, forward and backward": _fusion(gaussians, seed),
        "Adam": _adam(gaussians, seed),
    }
    variants = {
        (part, count): partial(_with_threads, count, timer)
        for part, timer in parts.items()
        for count in threads
    }
    try:
        samples = take_turns(variants, repeats)
    finally:
        torch.set_num_threads(before)
    return {key: spread(*zip(*times, strict=True)) for key, times in samples.items()}


def _with_threads(count: int, timer: Timer) -> tuple[float, float]:
    torch.set_num_threads(count)
    timer()  # wakes the threads
    return timer()


def _fusion(n: int, seed: int) -> Timer:
    g = torch.Generator().manual_seed(seed)
    attention = SelfAttention(color_dim=3, feature_dim=CODE)
    color, feature = (torch.rand(n, c, generator=g).requires_grad_() for c in (3, CODE))
    upstream = [torch.randn(n, c, generator=g) for c in (3, CODE)]
    leaves: list[Tensor] = [color, feature, *attention.parameters()]

    def timer() -> tuple[float, float]:
        took = time_pass(lambda: attention(color, feature), upstream, leaves)
        return took.forward + took.backward, took.forward_cpu + took.backward_cpu

    return timer


def _adam(n: int, seed: int) -> Timer:
    g = torch.Generator().manual_seed(seed)
    leaves = [torch.rand(n, c, generator=g).requires_grad_() for c in WIDTHS.values()]
    for leaf in leaves:
        leaf.grad = torch.randn(leaf.shape, generator=g)
    optimizer = torch.optim.Adam(leaves, lr=1e-3, eps=1e-15, fused=True)

    def timer() -> tuple[float, float]:
        wall, cpu = time.perf_counter(), time.process_time()
        optimizer.step()
        return 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)

    return timer


def show_alone(gaussians: int, times: dict[tuple[str, int], Spread]) -> Table:
    """One row per part and number of threads; a wall time means little where others use the cores."""
    load = (
        f"{os.getloadavg()[0]:.1f} of {os.cpu_count()} cores" if os.name == "posix" else "unknown"
    )
    table = Table(title=f"{gaussians} Gaussians, SH 3; load {load}")
    for name in ("part", "threads", "wall", "quartiles", "CPU"):
        table.add_column(name, justify="left" if name == "part" else "right")
    for (part, threads), t in times.items():
        spans = f"{t.q1:.1f} - {t.q3:.1f} ms"
        table.add_row(part, str(threads), f"{t.ms:.1f} ms", spans, f"{t.cpu:.1f} ms")
    return table
