"""What `vlgs.gsplat.rasterization` does not take, named before anything is computed."""

from collections.abc import Sequence

import torch
from torch import Tensor


def refuse(**arguments: object) -> None:
    """Refuse arguments of gsplat that ask for what is not here.

    Raises:
        ValueError: Naming the first that is neither None nor False.
    """
    for name, value in arguments.items():
        if value is not None and value is not False:
            raise ValueError(
                f"rasterization: {name} must be left at its default, which is all that vlgs.gsplat has, got {_short(value)}"
            )


def require_one_of(name: str, value: object, known: Sequence[str]) -> None:
    """Refuse another mode.

    Raises:
        ValueError: Naming the modes.
    """
    if value not in known:
        raise ValueError(f"rasterization: {name} must be {' or '.join(known)}, got {value!r}")


def require_shapes(
    splats: dict[str, Tensor], colors: Tensor, cameras: dict[str, Tensor], sh_degree: int | None
) -> None:
    """Refuse tensors that do not fit together, by gsplat's rules of shapes.

    Args:
        splats: means, quats, scales and opacities.
        colors: Values or coefficients.
        cameras: viewmats, Ks, and backgrounds if there are any.
        sh_degree: None for values.

    Raises:
        ValueError: Naming the tensor.
    """
    means, viewmats = splats["means"], cameras["viewmats"]
    if means.dim() < 2 or viewmats.dim() < 3 or viewmats.shape[-3] == 0:
        raise ValueError(
            "rasterization: means and viewmats must be [..., n, 3] and [..., c, 4, 4] with c > 0, "
            f"got {list(means.shape)} and {list(viewmats.shape)}"
        )
    batch, n, c = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
    ends = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
    ends |= {"viewmats": (c, 4, 4), "Ks": (c, 3, 3), "backgrounds": (c, colors.shape[-1])}
    for name, tensor in {**splats, **cameras}.items():
        _require(name, tensor, [(*batch, *ends[name])])
    last = colors.shape[-1:] if sh_degree is None else colors.shape[-2:]
    _require("colors", colors, [(*batch, n, *last), (*batch, c, n, *last)])
    for name, tensor in {**splats, "colors": colors}.items():
        if tensor.dtype not in (torch.float32, torch.float64) or tensor.dtype != means.dtype:
            raise ValueError(
                f"rasterization: {name} must be float32 or float64 like means ({means.dtype}), got {tensor.dtype}"
            )
    if sh_degree is None:
        return
    if sh_degree not in range(4):
        raise ValueError(f"rasterization: sh_degree must be 0, 1, 2 or 3, got {sh_degree}")
    if last[0] < (sh_degree + 1) ** 2 or last[1] != 3:
        raise ValueError(
            f"rasterization: colors must end in [k, 3] with k >= {(sh_degree + 1) ** 2} for sh_degree = {sh_degree}, got {list(last)}"
        )


def require_opacities(opacities: Tensor) -> None:
    """Refuse opacities that are none.

    Raises:
        ValueError: Naming the first.
    """
    good = (opacities >= 0) & (opacities <= 1)
    if not good.all():
        row = (~good).nonzero()[0].tolist()
        raise ValueError(
            f"rasterization: opacities must be in [0, 1], got {opacities[tuple(row)].item()} in row {row[-1]}"
        )


def require_positive(**numbers: int) -> None:
    """Refuse a number that counts and is not above 0.

    Raises:
        ValueError: Naming it.
    """
    for name, number in numbers.items():
        if number < 1:
            raise ValueError(f"rasterization: {name} must be above 0, got {number}")


def _require(name: str, tensor: Tensor, shapes: Sequence[tuple[int, ...]]) -> None:
    if tuple(tensor.shape) not in shapes:
        wanted = " or ".join(str(list(shape)) for shape in shapes)
        raise ValueError(
            f"rasterization: {name} must be of shape {wanted}, got {list(tensor.shape)}"
        )


def _short(value: object) -> str:
    return f"a tensor {list(value.shape)}" if isinstance(value, Tensor) else repr(value)
