"""Colour: the first term of Eq. 8."""

from typing import Literal

from jaxtyping import Float
from torch import Tensor

from vlgs.losses import l1_dssim, masked_mse
from vlgs.objectives.objective import Objective, StepView
from vlgs.objectives.targets import covered
from vlgs.values import require_choice

_ERRORS = {"mse": masked_mse, "l1_dssim": l1_dssim}


class Photometric(Objective):
    """How far the render of a view is from its photograph, over the pixels that the photograph covers.

    Args:
        error: ``mse`` is the paper's, ``l1_dssim`` 3DGS's.

    Raises:
        ValueError: If there is no such error.
    """

    needs = frozenset({"color"})

    def __init__(self, error: Literal["mse", "l1_dssim"] = "mse") -> None:
        require_choice("photometric", "error", error, tuple(_ERRORS))
        self.error = error

    def __call__(self, step: StepView) -> dict[str, Float[Tensor, ""]]:
        """Sum over both views."""
        losses = [
            _ERRORS[self.error](render.color, target.image, covered(target.view))
            for render, target in zip(step.renders, step.targets, strict=True)
            if render.color is not None
        ]
        return {"color": losses[0] + losses[1]} if losses else {}
