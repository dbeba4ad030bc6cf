"""Nothing is tracked but what belongs here."""

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = {"conf", "vlgs", "csrc", "sweeps", "tests", "results", ".ci", ".github"}
FILES = {
    *("README.md", "CHANGELOG.md", "LICENSE", "CITATION.cff", "pyproject.toml"),
    *(".gitignore", ".clang-format", ".pre-commit-config.yaml"),
}
"""GitHub looks for CITATION.cff at the root alone."""


def test_the_top_level_is_the_prescribed_one():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode != 0 or not listed.stdout:
        pytest.skip("no checkout of git: nothing is tracked")
    tracked = [Path(line) for line in listed.stdout.splitlines()]
    assert {path.parts[0] for path in tracked if len(path.parts) > 1} <= FOLDERS
    assert {path.name for path in tracked if len(path.parts) == 1} <= FILES
