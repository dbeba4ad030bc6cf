"""Objectives one by one against numbers worked by hand, and one of a user's own, with parameters, on an attribute of its own."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import jaxtyping
import pytest
import torch
from test_training_training import assert_same_bits, module_of, stop_at, train
from tiny_runs import TINY, composed
from torch import Tensor, nn

from vlgs.config import instantiate
from vlgs.fields.cloud import point_cloud
from vlgs.fields.splat import FusedGaussians, ViewRender
from vlgs.gaussians import GaussiansConfig, activate, attributes_of, conform, read_ply, write_ply
from vlgs.gaussians.parameters import complete
from vlgs.gaussians.ply import parse_ply
from vlgs.identity import run_id
from vlgs.losses import l1_dssim, masked_cosine, masked_l1, masked_mse
from vlgs.objectives import BlendedView, Language, Objective, Photometric, StepView
from vlgs.objectives.targets import Target
from vlgs.training.state import capture
from vlgs.types import Scene

VALID = torch.tensor([[True, False], [True, True]])
EMPTY = conform({"means": torch.zeros(0, 3)}, attributes_of(GaussiansConfig(), 3))
NONE = FusedGaussians(activate(EMPTY), torch.zeros(0, 3), EMPTY["features"], torch.zeros(0))
"""What is tested with it looks at pixels alone."""
UNCERTAINTY = (
    "+gaussians.attributes.uncertainty.width=1",
    "+gaussians.attributes.uncertainty.activation=logistic",
    "+gaussians.attributes.uncertainty.rate=0.01",
)


def seen(scene: Scene, color: Tensor, image: Tensor, feature: Tensor, codes: Tensor) -> StepView:
    view = replace(scene.train[0], read_valid=None)
    target = Target(view, image, True, {"codes": codes, "valid": VALID}.__getitem__)
    nothing = torch.zeros(0)
    render = ViewRender(color, feature, None, None, nothing.bool(), nothing.reshape(0, 2))
    return StepView(0, (0, 1), (target, target), (render, render), NONE, lambda: render)


def test_terms_are_sums_over_both_views(tiny_scene: Scene):
    color, image = torch.rand(2, 2, 3), torch.rand(2, 2, 3)
    feature, codes = torch.rand(2, 2, 3), torch.rand(2, 2, 3)
    step = seen(tiny_scene, color, image, feature, codes)
    assert torch.equal(Photometric()(step)["color"], 2 * masked_mse(color, image))
    assert torch.equal(Photometric("l1_dssim")(step)["color"], 2 * l1_dssim(color, image))
    errors = {"mse": masked_mse, "l1": masked_l1, "cos": masked_cosine}
    for name, error in errors.items():
        for pixels in ("valid", "all"):
            terms = Language(name, pixels)(step)  # pyright: ignore[reportArgumentType]
            assert len(terms) == 2
            assert all(
                torch.equal(term, error(feature, codes, VALID, pixels)) for term in terms.values()
            )
            halved = Language(name, pixels, weight=0.5)(step)  # pyright: ignore[reportArgumentType]
            assert all(torch.equal(2 * halved[place], term) for place, term in terms.items())


def test_a_blended_view_weighs_lambda_times_similarity(tiny_scene: Scene):
    module = module_of(tiny_scene, "loss.blended_view.weight=0.7", "loss.language.error=l1")
    objective = module.step.setup.objectives["blended_view"]
    assert isinstance(objective, BlendedView)
    done = module.step.forward(0)
    plan = objective.plan(0, done.seen.pair, done.seen.targets)
    assert plan is not None
    assert plan.weight == 0.7 * module.views.similarity(*done.seen.pair)
    objective.language.weight = 0.25
    of_weighted = objective.plan(0, done.seen.pair, done.seen.targets)
    assert of_weighted is not None
    assert of_weighted.weight == 0.25 * plan.weight
    assert done.seen.log == {"blend_weight": plan.weight}
    doubled = replace(plan, weight=2 * plan.weight)
    assert torch.equal(objective.loss(doubled, done.seen), 2 * done.terms["blended"])


def test_the_default_option_is_the_default_of_the_classes():
    loss = instantiate(composed().loss)
    assert list(loss) == ["photometric", "language", "blended_view"]
    assert (loss["photometric"].error, loss["language"].error) == ("l1_dssim", "l1")  # trainer's
    paper = instantiate(composed("trainer=paper").loss)
    for one in (loss, paper):
        assert one["language"].pixels == Language().pixels
    assert (paper["photometric"].error, paper["language"].error) == ("mse", Language().error)
    assert loss["blended_view"].weight == BlendedView().weight


def test_bad_values_are_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # types would speak first
    for make, message in {
        lambda: Photometric("l2"):  # pyright: ignore[reportArgumentType]
        "photometric: error must be one of mse, l1_dssim, got 'l2'",
        lambda: Language("l2"):  # pyright: ignore[reportArgumentType]
        "language: error must be one of mse, l1, cos, got 'l2'",
        lambda: Language("l1", "some"):  # pyright: ignore[reportArgumentType]
        "language: pixels must be one of valid, all, got 'some'",
        lambda: Language(weight=0.0): "language: weight must be above 0 and at most 1e[+]06, got 0",
        lambda: Language(weight=float("nan")): "language: weight must be above 0 .*, got nan",
        lambda: BlendedView(-1.0): "blended view: weight must be 0 to 1e[+]06, got -1",
        lambda: BlendedView(float("nan")): "weight must be 0 to 1e[+]06, got nan",
    }.items():
        with pytest.raises(ValueError, match=message):
            make()


class Doubt(nn.Module, Objective):
    """A user's own: an attribute should look like half the error of colour, times a factor that is learned."""

    needs = frozenset({"color", "uncertainty"})
    rate = 0.05

    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.ones(()))

    def __call__(self, step: StepView) -> Mapping[str, Tensor]:
        terms = {}
        for place, render, target in zip("12", step.renders, step.targets, strict=True):
            assert render.color is not None
            error = (render.color.detach() - target.image).abs().mean(dim=-1, keepdim=True)
            terms[f"doubt{place}"] = masked_mse(self.factor * render.further["uncertainty"], error)
        return terms


