"""Heads, and the objectives that are made for one of them, as functions of codes and weights."""

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from tests.stress.draws import Check, draw
from vlgs.heads.autoencoder import Autoencoder
from vlgs.heads.classifier import Classifier
from vlgs.heads.codebook import Codebook
from vlgs.heads.identity import Identity
from vlgs.heads.linear import Linear
from vlgs.heads.lookup import LookupTable
from vlgs.heads.principal import Principal
from vlgs.heads.quantised import QuantisedCodes, quantiser_loss
from vlgs.heads.rows import in_blocks, layers, linear_rows
from vlgs.objectives import CodebookLanguage, CodeClasses, LookupLanguage
from vlgs.objectives.choice import choose
from vlgs.objectives.mapped_error import mapped_l1
from vlgs.objectives.mask_classes import MaskClasses, NeighbourClasses


def linear_head(name: str) -> Check:
    """By codes, weights and biases."""
    made = Linear(dim=3, width=4).double()
    del made.map  # its weights are inputs here

    def run(x: Tensor, weight: Tensor, bias: Tensor):
        made.__dict__["map"] = SimpleNamespace(weight=weight, bias=bias)
        return getattr(made, name)(x)

    return run, [draw(2, 3, 3), draw(4, 3, seed=1), draw(4, seed=2)]


def bound(objective: Any, head: nn.Module) -> Any:
    """An objective that sees five masks and a head in float64."""
    masks = SimpleNamespace(codes_of=lambda rows: draw(5, 4, seed=5)[rows])
    objective.head, objective.views = head.double(), masks
    return objective


def codebook(name: str) -> Check:
    """By codes and entries."""
    made = Codebook(dim=3, width=4).double()
    del made.entries  # they are an input here

    def run(codes: Tensor, entries: Tensor):
        made.__dict__["entries"] = entries
        if name == "total":
            return bound(CodebookLanguage(), made).total(codes, torch.tensor([0, 3, 0, 1, 4, 1]))
        return getattr(made, name)(codes)

    return run, [draw(6, 3), draw(3, 4, seed=1)]


def head() -> Autoencoder:
    made = Autoencoder(dim=3, encoder_widths=(8, 6), decoder_widths=(6, 8))
    torch.manual_seed(0)
    made.build(5)
    made.requires_grad_(False)
    return made.double()


def classifier() -> Classifier:
    made = Classifier(dim=2)
    made.fit(draw(3, 4).float(), torch.ones(3))
    return made.double()


def lookup() -> LookupTable:
    torch.manual_seed(0)
    made = LookupTable(dim=2, rows=3, width=4)
    made.fit(draw(3, 4).float(), torch.ones(3))
    return made


def quantised() -> QuantisedCodes:
    torch.manual_seed(0)
    made = QuantisedCodes(dim=2, entries=3, width=4, hidden=[5])
    made.codebook = draw(3, 4)
    return made.double()


def principal() -> Principal:
    """Of embeddings of five numbers; codes shorter than `sure`, and drawn gently."""
    made = Principal(dim=2, entries=2, sharpness=2.0, sure=1.0).double()
    made.fit(draw(6, 5), torch.ones(6))
    return made


