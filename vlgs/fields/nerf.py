"""A radiance field, and a language field over it, as a field that can be asked: no Gaussians."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.fields import Field, FieldImages, require_outputs
from vlgs.fields.language_field import LanguageField
from vlgs.fields.radiance import RadianceField, Samples
from vlgs.fields.rays import ray_depth
from vlgs.fields.similarity import CHUNK, cosines, rendered_feature
from vlgs.types import Camera, DepthKind

RAYS = 2048
"""Rays that are rendered at once."""


class NerfField:
    """A trained radiance field.

    Args:
        radiance: Colour and density.
        language: What it means; None: nothing.
        samples: Of a ray, how many with the largest weights are asked for their features.
        scales: Physical scales among which each word has the one at which it fits best (LERF).
        negatives: Words that make "best" LERF's relevancy: an answer is then how far a word is above the strongest of them, and theirs is 0.
            Without any, an answer is a cosine.
    """

    def __init__(
        self,
        radiance: RadianceField,
        language: LanguageField | None = None,
        samples: int = 4,
        scales: Sequence[float] = (),
        negatives: Float[Tensor, "m e"] | None = None,
    ) -> None:
        self.radiance = radiance
        self.language = language
        self.samples = samples
        self.scales: Sequence[float | None] = scales or (None,)
        self.negatives = negatives

    @property
    def has_language(self) -> bool:
        """See `Field`."""
        return self.language is not None

    @property
    def outputs(self) -> frozenset[str]:
        """See `Field`."""
        return frozenset({"color", "alpha"} | ({"feature"} if self.language is not None else set()))

    def levels(self) -> Sequence[Field]:
        """See `Field`; there is one: a level of masks is a scale."""
        return (self,)

    @torch.no_grad()
    def render(self, camera: Camera, outputs: frozenset[str]) -> FieldImages:
        """See `Field`. What lies behind everything is part of the field, so that `alpha` is 1; `feature` is what the networks of language read."""
        require_outputs("radiance field", outputs, self.outputs)
        colors, features = [], []
        for pixels in torch.arange(camera.height * camera.width).split(RAYS):
            rays = self.radiance.frame.look(camera, pixels)
            samples = self.radiance.sample(rays)
            color, weights, _ = self.radiance(rays, samples)
            colors.append(color)
            if "feature" in outputs and self.language is not None:
                features.append(along(self.language, samples, weights, self.samples)[0])
        size = (camera.height, camera.width)
        color = torch.cat(colors).unflatten(0, size)
        return FieldImages(
            color=color if "color" in outputs else None,
            alpha=torch.ones(size) if "alpha" in outputs else None,
            feature=torch.cat(features).unflatten(0, size)[None] if features else None,
        )

    @torch.no_grad()
    def depth(self, camera: Camera, kind: DepthKind = "expected") -> Float[Tensor, "h w"]:
        """See `HasDepth`. What lies behind everything has a distance too, which draws the mean far back; the median it leaves alone."""
        forward, parts = camera.viewmat[2, :3], []
        for pixels in torch.arange(camera.height * camera.width).split(RAYS):
            rays = self.radiance.frame.look(camera, pixels)
            samples = self.radiance.sample(rays)
            distance = ray_depth(samples.distances, self.radiance.weights(samples), kind)
            parts.append(distance / self.radiance.frame.scale * (rays.directions @ forward))
        return torch.cat(parts).unflatten(0, (camera.height, camera.width))

    @torch.no_grad()
    def similarity(
        self,
        camera: Camera,
        words: Float[Tensor, "k e"],
        seen: FieldImages | None = None,
        pixels: Int[Tensor, " p"] | None = None,
    ) -> Float[Tensor, "levels k h w"]:
        """See `Field`: at each word's best scale, which is one for all pixels that are asked."""
        features = rendered_feature(self, camera, seen, pixels)[0]
        flat = features.flatten(0, 1)
        best = self._ask(flat, words, self.scales[0])
        for scale in self.scales[1:]:
            found = self._ask(flat, words, scale)
            better = found.amax(dim=1) > best.amax(dim=1)
            best = torch.where(better[:, None], found, best)
        return best.unflatten(1, features.shape[:2])[None]

    def _ask(
        self, features: Float[Tensor, "n w"], words: Float[Tensor, "k e"], scale: float | None
    ) -> Float[Tensor, "k n"]:
        """How well words fit at one scale."""
        assert self.language is not None  # it has features
        asked = words if self.negatives is None else torch.cat([words, self.negatives])
        parts = [cosines(self.language.embed(part, scale), asked) for part in features.split(CHUNK)]
        found = torch.cat(parts, dim=1)
        if self.negatives is None:
            return found
        own, negatives = found.split([len(words), len(self.negatives)])
        # A negative ties with the strongest negative by what the word means, whatever it is itself.
        same = (words @ self.negatives.T > 1 - 1e-5).any(dim=1, keepdim=True)
        return torch.where(same, 0.0, own - negatives.amax(dim=0))


def along(
    language: LanguageField,
    samples: Samples,
    weights: Float[Tensor, "r s"],
    count: int,
) -> tuple[Float[Tensor, "r w"], Float[Tensor, " r"]]:
    """Features that rays see, and how far away: means over the samples with the largest weights.

    LERF averages embeddings of such samples; features are averaged here, so that a network is asked once for a ray. No gradient reaches
    the weights.
    """
    best, index = weights.detach().topk(min(count, weights.shape[1]), dim=1, sorted=False)
    share = best / best.sum(dim=1, keepdim=True).clamp_min(1e-9)
    places = samples.places.gather(1, index[..., None].expand(-1, -1, 3))
    features = language.features(places.flatten(0, 1)).unflatten(0, index.shape)
    distances = samples.distances.gather(1, index)
    return (share[..., None] * features).sum(dim=1), (share * distances).sum(dim=1)
