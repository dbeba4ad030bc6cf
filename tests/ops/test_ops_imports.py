"""Only `vlgs.ops` imports the compiled kernel. An extension module is nothing to import-linter."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2] / "vlgs"


def imports_the_kernel(source: str) -> bool:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            names = {f"{node.module}.{alias.name}" for alias in node.names} | {node.module or ""}
        elif isinstance(node, ast.Import):
            names = {alias.name for alias in node.names}
        else:
            continue
        if "vlgs.ops._csrc" in names:
            return True
    return False


def test_every_form_of_import_is_seen():
    forms = (
        "from vlgs.ops import _csrc",
        "import vlgs.ops._csrc",
        "from vlgs.ops._csrc import project",
    )
    assert all(map(imports_the_kernel, forms))
    assert not imports_the_kernel("from vlgs import rasterize")


def test_nobody_else_imports_the_kernel():
    found = {
        path.relative_to(ROOT).as_posix()
        for path in ROOT.rglob("*.py")
        if imports_the_kernel(path.read_text())
    }
    assert found
    assert {name for name in found if not name.startswith("ops/")} == set()


def test_a_checkout_without_kernels_says_how_to_make_them(tmp_path: Path):
    (tmp_path / "vlgs" / "ops").mkdir(parents=True)
    (tmp_path / "vlgs" / "__init__.py").touch()
    shutil.copy(ROOT / "ops" / "__init__.py", tmp_path / "vlgs" / "ops")
    # Without site-packages, or the installed kernels would be found.
    command = [sys.executable, "-S", "-E", "-c", "import vlgs.ops"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("ImportError: vlgs: compiled kernels must be")
