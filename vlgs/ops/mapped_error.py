"""The absolute error of many numbers per pixel, and its gradient in their place."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vlgs.ops import _csrc
from vlgs.ops.arrays import arrays
from vlgs.ops.device import Kernels


def mapped_error_(
    made: Float[Tensor, "n e"],
    bias: Float[Tensor, " e"],
    wanted: Float[Tensor, "m e"],
    which: Int64[Tensor, " p"],
    scale: float,
) -> float:
    """Sum of ``|made + bias - wanted[which]|``. Its gradient, times `scale`, is written over the first p rows of `made`.

    Raises:
        ValueError: If shapes do not fit, or a row is not there.
    """
    width = made.shape[1]
    if bias.shape != (width,) or wanted.shape[1:] != (width,) or len(which) > len(made):
        raise ValueError(
            f"mapped_error: bias and wanted must be {width} wide, with no more than {len(made)} pixels, got {list(bias.shape)}, "
            f"{list(wanted.shape)} and {len(which)}"
        )
    return KERNELS.of(made)(made, bias, wanted, which, scale)


def _on_cpu(made: Tensor, bias: Tensor, wanted: Tensor, which: Tensor, scale: float) -> float:
    if len(which) == 0:
        return 0.0
    least, most = (int(end) for end in which.aminmax())
    if least < 0 or most >= len(wanted):
        raise ValueError(
            f"mapped_error: rows must be of {len(wanted)}, got some from {least} to {most}"
        )
    given = arrays(made, bias.contiguous(), wanted.contiguous(), which.contiguous())
    return _csrc.mapped_error(*given, scale, torch.get_num_threads())


KERNELS = Kernels("mapped_error", cpu=_on_cpu)
