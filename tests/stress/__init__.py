"""Numerical truth: inputs on which systems of this kind are known to fail, each with the criterion it must meet.

One list of cases: `python -m tests.stress` runs them at full size (10^4 to 10^6), the tests run them small. The numbers
N1 to N19 are those of the list of known failures in tests/README.md.
"""

from tests.stress.bits import BITS
from tests.stress.case import Case
from tests.stress.functions import FUNCTIONS
from tests.stress.hostile import HOSTILE
from tests.stress.order import ORDER
from tests.stress.training import TRAINING

CASES: tuple[Case, ...] = tuple(
    sorted((*HOSTILE, *ORDER, *FUNCTIONS, *TRAINING, *BITS), key=lambda c: int(c.name[1:].split()[0]))
)  # fmt: skip
