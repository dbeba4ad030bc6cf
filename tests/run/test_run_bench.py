from vlgs.bench.overhead import measure_overhead


def test_overhead_measures_both_parts():
    cost = measure_overhead(iterations=3)
    assert cost.step > 0
    assert cost.around > 0
