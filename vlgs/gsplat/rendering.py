"""`rasterization` with the signature, shapes and conventions of gsplat 1.5.3."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from vlgs.gaussians.sh import sh_to_rgb
from vlgs.geometry import camera_center
from vlgs.gsplat.absgrad import watch
from vlgs.gsplat.checks import (
    refuse,
    require_one_of,
    require_opacities,
    require_positive,
    require_shapes,
)
from vlgs.gsplat.view import Culling, ViewSplats, project_view
from vlgs.ops.rasterize import check_camera, check_config
from vlgs.ops.rasterize_to_pixels import rasterize_to_pixels
from vlgs.ops.view_color import view_color
from vlgs.types import Camera, ChannelGroup, RasterConfig

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]


class Meta(dict[str, Any]):
    """What gsplat calls ``meta`` or ``info``; what is asked for and not there is explained."""

    def __missing__(self, key: str) -> Any:
        raise KeyError(f"{key}: meta of vlgs.gsplat has {', '.join(self)}")


def rasterization(
    means: Float[Tensor, "*batch n 3"],
    quats: Float[Tensor, "*batch n 4"],
    scales: Float[Tensor, "*batch n 3"],
    opacities: Float[Tensor, "*batch n"],
    colors: Float[Tensor, "..."],
    viewmats: Float[Tensor, "*batch c 4 4"],
    Ks: Float[Tensor, "*batch c 3 3"],
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Float[Tensor, "*batch c d"] | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: object | None = None,
    rolling_shutter: object | None = None,
    viewmats_rs: Tensor | None = None,
) -> tuple[Float[Tensor, "*batch c h w x"], Float[Tensor, "*batch c h w 1"], Meta]:
    """Images of n Gaussians from c cameras, with gsplat's arguments, defaults, shapes and image model.

    The image model is that of gsplat 1.5.3: alpha is at most 0.999, contributions below 1/255 are left out, a pixel ends before the
    contribution that would bring its transmittance to 1e-4, and the Jacobian of the projection is clamped 0.3 half images outside of the
    image. tests/gsplat/dense.py writes it down in plain torch, and every mode is compared with that.

    ``meta`` has what gsplat's strategies and trainers read: ``means2d`` (between projecting and blending, so that after ``retain_grad()`` its
    gradient is that of the loss by pixels), ``radii``, ``depths``, ``conics``, ``opacities``, ``batch_ids``, ``camera_ids`` and ``gaussian_ids`` (None unless
    packed), ``width``, ``height``, ``tile_size``, ``tile_width``, ``tile_height``, ``n_batches`` and ``n_cameras``. Packed, the first six are of what each
    camera sees, ``[nnz, ...]``, camera by camera; otherwise ``[*batch, c, n, ...]`` with radii of 0 where a Gaussian is not seen.

    What differs from gsplat:

    * float64 works too, and everything is on the CPU.
    * `opacities` must be in [0, 1]; numbers that are not finite are an error that names them, not a picture.
    * A Gaussian exactly on the near plane is not drawn, nor is one whose quaternion is zero.
    * No gradient reaches `viewmats` and ``meta["conics"]``; spherical harmonics go to degree 3.
    * `packed` decides about ``meta`` alone; memory is the same. `tile_size`, `channel_chunk` and `segmented` change nothing that is drawn.
    * gsplat's lists of tiles (``tiles_per_gauss``, ``isect_ids``, ``flatten_ids``, ``isect_offsets``) are not in ``meta``.
    * `absgrad` is exact and slow (`vlgs.gsplat.absgrad`); ``meta["means2d"].absgrad`` is there, zero, before the backward pass.
    * Refused by name: `sparse_grad`, `distributed`, `covars`, `with_ut`, `with_eval3d`, distorted lenses, rolling shutters, and every `camera_model`
      but ``pinhole``.

    Args:
        means: Centres, world units.
        quats: Rotations (w, x, y, z), need not be normalised.
        scales: Standard deviations, world units, not their logarithms.
        opacities: In [0, 1], not their logits.
        colors: Values ``[*batch, (c,) n, d]``, or with `sh_degree` coefficients of spherical harmonics ``[*batch, (c,) n, k, 3]``.
        viewmats: World to camera.
        Ks: Pinhole intrinsics in pixels, without skew.
        width: Pixels.
        height: Pixels.
        near_plane: Nothing nearer is drawn, world units; above 0.
        far_plane: Nothing farther is drawn, world units.
        radius_clip: Gaussians whose radii are no larger are not drawn, pixels.
        eps2d: Added to the diagonal of 2D covariances, pixel^2; above 0.
        sh_degree: Highest degree in use, 0 to 3; None: `colors` are values.
        packed: Whether ``meta`` lists only what is seen.
        tile_size: Goes into ``meta``.
        backgrounds: What is seen where nothing lies; depth has none.
        render_mode: Colours, sum_i w_i z_i (``D``), the same by the accumulated weight (``ED``), or two of them: depth is the last channel.
        sparse_grad: Must be False.
        absgrad: Whether a backward pass writes ``meta["means2d"].absgrad``, the sums over pixels of the sizes of gradients (AbsGS).
        rasterize_mode: ``antialiased`` makes Gaussians fainter by what the blur of `eps2d` widens them (Mip-Splatting).
        channel_chunk: Without effect.
        distributed: Must be False.
        camera_model: Must be ``pinhole``.
        segmented: Without effect.
        covars: Must be None.
        with_ut: Must be False.
        with_eval3d: Must be False.
        radial_coeffs: Must be None.
        tangential_coeffs: Must be None.
        thin_prism_coeffs: Must be None.
        ftheta_coeffs: Must be None.
        rolling_shutter: Must be None, or gsplat's ``RollingShutterType.GLOBAL``.
        viewmats_rs: Must be None.

    Returns:
        Images, accumulated weights, and ``meta``.

    Raises:
        ValueError: For what is refused, a shape or a mode that gsplat does not have either, and as `vlgs.rasterize` does.

    Example:
        >>> K = torch.tensor([[[9.0, 0.0, 2.0], [0.0, 9.0, 1.5], [0.0, 0.0, 1.0]]])
        >>> splat = torch.tensor([[0.0, 0.0, 2.0]]), torch.eye(4)[:1], torch.full((1, 3), 0.1), torch.tensor([0.5])
        >>> image, alpha, meta = rasterization(*splat, torch.ones(1, 3), torch.eye(4)[None], K, 4, 3)
        >>> image.shape, alpha.shape, meta["radii"]
        (torch.Size([1, 3, 4, 3]), torch.Size([1, 3, 4, 1]), tensor([[3, 3]], dtype=torch.int32))
    """
    refuse(
        sparse_grad=sparse_grad, distributed=distributed, covars=covars,
        with_ut=with_ut, with_eval3d=with_eval3d, radial_coeffs=radial_coeffs,
        tangential_coeffs=tangential_coeffs, thin_prism_coeffs=thin_prism_coeffs,
        ftheta_coeffs=ftheta_coeffs, viewmats_rs=viewmats_rs,
    )  # fmt: skip
    require_one_of("camera_model", camera_model, ("pinhole",))
    require_one_of("rolling_shutter", getattr(rolling_shutter, "name", "GLOBAL"), ("GLOBAL",))
    require_one_of("render_mode", render_mode, ("RGB", "D", "ED", "RGB+D", "RGB+ED"))
    require_one_of("rasterize_mode", rasterize_mode, ("classic", "antialiased"))
    splats = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    places = {"viewmats": viewmats, "Ks": Ks}
    places |= {} if backgrounds is None else {"backgrounds": backgrounds}
    require_shapes(splats, colors, places, sh_degree)
    require_opacities(opacities)
    require_positive(tile_size=tile_size)
    batch, c = means.shape[:-2], viewmats.shape[-3]
    config = RasterConfig(near=near_plane, eps2d=eps2d, alpha_max=0.999, stop="before")
    culling = Culling(far_plane, radius_clip)
    try:
        check_config(config)
        cameras = _cameras(viewmats, Ks, width, height)
        parts = [_per_image(t, batch, c) for t in splats.values()]
        views = [
            project_view(
                mean, quat, scale, opacity, camera, config, culling, rasterize_mode == "antialiased"
            )
            for mean, quat, scale, opacity, camera in zip(*parts, cameras, strict=True)
        ]
        shades = _shades(colors, sh_degree, parts[0], cameras, batch)
        views = [_with_values(*pair, render_mode) for pair in zip(views, shades, strict=True)]
        views, meta = _describe(views, batch, c, packed)
        images, alphas = _draw(views, meta["means2d"], cameras, config, absgrad)
    except ValueError as error:
        raise ValueError(_in_gsplat_names(str(error))) from error
    images = images.view(*batch, c, *images.shape[1:])
    alphas = alphas.view(*batch, c, height, width, 1)
    if backgrounds is not None and "RGB" in render_mode:
        behind = pad(backgrounds, (0, images.shape[-1] - backgrounds.shape[-1]))
        images = images + (1 - alphas) * behind[..., None, None, :]
    if "ED" in render_mode:
        rest, depth = images.split([images.shape[-1] - 1, 1], dim=-1)
        images = torch.cat([rest, depth / alphas.clamp_min(1e-10)], dim=-1)
    meta |= {
        "width": width, "height": height, "tile_size": tile_size,
        "tile_width": math.ceil(width / tile_size), "tile_height": math.ceil(height / tile_size),
        "n_batches": math.prod(batch), "n_cameras": c,
    }  # fmt: skip
    return images, alphas, meta


def _cameras(viewmats: Tensor, Ks: Tensor, width: int, height: int) -> list[Camera]:
    """One per image: those of a batch entry stand together."""
    pairs = zip(viewmats.reshape(-1, 4, 4), Ks.reshape(-1, 3, 3), strict=True)
    cameras = [Camera(viewmat, K, width, height) for viewmat, K in pairs]
    for camera in cameras:
        check_camera(camera)
    return cameras


def _per_image(tensor: Tensor, batch: torch.Size, c: int) -> list[Tensor]:
    """A tensor of Gaussians ``[*batch, n, ...]`` once for each image."""
    entries = tensor.reshape(math.prod(batch), *tensor.shape[len(batch) :]).unbind(0)
    return [entry for entry in entries for _ in range(c)]


def _shades(
    colors: Tensor,
    sh_degree: int | None,
    means: Sequence[Float[Tensor, "n 3"]],
    cameras: Sequence[Camera],
    batch: torch.Size,
) -> list[Float[Tensor, "n d"]]:
    """Colour of every Gaussian in each image."""
    if colors.dim() == len(batch) + (2 if sh_degree is None else 3):
        own = _per_image(colors, batch, len(cameras) // math.prod(batch))
    else:
        own = list(colors.reshape(len(cameras), *colors.shape[len(batch) + 1 :]).unbind(0))
    if sh_degree is None:
        return own
    return [
        view_color(sh_to_rgb(k[:, 0]), k[:, 1:], mean, camera_center(camera.viewmat), sh_degree)
        for k, mean, camera in zip(own, means, cameras, strict=True)
    ]


def _with_values(
    view: ViewSplats, shade: Float[Tensor, "n d"], render_mode: RenderMode
) -> ViewSplats:
    """A view with what is blended: colour, depth, or depth after colour."""
    if "RGB" not in render_mode:
        return view
    values = torch.cat([shade, view.values], dim=1) if "D" in render_mode else shade
    return replace(view, values=values)


def _describe(
    views: Sequence[ViewSplats], batch: torch.Size, c: int, packed: bool
) -> tuple[list[ViewSplats], Meta]:
    """What is drawn, and what `Meta` says of it: of every Gaussian in every image, or packed."""
    ids: dict[str, Tensor | None] = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    shape = (*batch, c, len(views[0].radii))
    if packed:
        rows = [view.seen.nonzero()[:, 0] for view in views]
        views = [view.rows(row) for view, row in zip(views, rows, strict=True)]
        image = torch.arange(len(rows)).repeat_interleave(torch.tensor([len(r) for r in rows]))
        ids = {"batch_ids": image // c, "camera_ids": image % c, "gaussian_ids": torch.cat(rows)}
        shape = (len(image),)
    figures = {
        "radii": [view.radii for view in views],
        "means2d": [view.splats.mean2d for view in views],
        "depths": [view.depths for view in views],
        "conics": [view.conics for view in views],
        "opacities": [view.opacities for view in views],
    }
    joined = {k: _cat(parts).view(*shape, *parts[0].shape[1:]) for k, parts in figures.items()}
    return list(views), Meta(**ids, **joined)


def _cat(parts: Sequence[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


def _draw(
    views: Sequence[ViewSplats],
    means2d: Float[Tensor, "*shape 2"],
    cameras: Sequence[Camera],
    config: RasterConfig,
    absgrad: bool,
) -> tuple[Float[Tensor, "i h w x"], Float[Tensor, "i h w"]]:
    """Blend every image, with the centres that stand in `Meta`, so that their gradient is gathered there."""
    counts = [len(view.radii) for view in views]
    sizes = torch.zeros_like(means2d) if absgrad else means2d.detach()
    if absgrad:
        means2d.absgrad = sizes  # pyright: ignore[reportAttributeAccessIssue] (gsplat's name and place)
    images, alphas = [], []
    for view, center, size, camera in zip(
        views, means2d.view(-1, 2).split(counts), sizes.view(-1, 2).split(counts), cameras, strict=True
    ):  # fmt: skip
        splats = view.splats._replace(mean2d=center)
        out = rasterize_to_pixels(
            splats, [ChannelGroup(view.values, view.opacities)], camera, config
        )
        image, alpha = out.images[0], out.alphas[0]
        if absgrad:
            image, alpha = watch(out, view, camera, config, size)
        images.append(image)
        alphas.append(alpha)
    return _stack(images), _stack(alphas)


def _stack(parts: Sequence[Tensor]) -> Tensor:
    """Along a new first axis; a single image is not copied."""
    return parts[0][None] if len(parts) == 1 else torch.stack(list(parts))


def _in_gsplat_names(message: str) -> str:
    """What the operations below complain of, by the names of the arguments here."""
    for ours, theirs in _NAMES.items():
        message = message.replace(ours, theirs)
    return message


_NAMES = {
    "rasterize:": "rasterization:", "RasterConfig:": "rasterization:", "groups[0].values": "colors",
    "groups[0].weight": "opacities", "viewmat ": "viewmats ", "near ": "near_plane ", "K ": "Ks ",
}  # fmt: skip
