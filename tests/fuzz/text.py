"""Hostile names through every writer: what is read back is the name, and no reader computes, runs or obeys any of it."""

import csv
import io
import random
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from html.parser import HTMLParser
from pathlib import Path

import pandas as pd
from rich.console import Console

from tests.fuzz.judge import Attack
from vlgs.names import file_names
from vlgs.report.summary import print_summary
from vlgs.tables.benchmark import Benchmark
from vlgs.tables.fill import Cell, Filled, Place
from vlgs.tables.frame import Line, read_lines, tidy, write_lines
from vlgs.tables.html import write_report
from vlgs.tables.registry import Row, Table
from vlgs.tables.runs import Run, compare
from vlgs.tables.write import write_tables

NAMES = (
    "a\nb", "a\r\nb", "a\rb", "<script>alert(1)</script>", "</td><img src=x onerror=alert(1)>", "\\write18{id}", "\\input{/etc/passwd}",
    "}\\end{tabular}\\immediate\\write18{id}", "=cmd|'/c calc'!A0", "=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", "'=1", "''=1", "\uff1d1", "-0.5",
    "\x00", "a\x07b", "\x1b[31mred", "\x1b]0;title\x07", "\x9b31m", "\u202etxt.exe", "\u2066x\u2069", "a|b", "`id`", "```", "$x$", "$\\frac$",
    "100%", "a&b", "&lt;", "&#60;", "a_b", "_a_", "__init__", "*a*", "**", "~~x~~", "^^M", "#hash", "# head", "{x}", "[red]", "[/]", "[x](javascript:1)",
    "![x](http://x)", "[x]: http://x", "- item", "1. item", "> quote", 'a"b', "a,b", ' a ', "", "x" * 300, "a/b", "a b", "..", "CON", "A", "a", "é",
    "e\u0301", "ﬁ", "fi", "nul.txt", "cam0/001", "cam1/001", "日本", "\ud800", "\u2028", "\ufeff", "{{ 7*7 }}", "{% raw %}", "%s", "\\", "--", "+-",
)  # fmt: skip
"""Each alone in every place; more are made of pieces of them."""

BENCHMARK = Benchmark("strangers", ("data=synthetic",), ("glassware",), (0,))


def attacks(folder: Path, seed: int, count: int) -> Iterator[Attack]:
    """Every name in every place, then `count` mixtures."""
    rng = random.Random(seed)
    mixed = ("".join(rng.choices(NAMES, k=rng.randint(2, 4)))[:400] for _ in range(count))
    for number, name in enumerate((*NAMES, *mixed)):
        for place, check in PLACES.items():
            call = partial(_checked, check, name, folder / f"{number}-{place}")
            yield Attack(f"{place}: {name!a:.60}", call)
    yield Attack("all names in one folder", partial(_files, NAMES, folder / "all"))


def _checked(check: Callable[[str, Path], None], name: str, folder: Path) -> None:
    folder.mkdir()
    check(name, folder)


def _runs_csv(name: str, folder: Path) -> None:
    run = (name, name, name, name, name, 0, name, 2, name, name, name, 1, name)
    lines = [Line(*run, name, "", "", -1.5), Line(*run, "per_category", name, name, -0.5)]
    write_lines(lines, folder)
    for file, value in (("runs.csv", "-1.5"), ("categories.csv", "-0.5")):
        text = (folder / file).read_bytes().decode()
        _no_formula(text)
        assert list(csv.reader(io.StringIO(text, newline="")))[-1][-1] == value
    spelled = name.encode("utf-8", "backslashreplace").decode()
    first, second = read_lines(folder)
    assert first.scene == first.metric == second.category == spelled, (first, second)
    assert (first.value, second.value) == (-1.5, -0.5)


def _tables(name: str, folder: Path) -> None:
    write_tables(folder, [_filled(name)])
    text = (folder / "tiny.csv").read_bytes().decode()
    comments = [line for line in text.split("\n") if line.startswith("# ")]
    assert len(comments) == 2
    _no_formula(text.split("\n", 2)[2])
    pandas = pd.read_csv(folder / "tiny.csv", comment="#", keep_default_na=False)
    assert len(pandas) == 1
    assert pandas["mean"][0] == -1.5
    _latex((folder / "tiny.tex").read_text())
    _latex((folder / "tables.tex").read_text())
    _markdown((folder / "tiny.md").read_text())


def _html(name: str, folder: Path) -> None:
    filled = _filled(name)
    write_report(folder, [filled], filled.runs, folder)
    page = Page()
    page.feed((folder / "index.html").read_text())
    assert set(page.tags) <= PAGE_TAGS, set(page.tags) - PAGE_TAGS
    assert page.tags["script"] == page.tags["style"] == 1  # ours
    assert not _obeyed(page.text.replace("\n", ""))


def _comparison(name: str, folder: Path) -> None:
    runs = [
        Run(Path("x"), {name: name, "b": "1"}, {"psnr": -1.5}, name),
        Run(Path(name.replace("\0", "")), {"b": "2"}),
    ]
    table = compare(runs)
    assert not _obeyed(table.text().replace("\n", ""))
    assert table.text().count("\n") == 2
    for file in ("t.csv", "t.md"):
        table.write(folder / file)
    _no_formula((folder / "t.csv").read_bytes().decode())
    _markdown((folder / "t.md").read_text())


