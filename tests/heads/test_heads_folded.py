"""Heads without their last step: the same cosines as in float64, worked with numpy from the weights alone."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import nn

from vlgs.heads import Head
from vlgs.heads.autoencoder import Autoencoder, AutoencoderTraining
from vlgs.heads.classifier import Classifier
from vlgs.heads.codebook import Codebook
from vlgs.heads.folded import Foldable, fold_linear
from vlgs.heads.identity import Identity
from vlgs.heads.linear import Linear
from vlgs.heads.lookup import LookupTable
from vlgs.heads.quantised import QuantisedCodes, QuantiserTraining

Array = np.ndarray
WIDTH = 24


def number(tensor: torch.Tensor) -> Array:
    return tensor.detach().double().numpy()


def softmax(x: Array) -> Array:
    e = np.exp(x - x.max(axis=1, keepdims=True))
    return e / e.sum(axis=1, keepdims=True)


def through(network: nn.Sequential, x: Array) -> Array:
    for layer in network:
        if isinstance(layer, nn.Linear):
            x = x @ number(layer.weight).T + number(layer.bias)
        else:
            x = np.maximum(x, 0)
    return x


def unit(x: Array) -> Array:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def autoencoder(dim: int, widths: tuple[int, ...]) -> tuple[Head, Callable[[Array], Array]]:
    head = Autoencoder(dim, (8,), widths, training=AutoencoderTraining(steps=20, batch=8))
    return head, lambda x: through(head.decoder, x) + number(head.mean)


def linear() -> tuple[Head, Callable[[Array], Array]]:
    head = Linear(5, WIDTH)
    return head, lambda x: x @ number(head.map.weight).T + number(head.map.bias)


def codebook() -> tuple[Head, Callable[[Array], Array]]:
    head = Codebook(5, WIDTH)
    return head, lambda x: x @ number(head.entries)


def quantised() -> tuple[Head, Callable[[Array], Array]]:
    head = QuantisedCodes(5, 7, WIDTH, (6,), quantiser=QuantiserTraining(steps=5, batch=8))
    return head, lambda x: softmax(through(head.classifier, unit(x))) @ number(head.codebook)


def scores(head: Classifier | LookupTable, x: Array) -> Array:
    return x @ number(head.map.weight).T + number(head.map.bias)


def lookup() -> tuple[Head, Callable[[Array], Array]]:
    head = LookupTable(5, 7, WIDTH)
    return head, lambda x: number(head.table)[scores(head, x).argmax(axis=1)]


def classifier(most_probable: bool) -> tuple[Head, Callable[[Array], Array]]:
    head = Classifier(5, answer="most_probable" if most_probable else "probabilities")

    def embed(x: Array) -> Array:
        chances = softmax(30 * scores(head, x) if most_probable else scores(head, x))
        return (chances.round() if most_probable else chances) @ number(head.vectors)

    return head, embed


HEADS: dict[str, Callable[[], tuple[Head, Callable[[Array], Array]]]] = {
    "autoencoder of 3 numbers": lambda: autoencoder(3, (6, 9)),
    "autoencoder of 8 numbers": lambda: autoencoder(8, (9,)),
    "autoencoder wider than the embedding": lambda: autoencoder(3, (8, 40)),
    "linear": linear,
    "codebook": codebook,
    "quantised": quantised,
    "lookup": lookup,
    "classifier": lambda: classifier(False),
}


@pytest.mark.parametrize("name", HEADS)
def test_coordinates_have_the_cosines_of_the_embeddings(name: str):
    torch.manual_seed(0)
    head, embed = HEADS[name]()
    vectors = nn.functional.normalize(torch.randn(20, WIDTH) + 1, dim=1)
    head.fit(vectors, torch.rand(20) + 0.1)
    codes, words = torch.randn(50, head.dim), torch.randn(4, WIDTH)
    assert isinstance(head, Foldable)
    folded = head.fold()
    assert isinstance(folded.basis, torch.Tensor)
    basis, made = number(folded.basis), number(folded.coordinates(codes))
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-6)
    wanted = embed(number(codes))
    # Classes are told apart by an argmax in float32, which ties alone could move: there are none.
    np.testing.assert_allclose(made @ basis.T, wanted, atol=1e-5 * np.abs(wanted).max())
    cosines = unit(number(words)) @ unit(wanted).T
    np.testing.assert_allclose(unit(number(words)) @ basis @ unit(made).T, cosines, atol=1e-5)
    assert made.shape[1] <= WIDTH


def test_the_most_probable_object_is_one_row():
    head = Classifier(2, answer="most_probable")
    head.fit(torch.eye(3), torch.ones(3))
    with torch.no_grad():
        head.map.weight.copy_(torch.tensor([[1.0, 0], [0, 1], [-1, 0], [0, -1]]))
        head.map.bias.zero_()
    folded = head.fold()
    shown = folded.coordinates(torch.tensor([[2.0, 0], [0, 3], [-1, 0], [0, -5]])) @ folded.basis.T
    torch.testing.assert_close(shown, torch.cat([torch.eye(3), torch.zeros(1, 3)]))


def test_what_is_one_product_is_worked_by_hand():
    folded = fold_linear(
        torch.tensor([[3.0], [0.0]]), torch.tensor([0.0, 4.0]), lambda codes: codes
    )
    made = folded.coordinates(torch.tensor([[1.0], [0.0]]))
    torch.testing.assert_close(made.norm(dim=1), torch.tensor([5.0, 4.0]))
    torch.testing.assert_close(made @ folded.basis.T, torch.tensor([[3.0, 4.0], [0.0, 4.0]]))


def test_what_has_no_last_step_is_not_folded_and_what_was_not_fitted_says_so():
    assert not isinstance(Identity(8), Foldable)
    with pytest.raises(ValueError, match="fit or a state dict must come before"):
        Autoencoder().fold()
