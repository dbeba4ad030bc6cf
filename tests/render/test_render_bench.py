"""The benchmark's scenes are the published ones."""

import importlib.util
from pathlib import Path

import pytest
import torch

from vlgs.bench.workload import make_workload
from vlgs.ops.rasterize import rasterize
from vlgs.types import ChannelGroup, RasterConfig

PUBLISHED = Path(__file__).parents[2] / "../shared/reference/workload.py"


@pytest.mark.skipif(not PUBLISHED.exists(), reason="the published workload is not here")
def test_the_workload_is_the_published_one():
    spec = importlib.util.spec_from_file_location("published_workload", PUBLISHED)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    want = module.make(500, 64, 48, D=5)
    got = make_workload(500, 64, 48, channels=5)
    color, language = got.groups
    pairs = {
        "means": got.means, "scales": got.scales, "quats": got.quats, "opac": color.weight,
        "sem": language.weight, "colors": color.values, "feats": language.values,
        "v_color": got.upstream[0], "v_feat": got.upstream[1],
    }  # fmt: skip
    for name, tensor in pairs.items():
        torch.testing.assert_close(tensor.detach(), want[name], rtol=1e-6, atol=1e-9)


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
