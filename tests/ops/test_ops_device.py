"""The seam: an operation goes where its tensors are, or says by name that nothing computes it there."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

import vlgs.ops
from vlgs.fusion.attention import CrossAttention, SelfAttention
from vlgs.losses import l1_dssim, masked_mse, ssim_map
from vlgs.ops.cached_weights import CachedView
from vlgs.ops.code_table import code_table
from vlgs.ops.huber import huber_sum
from vlgs.ops.mapped_error import mapped_error_
from vlgs.ops.neighbours import neighbour_products
from vlgs.ops.radam import Moments, Rates, radam_step
from vlgs.ops.rasterize import rasterize
from vlgs.ops.row_sums import row_sums_backward
from vlgs.ops.ssim import KERNELS
from vlgs.ops.view_color import view_color
from vlgs.types import Camera, ChannelGroup, RasterConfig


def there(*shape: int) -> Tensor:
    """On a device that has shapes and no numbers, which no machine lacks."""
    return torch.zeros(*shape, device="meta")


K = torch.tensor([[9.0, 0, 2], [0, 9, 2], [0, 0, 1]])
GAUSSIANS = there(5, 3), there(5, 4), there(5, 3)
CALLS: dict[str, Callable[[], object]] = {
    "project": lambda: rasterize(
        *GAUSSIANS, [ChannelGroup(there(5, 3), there(5))], torch.eye(4), K, 4, 4
    ),
    "view_color": lambda: view_color(there(5, 3), there(5, 3, 3), there(5, 3), torch.zeros(3), 1),
    "attention": lambda: SelfAttention(2, 2).to("meta")(there(5, 2), there(5, 2)),
    "attention of one modality to the other": lambda: CrossAttention(2, 2).to("meta")(
        there(5, 2), there(5, 2)
    ),
    "squared_error": lambda: masked_mse(there(4, 5, 3), there(4, 5, 3)),
    "huber": lambda: huber_sum(there(4, 5, 3), there(4, 5, 3), there(4, 5).bool(), 1.0),
    "mapped_error": lambda: mapped_error_(there(4, 3), there(3), there(2, 3), there(4).long(), 1.0),
    "neighbours": lambda: neighbour_products(there(4, 5, 3)),
    "radam": lambda: radam_step(
        there(5), there(5), Moments(there(5), there(5)), Rates(1e-3, 0.9, 0.999, 1e-8, 0.0, 1.0)
    ),
    "row_sums": lambda: row_sums_backward(
        there(1).long(), there(4, 8).int(), there(4, 8), there(4, 1, 2), 8
    ),
    "ssim": lambda: ssim_map(there(4, 5, 3), there(4, 5, 3)),
    "l1_dssim": lambda: l1_dssim(there(4, 5, 3), there(4, 5, 3)),
    "code_table": lambda: code_table(there(4, 3), 1.0, there(2, 2, 2).int(), there(8, 8), 5),
    "project of a cached view": lambda: CachedView(
        *GAUSSIANS, there(5), Camera(torch.eye(4), K, 4, 4), RasterConfig()
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_device_that_has_no_kernel_is_refused_with_the_file_that_would_hold_it(name: str):
    operation = name.split()[0]
    with pytest.raises(ValueError, match=f"{operation}: tensors must be on cpu, got meta") as error:
        CALLS[name]()
    assert f"vlgs/ops/{operation}_meta.py" in str(error.value)


def test_tensors_of_two_devices_are_refused_by_name():
    means, quats, scales = torch.zeros(5, 3), torch.ones(5, 4), there(5, 3)
    group = ChannelGroup(torch.zeros(5, 3), torch.zeros(5))
    with pytest.raises(
        ValueError, match=r"scales must be on the device of means \(cpu\), got meta"
    ):
        rasterize(means, quats, scales, [group], torch.eye(4), K, 4, 4)


def test_another_device_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "ssim_meta.py").write_text(
        "from vlgs.ops.ssim import KERNELS\nKERNELS['meta'] = lambda a, b: a - b\n"
    )
    monkeypatch.setattr(vlgs.ops, "__path__", [*vlgs.ops.__path__, str(tmp_path)])
    monkeypatch.setattr(KERNELS, "_by_device", dict(KERNELS._by_device))  # pyright: ignore[reportPrivateUsage]
    try:
        image = there(4, 5, 3)
        assert ssim_map(image, image).shape == (4, 5, 3)
        assert ssim_map(image, image).device.type == "meta"
    finally:
        sys.modules.pop("vlgs.ops.ssim_meta", None)
