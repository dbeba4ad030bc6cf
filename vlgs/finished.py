"""Reads metrics.json of a finished run and checks the type of every entry. Imports no torch."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

REMEDY = "delete the file, and the run is reported again from its checkpoint"

_ALWAYS = {"config_hash": str, "scene": str, "seed": int}
_WITH_A_RECIPE = {"recipe": str, "data_recipe": str, "results_version": int}
"""Of runs that say which row of a table they are, which the first runs did not."""

_TEXTS = ("protocol", "dataset", "commit", "fingerprint", "level_models", "failure")
_MAPPINGS = (
    "per_category",
    "category_kinds",
    "indicator",
    "per_view",
    "reasons",
    "machine",
    "skips",
)
_NUMBERS = (
    "psnr", "ssim", "miou", "miou_translucent_reflective", "miou_other", "loc_acc", "loc_acc_dense_ceiling", "miou_lerf_ovs",
    "miou_lerf_ovs_ceiling", "loc_acc_lerf_ovs", "loc_acc_lerf_ovs_ceiling", "n_gaussians", "train_seconds", "peak_rss_bytes",
    "fps_color", "fps_language", "fps_query", "ply_bytes", "test_views", "test_views_seen",
)  # fmt: skip
"""What a summary or a table prints; null where it could not be computed."""


def read_finished(path: Path) -> dict[str, Any]:
    """The content of a metrics.json.

    Raises:
        ValueError: Names the file, the entry, what it must be and what to do.
        OSError: If the file cannot be read.
    """
    if path.exists() and not path.is_file():  # a pipe would be waited for without end
        raise ValueError(f"{path}: must be a file, got a folder or a device; {REMEDY}")
    try:
        content = json.loads(path.read_bytes().decode())
    except RecursionError:
        raise ValueError(f"{path}: must be JSON of a run, got endless nesting; {REMEDY}") from None
    except ValueError as error:
        raise ValueError(f"{path}: must be JSON in UTF-8, got: {error}; {REMEDY}") from error
    for what, expected, got in _faults(content):
        # Cut: nobody knows how much lies there.
        raise ValueError(f"{path}: {what} must be {expected}, got {got!r:.80}; {REMEDY}")
    return content


def is_number(value: Any) -> bool:
    """Whether JSON holds a number that a float can be."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) < 1e300 if isinstance(value, int) else math.isfinite(value)


def _faults(content: Any) -> Iterator[tuple[str, str, Any]]:
    """Entries with a wrong type or range: name, what it must be, what it is."""
    if not isinstance(content, dict):
        yield "content", "an object of metrics", type(content).__name__
        return
    needed = _ALWAYS | (_WITH_A_RECIPE if "recipe" in content else {})
    for name, kind in needed.items():
        value = content.get(name)
        if not isinstance(value, kind) or isinstance(value, bool):
            yield name, "a text" if kind is str else "a whole number", value
        elif isinstance(value, int) and not 0 <= value < 2**64:
            yield name, "from 0 to 2^64 - 1", value
    for name in _TEXTS:
        if not isinstance(content.get(name), (str, type(None))):
            yield name, "a text or null", content[name]
    for name in _MAPPINGS:
        if not isinstance(content.get(name), (dict, type(None))):
            yield name, "an object or null", content[name]
    if not isinstance(content.get("levels"), (list, type(None))):
        yield "levels", "a list or null", content["levels"]
    for name, value in content.items():
        if (name in _NUMBERS or isinstance(value, float)) and not _is_known(value):
            yield name, "a finite number or null", value
    yield from _faults_within(content)


def _faults_within(content: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
    """The same for the values inside of entries that are objects."""
    for category, value in (content.get("per_category") or {}).items():
        if not _is_known(value):
            yield f"per_category.{category}", "a finite number or null", value
    for name in ("category_kinds", "reasons"):
        for key, value in (content.get(name) or {}).items():
            if not isinstance(value, str):
                yield f"{name}.{key}", "a text", value
    machine = content.get("machine") or {}
    for name in ("cpu", "isa"):
        if not isinstance(machine.get(name), (str, type(None))):
            yield f"machine.{name}", "a text", machine[name]
    threads = machine.get("threads")
    if threads is not None and (isinstance(threads, bool) or not isinstance(threads, int)):
        yield "machine.threads", "a whole number", threads
    for name, entry in (content.get("skips") or {}).items():
        known = isinstance(entry, dict) and {"skipped", "share", "seconds_saved"} <= set(entry)
        if not known or not all(
            is_number(entry[key]) or (key == "seconds_saved" and entry[key] is None)
            for key in ("skipped", "share", "seconds_saved")
        ):
            yield f"skips.{name}", "numbers of skipped, share and seconds_saved", entry
    histogram = content.get("indicator") or {}
    bins = len(histogram["edges"]) - 1 if isinstance(histogram.get("edges"), list) else None
    for name, values in histogram.items():
        of_numbers = isinstance(values, list) and all(map(is_number, values))
        if bins is None or not of_numbers or len(values) != bins + (name == "edges"):
            yield f"indicator.{name}", "a list of numbers, one for each bin of edges", values


def _is_known(value: Any) -> bool:
    return value is None or is_number(value)
