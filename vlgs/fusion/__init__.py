"""What a Gaussian's colour and language code become before they are rasterised."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Fusion(Protocol):
    """The interface of a fusion: row i of the result depends on row i of the input only, in training and at test time alike."""

    def __call__(
        self, color: Float[Tensor, "n dc"], feature: Float[Tensor, "n df"]
    ) -> tuple[Float[Tensor, "n dc"], Float[Tensor, "n df"]]:
        """Return the colours and language codes to rasterise."""
        ...


def require_channels(who: str, color: Tensor, feature: Tensor, widths: tuple[int, int]) -> None:
    """Check the channels that a fusion was built for.

    Raises:
        ValueError: If colour or language code has another number of channels.
    """
    got = (color.shape[-1], feature.shape[-1])
    if got != widths:
        raise ValueError(f"{who}: channels of (color, feature) must be {widths}, got {got}")
