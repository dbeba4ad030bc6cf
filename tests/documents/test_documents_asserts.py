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
    known = list(functions(folder))
    while found := {n.name for _, n in known if n.name not in checking and _checks(n, checking)}:
        checking |= found
    return [place for place, n in known if n.name.startswith("test_") and n.name not in checking]


def _checks(function: ast.FunctionDef, checking: set[str]) -> bool:
    for node in ast.walk(function):
        if isinstance(node, ast.Assert):
            return True
        if isinstance(node, ast.Call):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if called.startswith("assert_") or called in checking:
                return True
    return False


def test_every_test_asserts_something():
    assert empty_tests(TESTS) == []


def test_a_test_without_an_assertion_is_found(tmp_path: Path):
    (tmp_path / "test_a.py").write_text(
        "def helper():\n    assert True\n\n\ndef test_good():\n    helper()\n\n\ndef test_bad():\n    print()\n"
    )
    assert empty_tests(tmp_path) == ["test_a.py: test_bad"]
