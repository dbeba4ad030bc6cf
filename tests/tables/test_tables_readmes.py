"""What the documents of results say of intervals is what the committed tables say."""

import csv
import re
from pathlib import Path

import pytest

RESULTS = Path(__file__).parents[2] / "results"
NUMBER = r"([+-]\d+\.\d+)"
INTERVAL = re.compile(rf"{NUMBER}(?: dB)?\s+\[{NUMBER}, {NUMBER}\]")


def claimed(folders: list[str]) -> set[tuple[str, ...]]:
    """Difference and interval of every claim, as a document rounds them."""
    found = set()
    for path in (path for name in folders for path in (RESULTS / name).rglob("*-claims.csv")):
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        for row in csv.DictReader(lines):
            if row["low"]:
                numbers = (float(row[name]) for name in ("difference", "low", "high"))
                found.add(tuple(f"{number:+.1f}" for number in numbers))
    return found


@pytest.mark.parametrize(
    ("name", "folders"),
    [
        ("synthetic", ["synthetic", "budget", "sunroom", "sunroom_even"]),
        ("camvid", ["camvid"]),
    ],
)
def test_every_interval_of_a_document_stands_in_a_table(name: str, folders: list[str]):
    known = claimed(folders)
    said = INTERVAL.findall((RESULTS / name / "README.md").read_text())
    assert len(said) > 5
    assert [one for one in said if one not in known] == []
