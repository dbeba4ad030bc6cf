"""No comment, docstring or document refers to what is not in the repository."""

import pytest
from citations import ROOT, dead, files

from vlgs.tables.registry import load_tables


def test_every_citation_leads_somewhere():
    found = [
        problem
        for path in files()
        for problem in dead(path.relative_to(ROOT).as_posix(), path.read_text())
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("vlgs/a.py", '"""The loss (S. D.8)."""', "S. D.8: a section of a document that is not here"),
        ("vlgs/a.py", "x = 1  # see systems.md A.2", "systems.md: a document that is not here"),
        ("vlgs/a.py", '"""Stuck (pitfalls N11)."""', "pitfalls N11: a document that is not here"),
        ("vlgs/a.py", '"""One.\n\nSee `vlgs/lossess.py`."""', "vlgs/a.py:3: vlgs/lossess.py: no such"),
        ("vlgs/a.py", '"""As `vlgs.losses.ssimm` does."""', "vlgs.losses.ssimm: no such module"),
        ("vlgs/a.py", '"""As `vlgs.lossess` does."""', "vlgs.lossess: no such module or name"),
        ("vlgs/a.py", '"""Below (D.8)."""', "D.8: of which document?"),
        ("vlgs/a.py", '"""See conf/README.md, D.8 and D.99."""', "D.99: conf/README.md has no such"),
        ("vlgs/a.py", '"""Poison (tests/README.md, N77)."""', "N77: tests/README.md has no such"),
        ("vlgs/a.py", '"""Fusion (Eq. attention)."""', "Eq. a: an equation by its label"),
        ("vlgs/a.py", '"""Fusion (Eq. 31)."""', "Eq. 31: the paper has 12"),
        ("vlgs/a.py", '"""The last row of tab:ab-multi."""', "tab:a: a table by its label alone"),
        ("vlgs/a.py", '"""The last row (tab:ab-multi)."""', "tab:a: a table by its label alone"),
        ("vlgs/a.py", '"""Table 5 (tab:ab-multi)."""', "another number"),
        ("vlgs/a.py", '"""See ../shared/reference/notes."""', "shared/reference: a document that is"),
        ("csrc/a.cpp", "int x;  // derived in DERIVATION.md", "csrc/a.cpp:1: DERIVATION.md: no such"),
        ("conf/a.yaml", "a: 1\nb: 2  # conf/blend/gama.yaml", "conf/a.yaml:2: conf/blend/gama.yaml"),
        ("A.md", "Words.\n\nSee [there](results/nowhere/README.md).", "A.md:3: results/nowhere/README"),
        (".github/A.md", "a case in `vlgs/bench/strain`", "vlgs/bench/strain: no such file"),
    ],
)  # fmt: skip
def test_a_citation_that_leads_nowhere_is_found(name: str, text: str, problem: str):
    assert any(problem in found for found in dead(name, text)), dead(name, text)


def test_what_is_there_may_be_cited():
    text = '"""Table 4 (tab:ab-multi), Eqs. 9 and 10; conf/README.md, D.1 to D.5; N12; `vlgs.losses.ssim`; csrc/README.md."""'
    assert dead("vlgs/a.py", text) == []


def test_the_papers_tables_are_numbered_as_it_prints_them():
    # Table 7 holds learning rates and has no sweep.
    numbers = [table.number for table in load_tables().values() if table.number]
    assert sorted(numbers) == [n for n in range(1, 29) if n != 7]
