"""Gaussian Grouping's query: a mask in one view says which objects a word means, and these are its answer in all views (Ye et al., ECCV 2024)."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.demands import Demand
from vlgs.fields import Field, HasObjects
from vlgs.fields.several import SeveralFields
from vlgs.fields.similarity import cosines
from vlgs.queries.prompts import Prompts
from vlgs.queries.view_masks import Found, masks_from
from vlgs.types import Scene
from vlgs.values import require_range

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Objects:
    """Relevancy is the probability of the objects that a mask of one training view shows.

    An object belongs to a word where most of the pixels that show it lie inside of the mask; if there is none, the one that most pixels of the
    mask show does. The released program has this mask from a detector (Grounding DINO and SAM), in the first view that it renders. Here it comes from
    a folder, or it is one of the scene's own, as for `vlgs.queries.hyperplane.Hyperplane`. A word without a mask has no answer: 0 everywhere.

    Args:
        share: Of the pixels that show an object, how much has to lie inside; 0.7 is the released program's.
        candidates: How many of the scene's masks are looked at whose vectors are nearest to the word.
        masks: Folder of ``<word>/<view>.png`` (`vlgs.queries.view_masks.MaskFolder`); null: the scene's own masks.

    Raises:
        ValueError: If a number is out of range.
    """

    demands: ClassVar[Sequence[Demand]] = (
        Demand("query=objects", "head", "classifies", "as it asks which object a pixel shows"),
    )
    share: float = 0.7
    candidates: int = 5
    masks: str | None = None

    def __post_init__(self) -> None:
        require_range("objects", 0, 1, share=self.share)
        require_range("objects", 1, 10**6, candidates=self.candidates)

    @property
    def negatives(self) -> Sequence[str]:
        """None: all other objects are what a word is compared with."""
        return ()

    @property
    def needs_all_prompts(self) -> bool:
        """False: every word has objects of its own."""
        return False

    def relevancy(
        self, prompts: Float[Tensor, " k *p"], negatives: Float[Tensor, " m *p"]
    ) -> Float[Tensor, " k *p"]:
        """The probabilities that the field of `learn` answers, as they are."""
        return prompts.clamp(0, 1)

    def __call__(
        self,
        features: Float[Tensor, "*p e"],
        text: Float[Tensor, "k e"],
        negatives: Float[Tensor, "m e"],
    ) -> Float[Tensor, " k *p"]:
        """Of embeddings, which know no objects: their cosines."""
        return cosines(features, text).clamp(0, 1)

    def require(self, scene: Scene, words: Sequence[str]) -> None:
        """Refuse masks that no word could be learned from; see `vlgs.queries.Particular`."""
        masks_from(self.masks, self.candidates).require(scene, words)

    @torch.no_grad()
    def learn(self, field: Field, scene: Scene, prompts: Prompts) -> Field:
        """The same field, which answers these words by the probabilities of their objects.

        Args:
            field: The trained scene, with a classifier. Of several mask levels every one has objects of its own; the last chooses the mask.
            scene: Its training views and masks.
            prompts: The words.

        Raises:
            ValueError: If the field knows no objects.
        """
        words = normalize(prompts.text.float(), dim=-1)
        masks, whole = masks_from(self.masks, self.candidates), field.levels()[-1]
        found = [
            masks.find(whole, scene, name, word)
            for name, word in zip(prompts.names, words, strict=True)
        ]
        learned = [self._learn(level, prompts, found) for level in field.levels()]
        return learned[0] if len(learned) == 1 else SeveralFields(learned)

    def _learn(self, field: Field, prompts: Prompts, found: Sequence[Found | None]) -> Field:
        if not isinstance(field, HasObjects) or not field.object_count:
            raise ValueError("objects: field must know objects (head=classifier), got one without")
        chosen = torch.zeros(len(found), field.object_count, dtype=torch.bool)
        for row, (name, one) in enumerate(zip(prompts.names, found, strict=True)):
            if one is not None:
                view, mask = one
                shown = field.objects(view.camera)
                chosen[row] = choose_objects(shown, mask, field.object_count, self.share)
                log.info(
                    "%s: objects %s in %s", name, chosen[row].nonzero()[:, 0].tolist(), view.name
                )
        return field.with_objects(prompts.text, chosen)


def choose_objects(
    shown: Int[Tensor, "h w"], mask: Bool[Tensor, "h w"], count: int, share: float
) -> Bool[Tensor, " objects"]:
    """The objects of which more than a share of their pixels lies inside of a mask; if there is none, the one that most of its pixels show.

    Args:
        shown: The object of each pixel; `count` where there is none.
        mask: Of the same view.
        count: How many objects there are.
        share: In [0, 1].

    Example:
        >>> shown = torch.tensor([[0, 0, 1], [2, 2, 1]])
        >>> choose_objects(shown, shown == 1, count=2, share=0.7)
        tensor([False,  True])
    """
    inside = torch.bincount(shown[mask].flatten(), minlength=count + 1)[:count]
    whole = torch.bincount(shown.flatten(), minlength=count + 1)[:count]
    chosen = inside > share * whole
    if not chosen.any() and inside.any():
        chosen[inside.argmax()] = True
    return chosen
