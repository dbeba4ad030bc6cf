"""Heads: what stands between the short code that a Gaussian carries and an image-text embedding."""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Head(Protocol):
    """The interface of a head. Implementations are modules, so that checkpoints contain what they learned.

    A head is either fitted to the embeddings of a scene before training, and stays as it is, or it is trained along with the
    Gaussians. What the language loss compares is `predict` of rendered codes with `targets` of masks: codes with codes, or
    embeddings with embeddings. A head that is fitted before says so: ``untrained: ClassVar[bool] = True`` (`vlgs.demands`).
    """

    dim: int
    """Width d of the codes."""

    @property
    def learning_rate(self) -> float | Mapping[str, float] | None:
        """Adam's, for parameters that are trained along with the Gaussians, or one for each part by its name; None: they are fitted before."""
        ...

    def fit(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> None:
        """Prepare for one scene: learn all that is not trained along.

        Args:
            vectors: Unit embeddings of the masks, `Scene.mask_vectors`.
            areas: Pixels that each one covers, `Scene.mask_areas`; its weight.
        """
        ...

    def targets(self, vectors: Float[Tensor, "m e"]) -> Float[Tensor, "m t"]:
        """What pixels of masks with these unit embeddings should show."""
        ...

    def predict(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b t"]:
        """What rendered codes show, to be compared with `targets`."""
        ...

    def decode(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """Unit embeddings of codes, which may be blends of several; see `lengths_count` for shorter ones."""
        ...


def lengths_count(head: Head) -> bool:
    """Whether the length of an embedding, at most 1, says how sure a head is of it: words are compared by products, which fade with it.

    Heads that say so have ``lengths_count: ClassVar[bool] = True``; all others are compared by cosines.
    """
    return getattr(head, "lengths_count", False) is True


@runtime_checkable
class Particular(Protocol):
    """A head that not every scene's embeddings will do for."""

    def require(self, vectors: Float[Tensor, "m e"]) -> None:
        """Refuse what `Head.fit` would refuse: now, and not after a stage that has no language.

        Raises:
            ValueError: If the embeddings are of another width than was announced.
        """
        ...


@runtime_checkable
class FittedHead(Head, Protocol):
    """A head whose fit takes steps, or is read from a file that another program wrote."""

    weights: str | None
    """File of weights that take the place of a fit (`vlgs.formats.load_weights`); None: it is fitted."""
    encoder_widths: tuple[int, ...]
    """Hidden widths from the embedding to the code."""
    decoder_widths: tuple[int, ...]
    """Hidden widths from the code to the embedding."""

    def rehearse(self, steps: int) -> None:
        """Take at most so many steps in `fit`, and keep nothing on disk."""
        ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> object:
        """Take weights in the place of a fit."""
        ...

    def requires_grad_(self, requires_grad: bool = True) -> object:
        """Say whether the weights are trained."""
        ...
