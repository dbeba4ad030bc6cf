"""`rasterization` against gsplat's documented model, dense and in float64: values, gradients and `meta`, in every mode."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.gsplat.dense import Picture, Settings, picture
from vlgs.gsplat import rasterization
from vlgs.gsplat.checks import require_opacities, require_shapes
from vlgs.gsplat.view import compensation
from vlgs.ops.project import project
from vlgs.types import Camera, RasterConfig

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def scene(n: int, seed: int, c: int = 2, k: int | None = None) -> dict[str, Tensor]:
    """Gaussians around the middle of what c cameras see, some behind them or beyond the edges; colours of 2 channels or k harmonics."""
    rng = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng).double()

    viewmats = torch.eye(4).double().repeat(c, 1, 1)
    viewmats[:, :3, :3] = torch.linalg.qr(torch.eye(3) + 0.2 * draw(c, 3, 3))[0]
    viewmats[:, :3, :3] *= torch.linalg.det(viewmats[:, :3, :3])[:, None, None]
    viewmats[:, :3, 3] = 0.2 * draw(c, 3) + torch.tensor([0, 0, 3.0])
    towards = viewmats[:, 2, 2].sign()
    viewmats[:, :3, :3] *= torch.stack([torch.ones(c), towards, towards], 1)[:, :, None]
    return {
        "means": draw(n, 3) * torch.tensor([1.2, 1.0, 1.5]), "quats": draw(n, 4),
        "scales": torch.exp(0.7 * draw(n, 3) - 1.7), "opacities": torch.rand(n, generator=rng).double().sqrt(),
        "colors": draw(n, 2) if k is None else 0.4 * draw(n, k, 3),
        "viewmats": viewmats, "Ks": torch.tensor([[20.0, 0, 10], [0, 22, 9], [0, 0, 1]]).double().repeat(c, 1, 1),
        "backgrounds": draw(c, 2 if k is None else 3),
    }  # fmt: skip


def leaves_of(scene: dict[str, Tensor]) -> dict[str, Tensor]:
    fixed = ("viewmats", "Ks")
    return {k: t.clone().requires_grad_(k not in fixed) for k, t in scene.items()}


def dense(inputs: dict[str, Tensor], s: Settings) -> list[Picture]:
    """One per camera; colours may be each camera's own."""
    own = inputs["colors"].dim() == (4 if s.sh_degree is not None else 3)
    behind = inputs.get("backgrounds")
    return [
        picture(
            inputs, inputs["colors"][i] if own else inputs["colors"], viewmat, K, s,
            None if behind is None else behind[i],
        )
        for i, (viewmat, K) in enumerate(zip(inputs["viewmats"], inputs["Ks"], strict=True))
    ]  # fmt: skip


def drawn(inputs: dict[str, Tensor], s: Settings, **more: Any) -> tuple[Tensor, Tensor, Any]:
    return rasterization(
        **inputs, width=s.width, height=s.height, near_plane=s.near, far_plane=s.far, radius_clip=s.radius_clip,
        eps2d=s.eps2d, sh_degree=s.sh_degree, render_mode=s.mode,  # pyright: ignore[reportArgumentType]
        rasterize_mode="antialiased" if s.antialiased else "classic", **more,
    )  # fmt: skip


