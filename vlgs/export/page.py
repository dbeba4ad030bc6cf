"""One HTML file that holds a scene and the program that shows it, and asks the network for nothing."""

import base64
import hashlib
import io
import json
import re
from html import escape
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from vlgs.export.content import Content
from vlgs.export.packed import pack
from vlgs.fields import Field
from vlgs.geometry import camera_center
from vlgs.opened import NamedCamera, OpenedRun
from vlgs.opened.cameras import focus, upright
from vlgs.report.colors import heat, to_uint8

_SOURCES = Path(__file__).with_name("page")
_SCRIPTS = ("data.js", "order.js", "camera.js", "shaders.js", "draw.js", "main.js")
"""In the order in which they are joined to one script."""
_POLICY = (
    "default-src 'none'; script-src '{script}'; style-src '{style}'; img-src data:; worker-src blob:; "
    "base-uri 'none'; form-action 'none'"
)
"""What the browser lets the page do: run this one script, and reach nothing outside of the file."""


def write_page(opened: OpenedRun, content: Content) -> bytes:
    """The file.

    Args:
        opened: The run, of which name, cameras and one picture are shown.
        content: At least one Gaussian.
    """
    # It begins at the first test camera, or the first of all.
    cameras = sorted(opened.cameras(), key=lambda one: one.split != "test")
    viewmats = torch.stack([one.camera.viewmat for one in cameras]).double()
    eyes = camera_center(viewmats)
    center = focus(eyes, viewmats[:, 2, :3])
    packed = pack(content, center, max((eyes - center).norm(dim=1).median().item(), 1e-6))
    constants = content.cloud.raster
    about = packed.about | {
        "focus": center.tolist(),
        "up": upright(viewmats).tolist(),
        "near": constants.near,
        "near_sigmas": constants.near_sigmas,
        "blur": constants.eps2d,
        "alpha": (constants.alpha_min, constants.alpha_max),
        "margin": constants.fov_margin,
        "cameras": [_camera(one) for one in cameras],
        "heat": _base64(heat(torch.linspace(0, 1, 256)[None]).numpy().tobytes()),
    }
    script = "\n".join((_SOURCES / name).read_text(encoding="utf-8") for name in _SCRIPTS)
    style = (_SOURCES / "style.css").read_text(encoding="utf-8")
    parts = {
        "policy": _POLICY.format(script=_digest(script), style=_digest(style)),
        "title": escape(opened.notes.name),
        "camera": escape(cameras[0].name),
        "count": f"{content.count:,}",
        "note": escape(_note(opened, content)),
        "picture": _base64(_picture(opened.field, cameras[0])),
        "about": _json(about),
        "splats": _base64(packed.data),
        "style": style,
        "script": script,
    }
    text = (_SOURCES / "page.html").read_text(encoding="utf-8")
    # In one pass: what is put in is not looked at again.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], text).encode()


def _note(opened: OpenedRun, content: Content) -> str:
    """What a reader of the page should know."""
    lines = ["A preview, not what a protocol measures: numbers are rounded."]
    if content.words:
        lines.append("Every Gaussian is asked for itself, where vlgs asks what they blend to.")
    lines += [f"{note[0].upper()}{note[1:]}." for note in content.notes]
    if opened.step is not None:
        lines.append(f"Training goes on: this is step {opened.step}.")
    return " ".join([*lines, f"Run {opened.path.resolve().name}."])


def _camera(one: NamedCamera) -> dict[str, Any]:
    camera = one.camera
    lens = [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]]
    return {
        "name": one.name,
        "split": one.split,
        "viewmat": [float(f"{value:.8g}") for value in camera.viewmat[:3].flatten().tolist()],
        "lens": [float(f"{value:.8g}") for value in map(float, lens)],
        "size": [camera.width, camera.height],
    }


def _picture(field: Field, one: NamedCamera) -> bytes:
    """JPEG of what a camera sees, for a browser that cannot draw."""
    color = field.render(one.camera, frozenset({"color"})).color
    assert color is not None  # it was asked for
    stream = io.BytesIO()
    Image.fromarray(to_uint8(color).numpy()).save(stream, "JPEG", quality=85)
    return stream.getvalue()


def _json(value: Any) -> str:
    """JSON that ends no script element, whatever texts are in it."""
    text = json.dumps(value, separators=(",", ":"))
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _digest(text: str) -> str:
    return f"sha256-{_base64(hashlib.sha256(text.encode()).digest())}"
