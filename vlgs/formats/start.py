"""Starts a run from the Gaussians of a file (``gaussians.init``)."""

import hashlib
import json
import logging
from pathlib import Path

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.formats.gaussians import read_gaussians
from vlgs.gaussians import Attributes, conform
from vlgs.gaussians.attributes import Attribute

log = logging.getLogger(__name__)

_ROUNDING = 1e-4
"""By how much the sum of weights may differ from 1."""
_NOTHING = -100.0
"""Logarithm of a weight of 0: its exponential is nothing beside the others'."""


def start_from(path: str | Path, attributes: Attributes) -> dict[str, Tensor]:
    """Raw parameters of a file for a model with these attributes; see `vlgs.gaussians.conform` for what differs.

    Codes of LangSplat checkpoints come at unit length, as LangSplat renders them. Files have codes as they are drawn: where these are weights of a
    codebook (``gaussians.codes=sparse``) training goes on from their logarithms.

    Args:
        path: See `vlgs.formats.read_gaussians`.
        attributes: What the Gaussians carry.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file cannot be used, holds no Gaussian, or has codes that are no weights where these are wanted.
    """
    shape = attributes["features"].shape
    assert shape is not None  # a training's table has them all
    read = read_gaussians(path, shape[0])
    if read.doubt:
        log.warning("%s: %s", path, read.doubt)
    params = dict(read.params)
    n = len(params["means"])
    if n == 0:
        raise ValueError(f"gaussians: init {path} must hold Gaussians, got none")
    width = params["features"].shape[1]
    if read.langsplat:
        params["features"] = normalize(params["features"], dim=1, eps=1e-9)
    if width != shape[0]:
        log.warning(
            "%s: language codes of width %d start at zero (head: %d)", path, width, shape[0]
        )
    elif attributes["features"].activation == "sparse" and params["features"].any():
        params["features"] = _logits(params["features"], attributes["features"], path)
        log.warning("%s: language codes start as logarithms of the weights in the file", path)
    log.info("%d Gaussians from %s", n, path)
    return conform(params, attributes)


def _logits(codes: Float[Tensor, "n d"], row: Attribute, path: str | Path) -> Float[Tensor, "n d"]:
    """What the activation ``sparse`` makes these codes of.

    Raises:
        ValueError: If they are not what it makes of anything.
    """
    each = codes.unflatten(1, (row.parts, -1))
    weights = (each >= 0).all(-1) & ((each > 0).sum(-1) <= row.kept)
    weights &= (each.sum(-1) - 1).abs() <= _ROUNDING
    if not weights.all():
        raise ValueError(
            f"gaussians: init {path} must hold weights of at most {row.kept} entries that add up to 1 with gaussians.codes=sparse, "
            f"got other codes in {int((~weights).any(1).sum())} of {len(codes)} Gaussians"
        )
    return codes.log().clamp_min(_NOTHING)


def file_digest(path: str | Path, key: str = "init") -> str:
    """Hash of a file's content: it moves every number of the run that starts from it. `key` names it in the error.

    Raises:
        FileNotFoundError: If there is no such file.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"run: {key} must be a file, got {path}")
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "blake2b").hexdigest()[:32]


def folder_digest(path: str | Path, key: str) -> str:
    """Hash of the names and contents of all files in a folder, wherever it lies. `key` names it in the error.

    Raises:
        FileNotFoundError: If there is no such folder.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise FileNotFoundError(f"run: {key} must be a folder, got {path}")
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    read = [[name, file_digest(folder / name, key)] for name in names]
    return hashlib.blake2b(json.dumps(read).encode(), digest_size=16).hexdigest()