def assert_agree(inputs: dict[str, Tensor], s: Settings, packed: bool) -> None:
    """Images, accumulated weights, the gradient of each argument, and that of the centres in `meta`."""
    got, want = leaves_of(inputs), leaves_of(inputs)
    images, alphas, meta = drawn(got, s, packed=packed)
    meta["means2d"].retain_grad()
    pictures = dense(want, s)
    for p in pictures:
        p.mean2d.retain_grad()
    wanted = torch.stack([p.image for p in pictures]), torch.stack([p.alpha for p in pictures])
    torch.testing.assert_close((images, alphas), wanted, rtol=1e-9, atol=1e-10)

    rng = torch.Generator().manual_seed(7)
    upstream = [torch.randn(t.shape, generator=rng).double() for t in wanted]
    torch.autograd.backward([images, alphas], upstream)
    torch.autograd.backward(wanted, upstream)
    for name, leaf in got.items():
        if leaf.requires_grad:
            assert_same_gradient(name, leaf.grad, want[name].grad)
    by_centers = [p.mean2d.grad[p.seen] for p in pictures if p.mean2d.grad is not None]
    seen = torch.stack([p.seen for p in pictures])
    mine = meta["means2d"].grad if packed else meta["means2d"].grad[seen]
    assert_same_gradient("means2d", mine, torch.cat(by_centers) if by_centers else None)


def assert_same_gradient(name: str, got: Tensor | None, want: Tensor | None) -> None:
    """None where nothing is asked of it stands for zeros."""
    if got is None or want is None:
        assert all(t is None or not t.any() for t in (got, want)), name
        return
    bound = 1e-9 * max(want.abs().max().item() if want.numel() else 0.0, 1.0)
    torch.testing.assert_close(got, want, rtol=1e-7, atol=bound, msg=lambda m: f"{name}: {m}")


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("mode", MODES)
def test_every_mode_is_the_documented_image(mode: str, packed: bool, antialiased: bool):
    assert_agree(scene(14, seed=len(mode)), Settings(mode=mode, antialiased=antialiased), packed)


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_are_those_of_3dgs(degree: int, mode: str):
    assert_agree(
        scene(10, seed=degree, k=16), Settings(sh_degree=degree, mode=mode), packed=degree > 1
    )


@settings(max_examples=30, deadline=None)
@given(
    n=st.integers(0, 20), seed=st.integers(0, 10**6), c=st.integers(1, 3), packed=st.booleans(),
    mode=st.sampled_from(MODES), own=st.booleans(), behind=st.booleans(), antialiased=st.booleans(),
    eps2d=st.sampled_from([0.1, 0.3, 1.0]), clip=st.sampled_from([0.0, 3.0, 6.0]), far=st.sampled_from([1e10, 3.0]),
)  # fmt: skip
def test_any_scene(
    n: int, seed: int, c: int, packed: bool, mode: str, own: bool, behind: bool, antialiased: bool,
    eps2d: float, clip: float, far: float,
):  # fmt: skip
    """Scenes of none to twenty Gaussians; colours of all cameras or of each, with a background or without, and what is culled."""
    inputs = scene(n, seed, c)
    if own:
        inputs["colors"] = inputs["colors"] * torch.arange(1.0, c + 1).double()[:, None, None]
    if not behind:
        del inputs["backgrounds"]
    chosen = Settings(
        mode=mode, antialiased=antialiased, eps2d=eps2d, radius_clip=clip, near=0.5, far=far
    )
    assert_agree(inputs, chosen, packed)


@pytest.mark.parametrize("opacity", [0.9, 0.97, 0.995, 1.0])
def test_where_light_runs_out_the_last_contribution_is_left_out(opacity: float):
    """Layers over the whole image, around the largest alpha and the smallest transmittance."""
    inputs = scene(8, seed=6)
    inputs["scales"] = inputs["scales"] + 2
    inputs["opacities"] = torch.full((8,), opacity).double()
    assert_agree(inputs, Settings(mode="RGB+D"), packed=True)