def doubting(scene: Scene, *overrides: str):
    """A module with an attribute and an objective of somebody else's."""
    name = f"+loss.doubt._target_={Doubt.__module__}.Doubt"
    return module_of(scene, *UNCERTAINTY, name, *overrides)


def test_an_attribute_and_an_objective_of_ones_own_train_and_resume(
    tiny_scene: Scene, tmp_path: Path
):
    whole = train(doubting(tiny_scene), tmp_path / "whole")
    table, splats = whole.model.attributes, whole.model.splats
    assert table["uncertainty"].rate == 0.01
    assert splats["uncertainty"].shape == (whole.model.count, 1)
    assert splats["uncertainty"].std() > 1e-3  # learned, each for itself
    assert abs(dict(whole.step.trained())["loss.doubt.factor"].item() - 1) > 1e-3
    half = doubting(tiny_scene)
    stop_at(half, 10)
    train(half, tmp_path / "halves")
    assert half.next_step == 10
    resumed = train(doubting(tiny_scene), tmp_path / "halves")
    assert_same_bits(whole, resumed)
    one, two = (capture(module, {}).tensors["loss.doubt.factor"] for module in (whole, resumed))
    assert torch.equal(one, two)
    write_ply(tmp_path / "a.ply", point_cloud(whole.model, []).params)
    assert torch.equal(parse_ply(tmp_path / "a.ply", table)["uncertainty"], splats["uncertainty"])
    assert "uncertainty" not in read_ply(tmp_path / "a.ply")  # other readers pass over it


@pytest.mark.parametrize("shape_grad", [True, False])
def test_its_gradient_reaches_shapes_only_if_it_may(tiny_scene: Scene, shape_grad: bool):
    given = f"+gaussians.attributes.uncertainty.shape_grad={str(shape_grad).lower()}"
    model = doubting(tiny_scene, given).model
    camera = tiny_scene.train[0].camera
    render = model.render(camera, color=False, language=False, further=["uncertainty"])
    assert render.color is None
    assert render.feature is None
    ramp = torch.arange(render.further["uncertainty"].numel()).float()
    (render.further["uncertainty"].flatten() * ramp).sum().backward()
    means, values = model.splats["means"].grad, model.splats["uncertainty"].grad
    assert values is not None
    assert values.any()
    assert bool(means is not None and means.any()) == shape_grad


def test_what_cannot_be_drawn_is_named(tiny_scene: Scene):
    model = doubting(tiny_scene, "+gaussians.attributes.uncertainty.blended_by=null").model
    for name in ("uncertainty", "means", "unheard"):
        with pytest.raises(
            ValueError, match=f"further attributes must be some of none, got {name}"
        ):
            model.render(tiny_scene.train[0].camera, further=[name])


def test_without_colour_densification_goes_by_what_there_is(tiny_scene: Scene):
    module = module_of(tiny_scene, "gaussians.densify_on=rgb")
    objectives = module.step.setup.objectives
    assert isinstance(objectives, dict)
    del objectives["photometric"]
    for step in range(2):  # codes start at zero, where language moves no position
        module.training_step(step, 0)
    assert any(gradient.any() for gradient in module.report.screen_gradients)


def test_an_attribute_named_like_another_does_not_hide_it(tmp_path: Path):
    config = GaussiansConfig(attributes={"lang_noise": {"width": 2}})
    table = attributes_of(config, 3)
    params = complete({row.name: torch.rand(4, *(row.shape or ())) for row in table.values()}, 3)
    params |= {"lang_noise": torch.rand(4, 2)}
    write_ply(tmp_path / "a.ply", params)
    back = parse_ply(tmp_path / "a.ply", table)
    assert back.keys() == params.keys()
    assert all(torch.equal(back[name], params[name]) for name in params)


def test_ids_count_what_stands_there():
    plain = run_id(composed(*TINY), "f")
    others = [
        run_id(composed(*TINY, *given), "f")
        for given in (UNCERTAINTY, ("+loss.doubt._target_=somewhere.Doubt",))
    ]
    assert len({plain, *others}) == 3


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"opacity": {"width": 1}}, "names of letters, digits and _ that are not taken, got opacity"),
        ({"features": {"width": 1}}, "not taken, got features"),
        ({"a b": {"width": 1}}, "not taken, got a b"),
        ({"mine": {}}, "attributes.mine must have a width"),
        ({"mine": {"width": 1, "colour": 2}}, "attributes.mine must have a width and some of"),
        ({"mine": {"width": 0}}, "width must be 1 to 4096, got 0"),
        ({"mine": {"width": 1, "activation": "relu"}}, "activation must be one of none, exp, logistic"),
        ({"mine": {"width": 1, "blended_by": "colour"}}, "blended_by must be"),
        ({"mine": {"width": 1, "rate": 2.0}}, "rate must be 0 to 1, got 2.0"),
    ],
)  # fmt: skip
def test_a_bad_attribute_is_named(
    monkeypatch: pytest.MonkeyPatch, attributes: dict[str, object], message: str
):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # types would speak first
    with pytest.raises(ValueError, match=message):
        attributes_of(GaussiansConfig(attributes=attributes), 3)
