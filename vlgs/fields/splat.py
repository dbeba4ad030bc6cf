"""A scene as a model: Gaussians, fusion, indicator and head together, rendered from any camera."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from vlgs.fusion import Fusion
from vlgs.gaussians import STANDARD, Attributes, activate
from vlgs.gaussians.sh import sh_to_rgb
from vlgs.geometry import camera_center
from vlgs.heads import Head
from vlgs.indicator import Indicator
from vlgs.ops.rasterize import rasterize
from vlgs.ops.view_color import view_color
from vlgs.types import Camera, ChannelGroup, Gaussians, RasterConfig

_ANYWHERE = torch.zeros(3)


@dataclass(frozen=True)
class FusedGaussians:
    """Gaussians after fusion: what all renders of one iteration share."""

    gaussians: Gaussians
    color: Float[Tensor, "n 3"]
    """u_1..3 of Eq. 5: RGB before the view-dependent part is added."""
    feature: Float[Tensor, "n d"]
    """u_4.. of Eq. 5; the codes of all mask levels side by side with ``levels=joint``."""
    language_weight: Float[Tensor, " n *levels"]
    """What blends language: l, o or a constant, as the indicator says (Eq. 6)."""
    level: int | None = None
    """Place of the mask level that `feature` and `language_weight` are of; None: all that the model has."""


@dataclass(frozen=True)
class ViewRender:
    """One view of a model. A modality that was not asked for is None."""

    color: Float[Tensor, "h w 3"] | None
    feature: Float[Tensor, "h w d"] | None
    alpha_color: Float[Tensor, "h w"] | None
    alpha_language: Float[Tensor, "h w *levels"] | None
    visible: Bool[Tensor, " n"]
    mean2d: Float[Tensor, "n 2"]
    further: Mapping[str, Float[Tensor, "h w _"]] = field(default_factory=dict)
    """Further attributes that were asked for, by name."""

    def detach(self) -> "ViewRender":
        """The same pixels, from which no gradient can be asked."""
        values = ((f.name, getattr(self, f.name)) for f in fields(self))
        tensors = {name: t.detach() for name, t in values if isinstance(t, Tensor)}
        further = {name: image.detach() for name, image in self.further.items()}
        return replace(self, **tensors, further=further)


class SplatModel(nn.Module):
    """A trained scene: the parameters in a checkpoint, and everything that is needed to render.

    Args:
        parameters: Raw Gaussians, by the names of `attributes`.
        fusion: Mixes colour and language of each Gaussian (Eq. 5).
        indicator: Chooses what blends language (Eq. 6).
        head: From language code to embedding.
        raster: Constants of the rasterizer.
        sh_degree: Highest spherical harmonics degree in use, 0 to 3.
        evaluated: Whether colour is fused as each view sees it, so that what is blended as language depends on the view
            (``gaussians.color=evaluated``, conf/README.md, D.7); questions in 3D are then asked of the fusion with degree 0.
        attributes: What a Gaussian carries.
    """

    def __init__(
        self,
        parameters: dict[str, Tensor],
        fusion: Fusion,
        indicator: Indicator,
        head: Head,
        raster: RasterConfig,
        sh_degree: int,
        evaluated: bool = False,
        attributes: Attributes = STANDARD,
    ) -> None:
        super().__init__()
        self.splats = nn.ParameterDict({k: nn.Parameter(v) for k, v in parameters.items()})
        self.fusion = fusion
        self.indicator = indicator
        self.head = head
        self.raster = raster
        self.sh_degree = sh_degree
        self.evaluated = evaluated
        self.attributes = attributes

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return self.splats["means"].shape[0]

    @property
    def levels(self) -> int:
        """Number of mask levels that a Gaussian has a code for; above 1 with ``levels=joint``, and 1 where a stage of colour alone leaves codes out."""
        return max(1, self.splats["features"].shape[1] // self.head.dim)

    def gaussians(self) -> Gaussians:
        """The Gaussians in natural units."""
        return activate(self.splats, self.attributes)

    def fuse(self) -> FusedGaussians:
        """Activate and fuse all Gaussians; once per iteration, however many views are rendered."""
        gaussians = self.gaussians()
        color, feature = self.fusion(sh_to_rgb(gaussians.sh0), gaussians.features)
        return FusedGaussians(gaussians, color, feature, self.indicator(gaussians))

    def render(
        self,
        camera: Camera,
        color: bool = True,
        language: bool = True,
        fused: FusedGaussians | None = None,
        further: Sequence[str] = (),
        raster: RasterConfig | None = None,
    ) -> ViewRender:
        """Render colour, language and further attributes in one pass over the tiles.

        Args:
            camera: Where to look from.
            color: Whether colour is wanted.
            language: Whether language is wanted.
            fused: Result of `fuse`, when several views share it.
            further: Names of further attributes that are wanted (``gaussians.attributes``).
            raster: In place of the model's own constants.

        Raises:
            ValueError: If nothing is wanted, a further attribute cannot be drawn, or a Gaussian is not finite.
        """
        if not (color or language or further):
            raise ValueError("render: color or language must be true, got neither")
        fused = self.fuse() if fused is None else fused
        groups, values, feature = [], None, fused.feature
        if self.evaluated:
            values, feature = self._fuse_as_seen(fused.gaussians, camera)
            if fused.level is not None:
                feature = feature.chunk(self.levels, dim=1)[fused.level]
        if color:
            values = self.view_color(fused, camera) if values is None else values
            groups.append(ChannelGroup(values, fused.gaussians.opacities))
        if language:
            shape_grad = self.attributes["features"].shape_grad
            groups += _language_groups(feature, fused, shape_grad)
        before = len(groups)
        groups += [self._group(name, fused) for name in further]
        out = self._rasterize(fused.gaussians, groups, camera, raster or self.raster)
        seen, alpha = out.images[before - 1], out.alphas[before - 1]
        if language and fused.language_weight.dim() == 2:
            levels = fused.language_weight.shape[1]
            seen = torch.cat(out.images[before - levels : before], dim=-1)
            alpha = torch.stack(out.alphas[before - levels : before], dim=-1)
        return ViewRender(
            color=out.images[0] if color else None,
            feature=seen if language else None,
            alpha_color=out.alphas[0] if color else None,
            alpha_language=alpha if language else None,
            visible=out.visible,
            mean2d=out.mean2d,
            further=dict(zip(further, out.images[before:], strict=True)),
        )

    def _group(self, name: str, fused: FusedGaussians) -> ChannelGroup:
        """What draws a further attribute."""
        row, values = self.attributes.get(name), fused.gaussians.further
        weight = fused.gaussians.opacities
        if row is None or name not in values or row.blended_by is None:
            drawn = [n for n in values if self.attributes[n].blended_by is not None]
            raise ValueError(
                f"render: further attributes must be some of {', '.join(drawn) or 'none'}, got {name}"
            )
        if row.blended_by == "opacity_logits":
            return ChannelGroup(values[name], weight, row.shape_grad)
        if fused.language_weight.dim() == 2:
            raise ValueError(
                f"render: {name} must be blended by the opacity with indicator=per_level, got the indicator"
            )
        return ChannelGroup(
            values[name], fused.language_weight, row.shape_grad, fused.gaussians.language_shape
        )

    def render_values(
        self,
        camera: Camera,
        values: Float[Tensor, "n c"],
        weight: Float[Tensor, " n"],
        step: int = 1,
        of_color: bool = False,
    ) -> Float[Tensor, "h w c"]:
        """Blend any per-Gaussian values with any weight, in the shapes of language, e.g. the l - o map of Fig. 3.

        Args:
            camera: Of the image.
            values: One row per Gaussian.
            weight: In place of the opacity, in [0, 1].
            step: Of `camera`, where it is every `step`-th pixel of another (`vlgs.geometry.subsample_camera`). They come out as in the other's
                image, but for Gaussians that `RasterConfig.fov_margin` clamps, as that depends on the image.
            of_color: In the shapes of colour instead.
        """
        return self.render_each(camera, [(values, weight, of_color)], step)[0]

    def render_each(
        self,
        camera: Camera,
        groups: Sequence[tuple[Float[Tensor, "n c"], Float[Tensor, " n"], bool]],
        step: int = 1,
    ) -> tuple[Float[Tensor, "h w c"], ...]:
        """Likewise for values, weight and `of_color` of several, in one pass over the tiles where they have one shape."""
        gaussians = self.gaussians()
        drawn = [
            ChannelGroup(values, weight, shape=None if of_color else gaussians.language_shape)
            for values, weight, of_color in groups
        ]
        return self._rasterize(gaussians, drawn, camera, self.raster_of(step)).images

    def raster_of(self, step: int) -> RasterConfig:
        """The constants for every `step`-th pixel of an image: `RasterConfig.eps2d` is in pixels."""
        return self.raster if step == 1 else replace(self.raster, eps2d=self.raster.eps2d / step**2)

    def predict(self, feature: Float[Tensor, "h w c"]) -> Float[Tensor, "h wl t"]:
        """What a rendered map of codes is compared by (`Head.predict`); l mask levels stand beside each other in a row."""
        # A map of one level has this shape already; a view for nothing is measured in every step (`vlgs.bench.seams`).
        head = self.head
        if feature.shape[-1] != head.dim:
            feature = feature.view(len(feature), -1, head.dim)
        return head.predict(feature)

    def view_color(self, fused: FusedGaussians, camera: Camera) -> Float[Tensor, "n 3"]:
        """RGB of every Gaussian as a camera sees it, >= 0."""
        if self.evaluated:
            return self._fuse_as_seen(fused.gaussians, camera)[0]
        gaussians, eye = fused.gaussians, self._eye(camera)
        return view_color(fused.color, gaussians.shN, gaussians.means, eye, self.sh_degree)

    def _eye(self, camera: Camera) -> Float[Tensor, " 3"]:
        """Where colour is seen from; of degree 0 it is the same from anywhere, and the centre is not looked for."""
        return camera_center(camera.viewmat) if self.sh_degree else _ANYWHERE

    def _fuse_as_seen(
        self, gaussians: Gaussians, camera: Camera
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n d"]]:
        eye, rgb = self._eye(camera), sh_to_rgb(gaussians.sh0)
        seen = view_color(rgb, gaussians.shN, gaussians.means, eye, self.sh_degree)
        color, feature = self.fusion(seen, gaussians.features)
        return color.clamp_min(0.0), feature

    def _rasterize(
        self,
        gaussians: Gaussians,
        groups: list[ChannelGroup],
        camera: Camera,
        raster: RasterConfig,
    ):
        return rasterize(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            groups,
            camera.viewmat,
            camera.K,
            camera.width,
            camera.height,
            config=raster,
        )


def _language_groups(
    feature: Float[Tensor, "n d"], fused: FusedGaussians, shape_grad: bool
) -> list[ChannelGroup]:
    """All codes in one group, or a group per mask level where each has an indicator of its own."""
    weight, shape = fused.language_weight, fused.gaussians.language_shape
    if weight.dim() == 1:
        return [ChannelGroup(feature, weight, shape_grad, shape)]
    levels = zip(feature.chunk(weight.shape[1], dim=1), weight.unbind(dim=1), strict=True)
    return [ChannelGroup(codes, own.contiguous(), shape_grad, shape) for codes, own in levels]
