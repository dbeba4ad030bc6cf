"""Views whose geometry and weights stay as they are: blending weights are kept, and rendering is a sparse product.

With means, quats, scales and the weight fixed, ``image = sum_i alpha_i T_i f_i`` is linear in the values f: LangSplat's
training of language on finished 3DGS geometry. The weights come from the rasterizer's own lists and stops, so that an image
and its gradients by the values are those of `vlgs.rasterize`, its reference, but for the order of sums.
"""

from typing import Any, NamedTuple, Protocol, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs.ops import _csrc
from vlgs.ops.arrays import arrays
from vlgs.ops.device import Kernels
from vlgs.ops.project import Splats, project
from vlgs.ops.rasterize_to_pixels import weights_alone
from vlgs.types import Camera, RasterConfig

DEFAULT_BUDGET = 2 << 30


class CacheBudgetError(ValueError):
    """The weights of a view do not fit."""


class Weights(Protocol):
    """The blending weights of one view, on one device."""

    @property
    def nbytes(self) -> int:
        """Bytes that they take, known before they are kept."""
        ...

    def keep(self) -> None:
        """Take these bytes."""
        ...

    def render(self, values: Float[Tensor, "n c"]) -> Float[Tensor, "h w c"]:
        """Blend values; differentiable in them, once."""
        ...


class ViewWeights(NamedTuple):
    """What a device makes of a view."""

    weights: Weights
    alpha: Float[Tensor, "h w"]
    visible: Bool[Tensor, " n"]


class CachedView:
    """The blending weights of one view.

    Args:
        means: Centres, world units.
        quats: Rotations (w, x, y, z), need not be normalised.
        scales: Standard deviations, world units.
        weight: In [0, 1], as in `ChannelGroup`.
        camera: Where from.
        config: Constants of the rasterizer.
        budget: Bytes that the weights may take: 76 per block of 4x4 pixels and Gaussian in float32.

    Raises:
        CacheBudgetError: If they would take more, before they are allocated.
        ValueError: If an input is not finite, a weight is not in [0, 1], or there is not one for each Gaussian.
    """

    @torch.no_grad()
    def __init__(
        self,
        means: Float[Tensor, "n 3"],
        quats: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
        weight: Float[Tensor, " n"],
        camera: Camera,
        config: RasterConfig,
        budget: int = DEFAULT_BUDGET,
    ) -> None:
        if len(weight) != len(means):
            raise ValueError(
                f"cached view: weight must be [{len(means)}], got {list(weight.shape)}"
            )
        splats = project(means, quats, scales, camera, config)
        made = KERNELS.of(means)(splats, weight, camera, config)
        if made.weights.nbytes > budget:
            raise CacheBudgetError(
                f"cached view: weights must be within {budget} bytes, got {made.weights.nbytes}"
            )
        made.weights.keep()
        self._weights = made.weights
        self.alpha: Float[Tensor, "h w"] = made.alpha
        """Accumulated weight."""
        self.visible: Bool[Tensor, " n"] = made.visible
        self.mean2d: Float[Tensor, "n 2"] = splats.mean2d

    @property
    def nbytes(self) -> int:
        """Bytes that the weights take."""
        return self._weights.nbytes

    def render(self, values: Float[Tensor, "n c"]) -> Float[Tensor, "h w c"]:
        """Blend values of any width; differentiable in them, once.

        Raises:
            ValueError: If the rows are not those of the view, or a value or a gradient is not finite.
        """
        return self._weights.render(values)


@torch.no_grad()
def weights_bytes(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    weight: Float[Tensor, " n"],
    camera: Camera,
    config: RasterConfig,
) -> int:
    """Bytes that the weights of a `CachedView` would take, of which none is kept."""
    splats = project(means, quats, scales, camera, config)
    return KERNELS.of(means)(splats, weight, camera, config).weights.nbytes


class _CpuWeights:
    """csrc/cached_weights.cpp."""

    def __init__(self, picture: Any, dtype: torch.dtype, size: tuple[int, int]) -> None:
        kind = _csrc.CachedWeightsFloat if dtype == torch.float32 else _csrc.CachedWeightsDouble
        self._picture: Any = picture
        self._weights = kind(picture, torch.get_num_threads())
        self._size = size

    @property
    def nbytes(self) -> int:
        return self._weights.bytes

    def keep(self) -> None:
        self._weights.keep(self._picture, torch.get_num_threads())
        self._picture = None

    def render(self, values: Float[Tensor, "n c"]) -> Float[Tensor, "h w c"]:
        return cast(Tensor, _Product.apply(values, self._weights, self._size))


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        values: Tensor,
        weights: _csrc.CachedWeightsFloat | _csrc.CachedWeightsDouble,
        size: tuple[int, int],
    ):
        values = values.contiguous()
        image = values.new_empty(*size, values.shape[1])
        weights.render(*arrays(values, image), torch.get_num_threads())
        ctx.weights, ctx.like = weights, values.shape
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        d_image = grad_outputs[0].contiguous()
        d_values = d_image.new_empty(ctx.like)
        ctx.weights.backward(*arrays(d_image, d_values), torch.get_num_threads())
        return d_values, None, None


def _on_cpu(splats: Splats, weight: Tensor, camera: Camera, config: RasterConfig) -> ViewWeights:
    picture, visible, alpha = weights_alone(splats, weight, camera, config)
    weights = _CpuWeights(picture, weight.dtype, (camera.height, camera.width))
    return ViewWeights(weights, alpha, visible)


KERNELS = Kernels("cached_weights", cpu=_on_cpu)
