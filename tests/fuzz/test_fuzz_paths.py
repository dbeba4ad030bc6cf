"""Odd names of files and folders: read, or one error that names them."""

from tests.fuzz.__main__ import run_family


def test_odd_names_are_read_or_named():
    wrong = [f"{o.name}: {o.said}" for o in run_family("paths", seed=0, count=42) if not o.right]
    assert not wrong