@pytest.mark.parametrize("packed", [True, False])
def test_absolute_gradients_are_summed_pixel_by_pixel(packed: bool):
    inputs, chosen = scene(8, seed=8), Settings(width=9, height=7, mode="RGB+ED")
    inputs["Ks"][:, :2] *= 0.4
    inputs["opacities"][:4] = 0.9995  # clamped near the centre
    images, alphas, meta = drawn(leaves_of(inputs), chosen, packed=packed, absgrad=True)
    rng = torch.Generator().manual_seed(7)
    d_image, d_alpha = (torch.randn(t.shape, generator=rng).double() for t in (images, alphas))
    torch.autograd.backward([images, alphas], [d_image, d_alpha])

    pictures, wanted = dense(leaves_of(inputs), chosen), []
    for i, p in enumerate(pictures):
        each = (p.image * d_image[i]).sum(-1) + p.alpha[..., 0] * d_alpha[i, ..., 0]
        by_pixel = [torch.autograd.grad(x, p.mean2d, retain_graph=True)[0] for x in each.flatten()]
        wanted.append(torch.stack(by_pixel).abs().sum(0))
    seen = torch.stack([p.seen for p in pictures])
    got = meta["means2d"].absgrad
    assert got.shape == meta["means2d"].shape
    empty = {k: t if k in ("viewmats", "Ks", "backgrounds") else t[:0] for k, t in inputs.items()}
    nothing = drawn(leaves_of(empty), chosen, packed=packed, absgrad=True)
    nothing[0].sum().backward()
    assert nothing[2]["means2d"].absgrad.numel() == 0
    want = torch.stack(wanted)
    torch.testing.assert_close(got, want[seen] if packed else want, rtol=1e-7, atol=1e-9)


def test_a_batch_is_its_entries():
    entries = [scene(9, seed=i, k=4) for i in range(6)]
    joined = {k: torch.stack([e[k] for e in entries]).unflatten(0, (3, 2)) for k in entries[0]}
    chosen = Settings(sh_degree=1, mode="RGB+D")
    whole = {packed: drawn(joined, chosen, packed=packed) for packed in (True, False)}
    meta, packed = whole[False][2], whole[True][2]
    assert meta["n_batches"] == 6
    assert meta["n_cameras"] == 2
    assert meta["radii"].shape == (3, 2, 2, 9, 2)
    for i, entry in enumerate(entries):
        image, alpha, own = drawn(entry, chosen, packed=False)
        at = (i // 2, i % 2)
        for out in whole.values():
            assert torch.equal(out[0][at], image)
            assert torch.equal(out[1][at], alpha)
        for name in ("radii", "means2d", "depths", "conics", "opacities"):
            assert torch.equal(meta[name][at], own[name])
            seen = (own["radii"] > 0).all(-1)
            assert torch.equal(packed[name][packed["batch_ids"] == i], own[name][seen])


def test_meta_is_what_was_projected():
    inputs, chosen = (
        scene(40, seed=3),
        Settings(antialiased=True, near=1.0, far=4.5, radius_clip=2.0),
    )
    pictures, (_, _, meta) = dense(inputs, chosen), drawn(inputs, chosen, packed=False)
    seen = torch.stack([p.seen for p in pictures])
    assert 5 < seen.sum() < 70
    assert torch.equal(meta["radii"], torch.stack([p.radii for p in pictures]))
    names = {"means2d": "mean2d", "depths": "depths", "conics": "conics", "opacities": "opacities"}
    for theirs, ours in names.items():
        want = torch.stack([getattr(p, ours) for p in pictures])[seen]
        torch.testing.assert_close(meta[theirs][seen], want, rtol=1e-9, atol=1e-9)
    _, _, packed = drawn(inputs, chosen, packed=True)
    assert torch.equal(
        torch.stack([packed["camera_ids"], packed["gaussian_ids"]], 1), seen.nonzero()
    )
    assert packed["batch_ids"].eq(0).all()
    for name in ("radii", *names):
        assert torch.equal(packed[name], meta[name][seen])
    assert (meta["batch_ids"], meta["camera_ids"], meta["gaussian_ids"]) == (None, None, None)
    numbers = (
        "width",
        "height",
        "tile_size",
        "tile_width",
        "tile_height",
        "n_batches",
        "n_cameras",
    )
    assert [meta[name] for name in numbers] == [23, 17, 16, 2, 2, 1, 2]
    with pytest.raises(
        KeyError, match=r"isect_ids: meta of vlgs.gsplat has batch_ids, .*, n_cameras"
    ):
        meta["isect_ids"]


@pytest.mark.parametrize("packed", [True, False])
def test_one_alpha_for_any_channels(packed: bool):
    inputs = scene(20, seed=4)
    inputs["colors"], inputs["backgrounds"] = (
        torch.rand(20, 45).double(),
        torch.rand(2, 45).double(),
    )
    assert_agree(inputs, Settings(mode="RGB+D"), packed)
    chunked = drawn(inputs, Settings(), packed=packed, channel_chunk=7, tile_size=8, segmented=True)
    assert torch.equal(chunked[0], drawn(inputs, Settings(), packed=packed)[0])


def test_floats_are_near_doubles():
    inputs = scene(30, seed=5)
    single = {k: t.float() for k, t in inputs.items()}
    exact = {k: t.double() for k, t in single.items()}
    for antialiased in (False, True):
        chosen = Settings(antialiased=antialiased, mode="RGB+D")
        got, want = drawn(single, chosen)[0], drawn(exact, chosen)[0]
        assert got.dtype == torch.float32
        torch.testing.assert_close(got.double(), want, rtol=1e-4, atol=1e-5)


def test_specks_keep_the_digits_of_their_compensation():
    """A thousandth of a pixel, where the blurred covariance has lost them in float32."""
    n = 50
    rng = torch.Generator().manual_seed(1)
    means = torch.cat([torch.rand(n, 2, generator=rng) - 0.5, torch.full((n, 1), 3.0)], 1)
    quats, scales = torch.randn(n, 4, generator=rng), 1e-4 * (0.5 + torch.rand(n, 3, generator=rng))
    camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 10], [0, 20, 8], [0, 0, 1]]), 20, 16)
    config = RasterConfig()
    splats = means, quats, scales
    got = compensation(project(*splats, camera, config), *splats, camera, config)
    exact = means.double(), quats.double(), scales.double()
    want = compensation(project(*exact, camera, config), *exact, camera, config)
    torch.testing.assert_close(got.double(), want, rtol=1e-5, atol=0)
    inputs = {"means": means, "quats": quats, "scales": scales, "opacities": torch.ones(n)}
    covariance = picture(
        {k: t.double() for k, t in inputs.items()}, torch.ones(n, 1).double(), torch.eye(4).double(), camera.K.double(),
        Settings(20, 16, antialiased=True),
    )  # fmt: skip
    torch.testing.assert_close(got.double(), covariance.opacities, rtol=1e-4, atol=0)


