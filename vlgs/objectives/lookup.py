"""Language by a table of embeddings: the four terms of GOI (Qu et al., ACM MM 2024)."""

from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.heads.lookup import LookupTable
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
        for place, render, target in zip("12", step.renders, step.targets, strict=True):
            if render.feature is None or not target.has_language:
                continue
            codes, masks = masked_codes(render.feature, target)
            if len(masks):
                own = self.terms(codes, masks, temperature)
                terms |= {f"{name} {place}": term for name, term in own.items()}
        return terms

    def terms(
        self, codes: Float[Tensor, "p d"], masks: Int[Tensor, " p"], temperature: float
    ) -> dict[str, Float[Tensor, ""]]:
        """The four terms for pixels with these codes and masks, weighted; p is at least 1."""
        rows, which, counts = masks.unique(return_inverse=True, return_counts=True)
        share = counts / len(masks)
        wanted = normalize(self.views.codes_of(rows), dim=-1)
        cosines = wanted @ normalize(self.head.table, dim=-1).T  # [masks, rows]
        nearest = cosines.detach().argmax(dim=-1)
        scores = self.head.predict(codes)
        odds = (temperature * cosines).log_softmax(dim=-1)
        return {
            "choice": self.choice * _choice(scores, nearest[which]),
            "near": 1 - share @ cosines.amax(dim=-1),
            "entropy": -self.entropy * (share @ (odds.exp() * odds).sum(dim=-1)),
            "answer": 1 - cosines[which, scores.detach().argmax(dim=-1)].mean(),
        }


def _choice(scores: Float[Tensor, "p k"], right: Int[Tensor, " p"]) -> Float[Tensor, ""]:
    """Mean squared error of the softmax and the unit vectors of what is right, ``|s|^2 - 2 s_right + 1``: no map of those is made."""
    odds = scores.softmax(dim=-1)
    errors = odds.square().sum(dim=-1) - 2 * odds.gather(1, right[:, None])[:, 0] + 1
    return errors.mean() / scores.shape[1]
