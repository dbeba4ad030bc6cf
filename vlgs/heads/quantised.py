"""LEGaussians' head: embeddings are quantised before training, and a rendered code is classified (Shi et al., CVPR 2024)."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize, one_hot

from vlgs.demands import Demand
from vlgs.heads.codebook import require_width
from vlgs.heads.folded import Folded, fold_linear
from vlgs.heads.rows import layers
from vlgs.heads.threads import one_thread
from vlgs.values import require_range


@dataclass(frozen=True)
class QuantiserTraining:
    """How the codebook is fitted: AdamW on masks drawn by their areas."""

    steps: int = 2000
    batch: int = 256
    learning_rate: float = 1e-4
    weight_decay: float = 0.01
    balance: float = 1.0
    """Weight of the term that spreads embeddings over all entries."""
    seed: int = 0

    def __post_init__(self) -> None:
        require_range("quantiser", 1, 10**7, steps=self.steps)
        require_range("quantiser", 1, 2**20, batch=self.batch)
        require_range("quantiser", 0, 1, learning_rate=self.learning_rate)
        require_range("quantiser", 0, 1e6, weight_decay=self.weight_decay, balance=self.balance)
        require_range("quantiser", 0, 2**63 - 1, seed=self.seed)


DEFAULT_TRAINING = QuantiserTraining()


class QuantisedCodes(nn.Module):
    """An embedding is one of a few entries of a codebook, and a network from the rendered code says which.

    Targets are unit vectors of the nearest entry, predictions are scores before the softmax, to be compared by
    `vlgs.objectives.CodeClasses`. Questions are asked of the mean of the entries, weighted by the softmax. The network sees the
    direction of a code alone. It is trained along with the Gaussians; the codebook stays as it was fitted.

    Args:
        dim: Width d of the codes.
        entries: Of the codebook.
        width: Embedding width e; 512 for CLIP ViT-B/16.
        hidden: Widths of the network between code and scores.
        learning_rate: Adam's, for the network.
        quantiser: How the codebook is fitted.

    Raises:
        ValueError: If a width is not positive, or the learning rate is not in [0, 1].

    Example:
        >>> head = QuantisedCodes(dim=2, entries=4, width=8)
        >>> head.fit(torch.eye(8), torch.ones(8))
        >>> head.targets(torch.eye(8)).sum(dim=1)
        tensor([1., 1., 1., 1., 1., 1., 1., 1.])
    """

    demands: ClassVar[Sequence[Demand]] = (
        Demand(
            "head=quantised", "loss", "trains_classes", "as its scores of entries are no embeddings"
        ),
    )
    has_classes: ClassVar[bool] = True
    """What its loss asks of it (`vlgs.demands`)."""
    codebook: Tensor

    def __init__(
        self,
        dim: int = 8,
        entries: int = 32,
        width: int = 512,
        hidden: Sequence[int] = (128, 256),
        learning_rate: float = 1e-3,
        quantiser: QuantiserTraining = DEFAULT_TRAINING,
    ) -> None:
        super().__init__()
        require_range("quantised head", 1, 65536, dim=dim, entries=entries, width=width)
        for one in hidden:
            require_range("quantised head", 1, 65536, hidden=one)
        require_range("quantised head", 0, 1, learning_rate=learning_rate)
        self.dim = dim
        self.learning_rate: float | None = learning_rate
        self.fit_settings = quantiser
        self.classifier = nn.Sequential()
        for before, after in pairwise((dim, *hidden)):
            self.classifier.extend([nn.Linear(before, after), nn.ReLU()])
        self.classifier.append(nn.Linear(hidden[-1] if hidden else dim, entries))
        self.register_buffer("codebook", torch.zeros(entries, width))

    def fit(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> None:
        """Quantise the embeddings of one scene.

        Raises:
            ValueError: If they have another width than was announced, or areas are negative or all zero.
        """
        self.require(vectors)
        self.codebook = quantise([vectors], [1.0], areas, len(self.codebook), self.fit_settings)[0]

    def require(self, vectors: Float[Tensor, "m e"]) -> None:
        """See `vlgs.heads.Particular`."""
        require_width("quantised head", vectors, self.codebook.shape[1])

    def targets(self, vectors: Float[Tensor, "m e"]) -> Float[Tensor, "m k"]:
        """One for the nearest entry, zero for all others."""
        nearest = (normalize(vectors, dim=-1) @ self.codebook.T).argmax(dim=-1)
        return one_hot(nearest, len(self.codebook)).to(vectors)

    def predict(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b k"]:
        """A score for each entry, before the softmax."""
        return layers(self.classifier, normalize(codes, dim=-1, eps=1e-6))

    def decode(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """See `Head`; the mean entry, at unit length."""
        return normalize(self.predict(codes).softmax(dim=-1) @ self.codebook, dim=-1, eps=1e-6)

    def fold(self) -> Folded:
        """See `vlgs.heads.folded.Foldable`."""
        return fold_linear(self.codebook.T, None, lambda codes: self.predict(codes).softmax(dim=-1))


def quantise(
    maps: Sequence[Float[Tensor, "m _"]],
    weights: Sequence[float],
    areas: Float[Tensor, " m"],
    entries: int,
    settings: QuantiserTraining,
) -> list[Float[Tensor, "entries _"]]:
    """Codebooks of one or several embeddings of the same masks, in which equal rows belong together.

    An entry fits a mask as well as the weighted sum of the cosines of its parts with the mask's embeddings says; LEGaussians adds
    half of DINO's cosine to CLIP's. The loss is `quantiser_loss`.

    Args:
        maps: Embeddings of the masks, such as CLIP's, and of a second network.
        weights: What the cosine of each counts.
        areas: Pixels of each mask, in proportion to which it is drawn.
        entries: Rows of the codebooks.
        settings: Of the fit.

    Returns:
        A codebook of unit rows for each of `maps`.

    Raises:
        ValueError: If areas are negative or all zero, or not as many as masks.
    """
    if len(areas) != len(maps[0]) or not (areas >= 0).all() or not areas.any():
        raise ValueError(
            f"quantiser: areas must be {len(maps[0])}, at least 0 and not all 0, got {len(areas)}"
        )
    generator = torch.Generator().manual_seed(settings.seed)
    unit = [normalize(vectors.detach().float(), dim=-1) for vectors in maps]
    with one_thread(), torch.enable_grad():
        bound = 1 / entries
        books = [
            torch.empty(entries, vectors.shape[1]).uniform_(-bound, bound, generator=generator)
            for vectors in unit
        ]
        parameters = [nn.Parameter(book) for book in books]
        rate, decay = settings.learning_rate, settings.weight_decay
        optimizer = torch.optim.AdamW(parameters, lr=rate, weight_decay=decay, fused=True)
        for _ in range(settings.steps):
            drawn = torch.multinomial(areas.float(), settings.batch, True, generator=generator)
            cosines = [
                vectors[drawn] @ normalize(book, dim=-1).T
                for vectors, book in zip(unit, parameters, strict=True)
            ]
            loss = quantiser_loss(cosines, weights, settings.balance)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return [normalize(book.detach(), dim=-1) for book in parameters]


def quantiser_loss(
    cosines: Sequence[Float[Tensor, "b k"]], weights: Sequence[float], balance: float
) -> Float[Tensor, ""]:
    """``1 - cos`` to the nearest entry, for each embedding, and how unevenly entries are used.

    The latter is ``sum_k f_k p_k``: f_k is the share of embeddings that entry k is nearest to, p_k the mean of the softmax of their
    fit to all entries; only p has a gradient.

    Args:
        cosines: Of embeddings and entries; one table for each kind of embedding.
        weights: What each kind counts.
        balance: Weight of the second term.
    """
    fit = torch.stack([w * table for w, table in zip(weights, cosines, strict=True)]).sum(dim=0)
    nearest = fit.argmax(dim=1, keepdim=True)
    errors = [
        w * (1 - table.gather(1, nearest).mean()) for w, table in zip(weights, cosines, strict=True)
    ]
    used = torch.bincount(nearest[:, 0], minlength=fit.shape[1]).to(fit) / len(fit)
    return torch.stack(errors).sum() + balance * (used @ fit.softmax(dim=1).mean(dim=0))
