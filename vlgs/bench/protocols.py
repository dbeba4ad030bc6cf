"""What a protocol costs: the time of its scores over many queries, without rendering."""

import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from rich.table import Table

from vlgs.metrics.dense import Dense
from vlgs.metrics.goi import Goi
from vlgs.metrics.lerf_ovs import LerfOvs
from vlgs.metrics.masks import Unit
from vlgs.metrics.ovs3d import Ovs3dArgmax, Ovs3dThreshold
from vlgs.metrics.protocol import EvaluationProtocol, Evidence, Splats
from vlgs.metrics.segment import LANGSPLAT_V2
from vlgs.metrics.select3d import Select3d

PROTOCOLS: tuple[EvaluationProtocol, ...] = (
    Dense(),
    LerfOvs(),
    LerfOvs(constants=LANGSPLAT_V2),
    LerfOvs(strict=True),
    Ovs3dArgmax(),
    Ovs3dThreshold(),
    Goi(),
    Select3d(),
)
CLASSES = 15
"""Queries per view: the size of a class list of LERF-OVS."""


@dataclass(frozen=True)
class Cost:
    """One protocol over all queries."""

    name: str
    queries: int
    cpu_seconds: float
    wall_seconds: float


def measure_protocols(
    queries: int = 300, levels: int = 3, width: int = 986, height: int = 728
) -> list[Cost]:
    """Score `queries` queries, `CLASSES` in a view, with every protocol on random smooth maps of one size.

    Views are scored again and again from one set of maps; what it costs to make them is not part of the figures.
    """
    views = -(-queries // CLASSES)
    seen = _evidence(levels, width, height)
    return [_measure(protocol, seen, views) for protocol in PROTOCOLS]


def show_protocols(costs: Sequence[Cost]) -> Table:
    """The figures for the terminal."""
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    table = Table(
        "protocol",
        title=f"{costs[0].queries} queries, {torch.get_num_threads()} threads",
        caption=f"peak memory of the process, maps included: {peak / 1e6:.0f} MB",
    )
    for column in ("CPU s", "wall s", "CPU ms per query"):
        table.add_column(column, justify="right")
    for cost in costs:
        table.add_row(
            cost.name,
            f"{cost.cpu_seconds:.1f}",
            f"{cost.wall_seconds:.1f}",
            f"{1e3 * cost.cpu_seconds / cost.queries:.0f}",
        )
    return table


def _measure(protocol: EvaluationProtocol, seen: Evidence, views: int) -> Cost:
    cpu, wall = time.process_time(), time.perf_counter()
    scores = [score for _ in range(views) for score in protocol.score(seen)]
    protocol.conclude(scores, seen.classes)
    return Cost(
        name=f"{protocol.name}{' (v2)' if protocol == LerfOvs(constants=LANGSPLAT_V2) else ''}",
        queries=len(scores),
        cpu_seconds=time.process_time() - cpu,
        wall_seconds=time.perf_counter() - wall,
    )


def _evidence(levels: int, width: int, height: int) -> Evidence:
    """Random maps, smooth as rendered ones are; each class's truth is where it is the largest."""
    rng = torch.Generator().manual_seed(0)
    coarse = torch.rand(levels, CLASSES, height // 40 + 1, width // 40 + 1, generator=rng)
    maps = list(
        torch.nn.functional.interpolate(
            coarse, (height, width), mode="bilinear", align_corners=True
        )
    )
    truth = maps[0].argmax(dim=0)
    names = tuple(f"class {i}" for i in range(CLASSES))
    units = [Unit(name, truth == i) for i, name in enumerate(names)]
    gaussians = [level.flatten(1) for level in maps]  # one per pixel

    def silhouette(level: int, selected: torch.Tensor) -> torch.Tensor:
        return selected.reshape(height, width).to(maps[0].dtype)

    return Evidence(
        "v", names, units, truth.to(torch.uint8), maps, maps, lambda: Splats(gaussians, silhouette)
    )
