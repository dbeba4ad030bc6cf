"""What an answer to a word costs beside the two renders that it is made of, and what folding and tables are off by."""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.bench.clock import Spread, spread, take_turns
from vlgs.bench.pareto import front
from vlgs.bench.presets import Trained
from vlgs.bench.record import (
    COLORS,
    STYLE,
    plain_ticks,
    provenance,
    say,
    show,
    write_figure,
    write_record,
)
from vlgs.bench.workload import make_workload
from vlgs.fields import FieldImages
from vlgs.fields.comparing import CELLS, Decoding, Folding, Tabulating
from vlgs.fields.splat import SplatModel
from vlgs.fields.trained import SplatField
from vlgs.fusion.none import NoFusion
from vlgs.gaussians.sh import rgb_to_sh
from vlgs.heads.folded import Foldable
from vlgs.indicator import Learned
from vlgs.opened.answers import ask_view
from vlgs.queries import Questions, encode_prompts
from vlgs.report.pictures import spread as evenly
from vlgs.types import Camera, RasterConfig

VIEWS = 4
"""Cameras that take turns."""
OBJECTS = 40
"""Of the workload, whose Gaussians have the code of the nearest object and some noise."""
NOISE = 0.1
ANY = 2.0
"""Between cosines there is no larger error."""
LARGE = (100_000, 986, 728)
SMOOTHED = 1 / 32
"""Cell of the table that is also timed with all that `vlgs.query` does."""


@dataclass(frozen=True)
class Asked:
    """A scene, seen from cameras, and a word."""

    name: str
    field: SplatField
    cameras: Sequence[Camera]
    questions: Questions


@dataclass(frozen=True)
class Row:
    """One way to answer."""

    scene: str
    gaussians: int
    width: int
    height: int
    threads: int
    way: str
    """decoded, folded, or table with the width of its cells; smoothed: as `vlgs.query` answers."""
    answer: Spread
    """Colour and language rendered, and the relevancy of a word, of views whose codes a table has seen."""
    render: Spread
    """Colour and language rendered, and nothing else, in turn with the answers."""
    ratio: float
    """The first by the second, medians of wall time."""
    ratio_cpu: float
    """Likewise, of CPU time."""
    answers_per_second: float
    first_ms: float
    """The same of the first view of all, for which a table is filled."""
    first_cpu: float
    nodes: int | None
    """Filled, of all views."""
    mib: float | None
    measured_error: float | None
    """Of cosines, the largest in the middle of a cell: what a bound is compared with."""
    cosine_error: float
    """The largest of all pixels and views, against decoding."""
    relevancy_error: float
    """Likewise."""
    relevancy_error_999: float
    """What 99.9 % of the pixels stay below."""
    front: bool
    """Whether no other way of the scene and the threads is both faster and more exact at 99.9 %."""


def run_query(
    trained: Trained,
    large: tuple[int, int, int],
    threads: Sequence[int],
    repeats: int,
    out: Path,
    seed: int,
) -> list[Row]:
    """Write query.csv and query.png, and print the table.

    Args:
        trained: A trained scene with codes of three numbers.
        large: Gaussians and size of the other scene, which borrows its head.
        threads: Numbers of threads.
        repeats: Answers of each way.
        out: Folder.
        seed: Of the workload.

    Raises:
        ValueError: If the codes do not have three numbers.
    """
    header = provenance(seed, views=VIEWS)
    before, rows = torch.get_num_threads(), list[Row]()
    scenes = [trained_scene(trained), workload_scene(trained, *large, seed)]
    try:
        for asked, count in itertools.product(scenes, threads):
            torch.set_num_threads(count)
            rows += measure(asked, repeats)
            _print(rows[-1].scene, [row for row in rows if row.scene == asked.name])
            write_record(out / "query.csv", rows, header)
    finally:
        torch.set_num_threads(before)
    draw(out / "query", rows)
    say(f"picture: {out / 'query'}.png")
    return rows


def trained_scene(trained: Trained) -> Asked:
    """A trained scene from cameras of its photographs, asked for its first class."""
    field, scene = SplatField(trained.module.model), trained.scene
    head = field.model.head
    if head.dim != 3 or not isinstance(head, Foldable):
        raise ValueError(
            f"query: the scene must have codes of 3 numbers and a head that folds, got {head.dim} and {type(head).__name__}"
        )
    experiment = trained.experiment
    text = experiment.make_text(vocabulary=scene.vocabulary)
    prompts = encode_prompts(experiment.query, text, scene.classes[:1])
    cameras = [view.camera for view in evenly([*scene.train, *scene.test], VIEWS)]
    return Asked(scene.name, field, cameras, Questions(prompts, experiment.query))


