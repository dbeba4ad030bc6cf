"""Encoders: the image tower of CLIP (or of any model with one), and the mean of dense maps from disk."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from vlgs.data.untrusted.arrays import map_npy
from vlgs.extras import require_extra
from vlgs.features.masks import Mask
from vlgs.features.weights import Pretrained


class ImageEncoder:
    """One vector per mask from a pretrained image encoder: CLIP, SigLIP, DINOv2 or what else transformers loads.

    As LangSplat's preprocessing does it: pixels outside of the mask black, cut to its box, padded to a square with black, scaled to the
    model's input. Models with ``get_image_features`` (CLIP, SigLIP) give what they compare with text, others (DINOv2)
    their pooled output.

    Args:
        pretrained: Weights, precision, device.
        batch: Crops at a time; memory and speed only.
        antialias: Whether crops larger than the input are averaged when they shrink. LangSplat does not, the models' own
            preprocessing does.

    Raises:
        ValueError: If `batch` is not positive.
    """

    def __init__(self, pretrained: Pretrained, batch: int = 32, antialias: bool = False):
        if batch < 1:
            raise ValueError(f"features: batch must be at least 1, got {batch}")
        self.pretrained = pretrained
        self.batch = batch
        self.antialias = antialias
        self._loaded: Any = None

    def identity(self) -> Mapping[str, str]:
        """Hash of the weights."""
        return {"encoder": self.pretrained.digest()}

    def __call__(
        self, image: UInt8[np.ndarray, "h w 3"], masks: Sequence[Mask], stem: str
    ) -> Float32[np.ndarray, "m e"]:
        """See `vlgs.features.Encoder`; the photograph's name does not matter."""
        model, side, mean, std = self._model()
        if not masks:
            return np.zeros((0, self._width(model, side)), np.float32)
        rows = []
        with torch.inference_mode():
            for start in range(0, len(masks), self.batch):
                group = masks[start : start + self.batch]
                crops = torch.stack([square_crop(image, m, side, self.antialias) for m in group])
                crops = (crops - mean[:, None, None]) / std[:, None, None]
                rows.append(self._features(model, crops))
        return torch.cat(rows).numpy()

    def _features(self, model: Any, crops: Float[Tensor, "b 3 s s"]) -> Float[Tensor, "b e"]:
        crops = crops.to(self.pretrained.device, self.pretrained.torch_dtype)
        out = (
            model.get_image_features(pixel_values=crops)
            if hasattr(model, "get_image_features")
            else model(pixel_values=crops)
        )
        vectors = out if isinstance(out, Tensor) else out.pooler_output
        return vectors.float().cpu()

    def _width(self, model: Any, side: int) -> int:
        """Of the vectors; for a photograph without masks."""
        with torch.inference_mode():
            return self._features(model, torch.zeros(1, 3, side, side)).shape[1]

    def _model(self) -> tuple[Any, int, Tensor, Tensor]:
        """The model, the side of its input, and mean and standard deviation of its pixels."""
        if self._loaded is None:
            require_extra("transformers", "features")
            from transformers import AutoModel

            settings = self.pretrained.preprocessing()
            size = settings.get("crop_size") or settings.get("size") or {}
            side = size if isinstance(size, int) else size.get("height", size.get("shortest_edge"))
            if not isinstance(side, int) or side < 1:
                raise ValueError(
                    f"{self.pretrained.folder()}: size of preprocessor_config.json must be pixels, got {size}"
                )
            model = self.pretrained.load(AutoModel).to(self.pretrained.torch_dtype)
            if model.config.model_type == "siglip2":  # those of one size call themselves siglip
                raise ValueError(
                    f"{self.pretrained.folder()}: encoder must take images of one size, as "
                    "google/siglip2-base-patch16-224 does, got a NaFlex model of SigLIP 2"
                )
            mean, std = (torch.tensor(settings[k]) for k in ("image_mean", "image_std"))
            self._loaded = model, side, mean, std
        return self._loaded


def square_crop(
    image: UInt8[np.ndarray, "h w 3"], mask: Mask, side: int, antialias: bool
) -> Float[Tensor, "3 s s"]:
    """What an encoder sees of a mask, in [0, 1]: nothing but the mask, in the middle of a black square.

    Args:
        image: The photograph.
        mask: Of it.
        side: Of the result in pixels.
        antialias: Whether pixels are averaged where the crop is larger than that.
    """
    crop = image[mask.window] * mask.pixels[..., None]
    height, width = mask.pixels.shape
    left, top = max(0, height - width) // 2, max(0, width - height) // 2
    right, bottom = max(0, height - width) - left, max(0, width - height) - top
    planes = torch.from_numpy(crop).permute(2, 0, 1)[None].float()
    planes = F.pad(planes, (left, right, top, bottom))
    scaled = F.interpolate(planes, (side, side), mode="bilinear", antialias=antialias)
    return scaled[0].round().clamp(0, 255) / 255


class DenseMaps:
    """The mean over each mask of feature maps that another program wrote, e.g. patch features of DINOv2 or APE.

    Args:
        folder: With one array of floats for each photograph.
        pattern: File name; ``{stem}`` is the photograph's.
        layout: ``hwc`` or ``chw``. The map covers the whole photograph at any resolution.

    Raises:
        ValueError: If pattern or layout cannot be right.
    """

    def __init__(self, folder: str, pattern: str = "{stem}.npy", layout: str = "hwc"):
        if "{stem}" not in pattern:
            raise ValueError(f"features: pattern must contain {{stem}}, got {pattern!r}")
        if layout not in ("hwc", "chw"):
            raise ValueError(f"features: layout must be hwc or chw, got {layout!r}")
        self.folder = Path(folder)
        self.pattern = pattern
        self.layout = layout

    def identity(self) -> Mapping[str, str]:
        """Nothing: the maps are many and large; the folder's settings name the layout."""
        return {}

    def __call__(
        self, image: UInt8[np.ndarray, "h w 3"], masks: Sequence[Mask], stem: str
    ) -> Float32[np.ndarray, "m e"]:
        """See `vlgs.features.Encoder`: of each pixel the map's cell that it lies in.

        Raises:
            FileNotFoundError: If the photograph has no map.
            ValueError: If the map is not one.
        """
        cells = self._read(stem)
        height, width, channels = cells.shape
        rows = np.arange(image.shape[0]) * height // image.shape[0]
        columns = np.arange(image.shape[1]) * width // image.shape[1]
        out = np.empty((len(masks), channels), np.float32)
        for i, mask in enumerate(masks):
            y, x = np.nonzero(mask.pixels)
            index = rows[y + mask.y] * width + columns[x + mask.x]
            used, counts = np.unique(index, return_counts=True)
            out[i] = counts @ cells.reshape(-1, channels)[used].astype(np.float64) / len(index)
        return out

    def _read(self, stem: str) -> np.ndarray:
        path = self.folder / self.pattern.replace("{stem}", stem)
        if not path.is_file():
            raise FileNotFoundError(
                f"features: {path} must be the feature map of photograph {stem}, got no such file"
            )
        cells = map_npy(path)
        if cells.ndim != 3 or cells.dtype.kind != "f" or 0 in cells.shape:
            raise ValueError(
                f"{path}: array must be floats [{', '.join(self.layout)}], got {cells.dtype} {list(cells.shape)}"
            )
        return np.ascontiguousarray(cells if self.layout == "hwc" else np.moveaxis(cells, 0, 2))
