"""Gaussian Grouping: its head, its two terms worked by hand, and where their gradients go."""

import math
from dataclasses import fields

import pytest
import torch
from tiny_runs import composed
from torch.nn.functional import normalize

from vlgs.config import instantiate
from vlgs.experiment import construct
from vlgs.heads import Head
from vlgs.heads.classifier import Classifier
from vlgs.objectives import MaskClasses, NeighbourClasses
from vlgs.training.build import Parts, build_module
from vlgs.training.lightning import VLGSModule
from vlgs.training.stages import TrainColor
from vlgs.types import Scene

GROUPING = ("method=gs_grouping", "trainer=smoke", "gaussians.background=0")


def module_of(scene: Scene, *overrides: str) -> VLGSModule:
    config = composed(*GROUPING, *overrides)
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(scene, parts, config.seed)


@pytest.fixture
def head() -> Classifier:
    """Three masks and nothing, of codes of width 2, in float64."""
    made = Classifier(dim=2).double()
    made.fit(torch.eye(3, 5, dtype=torch.float64), torch.ones(3, dtype=torch.float64))
    return made.double()


def test_an_answer_is_the_mean_embedding_by_probability(head: Classifier):
    assert isinstance(head, Head)
    assert (head.map.in_features, head.map.out_features, head.learning_rate) == (2, 4, 5e-4)
    assert Classifier().dim == 16
    with torch.no_grad():
        head.map.weight.zero_()
        head.map.bias.copy_(torch.tensor([0.5, 0.3, 0.0, 0.2]).log())
    codes = torch.zeros(1, 2, dtype=torch.float64)
    want = torch.tensor([[0.5, 0.3, 0.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(head.predict(codes), want)  # nothing adds nothing
    torch.testing.assert_close(head.decode(codes), normalize(want))
    head.answer = "most_probable"
    assert head.predict(codes).tolist() == [[1, 0, 0, 0, 0]]
    with torch.no_grad():
        head.map.bias[-1] = 9.0
    assert not head.decode(codes).any()


def test_it_is_read_back_whatever_the_number_of_masks(head: Classifier):
    other = Classifier(dim=2)
    other.load_state_dict(head.state_dict())
    other = other.double()
    assert other.classes == 4
    codes = torch.rand(7, 2, dtype=torch.float64)
    assert torch.equal(other.decode(codes), head.decode(codes))
    again = Classifier(dim=2)
    again.fit(torch.eye(3, 5), torch.ones(3))
    assert torch.equal(again.map.weight.double(), head.map.weight), "starts as it always does"


def test_cross_entropy_is_that_of_a_loop(head: Classifier):
    codes = torch.randn(2, 3, 2, dtype=torch.float64)
    masks = torch.tensor([[0, 2, -1], [1, -1, 0]])
    terms = []
    for code, mask in zip(codes.flatten(0, 1), masks.flatten().tolist(), strict=True):
        logits = head.logits(code).tolist()
        total = sum(math.exp(value) for value in logits)
        terms.append((mask, -math.log(math.exp(logits[mask]) / total) / math.log(4)))
    for unmasked in ("nothing", "ignored"):
        objective = MaskClasses(unmasked)  # type: ignore[arg-type]
        objective.head = head
        own = [term for mask, term in terms if mask >= 0 or unmasked == "nothing"]
        got = objective.of(codes, masks)
        torch.testing.assert_close(got.item(), sum(own) / len(own))
    assert objective.of(codes, torch.full((2, 3), -1)) == 0


def test_neighbours_are_five_others_and_their_divergence_that_of_a_loop(head: Classifier):
    objective = NeighbourClasses(samples=7)
    objective.head, objective.seed = head, 0
    means = torch.randn(40, 3)
    means[3] = means[4]
    drawn, near = objective.draw(means, 5)
    assert near.shape == (7, 5)
    for i, others in zip(drawn.tolist(), near.tolist(), strict=True):
        apart = (means - means[i]).norm(dim=1)
        apart[i] = torch.inf
        assert sorted(others) == sorted(apart.argsort()[:5].tolist())
    codes = torch.randn(40, 1, 2, dtype=torch.float64)
    p = head.logits(codes[:, 0]).softmax(dim=1).detach()
    pairs = [(i, j) for i, row in zip(drawn, near, strict=True) for j in row]
    loop = sum(float((p[i] * (p[i] / p[j]).log()).sum()) for i, j in pairs) / 35
    torch.testing.assert_close(objective.of(codes[drawn], codes[near]).item(), 2 * loop / 4)
    again, _ = objective.draw(means, 5)
    other, _ = objective.draw(means, 10)
    assert torch.equal(drawn, again)
    assert not torch.equal(drawn, other)
    few = objective.draw(means[:3], 0)[1]
    assert few.shape == (3, 2)


def test_the_gradient_of_classes_reaches_everything_and_that_of_neighbours_codes_alone(
    tiny_scene: Scene,
):
    module = module_of(tiny_scene)
    splats = module.model.splats
    assert splats["features"].shape[1] == 16
    assert splats["features"].detach().abs().amax() <= 0.5 / 0.28209479 + 1e-5
    assert splats["features"].detach().std() > 0.9  # uniform: 1.02
    done = module.step.forward(0)
    assert {"color", "classes 1", "classes 2", "neighbours"} == set(done.terms)
    assert "neighbours" not in module.step.forward(1).terms
    for term, reached in {
        "classes 1": {"means", "quats", "log_scales", "opacity_logits", "features"},
        "neighbours": {"features"},
    }.items():
        names = list(splats)
        gradients = torch.autograd.grad(
            done.terms[term], list(splats.values()), retain_graph=True, allow_unused=True
        )
        moved = {n for n, g in zip(names, gradients, strict=True) if g is not None and g.any()}
        assert moved == reached
        head = module.model.head
        assert isinstance(head, torch.nn.Module)
        own, *_ = torch.autograd.grad(done.terms[term], list(head.parameters()), retain_graph=True)
        assert own.any()


def test_neighbours_of_many_have_the_same_gradient_every_time(tiny_scene: Scene):
    module = module_of(tiny_scene, "head.dim=64")  # 5 x 400 x 64 numbers are shared out to threads
    features, step = module.model.splats["features"], module.step.forward(0)
    (near,) = (o for o in module.step.setup.objectives.values() if isinstance(o, NeighbourClasses))
    first, *others = (
        torch.autograd.grad(near(step.seen)["neighbours"], features, retain_graph=True)[0]
        for _ in range(5)
    )
    assert all(torch.equal(first, other) for other in others)


def test_its_method_is_what_it_says():
    experiment = construct(composed(*GROUPING))
    assert experiment.method is not None
    geometry, associate, _ = experiment.method.listed
    assert isinstance(geometry, TrainColor)
    assert associate.start == geometry.name  # type: ignore[attr-defined]
    rates = experiment.parts.trainer.learning_rates
    assert rates.features == 2.5e-3
    loss = experiment.parts.loss
    near = loss["neighbour_classes"]
    assert isinstance(near, NeighbourClasses)
    assert vars(near) == vars(NeighbourClasses())
    assert (near.weight, near.every, near.samples, near.neighbours, near.among) == (2, 5, 1000, 5, 200_000)  # fmt: skip
    with pytest.raises(ValueError, match=r"head must be classifier with loss\.mask_classes, as it"):
        construct(composed(*GROUPING, "head=autoencoder"))
    with pytest.raises(ValueError, match="neighbour classes: neighbours must be 1 to 1000, got 0"):
        NeighbourClasses(neighbours=0)
    with pytest.raises(ValueError, match="classifier: dim must be 1 to 65536, got 0"):
        Classifier(dim=0)
