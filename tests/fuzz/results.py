"""Damaged files of results and of the registry: the tables still come, or one error names the file."""

import json
import random
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import yaml

from tests.fuzz.judge import Attack
from tests.fuzz.places import KINDS, PATIENCE
from vlgs.identity import RESULTS_VERSION
from vlgs.runs import RunFolder
from vlgs.tables.benchmark import Benchmark, Composer
from vlgs.tables.registry import load_table
from vlgs.tables.runs import compare, read_runs
from vlgs.tables.write import write_all

TABLE = """
label: tiny
caption: words
dataset: lerf_ovs
scenes: {ramen: ramen}
metrics: [miou]
rows:
  - {label: Without, group: A, set: [fusion=none], marks: {m: true}, paper: {avg: 40.0}, ours: why}
  - {label: Full, set: [], paper: {ramen: {miou: 50.0}}}
"""
METRICS = {
    "miou": 0.5, "psnr": 30.0, "n_gaussians": 20, "train_seconds": 60.0, "per_category": {"cup": 0.5, "pot": None},
    "category_kinds": {"cup": "other"}, "indicator": {"edges": [-1.0, 0.0, 1.0], "other": [0.25, 0.75]}, "scene": "glassware",
    "dataset": "synthetic", "protocol": "dense@1/synthetic", "results_version": RESULTS_VERSION, "commit": "abcdef",
    "machine": {"cpu": "a cpu", "cores": 2}, "reasons": {"lpips": "no weights"}, "levels": [3], "level_models": "single",
    "skips": {"a": {"skipped": 9, "share": 0.5, "seconds_saved": None}}, "failure": None,
}  # fmt: skip
Content = bytes | Callable[[Path], None]
"""What is put in a file's place."""
ODD = (
    None,
    True,
    -1,
    2**70,
    10**400,
    float("nan"),
    float("inf"),
    "",
    "0.5",
    "\ud800",
    [],
    [1],
    {},
    {"a": 1},
    [[]],
)
"""Values where others belong."""


def attacks(folder: Path, seed: int, count: int) -> Iterator[Attack]:
    """Fixed damage, values of another kind, and `count` random edits, of each file."""
    _make(folder / "sound")
    rng = random.Random(seed)
    number = 0
    for name, act in READERS.items():
        sound = next((folder / "sound").glob(name)).read_bytes()
        edits = [
            *FIXED,
            *_odd_values(name, sound),
            *(_random_edit(sound, rng) for _ in range(count)),
        ]
        for what, content in edits:
            number += 1
            call = partial(_damage, folder / "sound", folder / str(number), name, content, act)
            yield Attack(f"{name}: {what}", call, endless=PATIENCE)


def _damage(
    sound: Path, folder: Path, name: str, content: Content, act: Callable[[Path], None]
) -> None:
    shutil.copytree(sound, folder)
    path = next(folder.glob(name))
    path.unlink()
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        content(path)
    try:
        act(folder)
    except (ValueError, OSError) as error:
        named = path.parent if name.startswith("runs/") else path
        if str(named) not in str(error) and "must hold" not in str(error):  # all runs, none is left
            raise AssertionError(f"does not name {path.name}: {error}") from error
        raise ValueError(
            f"tables: {error}"
        ) from error  # the system's own words begin with a number


def _tables(folder: Path) -> None:
    """All tables; those of the other rows and runs must be there."""
    write_all(folder, [load_table(folder / "sweeps" / "tiny.yaml")])
    assert (folder / "synthetic" / "tables.tex").is_file()


def _runs(folder: Path) -> None:
    """Tables, the comparison of the runs, and the run that is asked for again."""
    _tables(folder)
    assert (folder / "synthetic" / "tiny.md").is_file()
    assert len(compare(read_runs(folder)).rows) in (1, 2)
    RunFolder(min(folder.glob("runs/*"))).finished()


READERS: dict[str, Callable[[Path], None]] = {
    "runs/*0/metrics.json": _runs,
    "runs/*0/queries.json": _runs,
    "runs/*0/config.yaml": _runs,
    "runs.csv": _tables,
    "categories.csv": _tables,
    "synthetic/benchmark.yaml": _tables,
    "synthetic/recipes.json": _tables,
    "sweeps/tiny.yaml": _tables,
}

