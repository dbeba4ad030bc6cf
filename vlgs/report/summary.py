"""What a run prints when it is done: the scores and where everything is."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from vlgs.text import screen, visible

_ROWS = (
    ("psnr", "PSNR", "{:.2f} dB"),
    ("ssim", "SSIM", "{:.4f}"),
    ("miou", "mIoU", "{:.1%}"),
    ("miou_translucent_reflective", "  translucent or reflective", "{:.1%}"),
    ("miou_other", "  other", "{:.1%}"),
    ("loc_acc", "localisation accuracy", "{:.1%}"),
    ("loc_acc_dense_ceiling", "  of exact features", "{:.1%}"),
    ("miou_lerf_ovs", "mIoU, LERF-OVS", "{:.1%}"),
    ("miou_lerf_ovs_ceiling", "  of exact features", "{:.1%}"),
    ("loc_acc_lerf_ovs", "localisation accuracy, LERF-OVS", "{:.1%}"),
    ("loc_acc_lerf_ovs_ceiling", "  of exact features", "{:.1%}"),
    ("n_gaussians", "Gaussians", "{:,}"),
    ("train_seconds", "training", "{:.1f} s"),
    ("peak_rss_bytes", "peak memory", "{:,} MB"),
    ("fps_color", "colour render", "{:.1f} /s"),
    ("fps_language", "language render", "{:.1f} /s"),
    ("fps_query", "query, every pixel decoded", "{:.1f} /s"),
)
_SILENT = ("lpips",)  # never available, which metrics.json says
_ALWAYS = ("psnr", "ssim", "miou", "loc_acc")
_BY_PROTOCOL = ("miou", "loc_acc")
_LAST_MIOU = "miou_other"
"""The row under which the classes that mIoU is the mean of stand."""


def summary(metrics: Mapping[str, Any], paths: Mapping[str, Path]) -> RenderableType:
    """The result of a run for the terminal.

    Args:
        metrics: As `vlgs.report.results.write_metrics` returns them.
        paths: What it is -> where it is, in the order to print.
    """
    seen, views = metrics.get("test_views_seen") or 0, metrics.get("test_views")
    table = Table("metric", box=box.SIMPLE_HEAD)
    table.add_column("evaluated views" if seen else "held-out views", justify="right")
    for name, label, form in _ROWS:
        value = metrics.get(name)
        if value is not None:
            value = round(value / 1e6) if name.endswith("_bytes") else value
            table.add_row(label, form.format(value))
        elif name in _ALWAYS:
            table.add_row(label, "--")
        if name == _LAST_MIOU:
            _add_classes(table, metrics.get("per_category") or {})
    for name, entry in (metrics.get("skips") or {}).items():
        table.add_row(Text(visible(f"skipped: {name}")), _skipped(entry), style="dim")
    notes = [
        _text(f"{', '.join(names)}: {why}", style="yellow")
        for why, names in _reasons(metrics.get("reasons") or {}).items()
    ]
    if metrics.get("failure"):
        notes.append(_text(f"failed: {metrics['failure']}", style="bold red"))
    if seen:
        told = f"{seen} of {views} evaluated views were trained on: these are not held-out scores"
        notes.append(Text(told, style="yellow"))
    width = max((len(label) for label in paths), default=0)
    places = [_text(f"{label:<{width}}  {path}") for label, path in paths.items()]
    told = []
    if any(metrics.get(name) is not None for name in _BY_PROTOCOL):
        told.append(f"protocol: {metrics.get('protocol')}")
    if metrics.get("query"):
        told.append(f"query: {metrics['query']}")
    if metrics.get("levels"):
        several = f" ({metrics.get('level_models')})" if len(metrics["levels"]) > 1 else ""
        told.append(f"mask levels: {', '.join(map(str, metrics['levels']))}{several}")
    return Group(table, *notes, *map(_text, told), *places)


def _add_classes(table: Table, per_category: Mapping[str, float | None]) -> None:
    """A row for each class, under one that says what they are."""
    if per_category:
        table.add_row("IoU of each class", "")
    for category, iou in per_category.items():
        table.add_row(
            Text(visible(f"  {category}")), "--" if iou is None else f"{iou:.1%}", style="dim"
        )


def _reasons(reasons: Mapping[str, str]) -> dict[str, list[str]]:
    """Why something is not there -> the metrics that are not."""
    found: dict[str, list[str]] = {}
    for name, why in reasons.items():
        if name not in _SILENT:
            found.setdefault(why, []).append(name)
    return found


def _text(text: str, style: str = "") -> Text:
    """Text of a run, printed literally: without rich's markup and a terminal's control characters."""
    return Text(screen(text), style=style)


def _skipped(entry: Mapping[str, Any]) -> str:
    """E.g. ``5,994 (98.8%), saved ~12.1 s``."""
    text = f"{entry['skipped']:,} ({entry['share']:.1%})"
    saved = entry["seconds_saved"]
    return text if saved is None else f"{text}, saved ~{saved:.1f} s"


def print_summary(
    metrics: Mapping[str, Any],
    paths: Mapping[str, Path],
    console: Console | None = None,
    first: str = "",
) -> None:
    """Print `summary`, under a first line if there is one; paths are never wrapped, so that they can be copied."""
    console = console or Console()
    if first:
        console.print(_text(first), soft_wrap=True)
    console.print(summary(metrics, paths), soft_wrap=True)
