"""Products of neighbouring pixels of wide maps, a few rows at a time."""

from collections.abc import Iterator
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.ops import _csrc
from vlgs.ops.arrays import arrays
from vlgs.ops.device import Kernels

_SHIFTS = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
"""Places of the eight neighbours in the 3x3 pixels around an inner one."""
_NUMBERS = 1 << 18
"""Numbers of the rows that are looked at together, a megabyte: they stay in cache, and are large enough for threads."""


def neighbour_products(image: Float[Tensor, "h w c"]) -> Float[Tensor, "8 ih iw"]:
    """Scalar product of each inner pixel with its eight neighbours, row by row; nothing where there is no inner pixel.

    Plain torch makes a map as large as the image for every neighbour, and three more on the way back.

    Example:
        >>> image = torch.zeros(3, 3, 2)
        >>> image[1, 1], image[0, 2] = torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0])
        >>> neighbour_products(image)[:, 0, 0]
        tensor([ 0.,  0., 11.,  0.,  0.,  0.,  0.,  0.])
    """
    return KERNELS.of(image)(image)


class _NeighbourProducts(torch.autograd.Function):
    """Gradients are those of plain torch, bit for bit: terms are added in autograd's order, which is that of the neighbours backwards."""

    @staticmethod
    def forward(ctx: Any, image: Tensor) -> Tensor:
        image = image.contiguous()
        h, w, _ = image.shape
        out = image.new_empty(len(_SHIFTS), max(0, h - 2), max(0, w - 2))
        for top, end in _bands(image, out.shape[1]):
            inner = image[top + 1 : end + 1, 1 : w - 1]
            products = image.new_empty(len(_SHIFTS), *inner.shape)
            for product, (y, x) in zip(products, _SHIFTS, strict=True):
                torch.mul(inner, image[top + y : end + y, x : x + w - 2], out=product)
            out[:, top:end] = products.sum(-1)
        ctx.save_for_backward(image)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        (image,) = ctx.saved_tensors
        d_image = torch.empty_like(image)
        given = arrays(image, grad_outputs[0].contiguous(), d_image)
        _csrc.neighbours_backward(*given, torch.get_num_threads())
        return d_image


def _bands(image: Tensor, rows: int) -> Iterator[tuple[int, int]]:
    """First row of each band, and the row after its last."""
    step = max(1, _NUMBERS // max(1, image[:1].numel()))
    for top in range(0, rows, step):
        yield top, min(top + step, rows)


def _on_cpu(image: Tensor) -> Tensor:
    return cast(Tensor, _NeighbourProducts.apply(image))


KERNELS = Kernels("neighbours", cpu=_on_cpu)