def test_what_is_flat_or_has_no_rotation_has_finite_gradients():
    inputs = scene(6, seed=2)
    inputs["scales"][0] = torch.tensor([0.3, 0, 0])
    inputs["scales"][1] = 0
    inputs["quats"][2] = 0
    leaves = leaves_of(inputs)
    drawn(leaves, Settings(antialiased=True))[0].sum().backward()
    for name in ("means", "quats", "scales", "opacities", "colors"):
        gradient = leaves[name].grad
        assert gradient is not None
        assert gradient.isfinite().all(), name


@pytest.mark.parametrize("refused", [
    {"sparse_grad": True}, {"distributed": True}, {"covars": torch.eye(3)}, {"with_ut": True},
    {"with_eval3d": True}, {"radial_coeffs": torch.zeros(2, 6)}, {"tangential_coeffs": torch.zeros(2, 2)},
    {"thin_prism_coeffs": torch.zeros(2, 4)}, {"ftheta_coeffs": object()}, {"viewmats_rs": torch.eye(4)},
    {"camera_model": "fisheye"}, {"tile_size": 0}, {"eps2d": 0.0}, {"near_plane": 0.0},
])  # fmt: skip
def test_what_is_not_here_is_refused_by_name(refused: dict[str, Any]):
    (name,) = refused
    inputs = scene(3, seed=0)
    with pytest.raises(ValueError, match=rf"^rasterization: {name} must be .*, got "):
        rasterization(**{**inputs, "width": 8, "height": 8, **refused})


