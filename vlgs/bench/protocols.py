"""What a protocol costs: the time of its scores over many queries, without rendering."""

import time
from dataclasses import dataclass
from pathlib import Path

import torch

from vlgs.bench.child import Child, peak_mib
from vlgs.bench.record import provenance, show, write_record
from vlgs.metrics.dense import Dense
from vlgs.metrics.goi import Goi
from vlgs.metrics.lerf_ovs import LerfOvs
from vlgs.metrics.masks import Unit
from vlgs.metrics.ovs3d import Ovs3dArgmax, Ovs3dThreshold
from vlgs.metrics.protocol import EvaluationProtocol, Evidence, GaussianEvidence
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
    """One protocol over all queries, in a process of its own."""

    protocol: str
    queries: int
    width: int
    height: int
    levels: int
    threads: int
    wall_seconds: float
    cpu_seconds: float
    peak_mib: float
    """Most memory of the process, imports and the maps of one view included."""


def run_protocols(
    queries: int, levels: int, size: tuple[int, int], threads: int, out: Path, seed: int
) -> list[Cost]:
    """Score `queries` queries, `CLASSES` in a view, with every protocol on random smooth maps, and write protocols.csv.

    Views are scored again and again from one set of maps; what it costs to make them is not part of the figures.
    """
    header = provenance(seed)
    costs = []
    for index in range(len(PROTOCOLS)):
        with Child() as child:
            costs.append(child.call(measure, index, queries, levels, size, threads, seed))
    write_record(out / "protocols.csv", costs, header)
    show(
        f"{queries} queries, {threads} threads",
        ("protocol", "CPU s", "wall s", "CPU ms per query", "peak MiB"),
        [
            (
                cost.protocol,
                f"{cost.cpu_seconds:.1f}",
                f"{cost.wall_seconds:.1f}",
                f"{1e3 * cost.cpu_seconds / cost.queries:.0f}",
                f"{cost.peak_mib:.0f}",
            )
            for cost in costs
        ],
    )
    return costs


def measure(
    index: int, queries: int, levels: int, size: tuple[int, int], threads: int, seed: int
) -> Cost:
    """The figures of one of `PROTOCOLS` in this process."""
    torch.set_num_threads(threads)
    protocol, seen = PROTOCOLS[index], _evidence(levels, *size, seed)
    cpu, wall = time.process_time(), time.perf_counter()
    scores = [score for _ in range(-(-queries // CLASSES)) for score in protocol.score(seen)]
    protocol.conclude(scores, seen.classes)
    return Cost(
        protocol=f"{protocol.name}{' (v2)' if protocol == LerfOvs(constants=LANGSPLAT_V2) else ''}",
        queries=len(scores),
        width=size[0],
        height=size[1],
        levels=levels,
        threads=threads,
        wall_seconds=time.perf_counter() - wall,
        cpu_seconds=time.process_time() - cpu,
        peak_mib=peak_mib(),
    )


def _evidence(levels: int, width: int, height: int, seed: int) -> Evidence:
    """Random maps, smooth as rendered ones are; each class's truth is where it is the largest."""
    rng = torch.Generator().manual_seed(seed)
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
        "v",
        names,
        units,
        truth.to(torch.uint8),
        maps,
        maps,
        lambda: GaussianEvidence(gaussians, silhouette),
    )
