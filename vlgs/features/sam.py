"""SAM's automatic masks (Kirillov et al., ICCV 2023), its three outputs kept apart as LangSplat does.

Points of a grid are put to the model one by one, on the photograph and on overlapping crops of it. Of the three masks that
each point gives, those pass whose predicted IoU and stability are high and which do not end at the border of a crop; box NMS
within each crop and across crops, removal of specks, and LangSplat's mask NMS follow, on each output and on all together.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from PIL import Image
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vlgs.extras import require_extra
from vlgs.features.masks import Mask, crop_mask, remove_small_regions
from vlgs.features.nms import MaskNms, box_nms
from vlgs.features.weights import Pretrained

_AT_EDGE = 20
"""Pixels from the border of a crop within which a mask is taken to be cut off by it (SAM's)."""


@dataclass(frozen=True)
class GridPrompts:
    """Where SAM is asked."""

    points_per_side: int = 32
    """Points along each side of the photograph or crop."""
    crop_layers: int = 1
    """Layer i asks again on 4^i crops."""
    crop_overlap: float = 512 / 1500
    """Overlap of the crops of layer 1, as a share of the shorter side; layer i has 1/2^(i-1) of it."""
    points_downscale: int = 1
    """Points per side are divided by this in each further layer."""
    batch: int = 64
    """Points that are decoded at a time; memory only."""

    def __post_init__(self) -> None:
        if min(self.points_per_side, self.points_downscale, self.batch) < 1 or self.crop_layers < 0:
            raise ValueError(f"features: counts of the prompts must be positive, got {self}")
        if not 0 <= self.crop_overlap < 1:
            raise ValueError(f"features: crop_overlap must be in [0, 1), got {self.crop_overlap}")


@dataclass(frozen=True)
class MaskFilter:
    """Which of SAM's masks pass."""

    predicted_iou: float = 0.7
    """The model's own estimate must be above this."""
    stability: float = 0.85
    """IoU of the masks at the logits +`stability_offset` and -`stability_offset` must be at least this."""
    stability_offset: float = 1.0
    box_nms: float = 0.7
    """IoU of boxes within one crop."""
    crop_nms: float = 0.7
    """IoU of boxes from different crops; the smaller crop wins."""
    least_area: int = 100
    """Holes and islands with fewer pixels are removed; 0 keeps all."""


@dataclass(frozen=True)
class _Candidate:
    """A mask that SAM proposes."""

    mask: Mask
    predicted_iou: float
    stability: float
    crop_area: int


@dataclass(frozen=True)
class _Crop:
    """A window of the photograph that SAM sees as an image."""

    x1: int
    y1: int
    x2: int
    y2: int
    points_per_side: int

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.y2 - self.y1, self.x2 - self.x1


class SamSegmenter:
    """SAM's automatic masks at LangSplat's four levels: all outputs together, subpart, part, whole.

    The image encoder runs in the given precision; prompts and mask decoder always in float32, because coordinates do not
    survive half precision.

    Args:
        pretrained: Weights, precision, device.
        prompts: Where SAM is asked.
        keep: Which of its masks pass.
        nms: The second suppression of each level.
    """

    def __init__(
        self, pretrained: Pretrained, prompts: GridPrompts, keep: MaskFilter, nms: MaskNms
    ):
        self.pretrained = pretrained
        self.prompts = prompts
        self.keep = keep
        self.nms = nms
        self._loaded: Any = None

    def identity(self) -> Mapping[str, str]:
        """Hash of the weights."""
        return {"segmenter": self.pretrained.digest()}

    def __call__(self, image: UInt8[np.ndarray, "h w 3"]) -> Sequence[Sequence[Mask]]:
        """See `vlgs.features.Segmenter`."""
        size = (image.shape[0], image.shape[1])
        levels: list[list[_Candidate]] = [[], [], [], []]
        for crop in crop_windows(size, self.prompts):
            outputs = self._candidates(image, crop, size)
            together = [c for batch in zip(*outputs, strict=True) for part in batch for c in part]
            apart = ([c for part in output for c in part] for output in outputs)
            for level, found in zip(levels, (together, *apart), strict=True):
                scores = np.array([c.predicted_iou for c in found])
                level += _suppress(found, scores, self.keep.box_nms)
        return [self._finish(level, size) for level in levels]

    def _finish(self, found: list[_Candidate], size: tuple[int, int]) -> list[Mask]:
        """Suppression across crops, removal of specks, suppression of masks."""
        if self.prompts.crop_layers:
            scores = np.array([1 / c.crop_area for c in found])
            found = _suppress(found, scores, self.keep.crop_nms)
        if self.keep.least_area:
            cleaned = [remove_small_regions(c.mask, size, self.keep.least_area) for c in found]
            found = [replace(c, mask=mask) for c, (mask, _) in zip(found, cleaned, strict=True)]
            untouched = np.array([not changed for _, changed in cleaned], float)
            found = _suppress(found, untouched, max(self.keep.box_nms, self.keep.crop_nms))
        scores = np.array([c.stability * c.predicted_iou for c in found])
        kept = self.nms([c.mask for c in found], scores, size)
        return [found[i].mask for i in kept]

    def _candidates(
        self, image: np.ndarray, crop: _Crop, size: tuple[int, int]
    ) -> list[list[list[_Candidate]]]:
        """What passes on one crop: output -> batch of points -> candidates."""
        pixels = image[crop.y1 : crop.y2, crop.x1 : crop.x2]
        model = self._model()[0]
        inner = _fit(crop.size, model.config.vision_config.image_size)
        outputs: list[list[list[_Candidate]]] = [[], [], []]
        with torch.inference_mode():
            embedding = self._embed(pixels, inner)
            for points in grid_points(crop.points_per_side).split(self.prompts.batch):
                where = points * torch.tensor([inner[1], inner[0]], dtype=torch.float32)
                out = model(
                    image_embeddings=embedding,
                    input_points=where[None, :, None].to(embedding.device),
                    multimask_output=True,
                )
                for k, found in enumerate(outputs):
                    ious = out.iou_scores[0, :, k]
                    good = ious > self.keep.predicted_iou
                    logits = out.pred_masks[0, good, k]
                    found.append(list(self._pass(logits, ious[good], inner, crop, size)))
        return outputs

    def _embed(
        self, pixels: UInt8[np.ndarray, "h w 3"], inner: tuple[int, int]
    ) -> Float[Tensor, "1 c eh ew"]:
        """The image encoder's answer: scaled to `inner` by Pillow as SAM does, zeros below and to the right."""
        model, mean, std = self._model()
        side = model.config.vision_config.image_size
        scaled = Image.fromarray(pixels).resize((inner[1], inner[0]), Image.Resampling.BILINEAR)
        planes = torch.from_numpy(np.array(scaled)).permute(2, 0, 1)[None] / 255
        planes = (planes - mean[:, None, None]) / std[:, None, None]
        planes = F.pad(planes, (0, side - inner[1], 0, side - inner[0]))
        planes = planes.to(self.pretrained.device, self.pretrained.torch_dtype)
        return model.get_image_embeddings(planes).float()

    def _pass(
        self,
        logits: Float[Tensor, "n lh lw"],
        ious: Float[Tensor, " n"],
        inner: tuple[int, int],
        crop: _Crop,
        size: tuple[int, int],
    ) -> Iterator[_Candidate]:
        """Of masks with a high predicted IoU, those that are stable and not cut off by the crop."""
        if not len(logits):
            return
        side = self._loaded[0].config.vision_config.image_size
        full = F.interpolate(logits[:, None], (side, side), mode="bilinear")
        full = full[..., : inner[0], : inner[1]]
        full = F.interpolate(full, crop.size, mode="bilinear")[:, 0]
        offset = self.keep.stability_offset
        sure, possible = _areas(full > offset), _areas(full > -offset)
        stability = sure / np.maximum(possible, 1)
        stable = np.flatnonzero(stability >= self.keep.stability)
        inside = (full[torch.from_numpy(stable).to(full.device)] > 0).cpu().numpy()
        for pixels, i in zip(inside, stable.tolist(), strict=True):
            mask = crop_mask(pixels, crop.x1, crop.y1)
            if mask is not None and not _is_cut_off(mask, crop, size):
                area = crop.size[0] * crop.size[1]
                yield _Candidate(mask, float(ious[i]), float(stability[i]), area)

    def _model(self) -> tuple[Any, Tensor, Tensor]:
        """The model, and mean and standard deviation of its pixels."""
        if self._loaded is None:
            require_extra("transformers", "features")
            from transformers import SamModel  # 2.6 s, and an optional dependency

            model = self.pretrained.load(SamModel)
            model.vision_encoder.to(self.pretrained.torch_dtype)
            statistics = self.pretrained.preprocessing()
            mean, std = (torch.tensor(statistics[k]) for k in ("image_mean", "image_std"))
            self._loaded = model, mean, std
        return self._loaded


def crop_windows(size: tuple[int, int], prompts: GridPrompts) -> Iterator[_Crop]:
    """The photograph itself, then for each layer i its 2^i x 2^i overlapping crops.

    Args:
        size: Height and width of the photograph.
        prompts: Layers, overlap and points.
    """
    height, width = size
    yield _Crop(0, 0, width, height, prompts.points_per_side)
    for layer in range(1, prompts.crop_layers + 1):
        count = 2**layer
        overlap = int(prompts.crop_overlap * min(size) * 2 / count)
        points = max(1, prompts.points_per_side // prompts.points_downscale**layer)
        wide, high = (-(-(overlap * (count - 1) + side) // count) for side in (width, height))
        for column, row in product(range(count), repeat=2):
            x, y = (wide - overlap) * column, (high - overlap) * row
            yield _Crop(x, y, min(x + wide, width), min(y + high, height), points)


def grid_points(per_side: int) -> Float[Tensor, "p 2"]:
    """Middles of the cells of a square grid over [0, 1]^2, row by row, as (x, y)."""
    middles = (torch.arange(per_side) + 0.5) / per_side
    y, x = torch.meshgrid(middles, middles, indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


def _areas(masks: Bool[Tensor, "n h w"]) -> Int64[np.ndarray, " n"]:
    """Pixels of each mask. NumPy counts bits eight times faster than torch sums them."""
    return np.array([np.count_nonzero(mask) for mask in masks.cpu().numpy()], np.int64)


def _fit(size: tuple[int, int], side: int) -> tuple[int, int]:
    """Height and width scaled so that the longer one is `side`."""
    scale = side / max(size)
    return int(size[0] * scale + 0.5), int(size[1] * scale + 0.5)


def _is_cut_off(mask: Mask, crop: _Crop, size: tuple[int, int]) -> bool:
    """Whether the mask ends near a border of the crop that is not one of the photograph."""
    borders = zip(
        mask.box, (crop.x1, crop.y1, crop.x2, crop.y2), (0, 0, size[1], size[0]), strict=True
    )
    return any(
        abs(end - of_crop) <= _AT_EDGE < abs(end - of_photograph)
        for end, of_crop, of_photograph in borders
    )


def _suppress(
    found: Sequence[_Candidate], scores: Float[np.ndarray, " n"], threshold: float
) -> list[_Candidate]:
    if not found:
        return []
    boxes = np.array([c.mask.box for c in found])
    return [found[i] for i in box_nms(boxes, scores, threshold)]