def test_bad_tensors_are_refused_by_gsplats_names():
    inputs = scene(3, seed=0)
    size: dict[str, Any] = {"width": 8, "height": 8}
    skewed = inputs["Ks"].clone()
    skewed[1, 0, 1] = 0.1
    for name, value, said in (
        ("opacities", torch.tensor([0.5, 1.5, 0.5]).double(), r"opacities must be in \[0, 1\], got 1.5 in row 1"),
        ("opacities", torch.tensor([0.5, 0.5, torch.nan]).double(), r"opacities must be in \[0, 1\], got nan in row 2"),
        ("means", inputs["means"] * torch.nan, "means must be finite"),
        ("Ks", skewed, "Ks must be without skew"),
        ("viewmats", inputs["viewmats"].clone().requires_grad_(), "viewmats must be without gradient"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=f"^rasterization: {said}"):
            rasterization(**{**inputs, name: value}, **size)
    behind = inputs | {"colors": inputs["colors"] * torch.inf}
    with pytest.raises(ValueError, match=r"^rasterization: colors must be finite"):
        rasterization(**behind, **size, packed=False)


def test_shapes_that_do_not_fit_are_named():
    inputs = scene(3, seed=0, k=4)
    splats = {k: inputs[k] for k in ("means", "quats", "scales", "opacities")}
    cameras = {k: inputs[k] for k in ("viewmats", "Ks")}

    def refuse(said: str, **changed: Any) -> None:
        changed = {"colors": inputs["colors"], "sh_degree": 1, **changed}
        given = [{k: changed.get(k, t) for k, t in part.items()} for part in (splats, cameras)]
        if "backgrounds" in changed:
            given[1]["backgrounds"] = changed["backgrounds"]
        with pytest.raises(ValueError, match=f"^rasterization: {said}"):
            require_shapes(given[0], changed["colors"], given[1], changed["sh_degree"])

    refuse(r"quats must be of shape \[3, 4\], got \[2, 4\]", quats=inputs["quats"][:2])
    refuse(r"Ks must be of shape \[2, 3, 3\], got \[1, 3, 3\]", Ks=inputs["Ks"][:1])
    refuse(
        r"colors must be of shape \[3, 4, 3\] or \[2, 3, 4, 3\], got",
        colors=torch.zeros(4, 4, 3).double(),
    )
    refuse(r"colors must end in \[k, 3\] with k >= 9 for sh_degree = 2, got \[4, 3\]", sh_degree=2)
    refuse("sh_degree must be 0, 1, 2 or 3, got 4", sh_degree=4)
    refuse(r"backgrounds must be of shape \[2, 3\], got \[3\]", backgrounds=torch.zeros(3).double())
    refuse("scales must be float32 or float64 like means", scales=inputs["scales"].float())
    refuse("means and viewmats must be", viewmats=torch.zeros(0, 4, 4).double())
    require_opacities(torch.rand(4, 0))


def test_it_is_deterministic_over_threads():
    inputs = {k: t.float() for k, t in scene(6000, seed=1).items()}
    inputs["scales"] = inputs["scales"] / 5
    chosen, results = replace(Settings(), width=200, height=150, mode="RGB+D"), []
    inputs["Ks"] = inputs["Ks"] * torch.tensor([9.0, 9.0, 1.0])[:, None]
    threads = torch.get_num_threads()
    for count in (1, 2, 3, 8):
        torch.set_num_threads(count)
        leaves = leaves_of(inputs)
        image = drawn(leaves, chosen)[0]
        image.square().sum().backward()
        results.append([image, *(t.grad for t in leaves.values() if t.requires_grad)])
    torch.set_num_threads(threads)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], result, strict=True))