HEAD_CHECKS: dict[str, Callable[[], Check]] = {
    "vlgs.heads.rows.linear_rows": lambda: (linear_rows, [draw(2, 3, 4), draw(2, 4, seed=1), draw(2, seed=2)]),
    "vlgs.heads.rows.in_blocks": lambda: (in_blocks, [draw(3, 2)]),
    "vlgs.heads.rows.layers": lambda: (
        partial(layers, nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 2)).double()), [draw(5, 3)]
    ),
    "vlgs.heads.codebook.Codebook.targets": lambda: (Codebook(2, 3).targets, [draw(4, 3)]),
    "vlgs.heads.codebook.Codebook.predict": lambda: codebook("predict"),
    "vlgs.heads.codebook.Codebook.decode": lambda: codebook("decode"),
    "vlgs.heads.lookup.LookupTable.targets": lambda: (LookupTable(2, 3, 4).targets, [draw(4, 4)]),
    "vlgs.heads.lookup.LookupTable.predict": lambda: (LookupTable(2, 3, 4).double().predict, [draw(4, 2)]),
    "vlgs.heads.principal.Principal.targets": lambda: (principal().targets, [draw(4, 5)]),
    "vlgs.heads.principal.Principal.predict": lambda: (principal().predict, [draw(4, 2)]),
    "vlgs.heads.principal.Principal.decode": lambda: (principal().decode, [0.1 * draw(4, 2)]),
    "vlgs.heads.quantised.QuantisedCodes.predict": lambda: (QuantisedCodes(2, 3, 4, [5]).double().predict, [draw(4, 2)]),
    "vlgs.heads.quantised.QuantisedCodes.decode": lambda: (quantised().decode, [draw(4, 2)]),
    "vlgs.heads.quantised.quantiser_loss": lambda: (
        lambda a, b: quantiser_loss([a, b], [1.0, 0.5], 2.0), [draw(6, 3), draw(6, 3, seed=1)]
    ),
    "vlgs.heads.classifier.Classifier.logits": lambda: (classifier().logits, [draw(4, 2)]),
    "vlgs.heads.classifier.Classifier.targets": lambda: (classifier().targets, [draw(4, 4)]),
    "vlgs.heads.classifier.Classifier.predict": lambda: (classifier().predict, [draw(4, 2)]),
    "vlgs.heads.classifier.Classifier.decode": lambda: (classifier().decode, [draw(4, 2)]),
    "vlgs.objectives.mask_classes.MaskClasses.of": lambda: (
        lambda codes: bound(MaskClasses(), classifier()).of(codes, torch.tensor([0, -1, 2, 1])), [draw(4, 2)]
    ),
    "vlgs.objectives.mask_classes.NeighbourClasses.of": lambda: (
        bound(NeighbourClasses(), classifier()).of, [draw(3, 1, 2), draw(3, 5, 1, 2, seed=1)]
    ),
    "vlgs.objectives.codebook.CodebookLanguage.total": lambda: codebook("total"),
    "vlgs.objectives.lookup.LookupLanguage.terms": lambda: (
        lambda codes: tuple(bound(LookupLanguage(), lookup()).terms(codes, torch.tensor([0, 3, 0, 1]), 2.0).values()),
        [draw(4, 2)],
    ),
    "vlgs.objectives.choice.choose": lambda: (
        lambda codes, weight, bias: choose(codes, weight, bias, torch.tensor([2, 0, 2]), 3.0)[0],
        [draw(3, 2), draw(4, 2, seed=1), draw(4, seed=2)],
    ),
    "vlgs.objectives.mapped_error.mapped_l1": lambda: (
        lambda codes, weight, bias: mapped_l1(codes, weight, bias, 9 + draw(3, 4, seed=3), torch.arange(3), 3.0),
        [draw(3, 2), draw(4, 2, seed=1), draw(4, seed=2)],
    ),
    "vlgs.objectives.code_classes.CodeClasses.terms": lambda: (
        lambda codes, doubt: bound(CodeClasses(), quantised()).terms(codes, torch.eye(3).double(), doubt),
        [draw(3, 2), draw(3, low=0.1, high=0.9)],
    ),
    "vlgs.heads.linear.Linear.targets": lambda: (Linear(2, 3).targets, [draw(4, 3)]),
    "vlgs.heads.linear.Linear.predict": lambda: linear_head("predict"),
    "vlgs.heads.linear.Linear.decode": lambda: linear_head("decode"),
    "vlgs.heads.autoencoder.Autoencoder.encode": lambda: (head().encode, [draw(3, 5)]),
    "vlgs.heads.autoencoder.Autoencoder.decode": lambda: (head().decode, [draw(3, 3)]),
    "vlgs.heads.autoencoder.Autoencoder.targets": lambda: (head().targets, [draw(3, 5)]),
    "vlgs.heads.autoencoder.Autoencoder.predict": lambda: (head().predict, [draw(3, 3)]),
    "vlgs.heads.identity.Identity.targets": lambda: (Identity(3).targets, [draw(4, 3)]),
    "vlgs.heads.identity.Identity.predict": lambda: (Identity(3).predict, [draw(4, 3)]),
    "vlgs.heads.identity.Identity.decode": lambda: (Identity(3).decode, [draw(4, 3)]),
}  # fmt: skip
