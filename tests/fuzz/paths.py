"""Files and folders whose names nobody expects, given the natural way to every entry point, relative to where they lie."""

import json
import os
import random
import runpy
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
from PIL import Image

import vlgs.convert
import vlgs.data.colmap
import vlgs.features.job
import vlgs.formats.start
import vlgs.vocabulary  # noqa: F401 (imported once here, not in every child)
from tests.fuzz.judge import Attack
from vlgs.sfm.reconstruct import SfmOptions
from vlgs.sfm.result import REPORT, Reconstruction

NAMES = (
    "Ünï (1), [b]=c", "a,b", "a b  c", "-lead", "it's", 'a"b', "a\\", "a\\b", "$HOME", "#1", "~a", "a~b", "123", "1e5",
    "true", "nUll", "[a, b]", "{a: b}", "f(x)", "choice(a,b)", "日本語", "😀", "a\tb", "a\nb", "[red]x[/red]", ":car:", "100%s {}",
    "'quoted' 'twice", "a=b", "a;b|c&d", "*?", "<x>`y`", "x@y!", "e\u0301", "\u202egnp", "n" * 250, "...",
)  # fmt: skip
"""Of folders; all can be made."""

REFUSED = ("a${", "not utf-8 \udcff")
"""That a configuration cannot carry."""


def attacks(folder: Path, seed: int, count: int) -> Iterator[Attack]:
    """Each name with one entry point after the other; beyond all pairs of these, random names.

    What is there must be read; what is not there must be missed by its name.
    """
    rng = random.Random(seed)
    letters = "ab1 '\"\\[]{}(),=:;$~#%&*-ü😀\n"
    names = [*NAMES, *REFUSED]
    while len(names) * len(_PROGRAMS) < count:
        name = "".join(rng.choices(letters, k=rng.randint(1, 9))).strip()
        is_quoted = len(name) > 1 and name[0] == name[-1] and name[0] in "'\""
        if name not in ("", ".", "..", *names) and "${" not in name and not is_quoted:
            names.append(name)
    for number in range(count):
        turn, at = divmod(number, len(names))
        name, home = names[at], folder / str(at)
        if not home.exists():
            home.mkdir()
            _make(home / name)
        program = list(_PROGRAMS)[(at + turn) % len(_PROGRAMS)]
        call, must_refuse = _PROGRAMS[program](name)
        said = "nowhere" * must_refuse
        if name in REFUSED and program in _HYDRA:
            call, must_refuse, said = _PROGRAMS[program](name)[0], True, "command: names of files"
        else:
            call = call if must_refuse else _works(call)
        yield Attack(f"{program} {name!r}", _in(home, call), said, must_refuse)


def _in(home: Path, call: Callable[[], object]) -> Callable[[], object]:
    def attack() -> object:
        os.chdir(home)
        return call()

    return attack


def _module(name: str, *arguments: str) -> Callable[[], object]:
    """`python -m NAME ARGUMENTS`, which exits as that does."""

    def call() -> None:
        sys.argv = [name, *arguments]
        sys.modules.pop(name, None)
        runpy.run_module(name, run_name="__main__")

    return call


def _works(call: Callable[[], object]) -> Callable[[], object]:
    """A refusal is a failure."""

    def checked() -> None:
        try:
            call()
        except SystemExit as stop:
            if stop.code:
                raise AssertionError(f"must work, got {stop.code}") from None

    return checked


def _bare(name: str) -> str:
    """What a person gives to programs that take a leading dash for an option."""
    return f"./{name}" if name.startswith("-") else name


def _check(name: str) -> tuple[Callable[[], object], bool]:
    scene = ["data=colmap", f"data.root={name}", f"data.labels={name}/more", f"results={name}"]
    return _module("vlgs.check", *scene, f"data.vocabulary={name}/words.json"), False


def _run(name: str) -> tuple[Callable[[], object], bool]:
    return _module("vlgs.run", "data=colmap", f"data.root={name}/nowhere"), True


def _run_init(name: str) -> tuple[Callable[[], object], bool]:
    init = f"gaussians.init={name}/nowhere.ply"
    return _module("vlgs.run", "data=colmap", f"data.root={name}", init), True


def _features(name: str) -> tuple[Callable[[], object], bool]:
    places = [f"features.out={name}/maps", f"features.weights={name}/nowhere"]
    return _module("vlgs.features", "data=colmap", f"data.root={name}", *places), True


def _sfm(name: str) -> tuple[Callable[[], object], bool]:
    return _module("vlgs.sfm", f"{_bare(name)}/images", f"{_bare(name)}/done"), False


def _vocabulary(name: str) -> tuple[Callable[[], object], bool]:
    return _module("vlgs.vocabulary", f"{_bare(name)}/nowhere.txt", f"{_bare(name)}/out.npz"), True


def _convert(name: str) -> tuple[Callable[[], object], bool]:
    return _module("vlgs.convert", _bare(name), f"{_bare(name)}/cameras.json"), False


_PROGRAMS = {
    "check": _check,
    "run": _run,
    "run, gaussians.init": _run_init,
    "features": _features,
    "sfm": _sfm,
    "vocabulary": _vocabulary,
    "convert": _convert,
}
_HYDRA = ("check", "run", "run, gaussians.init", "features")


def _make(root: Path) -> None:
    """A scene of three photographs with COLMAP's text files, labels elsewhere and a vocabulary."""
    names = [f"{i}.png" for i in range(3)]
    for folder in ("images", "sparse/0", "more", "done"):
        (root / folder).mkdir(parents=True)
    rng = np.random.default_rng(0)
    for name in names:
        Image.fromarray(rng.integers(0, 256, (18, 24, 3), np.uint8)).save(root / "images" / name)
        Image.fromarray(np.zeros((18, 24), np.uint8)).save(root / "more" / name)
    sparse = root / "sparse" / "0"
    (sparse / "cameras.txt").write_text("1 PINHOLE 24 18 20 20 12 9\n")
    lines = [f"{i + 1} 1 0 0 0 {0.1 * i} 0 3 1 {name}\n\n" for i, name in enumerate(names)]
    (sparse / "images.txt").write_text("".join(lines))
    points = [
        f"{i + 1} {x} {y} {z} 9 9 9 0.1\n" for i, (x, y, z) in enumerate(rng.normal(size=(50, 3)))
    ]
    (sparse / "points3D.txt").write_text("".join(points))
    made = {"options": asdict(SfmOptions(matching="exhaustive")), "names": names}
    del made["options"]["threads"]
    result = Reconstruction(3, 3, 50, 0.1, (), (), 1, 1)
    (root / "done" / REPORT).write_text(json.dumps({**asdict(result), "made": made}))
    classes = {"classes": {"0": {"name": "wall"}}}
    (root / "more" / "classes.json").write_text(json.dumps(classes))
    words = {
        word: rng.normal(size=8).tolist()
        for word in ("wall", "object", "things", "stuff", "texture")
    }
    (root / "words.json").write_text(json.dumps(words))
