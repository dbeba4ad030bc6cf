"""Gaussian Grouping's query: which objects a mask means, what a field answers by them, and masks that a user gives."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_runs import TINY, composed

from vlgs.experiment import construct
from vlgs.fields import HasGaussians, HasObjects
from vlgs.fields.saved import put_together, take_apart
from vlgs.fields.several import SeveralFields
from vlgs.fields.trained import SplatField
from vlgs.heads.classifier import Classifier
from vlgs.opened import open_run
from vlgs.queries import Learning, Objects, Particular, Prompts, Query
from vlgs.queries.objects import choose_objects
from vlgs.queries.view_masks import MaskFolder
from vlgs.run import run
from vlgs.runs import RunFolder
from vlgs.training.build import build_module
from vlgs.training.joint import join_levels
from vlgs.types import Scene

METHOD = ("method=gs_grouping", *(o for o in TINY if not o.startswith("head.")))


def grouping(scene: Scene) -> SplatField:
    """Gaussians that tell the masks of a scene apart, as training leaves them that has hardly begun."""
    module = build_module(scene, construct(composed(*METHOD)).parts, seed=0)
    model = module.model
    with torch.no_grad():
        model.splats["features"].normal_(generator=torch.Generator().manual_seed(0)).mul_(4)
    return SplatField(model)


def write_mask(folder: Path, word: str, view: str, mask: np.ndarray) -> None:
    (folder / word).mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * mask).astype(np.uint8)).save(folder / word / f"{view}.png")


@pytest.mark.parametrize("share", [0.2, 0.7, 1.0])
def test_objects_are_those_that_lie_inside(share: float):
    generator = torch.Generator().manual_seed(0)
    shown = torch.randint(0, 7, (12, 16), generator=generator)
    mask = torch.rand(12, 16, generator=generator) < torch.linspace(0, 1, 16)
    shown[:, :4] = 5
    shown[:, 12:] = 6
    inside, whole = [0] * 6, [0] * 6
    for y in range(12):
        for x in range(16):
            if shown[y, x] < 6:  # 6 is no object
                whole[shown[y, x]] += 1
                inside[shown[y, x]] += bool(mask[y, x])
    want = [within > share * of for within, of in zip(inside, whole, strict=True)]
    if not any(want):
        want[inside.index(max(inside))] = True
    assert choose_objects(shown, mask, 6, share).tolist() == want
    assert not choose_objects(shown, mask & (shown == 6), 6, share).any()


def test_a_field_answers_by_the_probability_of_objects(tiny_scene: Scene):
    field, camera = grouping(tiny_scene), tiny_scene.train[0].camera
    assert isinstance(field, HasObjects)
    words = torch.randn(3, tiny_scene.mask_vectors.shape[1])
    chosen = torch.zeros(2, field.object_count, dtype=torch.bool)
    chosen[0, [0, 3]] = True
    learned = field.with_objects(words[:2], chosen)
    codes = field.render(camera, frozenset({"feature"})).feature
    assert codes is not None
    head = field.model.head
    assert isinstance(head, Classifier)
    probabilities = torch.stack([head.logits(row) for row in codes[0]]).softmax(dim=-1)
    answer = learned.similarity(camera, words)[0]
    torch.testing.assert_close(answer[0], probabilities[..., 0] + probabilities[..., 3])
    assert not answer[1].any(), "a word without objects is nowhere"
    torch.testing.assert_close(answer[2], field.similarity(camera, words[2:])[0, 0])
    assert torch.equal(field.objects(camera), probabilities.argmax(dim=-1))
    each = learned.gaussian_similarity(words)
    own = head.logits(field.model.splats["features"]).softmax(dim=-1)
    torch.testing.assert_close(each[0, 0], own[:, 0] + own[:, 3])
    plan, tensors = take_apart(learned)
    back = put_together(
        json.loads(json.dumps(plan)), tensors, lambda group, _: getattr(field.model, group)
    )
    assert torch.equal(back.similarity(camera, words), learned.similarity(camera, words))
    assert isinstance(back, HasGaussians)
    with pytest.raises(ValueError, match=r"objects must be \[2, 68\], got \[2, 67\]"):
        field.with_objects(words[:2], chosen[:, :-1])


def test_a_word_learns_from_a_mask_and_every_level_has_its_own_objects(tiny_scene: Scene):
    query = Objects(share=0.5)
    assert isinstance(query, Query)
    assert isinstance(query, Learning)
    assert isinstance(query, Particular)
    field, view = grouping(tiny_scene), tiny_scene.train[2]
    word = tiny_scene.mask_vectors[5]
    prompts = Prompts(("it",), word[None], torch.zeros(0, len(word)))
    learned = query.learn(field, tiny_scene, prompts)
    found = learned.similarity(view.camera, word[None])[0]
    answer = query.relevancy(found, found[:0])
    assert answer.shape == (1, view.camera.height, view.camera.width)
    assert 0 < answer.max() <= 1
    levels = join_levels([tiny_scene, tiny_scene])
    joint = query.learn(grouping(levels), levels, prompts)
    assert isinstance(joint, SeveralFields)
    assert len(joint.levels()) == 2
    assert joint.similarity(view.camera, word[None]).max() > 0


def test_masks_of_a_user_are_read_at_the_size_of_the_view(tmp_path: Path, tiny_scene: Scene):
    view, folder = tiny_scene.train[1], MaskFolder(str(tmp_path))
    small = np.zeros((view.camera.height // 2, view.camera.width // 2), bool)
    small[3:6, 4:9] = True
    for name in (view.name, tiny_scene.train[3].name, "elsewhere"):
        write_mask(tmp_path, "wine glass", name, small if name == view.name else ~small)
    field, vector = grouping(tiny_scene), tiny_scene.mask_vectors[0]
    found = folder.find(field, tiny_scene, "wine glass", vector)
    assert found is not None
    assert found[0] is view, "the first of the training views that has one"
    assert torch.equal(found[1], torch.from_numpy(small.repeat(2, 0).repeat(2, 1)))
    assert folder.find(field, tiny_scene, "../wine glass", vector) is None
    assert folder.find(field, tiny_scene, "mug", vector) is None


@pytest.mark.parametrize("suffix", [".png", ".PNG"])
def test_masks_of_a_user_end_where_they_are_transparent(
    tmp_path: Path, tiny_scene: Scene, suffix: str
):
    view = tiny_scene.train[1]
    pixels = np.full((view.camera.height, view.camera.width, 4), 255, np.uint8)
    pixels[..., 3] = 0
    pixels[3:6, 4:9, 3] = 255
    (tmp_path / "mug").mkdir()
    Image.fromarray(pixels).save(tmp_path / "mug" / f"{view.name}{suffix}")
    vector = tiny_scene.mask_vectors[0]
    found = MaskFolder(str(tmp_path)).find(grouping(tiny_scene), tiny_scene, "mug", vector)
    assert found is not None
    assert torch.equal(found[1], torch.from_numpy(pixels[..., 3] > 0))


def test_masks_that_teach_nothing_are_refused(
    tmp_path: Path, tiny_scene: Scene, caplog: pytest.LogCaptureFixture
):
    query = Objects(masks=str(tmp_path))
    first = tiny_scene.train[0].name
    with pytest.raises(ValueError, match=rf"masks .* such as mug/{first}\.png, got none"):
        query.require(tiny_scene, ["mug", "lemon"])
    write_mask(tmp_path, "mug", first, np.ones((9, 12), bool))
    with pytest.raises(ValueError, match=rf"{first}\.png must have some pixels .* got all of them"):
        query.require(tiny_scene, ["mug", "lemon"])
    write_mask(tmp_path, "mug", first, np.eye(9, 12, dtype=bool))
    query.require(tiny_scene, ["mug", "lemon"])
    assert "no mask of a training view for lemon" in caplog.text
    (tmp_path / "mug" / f"{first}.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match="content must be a whole image"):
        query.require(tiny_scene, ["mug"])


def test_a_run_says_whose_masks_it_learned_from(tmp_path: Path):
    config = composed(
        *METHOD,
        "trainer=smoke",
        "trainer.iterations=12",
        "query=objects",
        f"results={tmp_path}/results",
    )
    config.pictures = False
    scene = construct(config).read_scene()
    view, ids = scene.train[0], scene.train[0].read_masks
    assert ids is not None
    write_mask(tmp_path / "drawn", scene.classes[-1], view.name, (ids() == ids().max()).numpy())
    config.query.masks = str(tmp_path / "drawn")
    assert run(config) == 0
    (path,) = (tmp_path / "results" / "runs").iterdir()
    metrics = RunFolder(path).finished()
    assert metrics is not None
    assert metrics["query"] == "objects, masks of drawn"
    assert metrics["miou"] is not None
    opened = open_run(path)
    asked = opened.ask([scene.classes[-1], scene.classes[0]])
    there, nowhere = opened.field.similarity(view.camera, asked.prompts.text)[0]
    assert there.max() > 0
    assert not nowhere.any()


def test_without_a_classifier_it_is_refused(tiny_scene: Scene):
    lifting = construct(composed("method=lift", "gaussians.background=0")).parts
    with pytest.raises(
        ValueError,
        match=r"head must be classifier with query=objects, as it asks which object .*, got codebook",
    ):
        construct(composed("method=langsplat_v2", "query=objects"))
    with pytest.raises(ValueError, match="objects: share must be 0 to 1, got 2"):
        Objects(share=2.0)
    no_words = Prompts((), torch.zeros(0, 2), torch.zeros(0, 2))
    with pytest.raises(ValueError, match=r"field must know objects \(head=classifier\), got one"):
        Objects().learn(
            SplatField(build_module(tiny_scene, lifting, seed=0).model), tiny_scene, no_words
        )
