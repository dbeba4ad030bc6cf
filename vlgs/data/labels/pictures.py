"""PNGs of labels: which files they are, and which pixels of a mask are marked."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool
from PIL import Image


def find_pngs(folder: Path, pattern: str = "*") -> list[Path]:
    """Files of a folder that end in .png, or in .PNG as some programs write it, in order.

    Args:
        folder: Where they are.
        pattern: Of their paths below it, for `Path.glob`, without the suffix.
    """
    return sorted(path for path in folder.glob(pattern) if path.suffix.lower() == ".png")


def marked(mask: Image.Image) -> Bool[np.ndarray, "h w"]:
    """Pixels of a mask that are neither black nor wholly transparent.

    Programs that cut things out leave any colour, often white, under what is transparent.
    """
    colored = np.asarray(mask.convert("RGB")).max(axis=2) > 0
    if not mask.has_transparency_data:
        return colored
    return colored & (np.asarray(mask.convert("RGBA").getchannel("A")) > 0)
