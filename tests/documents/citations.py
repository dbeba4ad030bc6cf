"""What comments, docstrings and documents refer to: files, modules, numbered lists and the paper; and which of it is not there."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

_CODE = ("vlgs", "tests", "csrc", "conf", "sweeps", ".ci", ".github")
_SUFFIXES = (".py", ".cpp", ".h", ".yaml", ".yml", ".toml", ".md", ".cff")

_WRITTEN = ("results/runs", "results/logs", "results/cache", "results/multirun")
"""Folders that runs write; they are not part of the repository."""
_FOREIGN = ("preprocess.py", "autoencoder", "eval/evaluate_iou_loc.py", "scene/cameras.py")
"""Files of LangSplat's repository."""
_EXAMPLES = (
    "my_lab/gated.py",
    "my_conf/fusion/gated.yaml",
    "breakfast.yaml",
    "my_table.yaml",
    "F.md",
)
"""Files of a reader."""

_FILE = re.compile(r"(?<![\w/.<>*{}$~@%-])(?:[\w.-]+/)*\w[\w.-]*\.(?:md|py|yaml|cpp|h)\b(?![\w(])")
_FOLDER = re.compile(
    r"(?<![\w/.<>*{}$~-])(?:vlgs|tests|csrc|conf|sweeps|results|\.ci|\.github)(?:/[\w.-]*\w)+"
)
_MODULE = re.compile(r"(?<![\w/.])vlgs(?:\.\w+)+")
_SHORTHAND = {
    r"\bS\. ?[A-F]\.\d": "a section of a document that is not here",
    r"\b(?:systems|pitfalls|performance|dependencies|DESIGN|STYLE)\.md\b": "a document that is not here",
    r"\bpitfalls? (?:N|T|finding )?\d+": "a document that is not here",
    r"\bfinding \d": "a document that is not here",
    r"\bDESIGN,? (?:section|S\.|\d)": "a document that is not here",
    r"\bEqs?\. [a-z]": "an equation by its label; the PDF prints numbers",
    r"\b[Ff]igs?\. [a-z]|\b(?:sec|fig|eq):[a-z]": "a label of the paper; the PDF prints numbers",
    r"\bshared/(?:reference|\w+\.md)": "a document that is not here",
    r"(?<!Table \d \()(?<!Table \d\d \()\btab:[a-z]": "a table by its label alone; write: Table 4 (tab:ab-multi)",
}
_POINT = re.compile(r"\b[A-F]\.\d+\b")
_CITED_POINT = re.compile(r"conf/README\.md, (D\.\d+(?:(?:, | and | to )D\.\d+)*)")
_FAILURE = re.compile(r"\bN\d{1,2}\b")
_IN_PAPER = {r"\bEqs?\. (\d+)": 12, r"\bTables? (\d+)": 28, r"\bFigs?\. (\d+)": 19}
"""The last equation, table and figure of the paper."""
_LABELLED = re.compile(r"\bTable (\d+) \(tab:([\w-]+)\)")


def files() -> Iterator[Path]:
    """Everything whose words are checked. CHANGELOG tells history, and generated tables come from sweeps."""
    yield from (
        p for p in sorted(ROOT.glob("*.*")) if p.suffix in _SUFFIXES and p.stem != "CHANGELOG"
    )
    yield from (*sorted(ROOT.glob("results/**/README.md")), ROOT / "results/bench/tried.md")
    for folder in _CODE:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in _SUFFIXES and path != Path(__file__).resolve() and path.is_file():
                yield path


