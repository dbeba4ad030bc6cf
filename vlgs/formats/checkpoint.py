"""3DGS's and LangSplat's ``chkpnt<iteration>.pth``: a tuple of 12 or 13 values, and the iteration.

LangSplat's 13 are 3DGS's 12 with ``language_feature`` [n, 3] after the opacity; the length tells which. The raw values are kept:
LangSplat renders ``f / (|f| + 1e-9)``.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from vlgs.formats.plain import load_plain, save_plain
from vlgs.gaussians.ply import SH_COEFFICIENTS

_TENSORS = (
    ("xyz", "means", (None, 3)),
    ("f_dc", "sh0", (None, 1, 3)),
    ("f_rest", "shN", (None, None, 3)),
    ("scaling", "log_scales", (None, 3)),
    ("rotation", "quats", (None, 4)),
    ("opacity", "opacity_logits", (None, 1)),
)
"""3DGS's name, ours, shape; entries 1 to 6 of the tuple, in order."""

_LANGUAGE = 7
"""Place of LangSplat's language features."""


def parse_checkpoint(path: str | Path) -> tuple[dict[str, Tensor], int]:
    """What a checkpoint holds of `vlgs.gaussians.STANDARD`, not yet judged, and its iteration.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not such a checkpoint; names the value that does not fit.
    """
    who = f"checkpoint {path}"
    content = load_plain(path)
    if not isinstance(content, (tuple, list)) or len(content) != 2:
        raise ValueError(f"{who}: must be (values, iteration), got {_kind(content)}")
    values, iteration = content
    if not isinstance(values, (tuple, list)) or len(values) not in (12, 13):
        raise ValueError(
            f"{who}: must hold 12 values (3DGS) or 13 (LangSplat), got {_kind(values)}"
        )
    if type(iteration) is not int:
        raise ValueError(f"{who}: iteration must be a whole number, got {_kind(iteration)}")
    params: dict[str, Tensor] = {}
    for place, (theirs, ours, shape) in enumerate(_TENSORS, start=1):
        params[ours] = _take(
            who, theirs, values[place], shape, len(params.get("means", ())) or None
        )
    n = len(params["means"])
    if len(values) == 13:
        params["features"] = _take(who, "language_feature", values[_LANGUAGE], (None, None), n)
    if params["shN"].shape[1] not in SH_COEFFICIENTS:
        expected = "f_rest must have 0, 3, 8 or 15 coefficients"
        raise ValueError(f"{who}: {expected}, got {params['shN'].shape[1]}")
    params["sh0"] = params["sh0"][:, 0]
    params["opacity_logits"] = params["opacity_logits"][:, 0]
    return params, iteration


def write_checkpoint(
    path: str | Path, params: Mapping[str, Tensor], language: bool, iteration: int = 30_000
) -> None:
    """Write what 3DGS (12 values) or LangSplat (13) goes on from: with fresh optimiser and densification statistics.

    Args:
        path: The file.
        params: Raw parameters, by the names of `vlgs.gaussians.STANDARD`.
        language: Whether the features go with it, as LangSplat's 13th value; indicators have no place in either.
        iteration: Iterations that the Gaussians are said to have had.

    Raises:
        OSError: If the file cannot be written.
    """
    raw = {name: value.detach().float().clone() for name, value in params.items()}
    n, coefficients = raw["shN"].shape[:2]
    raw["sh0"], raw["opacity_logits"] = raw["sh0"][:, None], raw["opacity_logits"][:, None]
    leaves = [nn.Parameter(raw[ours].contiguous()) for _, ours, _ in _TENSORS]
    trained, names = leaves, [theirs for theirs, _, _ in _TENSORS]
    if language:
        leaves = [*leaves, nn.Parameter(raw["features"])]
        # LangSplat's second stage optimises the language alone.
        trained, names = leaves[-1:], ["language_feature"]
    groups: list[dict[str, Any]] = [
        {"params": [leaf], "lr": 0.0, "name": name}
        for leaf, name in zip(trained, names, strict=True)
    ]
    statistics = (torch.zeros(n), torch.zeros(n, 1), torch.zeros(n, 1))
    degree = SH_COEFFICIENTS.index(coefficients)
    optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15).state_dict()
    save_plain(path, ((degree, *leaves, *statistics, optimizer, 1.0), iteration))


def _take(who: str, name: str, value: Any, shape: tuple[int | None, ...], n: int | None) -> Tensor:
    """One tensor of the tuple as float32, if it has the shape; None stands for any length."""
    wanted = (n, *shape[1:])
    fits = isinstance(value, Tensor) and value.is_floating_point() and value.dim() == len(shape)
    if not fits or any(
        side is not None and side != got for side, got in zip(wanted, value.shape, strict=True)
    ):
        expected = ", ".join("n" if side is None else str(side) for side in wanted)
        raise ValueError(f"{who}: {name} must be floats [{expected}], got {_kind(value)}")
    return value.detach().float()


def _kind(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{value.dtype} {list(value.shape)}"
    if isinstance(value, (tuple, list, dict)):
        return f"a {type(value).__name__} of {len(value)}"
    return type(value).__name__
