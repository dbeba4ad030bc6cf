"""Views whose geometry and weights stay as they are: blending weights are kept, and rendering is a sparse product.

With means, quats, scales and the weight fixed, ``image = sum_i alpha_i T_i f_i`` is linear in the values f: LangSplat's
training of language on finished 3DGS geometry. The weights come from the rasterizer's own lists and stops, so that an image
and its gradients by the values are those of `vlgs.rasterize` but for the order of sums.
"""

import logging
from collections.abc import Hashable
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vlgs import _csrc
from vlgs.render import cpu
from vlgs.types import Camera, RasterConfig

log = logging.getLogger(__name__)

DEFAULT_BUDGET = 2 << 30


class FrozenBudgetError(ValueError):
    """The weights of a view do not fit."""


class FrozenView:
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
        FrozenBudgetError: If they would take more, before they are allocated.
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
                f"frozen view: weight must be [{len(means)}], got {list(weight.shape)}"
            )
        threads = torch.get_num_threads()
        splats = cpu.project(means, quats, scales, camera, config)
        picture, visible, alpha = cpu.freeze(splats, weight, camera, config)
        kind = _csrc.FrozenFloat if means.dtype == torch.float32 else _csrc.FrozenDouble
        self._weights = kind(picture, threads)
        if self._weights.bytes > budget:
            raise FrozenBudgetError(
                f"frozen view: weights must be within {budget} bytes, got {self._weights.bytes}"
            )
        self._weights.keep(picture, threads)
        self._size = (camera.height, camera.width)
        self.alpha: Float[Tensor, "h w"] = alpha
        """Accumulated weight."""
        self.visible: Bool[Tensor, " n"] = visible
        self.mean2d: Float[Tensor, "n 2"] = splats.mean2d

    @property
    def nbytes(self) -> int:
        """Bytes that the weights take."""
        return self._weights.bytes

    def render(self, values: Float[Tensor, "n c"]) -> Float[Tensor, "h w c"]:
        """Blend values of any width; differentiable in them, once.

        Raises:
            ValueError: If the rows are not those of the view, or a value or a gradient is not finite.
        """
        return _Product.apply(values, self._weights, self._size)  # pyright: ignore[reportReturnType]


class FrozenViews:
    """Frozen views by name, as many as a budget holds.

    The first that fit stay: every view comes once per epoch, so that putting out the oldest would rebuild one each time.
    """

    def __init__(self, budget: int) -> None:
        self.budget = budget
        self.used = 0
        self._views: dict[Hashable, FrozenView] = {}
        self._refused: set[Hashable] = set()

    def __len__(self) -> int:
        return len(self._views)

    def get(self, name: Hashable) -> FrozenView | None:
        """The view of that name, if it is kept."""
        return self._views.get(name)

    def refused(self, name: Hashable) -> bool:
        """Whether a view of that name did not fit."""
        return name in self._refused

    def make(self, name: Hashable, **view: Any) -> FrozenView | None:
        """Make and keep a view; None, with a line in the log the first time, where the budget does not hold it.

        Args:
            name: Under which `get` finds it.
            view: Arguments of `FrozenView`.
        """
        try:
            made = FrozenView(**view, budget=self.budget - self.used)
        except FrozenBudgetError as error:
            if not self._refused:
                log.info(
                    "frozen weights: %d views in %d bytes, others are rendered in full (%s)",
                    len(self), self.used, error,
                )  # fmt: skip
            self._refused.add(name)
            return None
        self._views[name] = made
        self.used += made.nbytes
        return made


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        values: Tensor,
        weights: _csrc.FrozenFloat | _csrc.FrozenDouble,
        size: tuple[int, int],
    ):
        values = values.contiguous()
        image = values.new_empty(*size, values.shape[1])
        weights.render(values, image, torch.get_num_threads())
        ctx.weights, ctx.like = weights, values.shape
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        d_image = grad_outputs[0].contiguous()
        d_values = d_image.new_empty(ctx.like)
        ctx.weights.backward(d_image, d_values, torch.get_num_threads())
        return d_values, None, None
