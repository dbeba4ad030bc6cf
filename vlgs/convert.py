"""From one format to another: `python -m vlgs.convert IN OUT`; see `--help`."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from vlgs.data.sparse import AT_HOME, find_sparse, read_cameras, subtracted, write_transforms
from vlgs.data.sparse.model import SparseModel
from vlgs.data.sparse.write import write_colmap
from vlgs.formats import (
    FORMATS,
    compress_language,
    read_autoencoder,
    read_gaussians,
    write_autoencoder,
    write_gaussians,
)
from vlgs.runs import RunFolder

_HELP = """Formats, by suffix; --as says which where a suffix has several:

  Gaussians     IN .ply .splat .pth, or the folder of a run -> OUT {gaussians}
  autoencoder   IN best_ckpt.pth -> OUT .safetensors (ours), or back
  language      IN language_features/ --head best_ckpt.pth -> OUT language_features_dim3/
  cameras       IN a scene's folder (COLMAP) or transforms.json -> OUT transforms.json, or a folder for COLMAP's files

Rows that are not finite or have no rotation are counted, and refuse the file; --drop leaves them out."""
_COLMAP = ("colmap", "colmap-text")
_COMPRESSED = FORMATS["compressed-ply"][0]


def main(arguments: list[str] | None = None) -> None:
    """Convert one file or folder; exit status 1 with one line if it cannot be done."""
    gaussians = ", ".join(f"{suffix} ({name})" for name, (suffix, _) in FORMATS.items())
    parser = argparse.ArgumentParser(
        prog="python -m vlgs.convert",
        description=__doc__,
        epilog=_HELP.format(gaussians=gaussians),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("source", type=Path, metavar="IN")
    parser.add_argument("target", type=Path, metavar="OUT")
    names = [*FORMATS, *_COLMAP]
    parser.add_argument("--as", dest="name", choices=names, help="format of OUT")
    parser.add_argument("--head", type=Path, help="autoencoder that makes codes of language maps")
    parser.add_argument("--codec", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--drop", action="store_true", help="leave broken Gaussians out")
    given = parser.parse_args(arguments)
    if given.codec is not None:
        parser.error(f"--codec must be given as --head, its new name, got --codec {given.codec}")
    try:
        for line in convert(given.source, given.target, given.name, given.head, given.drop):
            sys.stdout.write(f"{line}\n")
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")


def convert(
    source: Path,
    target: Path,
    name: str | None = None,
    head: Path | None = None,
    drop: bool = False,
) -> list[str]:
    """Read, write, and say in a few lines what was done and what was lost.

    Raises:
        FileNotFoundError: If there is no source.
        ValueError: If the two do not fit together, or the source is damaged.
        OSError: If the target cannot be written.
    """
    if not source.exists():
        raise FileNotFoundError(f"convert: IN must exist, got {source}")
    if source.resolve() == target.resolve():
        raise ValueError(f"convert: OUT must be another path than IN, got {target}")
    if head is not None:
        _require_unused("language maps", name, drop)
        count = compress_language(source, target, read_autoencoder(head))
        return [f"{target}: language codes of {count} views"]
    if _is_run(source):
        cloud, lines = _point_cloud_of(source)
        moved = _moved(source)
        return lines + _convert_gaussians(cloud, target, name, drop) + moved
    if source.is_dir() or source.suffix == ".json":
        return _convert_cameras(source, target, name, drop)
    if source.suffix == ".safetensors" or target.suffix == ".safetensors":
        _require_unused("an autoencoder", name, drop)
        return _convert_autoencoder(source, target)
    return _convert_gaussians(source, target, name, drop)


def _require_unused(what: str, name: str | None, drop: bool, names: Sequence[str] = ()) -> None:
    """Refuse options that mean nothing for what is written; `names` are the formats that there are of it."""
    if drop:
        raise ValueError(f"convert: --drop must go with Gaussians, got {what}")
    if name is not None and name not in names:
        expected = f"be {' or '.join(names)}" if names else "not be given"
        raise ValueError(f"convert: --as must {expected} for {what}, got {name}")


def _is_run(source: Path) -> bool:
    run = RunFolder(source)
    return (run.config.is_file() or run.ply.is_file()) and find_sparse(source) is None


def _point_cloud_of(folder: Path) -> tuple[Path, list[str]]:
    """The Gaussians that a run's pictures show, and, where it has several models, a line that says which these are."""
    found = sorted(folder.rglob(RunFolder(folder).ply.name))
    # Colour lies apart with sharing=none; with levels=separate the pictures show the last level, of whole objects.
    colored = [path for path in found if path.parent.name != "language"]
    if not colored:
        what = "must have a point_cloud.ply, got none; the command of the run finishes it"
        raise FileNotFoundError(f"convert: run {folder} {what}")
    chosen = colored[-1]
    others = ", ".join(str(path.relative_to(folder)) for path in found if path != chosen)
    says = f"from {chosen.relative_to(folder)}; the run also has {others}"
    return chosen, [says] if others else []


