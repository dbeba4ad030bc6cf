"""Every test can fail: it asserts something, or calls a helper of the tests that does."""

import ast
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]


def functions(folder: Path) -> Iterator[tuple[str, ast.FunctionDef]]:
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                yield f"{path.relative_to(folder)}: {node.name}", node


def empty_tests(folder: Path) -> list[str]:
    """Tests without ``assert``, ``pytest.raises``, ``assert_close`` and the like, in themselves or in what they call."""
    checking = {"raises", "warns", "fail"}
    known = [(place, node.name, _called(node)) for place, node in functions(folder)]
    while found := {
        name for _, name, called in known if name not in checking and called & checking
    }:
        checking |= found
    return [place for place, name, _ in known if name.startswith("test_") and name not in checking]


def _called(function: ast.FunctionDef) -> set[str]:
    """Names of what a function calls; ``assert`` and whatever is named like it is ``fail``."""
    found = set[str]()
    for node in ast.walk(function):
        if isinstance(node, ast.Assert):
            found.add("fail")
        if isinstance(node, ast.Call):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            found.add("fail" if called.startswith("assert_") else called)
    return found


def test_every_test_asserts_something():
    assert empty_tests(TESTS) == []


def test_a_test_without_an_assertion_is_found(tmp_path: Path):
    (tmp_path / "test_a.py").write_text(
        "def helper():\n    assert True\n\n\ndef test_good():\n    helper()\n\n\ndef test_bad():\n    print()\n"
    )
    assert empty_tests(tmp_path) == ["test_a.py: test_bad"]
