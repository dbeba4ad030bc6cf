"""GOI's plane: it separates what can be separated, and a field answers by it in any view."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.fields import Field, FieldImages
from vlgs.fields.similarity import cosines
from vlgs.queries import Hyperplane, Learning, Particular, Prompts, Query
from vlgs.queries.hyperplane import hinge_slope
from vlgs.types import Scene

WIDTH = 8


def blobs() -> tuple[Tensor, Tensor]:
    """Unit features of two things that are alike, and which of them are of the first."""
    generator = torch.Generator().manual_seed(0)
    middle = normalize(torch.ones(2, WIDTH) + 0.6 * torch.eye(2, WIDTH), dim=-1)
    which = torch.arange(300) % 3 != 0
    noise = 0.02 * torch.randn(300, WIDTH, generator=generator)
    return normalize(middle[which.long()] + noise, dim=-1), which


def test_a_plane_separates_what_can_be_separated():
    features, mask = blobs()
    word = normalize(torch.rand(WIDTH, generator=torch.Generator().manual_seed(1)), dim=-1)
    before = features @ word
    assert (before[mask].min() < before[~mask].max()).item()  # the word alone does not
    plane, overlap = Hyperplane(overlap=1.0).fit(features, mask, word)
    assert overlap == 1.0
    assert torch.equal(features @ plane.weights + plane.bias > 0, mask)
    again, _ = Hyperplane(overlap=1.0).fit(features, mask, word)
    assert torch.equal(plane.weights, again.weights)


def test_the_slope_is_that_of_the_hinge_loss():
    generator = torch.Generator().manual_seed(0)
    distance = (2 * torch.randn(20, generator=generator)).requires_grad_()
    inside, outside = torch.randint(4, (2, 20), generator=generator).float().unbind()
    loss = inside @ (1 - distance).clamp_min(0) + outside @ (1 + distance).clamp_min(0)
    (want,) = torch.autograd.grad(loss / (inside + outside).sum(), distance)
    torch.testing.assert_close(hinge_slope(distance.detach(), inside, outside), want)


class Painted:
    """A field whose pixels have the embedding of their mask in the first view of a scene, from wherever it is seen."""

    outputs = frozenset({"color", "feature"})
    has_language = True

    def __init__(self, scene: Scene) -> None:
        read = scene.train[0].read_masks
        assert read is not None
        self.masks = read().long()
        self.vectors = torch.cat([scene.mask_vectors, torch.zeros(1, scene.mask_vectors.shape[1])])

    def levels(self) -> Sequence[Field]:
        return (self,)  # pyright: ignore[reportReturnType]

    def render(self, camera, outputs) -> FieldImages:
        return FieldImages()

    def similarity(self, camera, words, seen=None, pixels=None) -> Tensor:
        return cosines(self.vectors[self.masks], words)[None]


def test_a_field_answers_by_the_planes_of_its_words(tiny_scene: Scene):
    field, scene = Painted(tiny_scene), replace(tiny_scene, train=tiny_scene.train[:1])
    row = int(field.masks[field.masks >= 0].mode().values)
    word = tiny_scene.mask_vectors[row]
    other = normalize(torch.randn(len(word), generator=torch.Generator().manual_seed(0)), dim=-1)
    query = Hyperplane()
    assert isinstance(query, Query)
    assert isinstance(query, Learning)
    prompts = Prompts(("it",), word[None], torch.zeros(0, len(word)))
    learned = query.learn(field, scene, prompts)  # pyright: ignore[reportArgumentType]
    camera = scene.train[0].camera
    answer = learned.similarity(camera, torch.stack([other, word]))
    relevancy = query.relevancy(answer[0], answer[0, :0])
    mask = field.masks == row
    chosen = relevancy[1] > 0.5
    assert (chosen & mask).sum() >= 0.9 * (chosen | mask).sum()
    # A word without a plane is asked as before.
    torch.testing.assert_close(answer[0, :1], field.similarity(camera, other[None])[0])
    (level,) = learned.levels()
    torch.testing.assert_close(level.similarity(camera, word[None]), answer[:, 1:])


def test_a_plane_learns_from_a_picture_of_the_user(tmp_path: Path, tiny_scene: Scene):
    """The word is that of one mask, and the picture shows another: it is the picture that counts."""
    field, scene = Painted(tiny_scene), replace(tiny_scene, train=tiny_scene.train[:1])
    rows, counts = field.masks[field.masks >= 0].unique(return_counts=True)
    own, shown = rows[counts.argsort(descending=True)][:2].tolist()
    word, mask, view = tiny_scene.mask_vectors[own], field.masks == shown, scene.train[0]
    (tmp_path / "it").mkdir()
    picture = Image.fromarray((255 * mask).byte().numpy())
    picture.save(tmp_path / "it" / f"{view.name}.png")
    query = Hyperplane(masks=str(tmp_path))
    assert isinstance(query, Particular)
    prompts = Prompts(("it",), word[None], torch.zeros(0, len(word)))
    learned = query.learn(field, scene, prompts)  # pyright: ignore[reportArgumentType]
    chosen = learned.similarity(view.camera, word[None])[0, 0] > 0
    assert (chosen & mask).sum() >= 0.9 * (chosen | mask).sum()
    with pytest.raises(ValueError, match=r"masks .* must have <word>/<view>\.png"):
        query.require(scene, ["mug"])


def test_bad_values_are_named():
    with pytest.raises(ValueError, match="overlap must be 0 to 1, got 2"):
        Hyperplane(overlap=2.0)
    with pytest.raises(ValueError, match="scale must be 1e-06 to 1e\\+06, got 0"):
        Hyperplane(scale=0.0)
