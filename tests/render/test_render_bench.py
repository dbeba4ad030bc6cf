"""The benchmark's scenes are the published ones."""

import json
from pathlib import Path

import pytest
import torch

from vlgs.bench.workload import make_workload
from vlgs.ops.rasterize import rasterize
from vlgs.types import ChannelGroup, RasterConfig

PUBLISHED = Path(__file__).parents[1] / "fixtures" / "workload.json"


def test_the_workload_is_the_published_one():
    got = make_workload(500, 64, 48, channels=5)
    color, language = got.groups
    tensors = {
        "means": got.means, "scales": got.scales, "quats": got.quats, "opac": color.weight,
        "sem": language.weight, "colors": color.values, "feats": language.values,
        "v_color": got.upstream[0], "v_feat": got.upstream[1],
    }  # fmt: skip
    published = json.loads(PUBLISHED.read_text())
    assert published.keys() == tensors.keys()
    for name, tensor in tensors.items():
        numbers = tensor.detach().double()
        first = numbers.flatten(0, -2)[0] if numbers.ndim > 1 else numbers[:1]
        assert first.tolist() == pytest.approx(published[name]["first"], rel=1e-6)
        assert numbers.abs().sum().item() == pytest.approx(published[name]["sum"], rel=1e-6)


def test_about_as_many_gaussians_cover_a_pixel_as_asked_for():
    w = make_workload(2000, 64, 48, covering=20.0)
    c = w.camera
    ones = ChannelGroup(torch.ones(2000, 1), 1e-3 * w.groups[0].weight.detach())
    # So faint that nothing hides anything: the image counts, weighted, what lies within each Gaussian's own cutoff.
    config = RasterConfig(alpha_min=1e-3 / 255)
    with torch.no_grad():
        out = rasterize(
            w.means, w.quats, w.scales, [ones], c.viewmat, c.K, c.width, c.height, config
        )
    assert out.visible.double().mean() > 0.8
    assert 0.5 < out.images[0].mean() / 1e-3 < 3
