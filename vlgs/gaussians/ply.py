"""Gaussians as a ``point_cloud.ply`` of 3DGS, with language codes and indicators appended.

Three dialects differ in what follows the rotation: ours ``lang_0`` ... and ``indicator``, Feature-3DGS ``semantic_0`` ...,
3DGS nothing. Whatever is there is read.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32
from plyfile import PlyData, PlyElement
from torch import Tensor, nn

from vlgs.data.untrusted.ply import read_vertices
from vlgs.files import write_atomically
from vlgs.gaussians.parameters import complete
from vlgs.gaussians.sound import require_sound

Dialect = Literal["vlgs", "3dgs", "feature3dgs"]

SH_COEFFICIENTS = (0, 3, 8, 15)
"""Coefficients per colour channel above degree 0, for degrees 0 to 3."""

PLAIN = "vlgs: Gaussians as they are drawn; no fusion is left to be done"
"""First note of a file that says of itself what it holds; see `write_ply`."""

_NOTES_END = 4096
"""Notes stand in the first bytes of a header, before its properties."""


def write_ply(
    path: str | Path,
    params: nn.ParameterDict | Mapping[str, Tensor],
    dialect: Dialect = "vlgs",
    notes: Sequence[str] = (),
) -> None:
    """Write raw parameters as 3DGS viewers expect them: binary little-endian, float32, logits and logarithms.

    Language codes follow as ``lang_0`` ..., the indicator's logit as ``indicator`` (one per mask level as ``indicator_0`` ...),
    language's own covariances, where there are any, as ``language_scale_0`` ... and ``language_rot_0`` ...; readers that look
    properties up by name pass over them. The file is complete or the one before stays.

    Args:
        path: The file; its folder must exist.
        params: The keys of `vlgs.gaussians.PARAMETERS`.
        dialect: ``3dgs`` leaves language out, ``feature3dgs`` calls the codes ``semantic_0`` ... and leaves the indicator out.
        notes: ASCII lines for the header, `PLAIN` first; without it, nobody knows whether the parameters wait for a fusion.

    Raises:
        ValueError: If a value is not finite or a quaternion is zero; names the parameter and how many rows.
        OSError: If the file cannot be written.
    """
    columns = {name: value.detach().to(torch.float32) for name, value in params.items()}
    require_sound(f"ply {path}", columns)
    named: list[tuple[str, Tensor]] = []
    _append(named, ("x", "y", "z"), columns["means"])
    _append(named, ("nx", "ny", "nz"), torch.zeros_like(columns["means"]))
    _append(named, _numbered("f_dc", 3), columns["sh0"])
    rest = columns["shN"].transpose(1, 2).flatten(1)  # all of red, then green, then blue
    _append(named, _numbered("f_rest", rest.shape[1]), rest)
    _append(named, ("opacity",), columns["opacity_logits"][:, None])
    _append(named, _numbered("scale", 3), columns["log_scales"])
    _append(named, _numbered("rot", 4), columns["quats"])
    if dialect != "3dgs":
        stem = "lang" if dialect == "vlgs" else "semantic"
        _append(named, _numbered(stem, columns["features"].shape[1]), columns["features"])
    if dialect == "vlgs":
        logits = columns["indicator_logits"]
        if logits.dim() == 1:
            _append(named, ("indicator",), logits[:, None])
        else:
            _append(named, _numbered("indicator", logits.shape[1]), logits)
        if "language_quats" in columns:
            _append(named, _numbered("language_scale", 3), columns["language_log_scales"])
            _append(named, _numbered("language_rot", 4), columns["language_quats"])
    vertices = np.empty(len(columns["means"]), dtype=[(name, "<f4") for name, _ in named])
    for name, column in named:
        vertices[name] = column.numpy()
    stream = io.BytesIO()
    element = PlyElement.describe(vertices, "vertex")
    PlyData([element], byte_order="<", comments=notes).write(stream)
    write_atomically(Path(path), stream.getvalue())


def read_ply(path: str | Path, feature_dim: int = 3) -> dict[str, Tensor]:
    """Raw parameters of a 3DGS file of any spherical harmonics degree, keyed by `vlgs.gaussians.PARAMETERS`.

    Properties are looked up by name. Without an indicator the opacity's logit takes its place.

    Args:
        path: The file.
        feature_dim: Width of the language codes, all zero, where the file has none.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a PLY file, is cut short, lacks a property, or holds a value that is not finite or a
            quaternion that is zero; names the file and what is wrong.
    """
    params = complete(parse_ply(path), feature_dim)
    require_sound(f"ply {path}", params)
    return params


def read_notes(path: str | Path) -> tuple[str, ...]:
    """The notes that `write_ply` put into a file; empty if the first is not `PLAIN`."""
    with Path(path).open("rb") as file:
        header, _, _ = file.read(_NOTES_END).partition(b"end_header")
    lines = header.decode("ascii", errors="replace").split("\n")
    notes = tuple(line.removeprefix("comment ") for line in lines if line.startswith("comment "))
    ours = notes[:1] == (PLAIN,) and all(note.isascii() and note.isprintable() for note in notes)
    return notes if ours else ()


def parse_ply(path: str | Path) -> dict[str, Tensor]:
    """The `vlgs.gaussians.PARAMETERS` of a file, not yet checked; `features` and `indicator_logits` may be missing.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a PLY file, is cut short or lacks a property.
    """
    path = Path(path)
    vertices = read_vertices(path)
    present = set(vertices)
    if "packed_position" in present:
        raise ValueError(
            f"ply {path}: must be uncompressed, got the compressed.ply of PlayCanvas and SuperSplat; export it as PLY "
            "there, or: npx @playcanvas/splat-transform IN plain.ply"
        )
    count = len(next(iter(vertices.values()), ()))
    n_rest = sum(name.startswith("f_rest_") for name in present)
    if n_rest not in [3 * count for count in SH_COEFFICIENTS]:
        raise ValueError(f"ply {path}: f_rest properties must be 0, 9, 24 or 45, got {n_rest}")
    stem = "lang" if "lang_0" in present else "semantic"
    n_lang = sum(name.startswith(f"{stem}_") for name in present)

    def take(*names: str) -> Float32[Tensor, "n c"]:
        columns = np.empty((count, len(names)), np.float32)
        for index, name in enumerate(names):
            if name not in present:
                raise ValueError(
                    f"ply {path}: vertex must have the numeric property {name}, got none"
                )
            # A double beyond float32 becomes inf, which is refused below.
            with np.errstate(over="ignore"):
                columns[:, index] = vertices[name]
        return torch.from_numpy(columns)

    params = {
        "means": take("x", "y", "z"),
        "quats": take(*_numbered("rot", 4)),
        "log_scales": take(*_numbered("scale", 3)),
        "sh0": take(*_numbered("f_dc", 3)),
        "shN": take(*_numbered("f_rest", n_rest)).unflatten(1, (3, n_rest // 3)).mT.contiguous(),
        "opacity_logits": take("opacity")[:, 0],
    }
    if "indicator" in present:
        params["indicator_logits"] = take("indicator")[:, 0]
    elif "indicator_0" in present:
        n_levels = sum(name.startswith("indicator_") for name in present)
        params["indicator_logits"] = take(*_numbered("indicator", n_levels))
    if n_lang:
        params["features"] = take(*_numbered(stem, n_lang))
    if "language_rot_0" in present:
        params["language_quats"] = take(*_numbered("language_rot", 4))
        params["language_log_scales"] = take(*_numbered("language_scale", 3))
    return params


def _numbered(stem: str, count: int) -> tuple[str, ...]:
    return tuple(f"{stem}_{index}" for index in range(count))


def _append(named: list[tuple[str, Tensor]], names: tuple[str, ...], values: Tensor) -> None:
    named.extend(zip(names, values.unbind(1), strict=True))