FIXED: tuple[tuple[str, Content], ...] = (
    ("empty", b""),
    ("{}", b"{}"),
    ("[]", b"[]"),
    ("null", b"null"),
    ("a number", b"3"),
    ("latin-1", b'{"scene": "\xff\xfe"}'),
    ("UTF-16", '{"scene": 1}'.encode("utf-16")),
    ("NUL", b"\0" * 1000),
    ("nested", b"[" * 100_000),
    ("a long line", b"x" * 300_000),
    ("a long cell", b'"' + b"x" * 300_000),
    ("bomb", b"a: &a [x, x, x, x, x, x, x, x, x]\n" + b"".join(
        b"%c: &%c [%s]\n" % (c, c, b", ".join([b"*%c" % (c - 1)] * 9)) for c in range(ord("b"), ord("k")))),
    *KINDS.items(),
)  # fmt: skip


def _odd_values(name: str, sound: bytes) -> Iterator[tuple[str, bytes]]:
    """Every entry, and every entry of an entry, without its value or with an odd one."""
    if name.endswith("csv"):
        for word in ("nan", "inf", "1e999", "'", "=1", '"', "\r", "2.5"):
            yield f"value {word}", sound.replace(b",0.5", b"," + word.encode(), 1)
            yield f"seed {word}", sound.replace(b",0,dense", f",{word},dense".encode(), 1)
        return
    if "recipes" in name:  # composing anew takes seconds
        rows = json.loads(sound)["rows"]
        for odd in (None, [], {key: "x" for key in rows}, {key: {"recipe": 1} for key in rows}):
            yield f"rows {odd!r:.20}", json.dumps(json.loads(sound) | {"rows": odd}).encode()
        return
    plain = yaml.safe_load(sound)
    if not isinstance(plain, dict):
        return
    for key, value in plain.items():
        for odd in ODD:
            text = json.dumps(plain | {key: odd})
            yield f"{key}={odd!r:.20}", text.encode()
            if isinstance(value, dict):
                for inner in value:
                    text = json.dumps(plain | {key: value | {inner: odd}})
                    yield f"{key}.{inner}={odd!r:.20}", text.encode()
        yield f"without {key}", json.dumps({k: v for k, v in plain.items() if k != key}).encode()
    for odd in ODD if "sweeps" in name else ():
        for key in plain["rows"][0]:
            rows = [plain["rows"][0] | {key: odd}, plain["rows"][1]]
            yield f"rows[0].{key}={odd!r:.20}", json.dumps(plain | {"rows": rows}).encode()


def _random_edit(sound: bytes, rng: random.Random) -> tuple[str, bytes]:
    """Cut, doubled, or some bytes changed."""
    place = rng.randrange(len(sound))
    kind = rng.choice(("cut", "doubled", "bytes"))
    if kind == "cut":
        return f"cut at {place}", sound[:place]
    if kind == "doubled":
        return f"doubled from {place}", sound + sound[place:]
    changed = bytearray(sound)
    for _ in range(rng.randint(1, 4)):
        changed[rng.randrange(len(sound))] = rng.randrange(256)
    return f"bytes around {place}", bytes(changed)


def _make(folder: Path) -> None:
    """Two runs with folders, one that only runs.csv knows, a table."""
    (folder / "sweeps").mkdir(parents=True)
    (folder / "sweeps" / "tiny.yaml").write_text(TABLE)
    benchmark = Benchmark("synthetic", ("data=synthetic",), ("glassware",), (0, 1))
    benchmark.extend(folder / "synthetic" / "benchmark.yaml")
    composer = Composer(benchmark, folder / "synthetic" / "recipes.json")
    table = load_table(folder / "sweeps" / "tiny.yaml")
    for row, seed in ((0, 0), (1, 0), (1, 1)):
        known = composer.identity(table.rows[row].overrides or (), seed)
        run = folder / "runs" / f"{row}{seed}0"
        run.mkdir(parents=True)
        metrics = METRICS | {
            "seed": seed,
            "config_hash": run.name,
            "recipe": known.recipe,
            "data_recipe": known.data,
        }
        (run / "metrics.json").write_text(json.dumps(metrics))
        (run / "queries.json").write_text(json.dumps([{"view": "v", "category": "a", "iou": 0.5}]))
        (run / "config.yaml").write_text(
            yaml.safe_dump({"fusion": {"_target_": "x.Y", "w": row}, "seed": seed})
        )
    composer.save()
    write_all(folder, [table])
    shutil.rmtree(folder / "runs" / "110")