def prose(name: str, text: str) -> Iterator[tuple[int, str]]:
    """Line numbers and texts of what a person reads in a file: comments, docstrings, documents."""
    suffix = Path(name).suffix
    if suffix == ".py":
        if "#" in text:
            for token in tokenize.generate_tokens(io.StringIO(text).readline):
                if token.type == tokenize.COMMENT:
                    yield token.start[0], token.string
        for node in _statements(ast.parse(text)):
            value = node.value if isinstance(node, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield value.lineno, value.value
    elif suffix == ".md":
        yield 1, text
    else:
        mark = "//" if suffix in (".cpp", ".h") else "#"
        for number, line in enumerate(text.splitlines(), 1):
            if mark in line:
                yield number, line[line.index(mark) :]


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    for field in ("body", "orelse", "finalbody", "handlers", "cases"):
        for inner in getattr(node, field, ()):
            yield inner
            yield from _statements(inner)


def dead(name: str, text: str) -> list[str]:
    """Every reference of a file that leads nowhere, as ``file:line: what``."""
    found = []
    for line, said in prose(name, text):
        for place, problem in _problems(name, said):
            found.append(f"{name}:{line + said[:place].count(chr(10))}: {problem}")
    return found


def _problems(name: str, said: str) -> Iterator[tuple[int, str]]:
    for pattern, problem in _SHORTHAND.items():
        for match in re.finditer(pattern, said):
            yield match.start(), f"{match[0]}: {problem}"
    for match in (*_FILE.finditer(said), *_FOLDER.finditer(said)):
        if not _is_file(name, match[0].rstrip(".")):
            yield match.start(), f"{match[0]}: no such file"
    for match in _MODULE.finditer(said):
        if not _is_module(match[0]):
            yield match.start(), f"{match[0]}: no such module or name"
    cited = {
        m.start(1) + p.start(): p[0]
        for m in _CITED_POINT.finditer(said)
        for p in _POINT.finditer(m[1])
    }
    for match in _POINT.finditer(said) if name != "conf/README.md" else ():
        before = said[: match.start()].rstrip().lower()
        if match.start() in cited:
            if match[0] not in _points():
                yield match.start(), f"{match[0]}: conf/README.md has no such point"
        elif not re.search(r"(appendix|\d{4}\.\d{5},)$", before):
            yield match.start(), f"{match[0]}: of which document?"
    for match in _FAILURE.finditer(said):
        if match[0] not in _failures():
            yield match.start(), f"{match[0]}: tests/README.md has no such failure"
    for pattern, last in _IN_PAPER.items():
        for match in re.finditer(pattern, said):
            if int(match[1]) > last:
                yield match.start(), f"{match[0]}: the paper has {last}"
    for match in _LABELLED.finditer(said):
        if _numbers().get(match[2]) != int(match[1]):
            yield match.start(), f"{match[0]}: sweeps give this table another number"


@cache
def _is_file(name: str, token: str) -> bool:
    if token in _FOREIGN or token in _EXAMPLES or token.startswith(_WRITTEN):
        return True
    near = (ROOT, (ROOT / name).parent, ROOT / "vlgs", ROOT / "tests")
    if any((folder / end).exists() for folder in near for end in (token, f"{token}.py")):
        return True
    return "/" not in token and token in _basenames()


@cache
def _is_module(dotted: str) -> bool:
    folder, *rest = dotted.split(".")
    path = ROOT / folder
    while rest and (path / rest[0]).is_dir():
        path /= rest.pop(0)
    if rest and (path / f"{rest[0]}.py").is_file():
        path = path / f"{rest.pop(0)}.py"
    elif rest and (path / f"{rest[0]}.pyi").is_file():
        return True
    else:
        path = path / "__init__.py"
    return not rest or re.search(rf"\b{rest[0]}\b", path.read_text()) is not None


@cache
def _basenames() -> frozenset[str]:
    return frozenset(p.name for folder in _CODE for p in (ROOT / folder).rglob("*.*")) | {
        p.name for p in ROOT.glob("*.*")
    }


@cache
def _points() -> frozenset[str]:
    return frozenset(re.findall(r"^\| (D\.\d+) ", (ROOT / "conf/README.md").read_text(), re.M))


@cache
def _failures() -> frozenset[str]:
    return frozenset(re.findall(r"^\| (N\d+) ", (ROOT / "tests/README.md").read_text(), re.M))


@cache
def _numbers() -> dict[str, int | None]:
    from vlgs.tables.registry import load_tables

    return {label: table.number for label, table in load_tables().items()}
