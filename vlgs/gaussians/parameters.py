"""The raw parameters that the optimiser moves, by the names of a table of attributes, and what they stand for."""

from collections.abc import Mapping
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor, nn

from vlgs.gaussians.attributes import STANDARD, THREE_DGS, Attribute, Attributes
from vlgs.types import Covariance, Gaussians

Parameters = nn.ParameterDict | Mapping[str, Tensor]
"""Name of an attribute -> [n, ...]; row i of every one of them is Gaussian i."""

_NEEDED = {*THREE_DGS, "features", "indicator_logits"}


def activate(params: Parameters, attributes: Attributes = STANDARD) -> Gaussians:
    """Gaussians in natural units: scales by exp, opacities and indicators by the logistic function.

    Args:
        params: Raw parameters: those of 3DGS, `features`, `indicator_logits`, and what else the table has.
        attributes: The table.

    Raises:
        ValueError: If a key is missing.
    """
    if not params.keys() >= _NEEDED:
        missing = sorted(_NEEDED - params.keys())
        raise ValueError(
            f"gaussians: parameters must have {', '.join(sorted(_NEEDED))}, got no {missing}"
        )
    natural = {name: attributes[name].activate(value) for name, value in params.items()}
    shape = None
    if "language_quats" in natural:
        shape = Covariance(natural["language_quats"], natural["language_log_scales"])
    return Gaussians(
        means=natural["means"],
        quats=natural["quats"],
        scales=natural["log_scales"],
        opacities=natural["opacity_logits"],
        indicators=natural["indicator_logits"],
        sh0=natural["sh0"],
        shN=natural["shN"],
        features=natural["features"],
        language_shape=shape,
        further={name: value for name, value in natural.items() if name not in STANDARD},
    )


def conform(params: Parameters, attributes: Attributes) -> dict[str, Tensor]:
    """The same Gaussians with the attributes of a table, in its order.

    What the table lacks goes; what the Gaussians lack starts as the table says. Harmonics are cut or filled with zeros, weights of other
    mask levels become equal ones (`at_levels`), and a value of another width starts anew.

    Args:
        params: With `means` at least.
        attributes: The table.
    """
    made: dict[str, Tensor] = {}
    for name, row in attributes.items():
        made[name] = _fitted(row, params[name]) if name in params else _started(row, made, params)
    return made


def complete(params: Parameters, width: int) -> dict[str, Tensor]:
    """What the file of another system holds, and language's code and indicator where it has none: zeros, and the opacity.

    Args:
        params: Those of 3DGS and any other of `STANDARD`.
        width: Of the language code where there is none.
    """
    absent = {"features": replace(STANDARD["features"], shape=(width,))}
    absent |= {"indicator_logits": replace(STANDARD["indicator_logits"], shape=())}
    table = {n: row for n, row in STANDARD.items() if n in params or n in absent}
    return conform(params, table | {n: row for n, row in absent.items() if n not in params})


def at_levels(logits: Float[Tensor, "n ..."], levels: int | None) -> Float[Tensor, "n ..."]:
    """Weights of so many mask levels, or one for all.

    One becomes several equal ones; several become one by the mean of their logits, as do those of another number of levels.
    """
    if logits.dim() == 2 and logits.shape[1] != levels:
        logits = logits.mean(dim=1)
    if logits.dim() == 1 and levels is not None:
        logits = logits[:, None].repeat(1, levels)
    return logits


def _started(row: Attribute, made: Mapping[str, Tensor], params: Parameters) -> Tensor:
    if isinstance(row.start, str):
        return (made[row.start] if row.start in made else params[row.start]).clone()
    return row.first(len(params["means"]))


def _fitted(row: Attribute, value: Tensor) -> Tensor:
    if row.shape is None or value.shape[1:] == row.shape:
        return value
    if row.role == "weight":
        return at_levels(value, row.shape[0] if row.shape else None)
    fresh = row.first(len(value))
    if len(row.shape) == 2 and value.dim() == 3:  # harmonics
        shared = min(row.shape[0], value.shape[1])
        fresh[:, :shared] = value[:, :shared]
    return fresh
