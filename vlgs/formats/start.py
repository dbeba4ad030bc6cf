"""Starts a run from the Gaussians of a file (``gaussians.init``)."""

import hashlib
import logging
from pathlib import Path

from torch import Tensor
from torch.nn.functional import normalize

from vlgs.formats.gaussians import read_gaussians
from vlgs.gaussians import Attributes, conform

log = logging.getLogger(__name__)


def start_from(path: str | Path, attributes: Attributes) -> dict[str, Tensor]:
    """Raw parameters of a file for a model with these attributes; see `vlgs.gaussians.conform` for what differs.

    Codes of LangSplat checkpoints come at unit length, as LangSplat renders them.

    Args:
        path: See `vlgs.formats.read_gaussians`.
        attributes: What the Gaussians carry.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file cannot be used, or holds no Gaussian.
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
    log.info("%d Gaussians from %s", n, path)
    return conform(params, attributes)


def file_digest(path: str | Path, key: str = "init") -> str:
    """Hash of a file's content: it moves every number of the run that starts from it. `key` names it in the error.

    Raises:
        FileNotFoundError: If there is no such file.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"run: {key} must be a file, got {path}")
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "blake2b").hexdigest()[:32]
