"""A trained `SplatModel` as a field."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vlgs.fields import Field, FieldImages, PointCloud, require_outputs
from vlgs.fields.cloud import point_cloud
from vlgs.fields.comparing import Comparing, Decoding, comparing
from vlgs.fields.similarity import CHUNK, rendered_feature
from vlgs.fields.splat import FusedGaussians, SplatModel
from vlgs.heads.classifier import Classifier
from vlgs.ops.depth import render_depth
from vlgs.types import Camera, DepthKind


class SplatField:
    """Gaussians whose training is over: they are fused once, for all that is asked of them.

    Args:
        model: The trained scene.
        color: Off: it was trained for language alone, and renders no colour.
        level: Place of the one mask level that is asked, from 0; None: all that the model has.
        language: Off: it was trained for colour alone, and answers no word.
        compare: How codes are compared with words; None: decoded.

    Raises:
        ValueError: If the model has no such level.
    """

    def __init__(
        self,
        model: SplatModel,
        color: bool = True,
        level: int | None = None,
        language: bool = True,
        compare: Comparing | None = None,
    ) -> None:
        if level is not None and not 0 <= level < model.levels:
            raise ValueError(f"splat field: level must be below {model.levels}, got {level}")
        self.model = model
        self.color = color
        self.level = level
        self.has_language = language
        self.compare = Decoding(model.head) if compare is None else compare

    @property
    def outputs(self) -> frozenset[str]:
        """See `Field`."""
        color = {"color", "alpha"} if self.color else set()
        return frozenset(color | ({"feature"} if self.has_language else set()))

    def levels(self) -> Sequence[Field]:
        """See `Field`; all have the same Gaussians and colour."""
        return (self,) if self.level is not None or self.model.levels == 1 else self._each

    @torch.no_grad()
    def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
        """See `Field`: one pass over the tiles."""
        require_outputs("splat field", outputs, self.outputs)
        color, language = bool(outputs & {"color", "alpha"}), "feature" in outputs
        view = self.model.render(camera, color, language, self._fused)
        return FieldImages(
            color=view.color if "color" in outputs else None,
            alpha=view.alpha_color if "alpha" in outputs else None,
            feature=None if view.feature is None else self._by_level(view.feature),
        )

    @torch.no_grad()
    def similarity(
        self,
        camera: Camera,
        words: Float[Tensor, "k e"],
        seen: FieldImages | None = None,
        pixels: Int[Tensor, " p"] | None = None,
    ) -> Float[Tensor, "levels k h w"]:
        """See `Field`: cosines with the embeddings of codes."""
        return self._compare(rendered_feature(self, camera, seen, pixels), words)

    def faster(self, within: float) -> "SplatField":
        """See `HasFaster`: of the same kind, with the same Gaussians."""
        made = copy(self)
        made.compare = comparing(self.model.head, within)
        vars(made).pop("_each", None)  # levels compare as they were made to
        return made

    def opacities(self) -> Float[Tensor, " n"]:
        """See `HasGaussians`."""
        return self._fused.gaussians.opacities

    def language_weights(self) -> Float[Tensor, " n *levels"]:
        """See `HasGaussians`; one for all levels, or one each with ``indicator=per_level``."""
        return self._fused.language_weight

    @torch.no_grad()
    def gaussian_similarity(self, words: Float[Tensor, "k e"]) -> Float[Tensor, "levels k n"]:
        """See `HasGaussians`."""
        return self._compare(self._by_level(self._fused.feature[None]), words)[:, :, 0]

    @torch.no_grad()
    def render_values(
        self, camera: Camera, values: Float[Tensor, "n c"], weight: Float[Tensor, " n"]
    ) -> Float[Tensor, "h w c"]:
        """See `HasGaussians`; in the shapes of language."""
        return self.model.render_values(camera, values, weight)

    @torch.no_grad()
    def depth(self, camera: Camera, kind: DepthKind = "expected") -> Float[Tensor, "h w"]:
        """See `HasDepth`: of what blends colour; of language, at the first level, where no colour was trained."""
        gaussians = self._fused.gaussians
        shape, weight = gaussians, gaussians.opacities
        if not self.color:
            shape = gaussians.language_shape or gaussians
            weight = self._fused.language_weight
            weight = weight if weight.dim() == 1 else weight[:, 0].contiguous()
        return render_depth(
            gaussians.means, shape.quats, shape.scales, weight,
            camera.viewmat, camera.K, camera.width, camera.height, self.model.raster, kind,
        )  # fmt: skip

    def point_cloud(self, cameras: Sequence[Camera]) -> PointCloud:
        """See `HasGaussians`; the codes of all levels, whichever is asked."""
        return point_cloud(self.model, cameras, self.color)

    @property
    def object_count(self) -> int:
        """See `HasObjects`."""
        head = self.model.head
        return head.classes - 1 if isinstance(head, Classifier) else 0

    @torch.no_grad()
    def objects(self, camera: Camera) -> Int[Tensor, "h w"]:
        """See `HasObjects`."""
        (codes,) = rendered_feature(self, camera, None, None)
        parts = codes.flatten(0, 1).split(CHUNK)
        found = torch.cat([self._classifier.logits(part).argmax(dim=-1) for part in parts])
        return found.view(codes.shape[:2])

    def with_objects(
        self, words: Float[Tensor, "k e"], chosen: Bool[Tensor, "k objects"]
    ) -> "ObjectField":
        """See `HasObjects`."""
        return ObjectField(self.model, words, chosen, self.color, self.level)

    @property
    def _classifier(self) -> Classifier:
        assert isinstance(self.model.head, Classifier)  # `object_count`
        return self.model.head

    @cached_property
    def _each(self) -> Sequence[Field]:
        return [
            SplatField(self.model, self.color, level, compare=self.compare)
            for level in range(self.model.levels)
        ]

    @cached_property
    def _fused(self) -> FusedGaussians:
        """Fusion over colour and the codes of all levels, of which those that are asked are kept."""
        with torch.no_grad():
            fused = self.model.fuse()
        if self.level is None:
            return fused
        weight = fused.language_weight
        return replace(
            fused,
            feature=fused.feature.chunk(self.model.levels, dim=1)[self.level],
            language_weight=weight if weight.dim() == 1 else weight[:, self.level].contiguous(),
            level=self.level,
        )

    def _by_level(self, codes: Float[Tensor, "h w c"]) -> Float[Tensor, "levels h w d"]:
        """Codes of the levels apart, which the model has side by side."""
        return _stack(codes.split(self.model.head.dim, dim=-1))

    def _compare(
        self, codes: Float[Tensor, "levels h w d"], words: Float[Tensor, "k e"]
    ) -> Float[Tensor, "levels k h w"]:
        return _stack([self.compare(level, words) for level in codes])


class ObjectField(SplatField):
    """A field that scores some words by the probability of their objects, and all others by cosines.

    Args:
        model: The trained scene, whose head is a classifier.
        words: Text vectors that have objects.
        chosen: Which objects each one has.
        color: See `SplatField`.
        level: Likewise.

    Raises:
        ValueError: If the words or the objects are not those that there are, or it is of several mask levels.
    """

    def __init__(
        self,
        model: SplatModel,
        words: Float[Tensor, "k e"],
        chosen: Bool[Tensor, "k objects"],
        color: bool = True,
        level: int | None = None,
    ) -> None:
        super().__init__(model, color, level)
        if len(self.levels()) > 1:
            raise ValueError(f"object field: mask levels must be 1, got {len(self.levels())}")
        wanted = [len(words), self.object_count]
        if words.dim() != 2 or list(chosen.shape) != wanted or not self.object_count:
            raise ValueError(f"object field: objects must be {wanted}, got {list(chosen.shape)}")
        self.words = words
        self.chosen = chosen

    def _compare(
        self, codes: Float[Tensor, "levels h w d"], words: Float[Tensor, "k e"]
    ) -> Float[Tensor, "levels k h w"]:
        scores = super()._compare(codes, words)
        for row, word in enumerate(words):
            for own, chosen in zip(self.words, self.chosen, strict=True):
                if torch.equal(own, word):
                    scores[0, row] = self._probability(codes[0], chosen)
        return scores

    def _probability(
        self, codes: Float[Tensor, "h w d"], chosen: Bool[Tensor, " objects"]
    ) -> Float[Tensor, "h w"]:
        """That a pixel shows one of the objects."""
        parts = codes.flatten(0, 1).split(CHUNK)
        logits = (self._classifier.logits(part) for part in parts)
        found = [one.softmax(dim=-1)[:, :-1][:, chosen].sum(dim=-1) for one in logits]
        return torch.cat(found).view(codes.shape[:2])


def _stack(parts: Sequence[Tensor]) -> Tensor:
    """Along a new first axis; a single one, which may be large, is not copied."""
    return parts[0][None] if len(parts) == 1 else torch.stack(list(parts))
