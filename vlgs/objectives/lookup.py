"""Language by a table of embeddings: the four terms of GOI (Qu et al., ACM MM 2024)."""

from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.demands import Demand
from vlgs.heads.lookup import LookupTable
from vlgs.heads.rows import linear_rows
from vlgs.objectives.choice import choose
from vlgs.objectives.objective import Objective, Setup, StepView
from vlgs.objectives.targets import masked_codes
from vlgs.values import require_range


class LookupLanguage(Objective):
    """Codes learn to choose the row of a table that is nearest to the embedding of the mask, while the rows learn to be near.

    Over the pixels that have a mask, with s the scores of a pixel (`vlgs.heads.lookup.LookupTable.predict`) and c its cosines with
    all rows:

    - ``choice``: squared error of softmax(s) and the unit vector of the nearest row, its mean over pixels and rows. It alone reaches
      the codes.
    - ``near``: ``1 - max c``.
    - ``entropy``: of softmax(t c), so that a row is near to few embeddings; t doubles late in training.
    - ``answer``: ``1 - c`` of the row that the scores choose.

    All pixels of a mask have the same cosines, which are computed once for each mask of a view.

    Args:
        choice: Weight of the first term.
        entropy: Weight of the third.
        temperature: t at first.
        late: Share of the iterations after which t is `late_temperature`.
        late_temperature: t then.

    Raises:
        ValueError: If a weight is negative, or `late` is not in [0, 1].
    """

    demands: ClassVar[Sequence[Demand]] = (
        Demand("loss.lookup", "head", "has_table", "as it learns the rows of a table"),
    )
    trains_table: ClassVar[bool] = True
    """What its head asks of a loss."""
    needs = frozenset({"feature"})

    def __init__(
        self,
        choice: float = 50.0,
        entropy: float = 0.3,
        temperature: float = 1.0,
        late: float = 2 / 3,
        late_temperature: float = 2.0,
    ) -> None:
        require_range("lookup language", 0, 1e6, choice=choice, entropy=entropy)
        require_range("lookup language", 0, 1e6, temperature=temperature)
        require_range("lookup language", 0, 1e6, late_temperature=late_temperature)
        require_range("lookup language", 0, 1, late=late)
        self.choice = choice
        self.entropy = entropy
        self.temperature = temperature
        self.late = late
        self.late_temperature = late_temperature

    def bind(self, setup: Setup) -> None:
        """The table is that of the head.

        Raises:
            ValueError: If the head has none.
        """
        head = setup.model.head
        if not isinstance(head, LookupTable):
            raise ValueError(
                f"lookup language: head must be lookup, which has a table, got {type(head).__name__}"
            )
        self.head, self.views, self.iterations = head, setup.views, setup.iterations

    def __call__(self, step: StepView) -> dict[str, Float[Tensor, ""]]:
        """The four terms of each view that has language."""
        late = step.step >= self.late * self.iterations
        temperature = self.late_temperature if late else self.temperature
        terms: dict[str, Tensor] = {}
        for place, _, feature, target in step.with_language():
            codes, masks = masked_codes(feature, target)
            if len(masks):
                own = self.terms(codes, masks, temperature)
                terms |= {f"{name} {place}": term for name, term in own.items()}
        return terms

    def terms(
        self, codes: Float[Tensor, "p d"], masks: Int[Tensor, " p"], temperature: float
    ) -> dict[str, Float[Tensor, ""]]:
        """The four terms for pixels with these codes and masks, weighted; p is at least 1."""
        rows, which, counts = masks.unique(return_inverse=True, return_counts=True)
        share = (counts / len(masks)).to(codes)
        size = len(self.head.table)
        wanted = normalize(self.views.codes_of(rows), dim=-1)
        cosines = linear_rows(wanted, normalize(self.head.table, dim=-1))  # [masks, rows]
        nearest = cosines.detach().argmax(dim=-1)
        map_ = self.head.map
        error, best = choose(codes, map_.weight, map_.bias, nearest[which], self.choice)
        # How often a mask of the view is answered by a row. A sum over pixels would have a gradient that threads add up in any order.
        chosen = torch.bincount(which * size + best, minlength=cosines.numel()).view_as(cosines)
        odds = (temperature * cosines).log_softmax(dim=-1)
        return {
            "choice": self.choice * error,
            "near": 1 - share @ cosines.amax(dim=-1),
            "entropy": -self.entropy * (share @ (odds.exp() * odds).sum(dim=-1)),
            "answer": 1 - (cosines * chosen).sum() / len(masks),
        }
