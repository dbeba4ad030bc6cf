"""Ground truth of a photograph in the two forms that evaluation reads: a class per pixel, and masks with boxes."""

import numpy as np
import torch
from jaxtyping import Bool, Int, UInt8

from vlgs.types import DenseLabels, ObjectLabels


def components(mask: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
    """Number the 8-connected components of a mask from 1; 0 is outside.

    Every pixel starts as its own root and takes the smallest root of its neighbourhood until nothing changes; following
    roots of roots makes that logarithmic in the length of a component instead of linear.
    """
    height, width = mask.shape
    root = np.where(mask, np.arange(1, mask.size + 1).reshape(mask.shape), 0)
    while True:
        smallest = np.pad(np.where(mask, root, mask.size + 1), 1, constant_values=mask.size + 1)
        for axis in (0, 1):
            size = (height, width)[axis]
            windows = [np.take(smallest, np.arange(k, k + size), axis) for k in range(3)]
            smallest = np.minimum(np.minimum(windows[0], windows[1]), windows[2])
        # A root's own root is found through the pixel it names; hooking it too lets whole trees move at once.
        flat = np.arange(mask.size + 1)
        inside = mask.ravel()
        np.minimum.at(flat, root.ravel()[inside], smallest.ravel()[inside])
        while not np.array_equal(flat, flat[flat]):
            flat = flat[flat]
        after = np.where(mask, flat[root], 0)
        if np.array_equal(after, root):
            numbers, compact = np.unique(root, return_inverse=True)
            return compact.reshape(mask.shape) + int(numbers[0] != 0)
        root = after


def dense_labels(ids: UInt8[np.ndarray, "h w"]) -> DenseLabels:
    """The class of every pixel."""
    return DenseLabels(torch.from_numpy(ids))


def object_labels(
    ids: UInt8[np.ndarray, "h w"],
    things: Int[np.ndarray, "h w"],
    classes: dict[int, str],
    smallest: int,
) -> ObjectLabels:
    """Masks per class and a box per connected component of a thing.

    Args:
        ids: Class id per pixel.
        things: Thing number per pixel, so that two mugs that touch in the image stay two.
        classes: Class id -> name of those that are asked for.
        smallest: Components with fewer pixels than this are left out, as annotators leave out slivers.
    """
    masks, boxes = {}, {}
    for class_id, name in classes.items():
        mask = np.zeros(ids.shape, bool)
        found = []
        for thing in np.unique(things[ids == class_id]):
            own = (things == thing) & (ids == class_id)
            y, x = np.nonzero(own)
            top, left = y.min(), x.min()
            pieces = components(own[top : y.max() + 1, left : x.max() + 1])
            for number in range(1, int(pieces.max()) + 1):
                y, x = np.nonzero(pieces == number)
                y, x = y + top, x + left
                if y.size >= smallest:
                    mask[y, x] = True
                    found.append([x.min(), y.min(), x.max(), y.max()])
        if found:
            masks[name] = torch.from_numpy(mask)
            boxes[name] = torch.tensor(sorted(found), dtype=torch.float32)
    return ObjectLabels(masks, boxes)
