import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load, save
from slow import with_slow
from torch import Tensor, nn
from torch.nn.functional import normalize

from vlgs.data.synthetic.language import vocabulary
from vlgs.heads import FittedHead, Head
from vlgs.heads.autoencoder import Autoencoder, AutoencoderTraining
from vlgs.heads.identity import Identity

CITYSCAPES = Path(__file__).parents[2] / (
    "../shared/data/clip_text_embeddings/semivl/cityscapes_single.npy"
)
CAMVID = [10, 2, 5, 0, 1, 8, 7, 4, 13, 11, 12]
NOISE = 0.35
QUICK = AutoencoderTraining(steps=40, batch=32)
"""Enough to run everything, not enough to be good."""


def draw(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def cone(k: int, width: int = 64) -> Tensor:
    """Class vectors with cosines near 0.8, as those of CLIP."""
    return normalize(2 * normalize(draw(1, width, seed=0)) + normalize(draw(k, width, seed=1)))


def masks(classes: Tensor, per_class: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Noisy unit vectors of masks, their areas, which differ by a factor of 30 between classes, and their classes."""
    k, width = classes.shape
    labels = torch.arange(k).repeat(per_class)
    offset = 0.5 * normalize(draw(1, width, seed=99))
    noise = NOISE * normalize(draw(len(labels), width, seed=seed))
    areas = 30.0 ** (labels / k) * (0.1 + draw(len(labels), seed=seed + 1).abs())
    return normalize(classes[labels] + offset + noise), areas, labels


def quick(**options) -> Autoencoder:
    return Autoencoder(encoder_widths=(16, 8), decoder_widths=(8, 16), training=QUICK, **options)


def weights(head: Autoencoder) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in head.state_dict().items()}


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.fixture(scope="module", params=with_slow(["procedural", "real"], ["real"]))
def camvid(request: pytest.FixtureRequest) -> tuple[Autoencoder, Tensor]:
    """A head, and the vectors of the eleven classes of a street that it was fitted to."""
    if request.param == "procedural":
        words = (
            "sky",
            "building",
            "pole",
            "road",
            "pavement",
            "tree",
            "sign",
            "fence",
            "car",
            "pedestrian",
            "bicyclist",
        )
        classes = vocabulary(words).vectors[:11]
    elif CITYSCAPES.exists():
        classes = normalize(torch.from_numpy(np.load(CITYSCAPES)[CAMVID].astype(np.float32)))
    else:
        pytest.skip("real text embeddings not at hand")
    head = Autoencoder(training=AutoencoderTraining(steps=300))  # half of what a run takes
    vectors, areas, _ = masks(classes, 60, seed=2)
    head.fit(vectors, areas)
    return head, classes


def accuracy(head: Autoencoder, classes: Tensor, codes: Tensor, labels: Tensor) -> float:
    return (head.decode(codes) @ classes.T).argmax(1).eq(labels).float().mean().item()


def test_three_numbers_tell_real_classes_apart(camvid: tuple[Autoencoder, Tensor]):
    head, classes = camvid
    vectors, _, labels = masks(classes, 20, seed=7)  # never seen
    codes = head.encode(vectors)
    assert codes.shape == (220, 3)
    assert accuracy(head, classes, codes, labels) > 0.99
    # What is rendered is off by some noise, and shorter where little covers the pixel.
    nudged = codes + 0.1 * normalize(draw(220, 3, seed=3))
    assert accuracy(head, classes, nudged, labels) > 0.99
    assert accuracy(head, classes, 0.6 * codes, labels) > 0.99


def test_reconstruction_is_the_area_weighted_cosine(camvid: tuple[Autoencoder, Tensor]):
    head, classes = camvid
    vectors, areas, _ = masks(classes, 60, seed=2)
    cosines = (head.decode(head.encode(vectors)) * vectors).sum(1)
    assert head.reconstruction == pytest.approx((areas @ cosines / areas.sum()).item(), abs=1e-5)
    # Noise of norm 0.35 on vectors of norm about 1.4 cannot be coded: the cosine ends near 1.4 / sqrt(1.4^2 + 0.35^2).
    assert head.reconstruction > 0.94


def test_layers_are_those_of_langsplat():
    head = Autoencoder()
    head.build(512)
    shapes = {
        name: tuple(value.shape) for name, value in head.state_dict().items() if "weight" in name
    }
    assert shapes == {
        "encoder.0.weight": (256, 512), "encoder.1.weight": (256,), "encoder.3.weight": (128, 256),
        "encoder.4.weight": (128,), "encoder.6.weight": (64, 128), "encoder.7.weight": (64,),
        "encoder.9.weight": (32, 64), "encoder.10.weight": (32,), "encoder.12.weight": (3, 32),
        "decoder.0.weight": (16, 3), "decoder.2.weight": (32, 16), "decoder.4.weight": (64, 32),
        "decoder.6.weight": (128, 64), "decoder.8.weight": (256, 128), "decoder.10.weight": (256, 256),
        "decoder.12.weight": (512, 256),
    }  # fmt: skip


def test_codes_and_embeddings_have_unit_length():
    head = quick(dim=4)
    assert isinstance(head, Head)
    vectors, areas, _ = masks(cone(5), 10, seed=2)
    head.fit(vectors, areas)
    codes = head.encode(vectors)
    torch.testing.assert_close(codes.norm(dim=1), torch.ones(50))
    decoded = head.decode(0.4 * codes.reshape(5, 10, 4))
    assert decoded.shape == (5, 10, 64)
    torch.testing.assert_close(decoded.norm(dim=-1), torch.ones(5, 10))


def test_fit_is_a_function_of_the_data_and_leaves_the_global_generator_alone():
    vectors, areas, _ = masks(cone(5), 10, seed=2)
    before = torch.get_rng_state()
    first, again, other = quick(), quick(), quick()
    first.fit(vectors, areas)
    assert torch.equal(before, torch.get_rng_state())
    torch.rand(3)
    threads = torch.get_num_threads()
    torch.set_num_threads(3 - min(threads, 2))
    shuffled = torch.randperm(50)
    twice = torch.cat([vectors, vectors])[torch.cat([shuffled, shuffled + 50])]
    half = (areas / 2).repeat(2)[torch.cat([shuffled, shuffled + 50])]
    try:
        again.fit(twice, half)
        assert torch.get_num_threads() == 3 - min(threads, 2)
    finally:
        torch.set_num_threads(threads)
    assert same(weights(first), weights(again))
    other.fit(vectors[:40], areas[:40])
    assert not same(weights(first), weights(other))


def test_no_two_classes_share_a_code_that_was_placed_apart():
    vectors, areas, labels = masks(cone(12), 10, seed=3)

    def nearest(seed: int, spread: int) -> float:
        """Degrees between the mean codes of the two classes that are nearest; 63 is the most that twelve can have."""
        training = AutoencoderTraining(steps=100, batch=64, seed=seed, spread=spread)
        head = Autoencoder(encoder_widths=(64, 32), decoder_widths=(32, 64), training=training)
        head.fit(vectors, areas)
        codes = head.encode(vectors)
        means = normalize(torch.stack([codes[labels == k].mean(dim=0) for k in range(12)]), dim=1)
        cosines = means @ means.T - 3 * torch.eye(12)
        return torch.rad2deg(torch.acos(cosines.max().clamp(-1, 1))).item()

    assert max(nearest(seed, spread=0) for seed in range(2)) < 30  # 18 here, 5 to 18
    assert min(nearest(seed, spread=48) for seed in range(2)) > 35  # 46 here, up to 54


@pytest.mark.slow
def test_faint_codes_say_what_all_masks_have_in_common_and_long_ones_their_own():
    vectors, areas, labels = masks(cone(12), 10, seed=3)
    classes = normalize(torch.stack([vectors[labels == k].mean(dim=0) for k in range(12)]))
    common = normalize(vectors.mean(dim=0), dim=0)
    towards = normalize(draw(500, 3, seed=5))

    def said(faint: float) -> tuple[float, float, float]:
        """Least cosine of faint codes with what is common, their largest preference of one class, and the share of masks whose code finds its own."""
        training = AutoencoderTraining(steps=200, batch=128, spread=32, faint=faint)
        head = Autoencoder(training=training)
        head.fit(vectors, areas)
        decoded = head.decode(torch.cat([0 * towards[:1], 0.3 * towards]))
        fits = decoded @ classes.T
        preference = fits.amax(dim=1) - fits.mean(dim=1)
        found = (head.decode(0.6 * head.encode(vectors)) @ classes.T).argmax(dim=1) == labels
        return (
            float((decoded @ common).min()),
            float(preference.max()),
            float(found.float().mean()),
        )

    agreed, preferred, found = said(0.35)
    before = said(0.0)
    assert agreed > 0.975 > before[0]  # 0.991, 0.923
    assert preferred < 0.07 < 0.1 < before[1]  # 0.048, 0.145
    assert found > 0.8


@pytest.mark.slow
def test_of_several_draws_the_one_that_reconstructs_best_stays():
    vectors, areas, _ = masks(cone(5), 10, seed=2)

    def fitted(seed: int, draws: int = 1) -> Autoencoder:
        head = Autoencoder(training=replace(QUICK, seed=seed, draws=draws))
        head.fit(vectors, areas)
        return head

    alone = [fitted(seed) for seed in range(6)]
    for first, several in ((0, fitted(0, draws=3)), (3, fitted(1, draws=3))):
        best = max(alone[first : first + 3], key=lambda head: head.reconstruction)
        assert same(weights(several), weights(best))
        assert several.reconstruction == best.reconstruction


def test_one_embedding_is_enough():
    head = Autoencoder(training=AutoencoderTraining(steps=200, batch=32))
    vector = normalize(draw(1, 64, seed=0))
    head.fit(vector, torch.ones(1))
    assert (head.decode(head.encode(vector)) * vector).sum().item() > 0.99


def test_without_centring_nothing_is_subtracted():
    vectors, areas, _ = masks(cone(3), 5, seed=2)
    plain, centred = quick(center=False), quick()
    plain.fit(vectors, areas)
    centred.fit(vectors, areas)
    assert plain.mean.eq(0).all()
    torch.testing.assert_close(centred.mean, areas @ vectors / areas.sum())


def test_a_fitted_head_does_not_change_in_training():
    vectors, areas, _ = masks(cone(3), 5, seed=2)
    head = quick()
    head.fit(vectors, areas)
    before, codes = weights(head), head.encode(vectors)
    model = nn.ModuleDict({"head": head}).train()
    torch.testing.assert_close(head.encode(vectors[:1]), codes[:1])
    assert same(before, weights(head))
    assert not any(parameter.requires_grad for parameter in model.parameters())


def test_state_goes_to_a_checkpoint_and_back_whatever_the_embedding_width():
    vectors, areas, _ = masks(cone(4, width=24), 5, seed=2)
    fitted, fresh = quick(), nn.ModuleDict({"head": quick()})
    fitted.fit(vectors, areas)
    fresh.load_state_dict(nn.ModuleDict({"head": fitted}).state_dict())
    loaded = fresh["head"]
    assert isinstance(loaded, Autoencoder)
    assert torch.equal(loaded.encode(vectors), fitted.encode(vectors))
    assert loaded.reconstruction == fitted.reconstruction
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


def test_cache_answers_with_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    vectors, areas, _ = masks(cone(4), 5, seed=2)
    first, again, other = (quick(cache_dir=tmp_path / "new") for _ in range(3))
    first.fit(vectors, areas)
    (file,) = (tmp_path / "new").iterdir()
    with monkeypatch.context() as patched:
        patched.delattr(Autoencoder, "_fit")
        again.fit(vectors, areas)
    assert same(weights(first), weights(again))
    assert not any(parameter.requires_grad for parameter in again.parameters())
    other.fit(vectors, areas + 1)  # other data, another entry
    assert len(list(file.parent.iterdir())) == 2


@pytest.mark.parametrize("damage", ["empty", "cut", "foreign", "bit", "unsigned"])
def test_a_damaged_cache_is_fitted_again(
    tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
):
    vectors, areas, _ = masks(cone(4), 5, seed=2)
    first, again = quick(cache_dir=tmp_path), quick(cache_dir=tmp_path)
    first.fit(vectors, areas)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    foreign = whole.replace(b"decoder.0.weight", b"decoder.0.wheels")
    flipped = whole[:-9] + bytes([whole[-9] ^ 1]) + whole[-8:]  # the last bit of a weight
    unsigned = save(load(whole))
    damaged = {"empty": b"", "cut": whole[:-9], "foreign": foreign, "bit": flipped}
    file.write_bytes(damaged.get(damage, unsigned))
    with caplog.at_level(logging.WARNING):
        again.fit(vectors, areas)
    assert "is not usable" in caplog.text
    assert same(weights(first), weights(again))
    assert file.read_bytes() == whole


def test_bad_calls():
    head = quick()
    for call in (head.encode, head.decode):
        with pytest.raises(ValueError, match="fit or a state dict must come before"):
            call(torch.ones(2, 3))
    good = normalize(draw(3, 8, seed=0))
    with pytest.raises(ValueError, match="at least 1 row, got 0"):
        head.fit(good[:0], torch.ones(0))
    bad = good.clone()
    bad[0, 0], bad[1] = torch.nan, 0.0
    with pytest.raises(ValueError, match="got 2 of 3 rows"):
        head.fit(bad, torch.ones(3))
    for areas in (
        torch.zeros(3),
        torch.tensor([1.0, -1.0, 3.0]),
        torch.tensor([1.0, torch.inf, 0.0]),
    ):
        with pytest.raises(ValueError, match="areas must be finite"):
            head.fit(good, areas)


@pytest.mark.parametrize(
    "options",
    [
        {"steps": 1}, {"batch": 0}, {"learning_rate": 0.0}, {"area_power": -1.0}, {"area_power": 2.5}, {"code_noise": torch.inf},
        {"min_coverage": 0.0}, {"draws": 0}, {"seed": 2**62, "draws": 3}, {"spread": -1}, {"spread": 257}, {"faint": -0.1}, {"faint": 1.5}, {"faint": torch.nan},
    ],
)  # fmt: skip
def test_bad_training_settings(options: dict):
    with pytest.raises(ValueError, match=f"autoencoder: {next(iter(options))} must be"):
        AutoencoderTraining(**options)


@pytest.mark.parametrize(
    "options", [{"dim": 0}, {"encoder_widths": ()}, {"decoder_widths": (8, 0)}]
)
def test_bad_widths(options: dict):
    with pytest.raises(ValueError, match="autoencoder: dim and one width"):
        Autoencoder(**options)


def test_of_many_embeddings_a_part_is_measured(monkeypatch: pytest.MonkeyPatch):
    vectors, areas, _ = masks(cone(6), 50, seed=7)
    seen: list[int] = []
    encode = Autoencoder.encode
    monkeypatch.setattr("vlgs.heads.autoencoder.MEASURED", 64)
    monkeypatch.setattr(
        Autoencoder, "encode", lambda head, rows: seen.append(len(rows)) or encode(head, rows)
    )
    head = quick()
    head.fit(vectors, areas)
    assert max(seen) == 60  # every fifth of 300
    every = (head.decode(encode(head, vectors)) * vectors).sum(dim=1)
    assert head.reconstruction == pytest.approx((areas @ every / areas.sum()).item(), abs=0.03)


def test_a_rehearsal_is_short_and_leaves_no_cache(tmp_path: Path):
    head = Autoencoder(training=QUICK, cache_dir=tmp_path)
    assert isinstance(head, FittedHead)
    assert not isinstance(Identity(3), FittedHead)
    head.rehearse(2)
    assert head.fit_settings.steps == 2
    head.rehearse(5)
    assert head.fit_settings.steps == 2
    head.fit(cone(4), torch.ones(4))
    assert not any(tmp_path.iterdir())
