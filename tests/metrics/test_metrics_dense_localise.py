import torch

from vlgs.metrics.dense import localise


def test_the_window_keeps_its_share_of_the_width():
    # 200 px wide: 30 * 200 / 988 = 6 px. A lone peak off the object must lose against a broad one on it; at 988 px
    # wide the same two objects would be a sixth of the window.
    relevancy = torch.zeros(150, 200)
    relevancy[20, 20] = 1.0
    relevancy[100:106, 100:106] = 0.5
    mask = torch.zeros(150, 200, dtype=torch.bool)
    mask[98:108, 98:108] = True
    assert localise([relevancy], mask)
    assert not localise([relevancy], ~mask)


def test_a_tiny_image_is_not_smoothed():
    relevancy = torch.zeros(12, 16)
    relevancy[3, 5] = 1.0
    mask = relevancy > 0
    assert localise([relevancy], mask)
    assert not localise([relevancy], ~mask)


def test_a_constant_map_is_no_hit():
    everywhere = torch.ones(12, 16, dtype=torch.bool)
    assert not localise([torch.full((12, 16), 0.3)], everywhere)
