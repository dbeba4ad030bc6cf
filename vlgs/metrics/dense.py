"""Scores of a class map against a class for every pixel.

The prediction of a pixel is the class with the largest cosine, which is also the largest under the paper's vocabulary softmax
at any temperature (systems.md B.7). Pixels are counted over all held-out views together; a class's IoU comes from these counts,
and mIoU is the mean over the classes that occur in truth or prediction. (torchmetrics' MeanIoU averages per image instead.)

Localisation is that of LERF-OVS in its strict form, with two changes that pixel labels and small images ask for: a hit is a pixel
of the class instead of a box, and the smoothing window keeps its share of the image's width, 30 px of 988, instead of its pixels.
"""

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from vlgs.metrics.lerf_ovs import LANGSPLAT, box_mean
from vlgs.types import IGNORE_ID

NAME = "dense"
VERSION = 1

LERF_OVS_WIDTH = 988
"""Pixels across an image of LERF-OVS's teatime, for which its window was made."""


def predict_classes(cosines: Float[Tensor, "k h w"]) -> Int[Tensor, "h w"]:
    """Class id of every pixel from its cosine with each class; a tie goes to the first."""
    return cosines.argmax(dim=0)


def confusion(
    prediction: Int[Tensor, "h w"], truth: UInt8[Tensor, "_ _"], classes: int
) -> Int[Tensor, "{classes} {classes}"]:
    """Pixels by true class (row) and predicted class (column), without those of `IGNORE_ID`. Sum it over views.

    Raises:
        ValueError: If the sizes differ or a class id has no class.
    """
    if prediction.shape != truth.shape:
        raise ValueError(
            f"dense: labels must be as large as the view {list(prediction.shape)}, got {list(truth.shape)}"
        )
    counted = truth != IGNORE_ID
    rows, columns = truth[counted].long(), prediction[counted].long()
    for who, ids in (("truth", rows), ("prediction", columns)):
        if ids.numel() and not 0 <= ids.min() <= ids.max() < classes:
            raise ValueError(
                f"dense: class ids of the {who} must be in 0..{classes - 1} or {IGNORE_ID}, got "
                f"{int(ids.min())}..{int(ids.max())}"
            )
    return torch.bincount(rows * classes + columns, minlength=classes**2).reshape(classes, classes)


def class_iou(confusion: Int[Tensor, "k k"]) -> list[float | None]:
    """IoU of every class; None for a class that occurs neither in the truth nor in the prediction."""
    hits = confusion.diagonal()
    unions = confusion.sum(0) + confusion.sum(1) - hits
    return [
        hit / union if union else None
        for hit, union in zip(hits.tolist(), unions.tolist(), strict=True)
    ]


def pixel_accuracy(confusion: Int[Tensor, "k k"]) -> float | None:
    """Share of counted pixels whose class is right; None without pixels."""
    total = int(confusion.sum())
    return int(confusion.trace()) / total if total else None


def localise(relevancy: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"]) -> bool:
    """Whether the first maximum of the smoothed relevancy lies on the class; a constant map never does."""
    window = max(1, round(LANGSPLAT.box * relevancy.shape[1] / LERF_OVS_WIDTH))
    smooth = box_mean(relevancy[None], window)[0]
    return bool(smooth.max() > smooth.min()) and bool(mask.flatten()[smooth.argmax()])
