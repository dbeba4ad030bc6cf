"""Gaussians as a ``point_cloud.ply`` of 3DGS, with language codes and indicators appended.

Three dialects differ in what follows the rotation: ours ``lang_0`` ... and ``indicator``, Feature-3DGS ``semantic_0`` ...,
3DGS nothing. Whatever is there is read.
"""

import io
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from vlgs.data.untrusted.ply import read_vertices
from vlgs.files import write_atomically
from vlgs.gaussians.attributes import (
    LANGUAGE_SHAPE,
    STANDARD,
    THREE_DGS,
    Attribute,
    Attributes,
)
from vlgs.gaussians.parameters import Parameters, complete
from vlgs.gaussians.validate import require_sound

Dialect = Literal["vlgs", "3dgs", "feature3dgs"]

SH_COEFFICIENTS = (0, 3, 8, 15)
"""Coefficients per colour channel above degree 0, for degrees 0 to 3."""

PLAIN = "vlgs: Gaussians as they are drawn; no fusion is left to be done"
"""First note of a file that says of itself what it holds; see `write_ply`."""

_NOTES_END = 4096
"""Notes stand in the first bytes of a header, before its properties."""


def write_ply(
    path: str | Path,
    params: Parameters,
    dialect: Dialect = "vlgs",
    notes: Sequence[str] = (),
) -> None:
    """Write what `encode_ply` makes of raw parameters. The file is complete or the one before stays.

    Args:
        path: The file; its folder must exist.
        params: See `encode_ply`.
        dialect: Likewise.
        notes: Likewise.

    Raises:
        ValueError: See `encode_ply`.
        OSError: If the file cannot be written.
    """
    write_atomically(Path(path), encode_ply(params, dialect, notes, who=f"ply {path}"))


def encode_ply(
    params: Parameters,
    dialect: Dialect = "vlgs",
    notes: Sequence[str] = (),
    who: str = "ply",
) -> bytes:
    """Raw parameters as 3DGS viewers expect them: binary little-endian, float32, logits and logarithms.

    Language codes follow as ``lang_0`` ..., the indicator's logit as ``indicator`` (one per mask level as ``indicator_0`` ...),
    language's own covariances, where there are any, as ``language_scale_0`` ... and ``language_rot_0`` ..., what `STANDARD` does not
    have under its own name; readers that look properties up by name pass over them.

    Args:
        params: Raw parameters.
        dialect: ``3dgs`` leaves out what 3DGS does not have, ``feature3dgs`` all of that but the codes, which it calls ``semantic_0`` ...
        notes: ASCII lines for the header, `PLAIN` first; without it, nobody knows whether the parameters wait for a fusion.
        who: Begins an error.

    Raises:
        ValueError: If a value is not finite or a quaternion is zero; names the parameter and how many rows.
    """
    columns = {name: value.detach().to(torch.float32) for name, value in params.items()}
    require_sound(who, columns)
    named: dict[str, Tensor] = {}
    for name, row in _in_dialect(columns, dialect).items():
        if name not in columns:
            continue
        value = columns[name]
        if value.dim() == 3:  # harmonics: all of red, then green, then blue
            value = value.mT.flatten(1)
        names = row.column_names(None if value.dim() == 1 else value.shape[1])
        named |= zip(names, value.reshape(len(value), len(names)).unbind(1), strict=True)
        if name == "means":  # 3DGS's normals, which nobody reads
            named |= dict.fromkeys(("nx", "ny", "nz"), torch.zeros(len(value)))
    vertices = np.empty(len(columns["means"]), dtype=[(name, "<f4") for name in named])
    for name, column in named.items():
        vertices[name] = column.numpy()
    stream = io.BytesIO()
    element = PlyElement.describe(vertices, "vertex")
    PlyData([element], byte_order="<", comments=notes).write(stream)
    return stream.getvalue()


def _in_dialect(names: Collection[str], dialect: Dialect) -> Attributes:
    """The rows that a dialect writes, in its order."""
    if dialect == "vlgs":
        further = {name: Attribute(name, None, name) for name in names if name not in STANDARD}
        return {**STANDARD, **further}
    kept = {name: STANDARD[name] for name in THREE_DGS}
    if dialect == "feature3dgs":
        kept["features"] = replace(STANDARD["features"], columns="semantic")
    return kept


def read_ply(path: str | Path, feature_dim: int = 3) -> dict[str, Tensor]:
    """Raw parameters of a 3DGS file of any spherical harmonics degree, by the names of `vlgs.gaussians.STANDARD`.

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


def parse_ply(path: str | Path, attributes: Attributes = STANDARD) -> dict[str, Tensor]:
    """What a file holds of a table of attributes, not yet checked; those that 3DGS does not have may be missing.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a PLY file, is cut short or lacks a property.
    """
    path = Path(path)
    vertices = read_vertices(path)
    if "packed_position" in vertices:
        raise ValueError(
            f"ply {path}: must be uncompressed, got the compressed.ply of PlayCanvas and SuperSplat; export it as PLY "
            "there, or: npx @playcanvas/splat-transform IN plain.ply"
        )
    count = len(next(iter(vertices.values()), ()))
    n_rest = _numbered(vertices, "f_rest")
    if n_rest not in [3 * count for count in SH_COEFFICIENTS]:
        raise ValueError(f"ply {path}: f_rest properties must be 0, 9, 24 or 45, got {n_rest}")
    if "lang_0" not in vertices:
        attributes = {**attributes, "features": replace(attributes["features"], columns="semantic")}
    params = {}
    for name, row in attributes.items():
        names = _columns_of(replace(row, shape=STANDARD.get(name, row).shape), vertices)
        if names is None:
            continue
        columns = np.empty((count, len(names)), np.float32)
        for index, column in enumerate(names):
            if column not in vertices:
                raise ValueError(
                    f"ply {path}: vertex must have the numeric property {column}, got none"
                )
            # A double beyond float32 becomes inf, which is refused below.
            with np.errstate(over="ignore"):
                columns[:, index] = vertices[column]
        value = torch.from_numpy(columns)
        if name == "shN":
            value = value.unflatten(1, (3, n_rest // 3)).mT.contiguous()
        params[name] = value[:, 0] if names == (row.columns,) else value
    return params


def _columns_of(row: Attribute, present: Collection[str]) -> tuple[str, ...] | None:
    """The properties that a file has, or must have, of an attribute; None where it need not and has not."""
    own_shape = row.name in LANGUAGE_SHAPE and "language_rot_0" in present
    required = row.name in THREE_DGS or own_shape
    if isinstance(row.columns, tuple) or row.shape == ():
        names = row.column_names(None)
    elif row.shape is None:
        single = row.columns in present
        names = row.column_names(None if single else _numbered(present, row.columns))
    else:
        names = row.column_names(row.shape[0])
    there = row.name not in LANGUAGE_SHAPE and bool(names) and names[0] in present
    return names if required or there else None


def _numbered(present: Collection[str], stem: str) -> int:
    """How many properties are called ``stem_0``, ``stem_1`` ...; ``stem_noise_0`` is another attribute's."""
    start = f"{stem}_"
    return sum(n.startswith(start) and n.removeprefix(start).isdigit() for n in present)