def _terminal(name: str, folder: Path) -> None:
    del folder
    console = Console(file=io.StringIO(), width=1000)
    reasons = {"miou": name.replace("\n", "")}
    metrics = {"per_category": {name: 0.5}, "protocol": "p", "reasons": reasons, "skips": {}}
    print_summary(metrics, {}, console)
    assert isinstance(console.file, io.StringIO)
    said = console.file.getvalue()
    assert not _obeyed(said.replace("\n", ""))
    assert "50.0%" in said


def _on_disk(name: str, folder: Path) -> None:
    twins = [
        name,
        name.upper(),
        f"{name} ",
        f"{name}/",
        unicodedata.normalize("NFD", name),
        f"{name}_",
    ]
    _files(twins, folder / "twins")


def _files(names: list[str] | tuple[str, ...], folder: Path) -> None:
    """Every name has a file of its own, on every file system."""
    folder.mkdir()
    found = file_names(names)
    for name, file in found.items():
        (folder / f"segmentation_{file}.png").write_text(name, errors="surrogatepass")
        assert (folder / file).parent == folder
        assert not re.fullmatch(r"(con|nul)(\..*)?", file, re.IGNORECASE)
    folded = {unicodedata.normalize("NFKC", file).casefold() for file in found.values()}
    assert len(folded) == len(set(names)) == len(list(folder.iterdir()))


PLACES: dict[str, Callable[[str, Path], None]] = {
    "runs.csv": _runs_csv,
    "tables": _tables,
    "html": _html,
    "comparison": _comparison,
    "terminal": _terminal,
    "disk": _on_disk,
}


def _filled(name: str) -> Filled:
    table = Table(
        "tiny",
        name,
        "synthetic",
        {},
        ("miou",),
        (Row(name, (), group=name, ours=name, marks={name: True}),),
    )
    cell = Cell(-1.5, 0.5, 2, float("nan"), float("nan"))
    of = ("h", "r", "d", name, name, 0, name, 2, name, name, name, 1, name)
    run = Line(*of, "miou", "", "", 0.5)
    cells = {Place(0, name, "miou"): cell}
    said = (f"data: {name}", f"machine: {name}")
    return Filled(table, BENCHMARK, (name,), {}, {0: "r"}, False, cells, (), tidy([run]), 2, said)


def _obeyed(text: str) -> set[str]:
    """Characters that a terminal or an editor acts on."""
    kinds = {"Cc", "Cf", "Cs", "Zl", "Zp"}
    return {c for c in text if unicodedata.category(c) in kinds and c not in "\u00ad\u200c\u200d"}


def _no_formula(text: str) -> None:
    """What a spreadsheet would compute: a cell that begins so and is no number."""
    for row in csv.reader(io.StringIO(text, newline="")):
        for cell in row:
            number = re.fullmatch(r"-?\d+(\.\d+)?(e-?\d+)?", cell)
            assert number or cell[:1] not in ("=", "+", "-", "@", "\t", "\r", "\uff1d"), cell


COMMANDS = {
    "begin", "centering", "caption", "label", "resizebox", "ifdim", "width", "linewidth", "else", "fi", "toprule", "midrule", "bottomrule",
    "end", "multirow", "textbf", "underline", "scriptsize", "pm", "checkmark", "times", "textbackslash", "textasciitilde", "textasciicircum",
    "documentclass", "usepackage", "title", "input", "clearpage", "par", "smallskip", "parbox", "footnotesize", "raggedright", "textless",
    "textgreater", "textbar", "textheight", "totalheight",
}  # fmt: skip


def _latex(text: str) -> None:
    """Only our commands, braces and columns that balance, comments of one line, nothing else that TeX obeys."""
    assert not _obeyed(text.replace("\n", ""))
    body = "\n".join(line for line in text.split("\n") if not line.startswith("% "))
    assert set(re.findall(r"\\([A-Za-z]+)", body)) <= COMMANDS, body
    plain = re.sub(r"\\[&%$#_{}\\]", "", body)
    assert plain.count("{") == plain.count("}")
    assert plain.count("$") % 2 == 0
    assert not set("#^~`") & set(re.sub(r"`", "", plain)), plain
    assert all(
        line.endswith(r"\fi}{%") or line.endswith("{!}{%")
        for line in plain.split("\n")
        if "%" in line
    ), plain
    rows = [line for line in re.sub(r"\\[&]", "", body).split("\n") if line.endswith(r"\\")]
    assert len({row.count("&") for row in rows}) <= 1, rows


def _markdown(text: str) -> None:
    """Rows of a table have their columns, and there is neither HTML nor code nor a link of a stranger's."""
    assert not _obeyed(text.replace("\n", ""))
    plain = re.sub(r"\\[^\w\s]", "", text)
    rows = [line.count("|") for line in plain.split("\n") if line.startswith("|")]
    assert len(set(rows)) == 1, rows
    assert not re.findall(r"`|\]\(|\]\[|\]:|<(?!/?u>)|&#", plain), plain


PAGE_TAGS = {
    "html", "head", "meta", "title", "style", "body", "h1", "h2", "p", "nav", "a", "div", "table", "thead", "tbody", "tr", "th", "td", "b", "u",
    "span", "img", "script",
}  # fmt: skip


class Page(HTMLParser):
    """Tags with their attributes' names, and the text."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: Counter[str] = Counter()
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep the tag; no attribute may be a handler of events."""
        self.tags[tag] += 1
        assert not any(name.startswith("on") for name, _ in attrs)
        assert all(not (value or "").startswith("javascript") for _, value in attrs)

    def handle_data(self, data: str) -> None:
        """Keep the text."""
        self.text += data
