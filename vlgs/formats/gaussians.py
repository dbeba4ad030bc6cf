"""Gaussians of any system, by the suffix of their file."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from vlgs.formats.checkpoint import parse_checkpoint, write_checkpoint
from vlgs.formats.compressed import write_compressed
from vlgs.formats.splat import parse_splat, write_splat
from vlgs.gaussians.parameters import complete
from vlgs.gaussians.ply import PLAIN, parse_ply, read_notes, write_ply
from vlgs.gaussians.sh import sh_to_rgb
from vlgs.gaussians.validate import drop_broken, require_sound

FORMATS: Mapping[str, tuple[str, str]] = {
    "vlgs": (".ply", "3DGS PLY with lang_* and indicator"),
    "3dgs-ply": (".ply", "3DGS PLY"),
    "feature3dgs": (".ply", "3DGS PLY with semantic_*"),
    "compressed-ply": (".compressed.ply", "PlayCanvas's compressed PLY, 16 bytes a Gaussian"),
    "splat": (".splat", "32 bytes a Gaussian; no view dependence, no language"),
    "3dgs": (".pth", "3DGS checkpoint, 12 values"),
    "langsplat": (".pth", "LangSplat checkpoint, 13 values"),
}
"""Name -> suffix and what it is."""

_CHECKPOINTS = (".pth", ".pt", ".ckpt")
_UNREAD = {
    ".spz": "Niantic's compressed Gaussians",
    ".ksplat": "mkkellogg's compressed Gaussians",
    ".sog": "PlayCanvas's compressed Gaussians",
}


@dataclass(frozen=True)
class Imported:
    """Gaussians from a file."""

    params: Mapping[str, Tensor]
    """Those of `vlgs.gaussians.STANDARD`; covariances of language's own only where the file has them."""
    has_language: bool
    """Whether the features came from the file."""
    langsplat: bool
    """Whether the file is a checkpoint of LangSplat, whose features are normalised before they are rendered."""
    dropped: Mapping[str, int]
    """What was wrong with how many rows that were left out."""
    notes: tuple[str, ...] = (PLAIN,)
    """What a file of ours says of itself; empty where it should and does not."""

    @property
    def doubt(self) -> str | None:
        """What is not known of the colours: vlgs used to write those before fusion, which no other program applies."""
        if self.notes:
            return None
        return (
            "the file does not say whether its colours and codes are those after fusion; a run of an older vlgs writes "
            "one that does when its metrics.json is deleted and its command repeated (nothing is trained again)"
        )


def read_gaussians(path: str | Path, feature_dim: int = 3, drop: bool = False) -> Imported:
    """Read a PLY of 3DGS, Feature-3DGS or ours, a ``.splat``, or a checkpoint of 3DGS or LangSplat.

    Args:
        path: The file; its suffix tells the format.
        feature_dim: Width of the language codes, all zero, where the file has none.
        drop: Leave out rows that are not finite or whose quaternion is zero, instead of refusing the file.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not of its format, or holds such rows; names the file, what is wrong and how many rows.
    """
    path = Path(path)
    if path.suffix == ".ply":
        params = parse_ply(path)
    elif path.suffix == ".splat":
        params = parse_splat(path)
    elif path.suffix in _CHECKPOINTS:
        params, _ = parse_checkpoint(path)
    elif path.suffix.lower() in _UNREAD:
        what = f"{path.name}, {_UNREAD[path.suffix.lower()]}"
        raise ValueError(
            f"gaussians: file must be .ply, .splat or {', '.join(_CHECKPOINTS)}, got {what}; "
            "SuperSplat exports it as PLY, and so does: npx @playcanvas/splat-transform IN plain.ply"
        )
    else:
        raise ValueError(
            f"gaussians: file must end in .ply, .splat or {', '.join(_CHECKPOINTS)}, got {path.name}"
        )
    params, dropped = drop_broken(params) if drop else (params, {})
    require_sound(f"{path.suffix[1:]} {path}", params)
    language = "features" in params
    in_checkpoint = path.suffix in _CHECKPOINTS
    own = path.suffix == ".ply" and "indicator_logits" in params
    notes = read_notes(path) if own else (PLAIN,)
    params = complete(params, feature_dim)
    return Imported(params, language, language and in_checkpoint, dropped, notes)


def write_gaussians(path: str | Path, imported: Imported, name: str) -> tuple[str, ...]:
    """Write Gaussians in a format of `FORMATS`.

    Returns:
        What the format has no place for and the Gaussians had.

    Raises:
        ValueError: If there is no such format, a row is broken, or the format needs language that is not there.
        OSError: If the file cannot be written.
    """
    params = imported.params
    require_sound(f"{name} {path}", params)
    if name in ("feature3dgs", "langsplat") and not imported.has_language:
        raise ValueError(f"{name} {path}: Gaussians must carry language features, got none")
    if name in ("vlgs", "3dgs-ply", "feature3dgs"):
        dialect = "3dgs" if name == "3dgs-ply" else name
        write_ply(path, params, dialect, imported.notes if name == "vlgs" else ())
    elif name == "compressed-ply":
        write_compressed(path, params)
    elif name == "splat":
        write_splat(path, params)
    elif name in ("3dgs", "langsplat"):
        write_checkpoint(path, params, language=name == "langsplat")
    else:
        raise ValueError(f"convert: format must be one of {', '.join(FORMATS)}, got {name}")
    return tuple(_lost(imported, name))


def _lost(imported: Imported, name: str) -> list[str]:
    params, lost = imported.params, []
    if name == "splat" and params["shN"].abs().sum() > 0:
        lost.append("spherical harmonics above degree 0")
    if name == "splat" and (bright := int((sh_to_rgb(params["sh0"]) > 1).any(dim=1).sum())):
        lost.append(f"colours above 1, of {bright} Gaussians")
    if name in ("splat", "compressed-ply", "3dgs-ply", "3dgs") and imported.has_language:
        lost.append("language features")
    if name != "vlgs" and not params["indicator_logits"].equal(params["opacity_logits"]):
        lost.append("indicators")
    if name == "langsplat" and (params["features"].norm(dim=1) - 1).abs().gt(1e-3).any():
        lost.append("lengths of language codes, in LangSplat's pictures")
    if name != "vlgs" and "language_quats" in params:
        lost.append("covariances of language's own")
    return lost
