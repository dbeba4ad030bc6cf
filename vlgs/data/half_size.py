"""Training views of half the width and height: a quarter of the pixels."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8
from PIL import Image
from torch import Tensor

from vlgs.geometry import resize_camera
from vlgs.types import Scene, View


def half_size(scene: Scene) -> Scene:
    """The scene with training views of half their width and height, rounded up; all else stays."""
    return replace(scene, train=tuple(map(_half, scene.train)))


def _half(view: View) -> View:
    """A pixel of the photograph is the mean over its area, one of the masks what lies in its middle; it counts where all of its area does."""
    width, height = ((side + 1) // 2 for side in (view.camera.width, view.camera.height))
    size, masks, valid = (width, height), view.read_masks, view.read_valid
    return replace(
        view,
        camera=resize_camera(view.camera, width, height),
        read_image=partial(_mean, view.read_image, size),
        read_masks=None if masks is None else partial(_middle, masks, size),
        read_valid=None if valid is None else partial(_whole, valid, size),
    )


def _mean(
    read: Callable[[], UInt8[Tensor, "h w 3"]], size: tuple[int, int]
) -> UInt8[Tensor, "h2 w2 3"]:
    small = Image.fromarray(read().numpy()).resize(size, Image.Resampling.BOX)
    return torch.from_numpy(np.array(small))


def _middle(
    read: Callable[[], Int[Tensor, "h w *levels"]], size: tuple[int, int]
) -> Int[Tensor, "h2 w2 *levels"]:
    masks = read()
    x, y = (
        (torch.arange(n) * 2 + 1) * of // (2 * n)
        for n, of in zip(size, masks.shape[1::-1], strict=True)
    )
    return masks[y[:, None], x]


def _whole(read: Callable[[], Bool[Tensor, "h w"]], size: tuple[int, int]) -> Bool[Tensor, "h2 w2"]:
    covered = Image.fromarray(read().numpy().astype(np.uint8) * 255)
    small = covered.resize(size, Image.Resampling.BOX)
    return torch.from_numpy(np.array(small)) == 255
