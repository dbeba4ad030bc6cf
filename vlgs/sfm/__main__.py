"""Command line: a folder of photographs in, a scene with cameras out."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from vlgs.arguments import command_line
from vlgs.data.diagnostics import listing
from vlgs.sfm.compare import compare_poses
from vlgs.sfm.reconstruct import ADVICE, SfmOptions, reconstruct
from vlgs.sfm.result import Reconstruction

_FEW = 0.9
"""Share of registered photographs below which advice is given."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Reconstruct and say what came of it; exit status 1 and one message where nothing did, 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(
        prog="python -m vlgs.sfm",
        description="Cameras from photographs alone (COLMAP: SIFT on the CPU, matching, incremental mapping). "
        "OUT becomes a scene for data=colmap; an interrupted run goes on with the same command.",
    )
    parser.add_argument("images", type=Path, help="folder of photographs")
    parser.add_argument(
        "out", type=Path, help="folder of the scene, to be made; what is finished there is reported"
    )
    default = SfmOptions()
    parser.add_argument(
        "--matching",
        choices=("auto", "exhaustive", "sequential"),
        default=default.matching,
        help="every pair, or neighbours by name as in a video; auto: every pair up to 120 photographs",
    )
    parser.add_argument(
        "--overlap", type=int, default=default.overlap, help="neighbours (%(default)s)"
    )
    parser.add_argument(
        "--camera", default=default.camera_model, help="COLMAP's camera model (%(default)s)"
    )
    parser.add_argument(
        "--single-camera",
        action=argparse.BooleanOptionalAction,
        help="whether one camera took them all (default: those of one size, with one camera and focal length in EXIF)",
    )
    parser.add_argument(
        "--max-size", type=int, default=default.max_size, help="pixels (%(default)s)"
    )
    parser.add_argument(
        "--max-features", type=int, default=default.max_features, help="(%(default)s)"
    )
    parser.add_argument(
        "--undistort",
        action="store_true",
        help="write pinhole photographs, for other programs (vlgs undistorts what it reads)",
    )
    parser.add_argument("--threads", type=int, default=default.threads, help="(%(default)s)")
    parser.add_argument("--seed", type=int, default=default.seed, help="(%(default)s)")
    parser.add_argument(
        "--reference",
        type=Path,
        help="scene with known cameras of these photographs to compare with",
    )
    args = vars(parser.parse_args(arguments))
    images, out, reference = args.pop("images"), args.pop("out"), args.pop("reference")
    console = Console(soft_wrap=True, highlight=False, markup=False, emoji=False)
    try:
        options = SfmOptions(camera_model=args.pop("camera"), **args)
        _report(console, out, reconstruct(images, out, options, console))
        if reference is not None:
            errors = compare_poses(out, reference)
            console.print(
                f"against {reference}: {errors.common} cameras, centres {np.median(errors.centers):.2%} of their spread "
                f"(worst {errors.centers.max():.2%}), {np.median(errors.degrees):.2f} degrees (worst {errors.degrees.max():.2f})"
            )
    except KeyboardInterrupt:
        print("stopped; the same command goes on from there", file=sys.stderr)
        sys.exit(130)
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")


def _report(console: Console, out: Path, result: Reconstruction) -> None:
    console.print(
        f"{result.registered} of {result.photographs} photographs registered, {result.points} points, "
        f"{result.reprojection_error:.2f} pixels mean reprojection error: {out}"
    )
    if result.apart:
        console.print(
            f"warning: {sum(result.apart)} more fit together (parts of {listing(map(str, result.apart))}), but not with these; they "
            "are left out, as nothing says how the parts lie to each other",
            style="yellow",
        )
    if result.cameras > result.devices:
        console.print(
            f"warning: {result.cameras} cameras were calibrated, but by size and EXIF {result.devices} took the photographs; "
            f"{'--single-camera' if result.devices == 1 else 'without --no-single-camera it'} is more exact",
            style="yellow",
        )
    if result.registered < _FEW * result.photographs:
        console.print(f"warning: no camera for {listing(result.missing)}; {ADVICE}", style="yellow")
    console.print(f"next: {command_line('vlgs.check', ['data=colmap', f'data.root={out}'])}")


if __name__ == "__main__":
    main()
