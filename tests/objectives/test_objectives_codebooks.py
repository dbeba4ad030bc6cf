"""Losses of heads with a table of embeddings, against loops over pixels; and what they must not move."""

import math
from dataclasses import fields, replace

import pytest
import torch
from tiny_runs import TINY, composed
from torch.nn.functional import cosine_similarity, normalize

from vlgs.config import instantiate
from vlgs.losses import masked_cosine
from vlgs.objectives import CodebookLanguage, CodeClasses, LookupLanguage, SmoothCodes
from vlgs.training.build import Parts, build_module
from vlgs.training.lightning import VLGSModule
from vlgs.types import Scene

KEPT = tuple(o for o in TINY if not o.startswith("head."))
FROZEN = (
    "trainer.freeze=[means,quats,log_scales,sh0,shN,opacity_logits,indicator_logits]",
    "gaussians.densify.stop=0",
)


def module_of(scene: Scene, method: str, *overrides: str, color: bool = True) -> VLGSModule:
    config = composed(*KEPT, f"method={method}", "trainer=smoke", *overrides)
    torch.manual_seed(config.seed)
    parts = Parts(**{field.name: instantiate(config[field.name]) for field in fields(Parts)})
    return build_module(scene, parts, config.seed, color)


def pixels(module: VLGSModule, count: int = 40):
    """Codes and masks of some pixels of a view, and the unit embeddings of the masks."""
    masks = module.views[0].masks
    some = masks[masks >= 0][:: max(1, int((masks >= 0).sum()) // count)].long()
    vectors = normalize(module.views.scene.mask_vectors, dim=-1)
    generator = torch.Generator().manual_seed(0)
    return torch.randn(len(some), module.model.head.dim, generator=generator), some, vectors


def test_langsplat_v2_is_one_minus_cos_whatever_way_it_is_computed(tiny_scene: Scene):
    module = module_of(tiny_scene, "langsplat_v2")
    objective = module.step.setup.objectives["codebook"]
    assert isinstance(objective, CodebookLanguage)
    assert objective.pixels == "all"
    codes, masks, vectors = pixels(module)
    codes = codes.softmax(dim=-1).requires_grad_()
    entries = objective.head.entries

    def loop():
        shown = codes @ entries
        return (1 - cosine_similarity(shown, vectors[masks], dim=-1)).sum()

    got, want = objective.total(codes, masks), loop()
    torch.testing.assert_close(got, want)
    for one, two in zip(
        torch.autograd.grad(got, [codes, entries]),
        torch.autograd.grad(want, [codes, entries]),
        strict=True,
    ):
        torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-5)
    # Over a whole view it is the error of maps; pixels without a mask count, and as zero.
    seen = module.step.forward(0).seen
    given, render = seen.targets[0], seen.renders[0]
    holes = given.masks.clone()
    holes[:5] = -1
    maps = {"masks": holes, "valid": holes >= 0}
    target = replace(given, read=maps.__getitem__)
    assert render.feature is not None
    with torch.no_grad():
        term = objective(replace(seen, targets=(target, target)))["language 1"]
        shown = module.model.head.predict(render.feature)
        whole = masked_cosine(shown, given.codes, holes >= 0, "all")
    torch.testing.assert_close(term, whole, rtol=1e-4, atol=1e-6)


def test_what_langsplat_v2_blends_is_a_mean_of_at_most_four_entries(tiny_scene: Scene):
    module = module_of(tiny_scene, "langsplat_v2", *FROZEN, color=False)
    for step in range(3):
        module.training_step(step, 0)
    feature = module.model.fuse().feature
    assert feature.shape[1] == 64
    assert feature.count_nonzero(dim=1).max() == 4
    torch.testing.assert_close(feature.sum(dim=1), torch.ones(len(feature)))


@pytest.mark.parametrize("late", [False, True])
def test_the_four_terms_of_goi_are_those_of_a_loop(tiny_scene: Scene, late: bool):
    module = module_of(tiny_scene, "goi", "head.rows=7", "trainer.iterations=9")
    objective = module.step.setup.objectives["lookup"]
    assert isinstance(objective, LookupLanguage)
    assert objective.iterations == 9
    codes, masks, vectors = pixels(module)
    temperature = 2.0 if late else 1.0
    with torch.no_grad():
        got = objective.terms(codes, masks, temperature)
        table, scores = normalize(objective.head.table, dim=-1), objective.head.map(codes)
        want = dict.fromkeys(got, 0.0)
        for score, mask in zip(scores, masks, strict=True):
            cosines = [float(vectors[mask] @ row) for row in table]
            odds = score.softmax(dim=-1)
            right = cosines.index(max(cosines))
            unit = torch.zeros(7)
            unit[right] = 1
            want["choice"] += 50 * float((odds - unit).square().mean())
            want["near"] += 1 - max(cosines)
            powers = [math.exp(temperature * c) for c in cosines]
            shares = [power / sum(powers) for power in powers]
            want["entropy"] -= 0.3 * sum(p * math.log(p) for p in shares)
            want["answer"] += 1 - cosines[int(score.argmax())]
    for name, total in want.items():
        assert got[name].item() == pytest.approx(total / len(masks), rel=1e-4, abs=1e-6), name
    # The temperature of a step: it is late from two thirds of the iterations on.
    step = replace(module.step.forward(0).seen, step=7 if late else 5)
    rendered, target = step.renders[0].feature, step.targets[0]
    assert rendered is not None
    there = target.valid
    own = objective.terms(rendered[there], target.masks[there].long(), temperature)
    torch.testing.assert_close(objective(step)["entropy 1"], own["entropy"])


@pytest.mark.parametrize("method", ["langsplat_v2", "goi"])
def test_only_codes_and_the_head_learn_from_language(tiny_scene: Scene, method: str):
    module = module_of(tiny_scene, method, *FROZEN, color=False)
    names = {group["name"] for group in module.optimizer.param_groups}
    assert names == {"features", *(["head"] if method == "langsplat_v2" else ["head.map", "head.table"])}  # fmt: skip
    before = {name: value.detach().clone() for name, value in module.model.splats.items()}
    for step in range(2):
        module.training_step(step, 0)
    moved = {n for n, v in module.model.splats.items() if not torch.equal(v, before[n])}
    assert moved == {"features"}
    for parameter in module.model.head.parameters():  # pyright: ignore[reportAttributeAccessIssue]
        assert parameter.grad is not None
        assert parameter.grad.any()


def test_goi_reaches_codes_by_the_choice_and_the_table_by_the_rest(tiny_scene: Scene):
    module = module_of(tiny_scene, "goi", "head.rows=7")
    objective = module.step.setup.objectives["lookup"]
    assert isinstance(objective, LookupLanguage)
    codes, masks, _ = pixels(module)
    codes.requires_grad_()
    for name, term in objective.terms(codes, masks, 1.0).items():
        by_codes, by_table = torch.autograd.grad(
            term, [codes, objective.head.table], retain_graph=True, allow_unused=True
        )
        assert (by_codes is not None) == (name == "choice")
        assert (by_table is not None) == (name != "choice")


def test_the_terms_of_legaussians_are_those_of_a_loop(tiny_scene: Scene):
    module = module_of(tiny_scene, "legaussians", "head.quantiser.steps=20")
    objective = module.step.setup.objectives["classes"]
    assert isinstance(objective, CodeClasses)
    codes, masks, _ = pixels(module)
    doubt = torch.linspace(0.01, 0.9, len(masks))
    classes = module.views.codes_of(masks)
    with torch.no_grad():
        error, price = objective.terms(codes, classes, doubt)
        scores = module.model.head.predict(codes)
        loop = [
            (1 - float(u)) * -math.log(float(score.softmax(0)[int(own.argmax())]))
            for score, own, u in zip(scores, classes, doubt, strict=True)
        ]
    assert error.item() == pytest.approx(sum(loop) / len(loop), rel=1e-4)
    want = -sum(math.log(1 - float(u)) for u in doubt) / len(doubt)
    assert price.item() == pytest.approx(want, rel=1e-4)


def test_legaussians_starts_as_it_says_and_reaches_shapes_and_opacity(tiny_scene: Scene):
    module = module_of(tiny_scene, "legaussians", "head.quantiser.steps=20")
    splats = module.model.splats
    assert splats["features"].shape[1] == 8
    torch.testing.assert_close(splats["uncertainty"].sigmoid(), torch.full_like(splats["uncertainty"], 0.01))  # fmt: skip
    assert module.model.attributes["uncertainty"].rate == 0.05
    assert module.model.attributes["features"].rate == 1e-3
    done = module.step.forward(0)
    (done.terms["codes 1"] + done.terms["codes 2"]).backward()
    for name in ("features", "uncertainty", "means", "log_scales", "quats", "opacity_logits"):
        gradient = splats[name].grad
        assert gradient is not None, name
        assert gradient.any(), name
    assert splats["sh0"].grad is None or not splats["sh0"].grad.any()
    assert not module.model.head.codebook.requires_grad  # pyright: ignore


def test_codes_are_pulled_to_a_network_of_positions(tiny_scene: Scene):
    module = module_of(tiny_scene, "legaussians", "head.quantiser.steps=20")
    objective = module.step.setup.objectives["smooth"]
    assert isinstance(objective, SmoothCodes)
    shapes = [tuple(p.shape) for p in objective.parameters() if p.dim() == 2]
    assert shapes == [(128, 3), (128, 128), (128, 128), (128, 128), (8, 128)]
    means, codes = torch.randn(6, 3, requires_grad=True), torch.randn(6, 8, requires_grad=True)
    doubt = torch.linspace(0, 1, 6)
    terms = objective.terms(means, codes, doubt)
    answer = objective.network(means).detach()
    squares = [
        float((a - c).square().sum()) / 8 for a, c in zip(answer, codes.detach(), strict=True)
    ]
    assert terms["smooth network"].item() == pytest.approx(sum(squares) / 6, rel=1e-5)
    pulled = [(float(u) + 0.1 * (1 - float(u))) * s for u, s in zip(doubt, squares, strict=True)]
    assert terms["smooth codes"].item() == pytest.approx(sum(pulled) / 6, rel=1e-5)
    weights = list(objective.parameters())
    moved = torch.autograd.grad(terms["smooth codes"], [codes, means, *weights], allow_unused=True)
    assert moved[0] is not None
    assert not any(gradient is not None for gradient in moved[1:])
    learnt = torch.autograd.grad(terms["smooth network"], [codes, means], allow_unused=True)
    assert learnt == (None, None)
    # Every tenth iteration, and no other.
    seen = module.step.forward(0).seen
    assert [step for step in range(21) if objective(replace(seen, step=step))] == [9, 19]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("langsplat_v2", "head=identity"), "codebook language: head must be codebook, which has entries, got Identity"),
        (("goi", "head=codebook"), "lookup language: head must be lookup, which has a table, got Codebook"),
        (("legaussians", "head=lookup"), "code classes: head must be quantised, which has classes, got LookupTable"),
        (("legaussians", "loss.smooth.attribute=doubt", "head.quantiser.steps=2"), "gaussians.attributes must have doubt, got means"),
        (("goi", "loss.lookup.late=2"), "late must be 0 to 1, got 2"),
        (("langsplat_v2", "loss.codebook.pixels=some"), "pixels must be one of valid, all, got 'some'"),
        (("legaussians", "head.quantiser.balance=-1"), "balance must be 0 to 1e\\+06, got -1"),
        (("langsplat_v2", "gaussians.codes_kept=0"), "codes_kept must be 1 to 65536, got 0"),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_named(
    tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch, overrides: tuple[str, ...], message: str
):
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)  # types would speak first
    with pytest.raises(ValueError, match=message):
        module_of(tiny_scene, *overrides)
