"""metrics.json, one flat file per run, and a table of the meaning of each entry."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlgs.files import write_atomically
from vlgs.report.evaluate import Evaluation

METRICS: Mapping[str, tuple[str, str]] = {
    "psnr": ("dB", "mean over held-out views, colours clamped to [0, 1]"),
    "ssim": ("-1..1", "mean over held-out views, 11x11 Gaussian window, mirrored borders"),
    "ssim_3dgs": ("-1..1", "ssim with borders padded by zeros, as 3DGS computes it"),
    "lpips": ("", "not available, see reasons"),
    "miou": ("0..1", "mIoU under `protocol`"),
    "loc_acc": ("0..1", "localisation accuracy under `protocol`"),
    "per_category": ("0..1", "category -> IoU under `protocol`"),
    "category_kinds": ("", "category -> translucent_reflective or other, where the scene says it"),
    "indicator": (
        "",
        "histogram of l - o, averaged over the Gaussians of a pixel of a held-out view: `edges`, and per kind of category the "
        "share of its pixels in each bin; null where no view has a class for every pixel",
    ),
    "protocol": ("", "what miou and loc_acc mean: name@version[settings]/split"),
    "miou_<kind>": ("0..1", "mean IoU of the categories of a kind, e.g. translucent_reflective"),
    "miou_dense": ("0..1", "argmax over all classes, pixels of all held-out views together"),
    "miou_dense_present": ("0..1", "miou_dense over the classes that the truth shows"),
    "boundary_iou": ("0..1", "mean Boundary IoU of the queries under `protocol`"),
    "hits": ("", "hits of loc_acc, for LERF-OVS as the headline"),
    "units": ("", "queries of loc_acc, for LERF-OVS as the headline"),
    "mask_accuracy": ("0..1", "mean share of a view's pixels that a mask has right (GOI's mPA)"),
    "mask_precision": ("0..1", "mean share of a mask that is true (GOI's mP)"),
    "acc25": ("0..1", "queries with IoU above 0.25, for select3d"),
    "acc50": ("0..1", "queries with IoU above 0.5, for select3d"),
    "pixel_accuracy": ("0..1", "share of pixels whose class is right"),
    "miou_lerf_ovs": ("0..1", "relevancy over threshold, mean over units (view, category)"),
    "loc_acc_lerf_ovs": ("0..1", "hits / units"),
    "miou_lerf_ovs_ceiling": (
        "0..1",
        "miou_lerf_ovs of exact features; smoother answers can pass it",
    ),
    "loc_acc_lerf_ovs_ceiling": (
        "0..1",
        "loc_acc_lerf_ovs of exact features; smoother answers can pass it",
    ),
    "loc_acc_dense": ("0..1", "classes of a view whose most relevant spot lies on them"),
    "loc_acc_dense_ceiling": ("0..1", "loc_acc_dense of exact features"),
    "hits_lerf_ovs": ("", "units whose most relevant pixel lies on the object"),
    "units_lerf_ovs": ("", "units that LERF-OVS localisation was scored on"),
    "test_views": ("", "held-out views"),
    "test_views_seen": ("", "held-out views that were also trained on; 0 for a fair split"),
    "n_gaussians": ("", "Gaussians at the end, of all models of the run together"),
    "levels": (
        "",
        "mask levels that were learned: data.level, or 1, 2, 3 with levels=separate or joint; empty without language",
    ),
    "level_models": (
        "",
        "single: one model of one level; separate: a model for each; joint: one model with codes of all",
    ),
    "query": (
        "",
        "option of conf/query that words were asked by, and the folder of masks that it learned from where one was given",
    ),
    "train_seconds": (
        "s",
        "wall time of training, of all models together, without reading, evaluation and pictures",
    ),
    "skips": (
        "",
        "skip of vlgs.skips -> skipped (count), share (of that work), seconds_saved (wall time: count x mean cost of the "
        "forward part in this run; null where none was done to measure)",
    ),
    "peak_rss_bytes": (
        "B",
        "most memory the process ever held, reading to reporting; of the run that trained the models if that was another",
    ),
    "fps_color": (
        "1/s",
        "colour render, median; with several levels of the model of whole objects",
    ),
    "fps_language": ("1/s", "language render, median"),
    "fps_query": ("1/s", "both renders, decoding and the relevancy of one prompt, median"),
    "ply_bytes": ("B", "point_cloud.ply"),
    "checkpoint_bytes": ("B", "newest checkpoint with optimiser state"),
    "seed": ("", "seed of every random draw of the run"),
    "config_hash": ("", "hash of all that can move a number; runs of one hash are one run"),
    "recipe": ("", "hash of the configuration without data and seed: what a row of a table runs"),
    "data_recipe": (
        "",
        "hash of how the data was read, wherever it lies and whichever scene it is",
    ),
    "dataset": ("", "option of conf/data"),
    "scene": ("", "name of the scene"),
    "fingerprint": ("", "hash of the data's content"),
    "training": ("", "hash of all that can move a model: runs of one hash have the same models"),
    "results_version": ("", "raised by changes of vlgs that can move a number"),
    "commit": ("", "git commit, +dirty with local changes, null for an installed wheel"),
    "machine": ("", "cpu, isa (instruction set of the kernels), cores, threads, torch, platform"),
    "per_view": ("", "held-out view -> psnr, ssim"),
    "failure": ("", "why nothing could be scored although it was asked for; null for a good run"),
    "reasons": (
        "",
        "metric that is null -> why; under `words` what the pictures ask of a scene without labels, under `pictures` of which "
        "model they are where each mask level has one",
    ),
}
"""Entry of metrics.json -> (unit or range, meaning). An entry that could not be computed is null."""


def write_metrics(path: Path, evaluation: Evaluation, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Write metrics.json in one step, so that a reader sees the old file or the whole new one.

    Args:
        path: Where to; its folder must exist.
        evaluation: Scores.
        extra: Further entries named in `METRICS`, such as ``train_seconds``, ``seed`` and ``machine``.

    Returns:
        What was written. Numbers that are not finite are None, which JSON spells null.

    Raises:
        ValueError: If an extra entry is not in `METRICS`, or would overwrite a score.
    """
    scores = {
        "psnr": evaluation.psnr,
        "ssim": evaluation.ssim,
        "miou": evaluation.miou,
        "loc_acc": evaluation.loc_acc,
        "protocol": evaluation.protocol,
        "failure": evaluation.failure,
        **evaluation.beside,
    }
    details = {
        "per_category": dict(evaluation.per_category),
        "category_kinds": dict(evaluation.category_kinds),
        "indicator": evaluation.indicator,
        "per_view": {name: dict(values) for name, values in evaluation.per_view.items()},
        "reasons": dict(evaluation.reasons),
    }
    unknown = sorted(set(extra) - set(METRICS))
    twice = sorted(set(extra) & (set(scores) | set(details)))
    if unknown or twice:
        raise ValueError(
            f"metrics: extra entries must be listed in METRICS and new, got unknown {unknown} and repeated {twice}"
        )
    metrics = _finite({**scores, **extra, **details})
    write_atomically(path, (json.dumps(metrics, indent=2, allow_nan=False) + "\n").encode())
    return metrics


def write_queries(path: Path, evaluation: Evaluation) -> None:
    """Write the rows of `Evaluation.queries` as a JSON list, which pandas reads with ``read_json``."""
    rows = [_finite(row) for row in evaluation.queries]
    write_atomically(path, (json.dumps(rows, indent=0, allow_nan=False) + "\n").encode())


def metrics_table() -> str:
    """The entries of metrics.json as a Markdown table."""
    rows = [f"| `{name}` | {unit} | {meaning} |" for name, (unit, meaning) in METRICS.items()]
    return "\n".join(["| entry | unit | meaning |", "|---|---|---|", *rows])


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