def workload_scene(trained: Trained, count: int, width: int, height: int, seed: int) -> Asked:
    """The workload of `vlgs.bench.workload` with the head of a trained scene: every Gaussian is of the nearest of some objects."""
    work, small = make_workload(count, width, height, seed=seed), trained_scene(trained)
    rng = torch.Generator().manual_seed(seed)
    head, means = small.field.model.head, work.means.detach()
    vectors = trained.scene.mask_vectors.float()
    drawn = torch.randint(len(vectors), (OBJECTS,), generator=rng)
    centers = means[torch.randint(count, (OBJECTS,), generator=rng)]
    nearest = torch.cdist(means, centers).argmin(dim=1)
    with torch.no_grad():
        codes = head.targets(vectors[drawn])[nearest]
        codes = codes + NOISE * torch.randn(codes.shape, generator=rng)
        color, language = work.groups
        raw = {
            "means": means,
            "quats": work.quats.detach(),
            "log_scales": work.scales.detach().log(),
            "sh0": rgb_to_sh(color.values.detach()),
            "shN": torch.zeros(count, 0, 3),
            "opacity_logits": color.weight.detach().logit(),
            "indicator_logits": language.weight.detach().logit(),
            "features": codes,
        }
    model = SplatModel(raw, NoFusion(), Learned(), head, RasterConfig(), 0)
    cameras = []
    for index in range(VIEWS):  # a step to the side each
        viewmat = work.camera.viewmat.clone()
        viewmat[0, 3] = 0.02 * index
        cameras.append(Camera(viewmat, work.camera.K, width, height))
    name = f"workload {count // 1000}k {width}x{height}"
    return Asked(name, SplatField(model), cameras, small.questions)


def measure(asked: Asked, repeats: int) -> list[Row]:
    """All ways of one scene, in turn, on as many threads as there are."""
    head = asked.field.model.head
    assert isinstance(head, Foldable)  # `trained_scene`
    folding = Folding(head.fold())
    ways: dict[str, Decoding | Folding | Tabulating] = {"decoded": Decoding(head), "folded": folding}  # fmt: skip
    ways |= {f"table {cell:g}": Tabulating(folding, ANY, (cell,)) for cell in CELLS}
    fields = {
        name: SplatField(asked.field.model, compare=compare) for name, compare in ways.items()
    }
    firsts, errors = _first_looks(asked, fields)
    smoothed = f"table {SMOOTHED:g}"
    calls: dict[str, Callable[[Camera], object]] = {"render": lambda camera: _look(asked.field, camera)}  # fmt: skip
    calls |= {
        name: lambda camera, field=field: answer(asked, field, camera)
        for name, field in fields.items()
    }
    calls[f"{smoothed}, smoothed"] = lambda camera: ask_view(fields[smoothed], camera, asked.questions)  # fmt: skip
    timed = _timed(calls, asked.cameras, repeats)
    names, render = [name for name in timed if name != "render"], timed["render"]
    kept = front([(timed[name].ms, errors[name.partition(",")[0]][2]) for name in names])
    rows = []
    for name, best in zip(names, kept, strict=True):
        own = name.partition(",")[0]
        compare, own_time, camera = ways[own], timed[name], asked.cameras[0]
        table = next(iter(compare.tables.values())) if isinstance(compare, Tabulating) else None
        rows.append(Row(
            asked.name, asked.field.model.count, camera.width, camera.height, torch.get_num_threads(), name, own_time,
            render, own_time.ms / render.ms, own_time.cpu / render.cpu, 1e3 / own_time.ms, *firsts[own],
            None if table is None else len(table.rows), None if table is None else table.nbytes / 2**20,
            None if table is None else table.error, *errors[own], best,
        ))  # fmt: skip
    return rows


