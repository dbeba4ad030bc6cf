import torch

from vlgs.bench.alone import WIDTHS, measure_alone, show_alone
from vlgs.gaussians import STANDARD

PARAMETERS = tuple(STANDARD)[:8]
"""What every training has."""


def test_fusion_and_adam_are_timed_by_threads():
    before = torch.get_num_threads()
    times = measure_alone(50, (1, 2), 2, seed=0)
    assert torch.get_num_threads() == before
    assert [threads for _, threads in times] == [1, 2, 1, 2]
    assert all(t.ms > 0 and t.q1 <= t.ms <= t.q3 for t in times.values())
    assert show_alone(50, times).row_count == 4


def test_every_parameter_takes_a_step():
    assert set(WIDTHS) == set(PARAMETERS)
