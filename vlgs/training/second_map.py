"""A second map of each training view, in the place that DINO's has in LERF and FMGS: low-level, and the same for all that belongs together."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from vlgs.data.untrusted.arrays import map_npy
from vlgs.types import Scene, View
from vlgs.values import require_range


@runtime_checkable
class SecondMap(Protocol):
    """Gives every training view a map of one width."""

    def require(self, scene: Scene) -> int:
        """Width of the maps, if every training view has one.

        Raises:
            ValueError: If one has none; it is named.
        """
        ...

    def read(self, view: View) -> Float[Tensor, "h w c"]:
        """The map of a view, at the size of its photograph."""
        ...


def choose_second_map(
    folder: str | None = None, fine: float = 1.0, coarse: float = 4.0
) -> SecondMap:
    """Maps of a folder, or computed from the photographs.

    Args:
        folder: See `FolderMap`; None: a `PhotographMap`.
        fine: See `PhotographMap`.
        coarse: Likewise.
    """
    return PhotographMap(fine, coarse) if folder is None else FolderMap(folder)


@dataclass(frozen=True)
class PhotographMap:
    """Computed from the photograph itself: its CIELAB colour, blurred a little and blurred more, and where it has edges.

    No network is needed, and no weights. It knows what looks alike, which is less than DINO knows.

    Raises:
        ValueError: If a number is out of range.
    """

    fine: float = 1.0
    """Standard deviation of the lesser blur, in pixels."""
    coarse: float = 4.0
    """Of the greater one."""

    def __post_init__(self) -> None:
        require_range("second map", 0.1, 1000, fine=self.fine, coarse=self.coarse)

    def require(self, scene: Scene) -> int:
        """See `SecondMap`: 7 numbers."""
        return 7

    def read(self, view: View) -> Float[Tensor, "h w 7"]:
        """See `SecondMap`. Lightness is in [0, 1], the colours are in units of 100, edges in lightness per pixel."""
        from kornia.color import rgb_to_lab
        from kornia.filters import gaussian_blur2d, spatial_gradient

        image = view.read_image().permute(2, 0, 1)[None].float() / 255
        lab = rgb_to_lab(image) / 100
        blurred = []
        for deviation in (self.fine, self.coarse):
            # The window reaches three deviations, but never beyond a small picture.
            reach = min(int(3 * deviation + 0.5), (min(image.shape[-2:]) - 1) // 2)
            size = 2 * max(1, reach) + 1
            blurred.append(gaussian_blur2d(lab, (size, size), (deviation, deviation)))
        edges = spatial_gradient(blurred[0][:, :1]).norm(dim=2)
        return torch.cat([*blurred, edges], dim=1)[0].permute(1, 2, 0)


@dataclass(frozen=True)
class FolderMap:
    """Read from files, as some network wrote them: ``<folder>/<view>.npy`` with [h, w, c] numbers of any resolution."""

    folder: str

    def require(self, scene: Scene) -> int:
        """See `SecondMap`."""
        widths = {}
        for view in scene.train:
            path = self._path(view)
            if not path.is_file():
                raise ValueError(
                    f"second map: {path} must be there, as every training view needs a map, got no file"
                )
            shape = map_npy(path).shape
            if len(shape) != 3 or 0 in shape:
                raise ValueError(
                    f"second map: {path} must be an array [h, w, c], got {list(shape)}"
                )
            widths[shape[2]] = path
        if len(widths) != 1:
            raise ValueError(f"second map: maps must have one width, got {sorted(widths)}")
        return next(iter(widths))

    def read(self, view: View) -> Float[Tensor, "h w c"]:
        """See `SecondMap`; resized bilinearly.

        Raises:
            ValueError: If a number is not finite.
        """
        path = self._path(view)
        values = torch.tensor(map_npy(path)).float().permute(2, 0, 1)[None]
        if not torch.isfinite(values).all():
            raise ValueError(f"second map: {path} must hold finite numbers, got others")
        size = (view.camera.height, view.camera.width)
        return interpolate(values, size, mode="bilinear", antialias=False)[0].permute(1, 2, 0)

    def _path(self, view: View) -> Path:
        return Path(self.folder) / f"{view.name}.npy"