@torch.no_grad()
def answer(
    asked: Asked, field: SplatField, camera: Camera
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """The relevancy of the word and its cosine, of a view that is rendered for it."""
    prompts = asked.questions.prompts
    found = field.similarity(
        camera, torch.cat([prompts.text, prompts.negatives]), _look(field, camera)
    )[0]
    return asked.questions.query.relevancy(found[:1], found[1:])[0], found[0]


def _look(field: SplatField, camera: Camera) -> FieldImages:
    return field.render(camera, frozenset({"color", "feature"}))


def _first_looks(
    asked: Asked, fields: Mapping[str, SplatField]
) -> tuple[dict[str, tuple[float, float]], dict[str, tuple[float, float, float]]]:
    """Milliseconds of the first answer of each way, and how far all answers are from the first way's: cosines, relevancy, and 99.9 % of it."""
    firsts: dict[str, tuple[float, float]] = {}
    off: dict[str, list[Tensor]] = {name: [] for name in fields}
    for field in fields.values():
        _look(field, asked.cameras[0])  # Gaussians are fused once, for whatever is asked
    for camera in asked.cameras:
        exact: Sequence[Tensor] | None = None
        for name, field in fields.items():
            wall, cpu = time.perf_counter(), time.process_time()
            found = answer(asked, field, camera)
            took = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
            firsts.setdefault(name, took)
            exact = found if exact is None else exact
            gaps = [(a - b).abs().flatten() for a, b in zip(found, exact, strict=True)]
            off[name].append(torch.stack(gaps))
    return firsts, {name: _errors(torch.cat(parts, dim=1)) for name, parts in off.items()}


def _errors(off: Float[Tensor, "both p"]) -> tuple[float, float, float]:
    rank = max(round(0.999 * off.shape[1]), 1)
    return float(off[1].max()), float(off[0].max()), float(off[0].kthvalue(rank).values)


def _timed(
    calls: Mapping[str, Callable[[Camera], object]], cameras: Sequence[Camera], repeats: int
) -> dict[str, Spread]:
    turns = {name: itertools.cycle(cameras) for name in calls}

    def one(name: str) -> tuple[float, float]:
        camera = next(turns[name])
        wall, cpu = time.perf_counter(), time.process_time()
        calls[name](camera)
        return 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)

    samples = take_turns({name: lambda name=name: one(name) for name in calls}, repeats)
    return {name: spread(*zip(*taken, strict=True)) for name, taken in samples.items()}


def draw(stem: Path, rows: Sequence[Row]) -> None:
    """Time of an answer by that of the renders against the error of its relevancy, one panel for each scene."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row.scene for row in rows))
    with rc_context(STYLE):
        figure = Figure(figsize=(4.2 * len(scenes), 3.2), layout="constrained")
        panels = figure.subplots(1, len(scenes), squeeze=False)[0]
        for scene, panel in zip(scenes, panels, strict=True):
            counts = dict.fromkeys(row.threads for row in rows if row.scene == scene)
            for color, threads in zip(COLORS, counts, strict=False):
                points = [row for row in rows if (row.scene, row.threads) == (scene, threads)]
                shown = [row for row in points if row.relevancy_error_999 > 0]  # no logarithm of 0
                best = sorted((row.ratio, row.relevancy_error_999) for row in shown if row.front)
                panel.plot(*zip(*best, strict=True), color=color, lw=0.6)
                panel.scatter(
                    [row.ratio for row in shown], [row.relevancy_error_999 for row in shown],
                    s=14, color=color, label=f"{threads} threads" if threads > 1 else "1 thread",
                )  # fmt: skip
                for row in shown:
                    at = (row.ratio, row.relevancy_error_999)
                    panel.annotate(row.way, at, (3, 3), textcoords="offset points", fontsize=5)
            panel.set(xscale="log", yscale="log", title=scene)
            panel.set_xlabel("an answer by its two renders (median wall clock)")
            panel.set_ylabel("error of relevancy, 99.9 % of pixels")
            panel.margins(0.25)
            plain_ticks(panel.xaxis)
            panel.legend()
        write_figure(stem, figure)


def _print(scene: str, rows: Sequence[Row]) -> None:
    columns = ("way", "threads", "ms", "by the renders", "CPU", "answers/s", "first, ms", "nodes", "error 99.9 %", "max", "front")  # fmt: skip
    lines = [
        (
            row.way, str(row.threads), f"{row.answer.ms:.1f}", f"{row.ratio:.2f}", f"{row.ratio_cpu:.2f}",
            f"{row.answers_per_second:.1f}", f"{row.first_ms:.0f}", str(row.nodes or ""),
            f"{row.relevancy_error_999:.1e}", f"{row.relevancy_error:.1e}", "yes" if row.front else "",
        )
        for row in rows
    ]  # fmt: skip
    show(f"{scene}: a word answered", columns, lines)
