"""Scores of a class map against a class for every pixel.

The prediction of a pixel is the class with the largest cosine, which is also the largest under the paper's softmax over the
vocabulary (Eq. 4) at any temperature; with several mask levels the largest cosine of any level counts. Pixels are counted over all
held-out views together, and a class's IoU comes from these counts. (torchmetrics' MeanIoU averages per image instead.)

mIoU is the mean over the classes that occur in truth or prediction: a class that the scene does not show, predicted on one stray
pixel, scores 0, as in torchmetrics and scikit-learn. The protocols that ask for labelled objects (`lerf_ovs`, `ovs3d`, `goi`)
never see such a pixel. ``absent=skip`` leaves these classes out; `miou_dense_present` is that figure beside the headline.

Localisation is that of LERF-OVS in its strict form, with two changes that pixel labels and small images ask for: a hit is a pixel
of the class instead of a box, and the smoothing window keeps its share of the image's width, 30 px of 988, instead of its pixels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from vlgs.metrics.masks import QueryScore, share_hit
from vlgs.metrics.mean import mean_of_known
from vlgs.metrics.protocol import Evidence, Figures
from vlgs.metrics.segment import LANGSPLAT, check_relevancy
from vlgs.metrics.smooth import box_mean
from vlgs.types import IGNORE_ID

NAME = "dense"
VERSION = 1

LERF_OVS_WIDTH = 988
"""Pixels across an image of LERF-OVS's teatime, for which its window was made."""


@dataclass(frozen=True)
class Dense:
    """Argmax over all classes against dense labels.

    Args:
        absent: What a class scores that is predicted but not in the truth: ``zero``, or ``skip`` for nothing.

    Raises:
        ValueError: If `absent` is neither.
    """

    absent: Literal["zero", "skip"] = "zero"

    def __post_init__(self) -> None:
        if self.absent not in ("zero", "skip"):
            raise ValueError(f"dense: absent must be zero or skip, got {self.absent!r}")

    @property
    def name(self) -> str:
        """``dense``."""
        return NAME

    @property
    def version(self) -> int:
        """Raised when a change can move a number."""
        return VERSION

    def score(self, seen: Evidence) -> list[QueryScore]:
        """Count one view; a view without dense labels adds nothing.

        Raises:
            ValueError: If sizes differ, an id has no class, or a value is not finite.
        """
        if seen.truth is None:
            return []
        for level in seen.cosines:
            check_relevancy(NAME, level, "every class")
        counts = confusion(predict_classes(seen.cosines), seen.truth, len(seen.classes))
        hits = {
            i: localise([level[i] for level in seen.relevancy], seen.truth == i)
            for i in seen.truth.unique().tolist()
            if i != IGNORE_ID
        }
        return class_counts(seen.view, counts, seen.classes, hits)

    def conclude(self, scores: Sequence[QueryScore], classes: Sequence[str]) -> Figures:
        """Figures from the pixels of all views together."""
        zero, skip = (pooled_iou(scores, classes, absent) for absent in ("zero", "skip"))
        per_category = zero if self.absent == "zero" else skip
        miou, counted = mean_of_known(per_category.values()), sum(s.true for s in scores)
        reasons = {} if miou is not None else {"miou": "no held-out view has a class for any pixel"}
        loc_acc = share_hit(scores)
        if loc_acc is None:
            reasons["loc_acc"] = "no held-out view has a labelled object"
        return Figures(
            miou=miou,
            loc_acc=loc_acc,
            per_category=per_category,
            more={
                "miou_dense_present": mean_of_known(skip.values()),
                "pixel_accuracy": sum(s.both for s in scores) / counted if counted else None,
            },
            reasons=reasons,
        )


def predict_classes(cosines: Sequence[Float[Tensor, "k h w"]]) -> Int[Tensor, "h w"]:
    """Class id of every pixel from its cosine with each class at one or several levels; a tie goes to the first."""
    best = cosines[0]
    for level in cosines[1:]:
        best = torch.maximum(best, level)
    return best.argmax(dim=0)


def confusion(
    prediction: Int[Tensor, "h w"], truth: UInt8[Tensor, "_ _"], classes: int
) -> Int[Tensor, "{classes} {classes}"]:
    """Pixels by true class (row) and predicted class (column), without those of `IGNORE_ID`.

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


def class_counts(
    view: str,
    confusion: Int[Tensor, "k k"],
    classes: Sequence[str],
    hits: Mapping[int, bool] | None = None,
) -> list[QueryScore]:
    """One record per class that occurs in the truth or the prediction of a view."""
    both, true, selected = confusion.diagonal(), confusion.sum(1), confusion.sum(0)
    return [
        QueryScore(
            view,
            classes[i],
            both=int(both[i]),
            selected=int(selected[i]),
            true=int(true[i]),
            pixels=int(confusion.sum()),
            hit=(hits or {}).get(i),
        )
        for i in range(len(classes))
        if true[i] or selected[i]
    ]


def pooled_iou(
    scores: Sequence[QueryScore], classes: Sequence[str], absent: Literal["zero", "skip"] = "zero"
) -> dict[str, float | None]:
    """IoU of every class from the pixels of all views; None for one that occurs neither in truth nor in prediction.

    A class that is only predicted is 0, or None with ``absent=skip``.
    """
    ious: dict[str, float | None] = {}
    for name in classes:
        of_class = [score for score in scores if score.category == name]
        both = sum(score.both for score in of_class)
        true = sum(score.true for score in of_class)
        union = sum(score.selected for score in of_class) + true - both
        ious[name] = None if not union or (absent == "skip" and not true) else both / union
    return ious


def localise(relevancy: Sequence[Float[Tensor, "h w"]], mask: Bool[Tensor, "h w"]) -> bool:
    """Whether the first maximum of the smoothed relevancy lies on the class; a constant map never does.

    Of several levels the one with the largest smoothed value counts, as in LERF-OVS.
    """
    levels = torch.stack(list(relevancy))
    window = max(1, round(LANGSPLAT.box * levels.shape[2] / LERF_OVS_WIDTH))
    smoothed = box_mean(levels, window)
    best = smoothed[smoothed.flatten(1).amax(dim=1).argmax()]
    return bool(best.max() > best.min()) and bool(mask.flatten()[best.argmax()])
