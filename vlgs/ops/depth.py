"""How far away is what each pixel shows: z of the camera's axes, not the length of a ray."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.ops.device import Kernels
from vlgs.ops.project import Splats, project
from vlgs.ops.rasterize import DEFAULT, check_camera, check_config, check_tensors, rasterize
from vlgs.ops.rasterize_to_pixels import weights_alone
from vlgs.types import Camera, ChannelGroup, DepthKind, RasterConfig


def render_depth(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    config: RasterConfig = DEFAULT,
    kind: DepthKind = "expected",
) -> Float[Tensor, "h w"]:
    """Depth image of 3D Gaussians: camera z in world units, 0 where nothing lies.

    With z_i the depth of a Gaussian's centre and w_i = alpha_i T_i its blending weight at a pixel, as in `vlgs.rasterize`:

    * ``accumulated`` is sum_i w_i z_i: where the scene is translucent, less than any depth in it. It is linear in the weights,
      so that a background of some depth can be added to it.
    * ``expected`` is the accumulated depth divided by sum_i w_i, the mean depth of what is seen.
    * ``median`` is z of the first Gaussian, front to back, behind which the transmittance is 0.5 or less. It is 0 where that
      never happens: a pixel of which less than half is covered has no median depth.

    ``accumulated`` and ``expected`` are differentiable in `means`, `quats`, `scales` and `opacities`. The median is the depth of one
    Gaussian, and its gradient reaches the centre of that one alone: which one it is changes in steps, and quats, scales and opacities
    get no gradient from it.

    Args:
        means: Centres, world units.
        quats: Rotations (w, x, y, z), need not be normalised.
        scales: Standard deviations along the principal axes, world units, >= 0.
        opacities: What blends, in [0, 1]; any weight of `ChannelGroup`.
        viewmat: World to camera; no gradient is formed.
        K: Pinhole intrinsics in pixels, without skew; no gradient is formed.
        width: Pixels.
        height: Pixels.
        config: Constants of the image model.
        kind: Which depth.

    Raises:
        ValueError: As `vlgs.rasterize` does, whose group of depths is ``groups[0]``; if there is no such kind.

    Example:
        >>> splats = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0]])
        >>> shape = torch.eye(4)[:1].expand(2, 4), torch.full((2, 3), 0.1)
        >>> K = torch.tensor([[9.0, 0.0, 1.5], [0.0, 9.0, 1.5], [0.0, 0.0, 1.0]])
        >>> half = torch.tensor([0.4, 0.5])
        >>> kinds = ("accumulated", "expected", "median")
        >>> [render_depth(splats, *shape, half, torch.eye(4), K, 3, 3, kind=k)[1, 1] for k in kinds]
        [tensor(2.), tensor(2.8571), tensor(4.)]
    """
    check_config(config)
    check_tensors(means, quats, scales, [ChannelGroup(means, opacities)])
    camera = Camera(viewmat, K, width, height)
    check_camera(camera)
    if kind in ("accumulated", "expected"):
        values = camera_depth(means, camera)[:, None]
        if kind == "expected":
            values = torch.cat([values, torch.ones_like(values)], dim=1)
        groups = [ChannelGroup(values, opacities)]
        image = rasterize(means, quats, scales, groups, viewmat, K, width, height, config).images[0]
        if kind == "accumulated":
            return image[..., 0]
        # Summed as the depths are: the accumulated weight, 1 - T, has lost the digits of what is faint.
        depth, total = image.unbind(dim=-1)
        mean = depth / torch.where(total > 0, total, 1.0)
        # A mean of the largest numbers there are may round beyond them.
        return mean.clamp_max(torch.finfo(mean.dtype).max)
    if kind != "median":
        raise ValueError(f"depth: kind must be accumulated, expected or median, got {kind!r}")
    with torch.no_grad():
        rows = median_rows(project(means, quats, scales, camera, config), opacities, camera, config)
    return at_rows(camera_depth(means, camera), rows)


def camera_depth(means: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, " n"]:
    """Camera z of every point, differentiable in it."""
    # In float64, as the kernel projects: sums of large numbers may be small.
    axis = camera.viewmat[2].double()
    return (means.double() @ axis[:3] + axis[3]).to(means.dtype)


def median_rows(
    splats: Splats, weight: Float[Tensor, " n"], camera: Camera, config: RasterConfig
) -> Int[Tensor, "h w"]:
    """The Gaussian behind which at most half of a pixel's light is left; -1 where more is left behind all.

    `vlgs.ops.rasterize_reference.render_depth` defines it, on checked input.
    """
    return KERNELS.of(splats.depth)(splats, weight, camera, config)


def at_rows(values: Float[Tensor, " n"], rows: Int[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """The values of some rows, 0 for row -1; gradients are added up in one order whatever the threads."""
    padded = torch.cat([values.new_zeros(1), values])
    return padded.index_select(0, rows.flatten() + 1).view(rows.shape)


def _on_cpu(splats: Splats, weight: Tensor, camera: Camera, config: RasterConfig) -> Tensor:
    picture = weights_alone(splats, weight, camera, config)[0]
    rows = torch.empty(camera.height, camera.width, dtype=torch.int64)
    picture.median_rows(rows, torch.get_num_threads())
    return rows


KERNELS = Kernels("depth", cpu=_on_cpu)
