"""GOI's optimisable hyperplane: what belongs to a word is learned from a mask in one view, and asked of all others (Qu et al., ACM MM 2024)."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.fields import Field
from vlgs.fields.planes import Plane, with_planes
from vlgs.fields.similarity import cosines
from vlgs.queries.prompts import Prompts
from vlgs.queries.view_masks import masks_from
from vlgs.types import Scene
from vlgs.values import require_range

log = logging.getLogger(__name__)

PIXELS = 2048
"""Most features that a plane is fitted to, evenly chosen among different ones; a table of 300 embeddings has fewer."""
ROUNDING = 1e-4
"""Features nearer than this in every number count as one."""


@dataclass(frozen=True)
class Hyperplane:
    """Relevancy is ``sigmoid(f w / scale + b)`` of a unit feature f, with a plane (w, b) for each word.

    A plane starts as the word itself and is moved by gradient descent on the hinge loss of the pixels of one training view, until
    its answer there overlaps the mask well enough. GOI takes this mask from a network that finds what words refer to. Here it comes from a
    folder (`vlgs.queries.view_masks.MaskFolder`), or it is one of the scene's own (`vlgs.queries.view_masks.OwnMasks`).

    Args:
        scale: Of the products; that of APE's embeddings in GOI.
        bias: b at the start; null: half-way between the mean products inside and outside of the mask. GOI's for APE is
            ``2 - logit(0.86)``, 0.185, with which almost all of a picture answers to CLIP's cosines.
        learning_rate: Of the descent.
        steps: At most.
        overlap: IoU with the mask at which a plane is good enough.
        candidates: How many of the nearest masks are looked at, of the scene's own.
        masks: Folder of ``<word>/<view>.png``; null: the scene's own masks.

    Raises:
        ValueError: If a number is out of range.
    """

    scale: float = 0.3438
    bias: float | None = None
    learning_rate: float = 0.01
    steps: int = 8000
    overlap: float = 0.9
    candidates: int = 5
    masks: str | None = None

    def __post_init__(self) -> None:
        require_range("hyperplane", 1e-6, 1e6, scale=self.scale)
        require_range("hyperplane", -1e6, 1e6, bias=self.bias)
        require_range("hyperplane", 0, 1e3, learning_rate=self.learning_rate)
        require_range("hyperplane", 0, 10**7, steps=self.steps)
        require_range("hyperplane", 0, 1, overlap=self.overlap)
        require_range("hyperplane", 1, 10**6, candidates=self.candidates)

    @property
    def negatives(self) -> Sequence[str]:
        """None: a plane has its own other side."""
        return ()

    @property
    def needs_all_prompts(self) -> bool:
        """False: every word has a plane of its own."""
        return False

    def relevancy(
        self, prompts: Float[Tensor, " k *p"], negatives: Float[Tensor, " m *p"]
    ) -> Float[Tensor, " k *p"]:
        """From the distances to the planes that the field of `learn` answers; 0.5 is on the plane."""
        return prompts.sigmoid()

    def __call__(
        self,
        features: Float[Tensor, "*p e"],
        text: Float[Tensor, "k e"],
        negatives: Float[Tensor, "m e"],
    ) -> Float[Tensor, " k *p"]:
        """Without a mask to learn from: the planes as they start with ``bias``, or through the origin."""
        return (cosines(features, text) / self.scale + (self.bias or 0.0)).sigmoid()

    def require(self, scene: Scene, words: Sequence[str]) -> None:
        """Refuse masks that no word could be learned from; see `vlgs.queries.Particular`."""
        masks_from(self.masks, self.candidates).require(scene, words)

    @torch.no_grad()
    def learn(self, field: Field, scene: Scene, prompts: Prompts) -> Field:
        """The same field, which answers these words by planes; that of a word without a mask stays as it starts.

        Args:
            field: The trained scene. Of several mask levels the last, of whole objects, is looked at.
            scene: Its training views and masks.
            prompts: The words.
        """
        planes, whole = [], field.levels()[-1]
        masks = masks_from(self.masks, self.candidates)
        for name, word in zip(prompts.names, normalize(prompts.text.float(), dim=-1), strict=True):
            found = masks.find(whole, scene, name, word)
            if found is None:
                planes.append(Plane(word / self.scale, self.bias or 0.0))
                continue
            view, mask = found
            # Cosines with the axes are the unit features themselves.
            seen = whole.similarity(view.camera, torch.eye(len(word)))  # [1, e, h, w]
            plane, overlap = self.fit(seen[0].flatten(1).T, mask.flatten(), word)
            log.info("%s: plane with overlap %.2f in %s", name, overlap, view.name)
            planes.append(plane)
        return with_planes(field, prompts.text, planes)

    def fit(
        self, features: Float[Tensor, "p e"], mask: Bool[Tensor, " p"], word: Float[Tensor, " e"]
    ) -> tuple[Plane, float]:
        """The plane of a word, and its overlap (IoU) with the mask.

        Args:
            features: Of unit length, one for each pixel of a view.
            mask: What belongs to the word.
            word: Of unit length.
        """
        rows, inside, outside = _different(features, mask)
        rows = rows / self.scale
        weights, bias = word.clone(), self.bias
        products = rows @ weights
        if bias is None:
            means = [(products @ n) / n.sum().clamp_min(1) for n in (inside, outside)]
            bias = -float(means[0] + means[1]) / 2
        offset = torch.tensor(bias)
        best, best_overlap = (weights.clone(), float(offset)), -1.0
        for _ in range(self.steps + 1):
            distance = rows @ weights + offset
            overlap = _overlap(distance > 0, inside, outside)
            if overlap > best_overlap:
                best, best_overlap = (weights.clone(), float(offset)), overlap
            if overlap >= self.overlap:
                break
            slope = hinge_slope(distance, inside, outside)
            weights = weights - self.learning_rate * (slope @ rows)
            offset = offset - self.learning_rate * slope.sum()
        return Plane(best[0] / self.scale, best[1]), best_overlap


def hinge_slope(
    distance: Float[Tensor, " r"], inside: Float[Tensor, " r"], outside: Float[Tensor, " r"]
) -> Float[Tensor, " r"]:
    """Gradient of the mean of ``max(0, 1 - d)`` inside and ``max(0, 1 + d)`` outside by the distances d; counts say how often each is there."""
    slope = outside * (distance > -1) - inside * (distance < 1)
    return slope / (inside.sum() + outside.sum())


def _different(
    features: Float[Tensor, "p e"], mask: Bool[Tensor, " p"]
) -> tuple[Float[Tensor, "r e"], Float[Tensor, " r"], Float[Tensor, " r"]]:
    """Features that differ, and how many pixels inside and outside of the mask have each."""
    every = 1
    rounded = (features / ROUNDING).round()
    rows, which = rounded.unique(dim=0, return_inverse=True)
    if len(rows) > PIXELS:
        every = -(-len(features) // PIXELS)
        rows, which = rounded[::every].unique(dim=0, return_inverse=True)
    kept = mask[::every]
    counts = [torch.bincount(which[side], minlength=len(rows)).float() for side in (kept, ~kept)]
    return rows * ROUNDING, counts[0], counts[1]


def _overlap(
    chosen: Bool[Tensor, " r"], inside: Float[Tensor, " r"], outside: Float[Tensor, " r"]
) -> float:
    both = inside[chosen].sum()
    return float(both / (inside.sum() + outside[chosen].sum()).clamp_min(1))
