"""A sample of the attacks of `python -m tests.fuzz`, in a process of its own: one that has computed with threads must not be forked."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

SAMPLES = {
    "files": ("--count", "40"),
    "bombs": ("--every", "12"),
    "paths": ("--count", "42"),
    "places": ("--every", "16"),
    "text": ("--every", "7", "--count", "0"),
    "results": ("--every", "13", "--count", "0"),
}


@pytest.mark.parametrize("family", SAMPLES)
def test_a_sample_of_the_attacks_is_met_rightly(family: str):
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", family, *SAMPLES[family]],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    tried, right = map(int, re.findall(r"tried +(\d+)  right +(\d+)", done.stdout)[0])
    assert tried == right > 10
