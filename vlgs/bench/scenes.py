"""What errors are measured on: the workload, and views of a trained scene, in the same form."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from vlgs.bench.workload import Workload
from vlgs.types import Camera, ChannelGroup

if TYPE_CHECKING:
    from vlgs.fields.splat import SplatModel

LEAVES = ("means", "quats", "scales", "colors", "codes", "opacities", "indicators")
"""Names of what `Workload.leaves` gives, in its order."""


@torch.no_grad()
def view_of(model: "SplatModel", camera: Camera, seed: int) -> Workload:
    """One view of a trained model, exactly as it renders it, with gradients of a loss like the workload's.

    Args:
        model: The trained scene.
        camera: Where it is seen from.
        seed: Of the upstream gradients, standard normal over the number of pixels.
    """
    fused = model.fuse()
    g = fused.gaussians
    colors = model.view_color(fused, camera)
    rng = np.random.default_rng(seed)
    pixels = camera.width * camera.height
    upstream = (
        torch.from_numpy(rng.standard_normal((camera.height, camera.width, c)) / pixels).float()
        for c in (3, fused.feature.shape[1])
    )
    d_color, d_language = upstream
    groups = (
        ChannelGroup(colors.clamp_min(0), g.opacities),
        ChannelGroup(fused.feature, fused.language_weight),
    )
    view = Workload(g.means, g.quats, g.scales, groups, camera, (d_color, d_language))
    return in_precision(view, torch.float32)


def in_precision(w: Workload, dtype: torch.dtype) -> Workload:
    """A copy with leaves of its own; float32 values are exact in float64, so that only arithmetic differs."""

    def leaf(tensor: Tensor) -> Tensor:
        return tensor.detach().to(dtype, copy=True).requires_grad_()

    color, language = w.groups
    opacity = leaf(color.weight)
    indicator = opacity if language.weight is color.weight else leaf(language.weight)
    groups = (
        ChannelGroup(leaf(color.values), opacity),
        ChannelGroup(leaf(language.values), indicator),
    )
    d_color, d_language = (d.to(dtype) for d in w.upstream)
    shape = leaf(w.means), leaf(w.quats), leaf(w.scales)
    return Workload(*shape, groups, w.camera, (d_color, d_language))


def with_one_weight(w: Workload) -> Workload:
    """The same with language blended by opacity (``indicator=opacity``), so that both groups share one transmittance."""
    color, language = w.groups
    return w._replace(groups=(color, ChannelGroup(language.values, color.weight)))


def save_workload(path: Path, w: Workload) -> None:
    """Put a workload where another process can read it."""
    from safetensors.torch import save_file

    c = w.camera
    tensors = dict(zip(LEAVES, w.leaves(), strict=True))
    tensors |= {"viewmat": c.viewmat, "K": c.K, "size": torch.tensor([c.width, c.height])}
    tensors["shared"] = torch.tensor(w.groups[0].weight is w.groups[1].weight)
    tensors |= {"d_color": w.upstream[0], "d_language": w.upstream[1]}
    save_file({name: t.detach().clone().contiguous() for name, t in tensors.items()}, path)


def load_workload(path: Path) -> Workload:
    """What `save_workload` wrote, with leaves that want gradients."""
    from safetensors.torch import load_file

    t = load_file(path)
    width, height = t["size"].tolist()
    indicators = t["opacities"] if t["shared"] else t["indicators"]
    groups = ChannelGroup(t["colors"], t["opacities"]), ChannelGroup(t["codes"], indicators)
    camera = Camera(t["viewmat"], t["K"], width, height)
    w = Workload(
        t["means"], t["quats"], t["scales"], groups, camera, (t["d_color"], t["d_language"])
    )
    return in_precision(w, t["means"].dtype)
