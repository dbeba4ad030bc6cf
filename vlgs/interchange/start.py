"""Starts a run from the Gaussians of a file (``gaussians.init``)."""

import hashlib
import logging
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.gaussians.config import GaussiansConfig
from vlgs.interchange.gaussians import read_gaussians

log = logging.getLogger(__name__)


def start_from(path: str | Path, config: GaussiansConfig, feature_dim: int) -> dict[str, Tensor]:
    """Raw parameters of a file for a model that stores `config.degree` and codes of `feature_dim`.

    Spherical harmonics are cut or filled with zeros. Language codes of another width start at zero. Those of LangSplat
    checkpoints come at unit length, as LangSplat renders them.

    Args:
        path: See `vlgs.interchange.read_gaussians`.
        config: What the Gaussians carry.
        feature_dim: Width d of the codec.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file cannot be used, or holds no Gaussian.
    """
    read = read_gaussians(path, feature_dim)
    if read.doubt:
        log.warning("%s: %s", path, read.doubt)
    params = dict(read.params)
    n = len(params["means"])
    if n == 0:
        raise ValueError(f"gaussians: init {path} must hold Gaussians, got none")
    coefficients = (config.degree + 1) ** 2 - 1
    rest = torch.zeros(n, coefficients, 3)
    shared = min(coefficients, params["shN"].shape[1])
    rest[:, :shared] = params["shN"][:, :shared]
    params["shN"] = rest
    width = params["features"].shape[1]
    if read.langsplat:
        params["features"] = normalize(params["features"], dim=1, eps=1e-9)
    if width != feature_dim:
        log.warning(
            "%s: language codes of width %d start at zero (codec: %d)", path, width, feature_dim
        )
        params["features"] = torch.zeros(n, feature_dim)
    log.info("%d Gaussians from %s", n, path)
    return params


def file_digest(path: str | Path, key: str = "init") -> str:
    """Hash of a file's content: it moves every number of the run that starts from it. `key` names it in the error.

    Raises:
        FileNotFoundError: If there is no such file.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"run: {key} must be a file, got {path}")
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "blake2b").hexdigest()[:32]
