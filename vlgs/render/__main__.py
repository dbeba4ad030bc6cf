"""Render a trained scene: `python -m vlgs.render RUN --cameras orbit --format mp4`; see `--help`."""

import argparse
import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vlgs.names import file_names
from vlgs.opened.commands import add_words, command, new_parser, opened
from vlgs.values import require_choice, require_range

if TYPE_CHECKING:
    from vlgs.opened.cameras import CameraPath
    from vlgs.render.outputs import Frame, Renderer

FORMATS = ("png", "npy", "mp4")
_FPS = 24.0

_HELP = """Outputs: color; depth (camera z, in units of the scene); alpha; language (feature colours); relevancy:WORD.

Cameras: train or test (those of the photographs), the name of a photograph, orbit (around what the cameras look at), or a file in the world of
the scene's own cameras: a camera path of nerfstudio's viewer, a transforms.json, or a folder of COLMAP's.

Formats: png (a picture per frame); npy (the numbers per frame, float32: RGB in [0, 1], depth, alpha, codes, relevancy); mp4 (a video per
output; pip install 'vlgs[video]'). Pictures of depth, features and relevancy mean the same in every frame: their bounds come from held-out
photographs' cameras. Written as OUT/OUTPUT/FRAME.png and OUT/OUTPUT.mp4."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Render; exit status 1 and one line where that cannot be."""
    parser = new_parser("vlgs.render", __doc__, _HELP)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run, finished or not")
    parser.add_argument("--outputs", default="color", help="with commas between them (%(default)s)")
    parser.add_argument("--cameras", default="test", help="see below (%(default)s)")
    parser.add_argument(
        "--format",
        default="png",
        help=f"{', '.join(FORMATS)}, with commas between them (%(default)s)",
    )
    parser.add_argument("--out", type=Path, help="folder to write to (RUN/rendered)")
    parser.add_argument("--size", metavar="WxH", help="of the pictures (that of the cameras)")
    parser.add_argument("--frames", type=int, default=120, help="of an orbit (%(default)s)")
    parser.add_argument("--fps", type=float, help="of a video (that of the file, or 24)")
    parser.add_argument(
        "--depth", default="expected", help="expected, the mean, or median (%(default)s)"
    )
    parser.add_argument("--level", type=int, help="mask level of language, 1 to 3 (the last)")
    add_words(parser)
    args = parser.parse_args(arguments)
    with command():
        render(args)


def render(args: argparse.Namespace) -> None:
    """Do what the command line says.

    Raises:
        ValueError: If something that was asked for cannot be.
        OSError: If a file cannot be read or written.
    """
    formats = _listed(args.format)
    for one in formats or [args.format]:
        require_choice("render", "format", one, FORMATS)
    require_choice("render", "depth", args.depth, ("expected", "median"))
    require_range("render", 1e-3, 1e3, fps=args.fps)
    run = opened(args)
    from vlgs.opened.cameras import cameras_of
    from vlgs.render.outputs import Renderer

    path = _sized(cameras_of(run, args.cameras, args.frames), args.size)
    renderer = Renderer(run, _listed(args.outputs), args.level, args.depth)
    out = args.out or args.run / "rendered"
    out.mkdir(parents=True, exist_ok=True)
    for line in _render(renderer, path, out, formats, args.fps or path.fps or _FPS):
        sys.stdout.write(f"{line}\n")


def _render(
    renderer: "Renderer", path: "CameraPath", out: Path, formats: Sequence[str], fps: float
) -> list[str]:
    """Every frame in every format; returns what was written, in lines."""
    from rich.console import Console
    from rich.progress import track

    from vlgs.render.video import Video

    outputs = file_names(renderer.outputs)
    names = file_names(one.name for one in path.frames)
    videos = {o: Video(out / f"{outputs[o]}.mp4", fps) for o in outputs if "mp4" in formats}
    screen = Console(stderr=True)
    for one in track(
        path.frames, "rendering", console=screen, transient=True, disable=not screen.is_terminal
    ):
        for output, frame in renderer.draw(one.camera).items():
            stem = out / outputs[output] / names[one.name]
            for form in formats:
                if form != "mp4":
                    _write(stem, form, frame)
            if output in videos:
                videos[output].add(frame.picture)
    for video in videos.values():
        video.close()
    lines = [
        f"{out / folder}: {len(path.frames)} frames as {form}"
        for folder in outputs.values()
        for form in formats
        if form != "mp4"
    ]
    return lines + [
        f"{video.path}: {len(path.frames)} frames, {fps:g} a second" for video in videos.values()
    ]


def _write(stem: Path, form: str, frame: "Frame") -> None:
    import numpy as np

    from vlgs.files import write_atomically
    from vlgs.report.pictures import save_picture

    stem.parent.mkdir(parents=True, exist_ok=True)
    target = stem.with_name(f"{stem.name}.{form}")
    if form == "png":
        save_picture(target, frame.picture)
        return
    buffer = io.BytesIO()
    np.save(buffer, frame.values.float().numpy())
    write_atomically(target, buffer.getvalue(), durable=False)


def _sized(path: "CameraPath", size: str | None) -> "CameraPath":
    from dataclasses import replace

    from vlgs.opened.cameras import with_size

    if size is None:
        return path
    width, _, height = size.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise ValueError(f"render: size must be WIDTHxHEIGHT in pixels, as 640x480, got {size!r}")
    frames = [
        replace(one, camera=with_size(one.camera, int(width), int(height))) for one in path.frames
    ]
    return replace(path, frames=frames)


def _listed(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


if __name__ == "__main__":
    main()
