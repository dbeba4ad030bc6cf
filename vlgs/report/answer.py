"""Renders one view of a trained scene and answers prompts in it. Scores and pictures are both made from this."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from vlgs.query import Prompts, decoded_cosines
from vlgs.types import Camera, Gaussians


@runtime_checkable
class RenderedView(Protocol):
    """What is read of `vlgs.render.model.ViewRender`; a modality that was not asked for is None."""

    @property
    def color(self) -> Float[Tensor, "h w 3"] | None:
        """Blended colour, not clamped."""
        ...

    @property
    def feature(self) -> Float[Tensor, "h w d"] | None:
        """Blended language code."""
        ...


@runtime_checkable
class Fused(Protocol):
    """What is read of `vlgs.render.model.FusedGaussians`."""

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians in natural units."""
        ...

    @property
    def feature(self) -> Float[Tensor, "n d"]:
        """Language code of each Gaussian, as it is blended."""
        ...

    @property
    def language_weight(self) -> Float[Tensor, " n"]:
        """What blends language, l in general."""
        ...


@runtime_checkable
class ViewModel(Protocol):
    """What is used of `vlgs.render.model.SplatModel`: a scene that can be rendered from any camera."""

    codec: Any
    """`vlgs.codec.Codec`: `decode` turns codes ``[..., d]`` into embeddings ``[..., e]``."""

    def fuse(self) -> Any:
        """A `Fused`, which all views of a finished scene share."""
        ...

    def render(
        self, camera: Camera, color: bool = True, language: bool = True, fused: Any = None
    ) -> RenderedView:
        """Colour, language or both from one camera."""
        ...

    def render_values(
        self, camera: Camera, values: Float[Tensor, "n c"], weight: Float[Tensor, " n"]
    ) -> Float[Tensor, "h w c"]:
        """Any values per Gaussian, blended with any weight."""
        ...


@dataclass(frozen=True)
class Answer:
    """A rendered view and how its pixels compare with the prompts."""

    color: Float[Tensor, "h w 3"]
    """Clamped to [0, 1]."""
    feature: Float[Tensor, "h w d"]
    """Language codes as rendered."""
    cosines: Float[Tensor, "k h w"] | None
    """With every prompt; None without prompts."""
    negatives: Float[Tensor, "m h w"] | None
    """With every negative of the query."""


@torch.no_grad()
def answer_view(model: ViewModel, camera: Camera, prompts: Prompts | None, fused: Fused) -> Answer:
    """Render a view once and decode it once, for all prompts and negatives together.

    Args:
        model: The trained scene.
        camera: Where to look from.
        prompts: What is asked for, or None for the pictures alone.
        fused: Result of `model.fuse`, which all views of a finished scene share.
    """
    view = model.render(camera, color=True, language=True, fused=fused)
    assert view.color is not None  # both modalities were asked for
    assert view.feature is not None
    cosines = negatives = None
    if prompts is not None:
        words = torch.cat([prompts.text, prompts.negatives])
        both = decoded_cosines(model.codec.decode, view.feature, words)
        cosines, negatives = both.split([len(prompts.text), len(prompts.negatives)])
    return Answer(view.color.clamp(0, 1), view.feature, cosines, negatives)
