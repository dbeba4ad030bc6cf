"""What lies before what: opaque stacks, ties, edges of the weights, and modalities that must not see each other (N10, N13, N19)."""

from dataclasses import replace

import torch

from tests.fuzz_kernel.scene import WEIGHTS
from tests.stress.case import Case, Verdict, bound, relative_error
from tests.stress.splats import (
    full_screen,
    make_splats,
    render,
    render_with_gradients,
    same_bits,
)
from vlgs.types import RasterConfig


def opaque_stack(full: bool) -> Verdict:
    """30 opaque Gaussians in a row: what lies behind the second has no value and no gradient; finite differences agree to 5e-4."""
    config = RasterConfig(transmittance_min=1e-3)  # 0.01, then 1e-4: the second crosses
    base = full_screen(30, (33, 21), channels=3).to(torch.float64)
    rng = torch.Generator().manual_seed(0)
    base = replace(
        base, weights=(torch.full((30,), 0.98).double(),),
        values=(torch.randn(30, 3, generator=rng).double(),),
    )  # fmt: skip
    opaque = replace(base, weights=(torch.ones(30).double(),))
    out, grads = render_with_gradients(opaque, config=config)
    behind = max(grads[name][2:].abs().max().item() for name in grads)
    other = replace(opaque, values=(torch.cat([opaque.values[0][:2], 1e3 * opaque.values[0][2:]]),))
    shown = (render(other, config=config)[0].images[0] - out.images[0]).abs().max().item()

    out, leaves = render(base, config=config)  # below the clamp, where a weight has a gradient
    weight, values = leaves["weight0"], leaves["values0"]
    gradients = torch.autograd.grad(out.images[0].square().sum(), [weight, values])
    error = 0.0
    for name, gradient in zip(("weights", "values"), gradients, strict=True):
        start = getattr(base, name)[0]
        estimate = torch.zeros_like(gradient)
        for index in range(min(start.numel(), 90 if full else 9)):
            ends = []
            for sign in (1, -1):
                moved = start.clone()
                moved.view(-1)[index] += sign * 1e-6
                image = render(replace(base, **{name: (moved,)}), config=config)[0].images[0]
                ends.append(image.square().sum().item())
            estimate.view(-1)[index] = (ends[0] - ends[1]) / 2e-6
        count = min(start.numel(), 90 if full else 9)
        error = max(error, relative_error(estimate.view(-1)[:count], gradient.view(-1)[:count]))
    limits = {"gradient behind": 0, "value behind": 0, "finite differences": 5e-4}
    return bound(
        {"gradient behind": behind, "value behind": shown, "finite differences": error}, limits
    )


def edges_of_weights(full: bool) -> Verdict:
    """O and l in {0, 1e-7, 1/255 +- ulp, 0.99 +- ulp, 1}, all pairs, at a pixel's centre: finite, and equal to the reference to 1e-6."""
    pairs = torch.cartesian_prod(torch.tensor(WEIGHTS), torch.tensor(WEIGHTS))
    n = len(pairs)
    splats = make_splats(n, seed=1, size=(9 * 4, 9 * 4))
    row, column = torch.arange(n) // 9, torch.arange(n) % 9
    pixel = torch.stack([4 * column + 1.5, 4 * row + 1.5], 1)
    focal, depth = 32.0, 2.0
    means = torch.cat([(pixel - 18) / focal * depth, torch.full((n, 1), depth)], 1)
    splats = replace(
        splats, means=means, scales=0.3 * splats.scales, focal=focal,
        weights=(pairs[:, 0].contiguous(), pairs[:, 1].contiguous()),
    )  # fmt: skip
    worst = {"image": 0.0, "gradient": 0.0}
    for stop in ("after", "before"):
        config = RasterConfig(stop=stop)
        got, got_grads = render_with_gradients(splats, config=config)
        want, want_grads = render_with_gradients(splats, "reference", config)
        for a, b in zip(got.images + got.alphas, want.images + want.alphas, strict=True):
            worst["image"] = max(worst["image"], (a - b).abs().max().item())
        for name, grad in want_grads.items():
            worst["gradient"] = max(worst["gradient"], relative_error(got_grads[name], grad))
    return bound(worst, {"image": 1e-6, "gradient": 1e-5}, f"{n} pairs, both stops")


def depth_ties(full: bool) -> Verdict:
    """Coplanar Gaussians, 10^4 of them: the same image as with depths an ulp apart in the order of the rows; rows that are culled between them change no bit."""
    n = 10_000 if full else 300
    splats = make_splats(n, seed=2).to(torch.float64)
    means = splats.means.clone()
    means[:, :2] *= 2 / means[:, 2:]
    means[:, 2] = 2
    tied = replace(splats, means=means)
    stepped = means.clone()
    stepped[:, 2] += torch.arange(n).double() * 1e-14
    a, _ = render(tied)
    b, _ = render(replace(tied, means=stepped))
    apart = max((x - y).abs().max().item() for x, y in zip(a.images, b.images, strict=True))

    # The same rows scattered among culled ones, in the same order.
    places = torch.randperm(2 * n, generator=torch.Generator().manual_seed(3))[:n].sort().values
    index = torch.zeros(2 * n, dtype=torch.long).index_put((places,), torch.arange(n))
    scattered = tied.rows(index)
    hidden = torch.ones(2 * n, dtype=torch.bool).index_fill(0, places, False)
    behind = torch.where(hidden[:, None], -scattered.means, scattered.means)
    c, _ = render(replace(scattered, means=behind))
    differ = float(not same_bits([*a.images], [*c.images]))
    return bound(
        {"apart": apart, "scattered differs": differ}, {"apart": 1e-9, "scattered differs": 0}
    )


def modalities_apart(full: bool) -> Verdict:
    """L set to o gives colour's bits to language; another l leaves every bit of colour and its gradients, and the reverse."""
    n = 100_000 if full else 300
    splats = make_splats(n, seed=4, size=(240, 180) if full else (61, 45))
    o, f = splats.weights[0], splats.values[0]
    same, grads = render_with_gradients(
        replace(splats, weights=(o, o.clone()), values=(f, f.clone()))
    )
    wrong = []
    if not same_bits([same.images[0], same.alphas[0]], [same.images[1], same.alphas[1]]):
        wrong.append("l := o")
    for kept, moved in ((0, 1), (1, 0)):
        results = []
        for factor in (1.0, 0.3):
            weights = list(splats.weights)
            weights[moved] = factor * weights[moved]
            out, leaves = render(replace(splats, weights=tuple(weights)))
            names = ["means", "quats", "scales", f"weight{kept}", f"values{kept}"]
            loss = out.images[kept].square().sum()
            grads = torch.autograd.grad(loss, [leaves[name] for name in names])
            results.append([out.images[kept], out.alphas[kept], *grads])
        if not same_bits(*results):
            wrong.append(f"group {moved} seen by group {kept}")
    return Verdict(f"{n} Gaussians, different bits: {', '.join(wrong) or 'none'}", not wrong)


ORDER = (
    Case("N10 opaque stack", opaque_stack),
    Case("N10 edges of the weights", edges_of_weights),
    Case("N13 depth ties", depth_ties),
    Case("N19 modalities apart", modalities_apart),
)