def _moved(folder: Path) -> list[str]:
    """That positions of a run are not those of its scene's files, where they are not."""
    from vlgs.opened.files import read_scene

    run = RunFolder(folder)
    origin = read_scene(run).origin if run.scene.is_file() else AT_HOME  # version 0.1 wrote none
    return [] if origin == AT_HOME else [f"beware: {subtracted(origin)}"]


def _convert_gaussians(source: Path, target: Path, name: str | None, drop: bool) -> list[str]:
    compressed = target.name.lower().endswith(_COMPRESSED)
    ending = _COMPRESSED if compressed else target.suffix
    matching = [key for key, (suffix, _) in FORMATS.items() if suffix == ending]
    if name is None and not matching:
        suffixes = ", ".join(dict.fromkeys(suffix for suffix, _ in FORMATS.values()))
        raise ValueError(f"convert: OUT must end in {suffixes}, got {target.name}")
    if name is None and len(matching) > 1 and ending != ".ply":
        raise ValueError(
            f"convert: OUT needs --as {' or '.join(matching)}, got {target.name} alone"
        )
    if name is not None and name not in matching:
        suffix = FORMATS[name][0] if name in FORMATS else "nothing, as cameras do,"
        raise ValueError(f"convert: OUT must end in {suffix} for --as {name}, got {target}")
    read = read_gaussians(source, drop=drop)
    if name is None and ending == ".ply":
        name = "vlgs" if read.has_language else "3dgs-ply"
    name = name or matching[0]
    lost = write_gaussians(target, read, name)
    lines = [f"{target}: {len(read.params['means'])} Gaussians as {FORMATS[name][1]}"]
    lines += [f"left out: {count} rows, {what}" for what, count in read.dropped.items()]
    lines += [f"not kept: {what}" for what in lost]
    return lines + ([f"beware: {read.doubt}"] if read.doubt else [])


def _convert_autoencoder(source: Path, target: Path) -> list[str]:
    from safetensors.torch import save

    from vlgs.files import write_atomically

    head = read_autoencoder(source)
    if target.suffix == ".safetensors":
        write_atomically(target, save(head.state_dict()))
    else:
        write_autoencoder(target, head)
    return [f"{target}: autoencoder {head.mean.shape[0]} -> {head.dim}"]


def _convert_cameras(source: Path, target: Path, name: str | None, drop: bool) -> list[str]:
    model = read_cameras(source)
    beware = []
    if target.suffix == ".json":
        _require_unused("cameras in a .json", name, drop)
        images = _images_of(source, model)
        if images is None:
            beware = ["beware: no photographs found; their paths are images/NAME, beside the file"]
        beside = "images" if images is None else os.path.relpath(images, target.parent.resolve())
        write_transforms(target, model, Path(beside).as_posix())
    else:
        _require_unused("cameras", name, drop, _COLMAP)
        if target.suffix.lower() in {suffix for suffix, _ in FORMATS.values()}:
            what = "must be a .json or a folder for cameras"
            raise ValueError(f"convert: OUT {what}, got {target.name}, a file of Gaussians")
        write_colmap(target, model, text=name == "colmap-text")
    return [f"{target}: {len(model.images)} images, {len(model.points)} points", *beware]


def _images_of(source: Path, model: SparseModel) -> Path | None:
    """The folder of a scene's photographs: beside its cameras, or beside the folders that COLMAP's files lie in."""
    folder = (source if source.is_dir() else source.parent).resolve()
    for above in (folder, *folder.parents[:2]):
        for images in (above / "images", above):
            if model.images and (images / model.images[0].name).is_file():
                return images
    return None


if __name__ == "__main__":
    main()
