"""The 32-byte ``.splat`` rows that web viewers read: position, scale, colour with opacity, rotation; no view dependence.

    3 float32 position, 3 float32 scale, 4 uint8 red green blue opacity, 4 uint8 rotation w x y z as 128 + 128 q

What a row keeps: positions bit for bit, scales to 2e-6 (we hold their logarithms), colour and opacity to 1/510, each component of the unit
quaternion to 1/256 (a component of +1 to 1/128). Colours outside [0, 1] are clipped. Rows are in the order of the Gaussians.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from vlgs.data.untrusted import read_bytes
from vlgs.files import write_atomically
from vlgs.gaussians.sh import rgb_to_sh, sh_to_rgb

_ROW = np.dtype([("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_QUARTER = 0.25 / 255
"""Opacities of 0 and 255 have no finite logit; this far inside they still round back to themselves."""
_UNIT = 0.02
"""A quaternion this close to unit length is one that was quantised: scaling it again would move its bytes."""


def parse_splat(path: str | Path) -> dict[str, Tensor]:
    """What a file holds of `vlgs.gaussians.STANDARD`, not yet judged.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If its length is not that of whole rows.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"splat {path}: file must exist, got none")
    data = read_bytes(path)
    if len(data) % _ROW.itemsize:
        left = len(data) % _ROW.itemsize
        what = f"must be rows of {_ROW.itemsize} bytes, got {len(data)} bytes"
        raise ValueError(f"splat {path}: {what}, {left} too many at byte {len(data) - left}")
    rows = np.frombuffer(data, _ROW)
    rgba = torch.from_numpy(rows["rgba"].astype(np.float64)) / 255
    alpha = rgba[:, 3].clamp(_QUARTER, 1 - _QUARTER)
    with np.errstate(
        divide="ignore", invalid="ignore"
    ):  # a scale of 0 is told as what is not finite
        log_scales = np.log(rows["scale"].astype(np.float64)).astype(np.float32)
    return {
        "means": torch.from_numpy(rows["xyz"].copy()),
        "quats": torch.from_numpy((rows["quat"].astype(np.float32) - 128) / 128),
        "log_scales": torch.from_numpy(log_scales),
        "sh0": rgb_to_sh(rgba[:, :3]).float(),
        "shN": torch.zeros(len(rows), 0, 3),
        "opacity_logits": alpha.logit().float(),
    }


def write_splat(path: str | Path, params: Mapping[str, Tensor]) -> None:
    """Write what the format keeps of raw parameters that are sound.

    Raises:
        ValueError: If a scale does not fit float32.
        OSError: If the file cannot be written.
    """
    rows = np.zeros(len(params["means"]), _ROW)
    scales = params["log_scales"].detach().double().exp().float()
    if not (scales.isfinite() & (scales > 0)).all():
        bad = int((~(scales.isfinite() & (scales > 0))).any(dim=1).sum())
        what = f"scales must fit float32, got {bad} of {len(scales)} rows that do not"
        raise ValueError(f"splat {path}: {what}")
    quats = params["quats"].detach().double()
    norms = quats.norm(dim=1, keepdim=True)
    quats = torch.where((norms - 1).abs() <= _UNIT, quats, quats / norms)
    opacity = params["opacity_logits"].detach().double().sigmoid()[:, None]
    rgba = torch.cat([sh_to_rgb(params["sh0"].detach().double()), opacity], dim=1)
    rows["xyz"], rows["scale"] = params["means"].detach().float(), scales
    rows["rgba"] = (rgba * 255).round().clamp(0, 255).byte()
    rows["quat"] = (quats * 128 + 128).round().clamp(0, 255).byte()
    write_atomically(Path(path), rows.tobytes())
