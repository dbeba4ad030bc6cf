"""Random hostile scenes through the rasterizer and back: finite numbers or a named error, nothing else (tests/README.md, N2).

With each scene go random calls of the other kernels (`tests.fuzz_kernel.layers`). A scene is a function of its seed alone, so that
`python -m tests.fuzz_kernel --first SEED --scenes 1` runs a failure again. Refusing a tame scene is a failure too.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from tests.fuzz_kernel.layers import run_cached_view, run_depth, run_layers
from tests.fuzz_kernel.scene import POISON, FuzzScene, make_scene
from vlgs.ops.rasterize import rasterize
from vlgs.types import Rendered

NAMED = re.compile(r"^[A-Za-z]\w*: .+ must be .+, got ", re.DOTALL)
"""``<who>: <what> must be <expected>, got <actual>``."""


@dataclass
class FuzzReport:
    """What became of the scenes."""

    finite: int = 0
    refused: int = 0
    """Scenes that ended in a named error."""
    failures: dict[int, str] = field(default_factory=dict)
    """Seed -> what is wrong."""

    def __str__(self) -> str:
        wrong = "".join(f"\n  seed {seed}: {what}" for seed, what in self.failures.items())
        return f"{self.finite} finite, {self.refused} refused by name, {len(self.failures)} failed{wrong}"


def run_scene(scene: FuzzScene) -> str | None:
    """Render and differentiate; returns the message of a named error, or None where all is finite.

    After a full backward pass: the same picture without gradients, a backward pass for some gradients of some pictures, depths, the
    first group as a cached view, and the list of what may be seen.

    Raises:
        AssertionError: If a result is not finite, has another shape than it should, differs where it should not, or a tame scene
            is refused.
    """
    try:
        out = _differentiate(scene, scene.differentiable, range(len(scene.upstream)))
        with torch.no_grad():
            alone = _rasterize(scene, scene.leaves())
        _require(
            all(torch.equal(a, b) for a, b in zip(_pictures(out), _pictures(alone), strict=True)),
            "a picture without gradients has other bits",
        )
        _differentiate(scene, scene.asked, scene.used)
        run_depth(scene.tensors, scene.width, scene.height, scene.config)
    except ValueError as error:
        _require(bool(NAMED.match(str(error))), f"error without a name: {error}")
        _require(not scene.tame, f"a tame scene was refused: {error}")
        return str(error)
    # A cached view also refuses values of Gaussians out of sight, which the rasterizer never reads.
    if scene.tensors["values0"].isfinite().all() and scene.shape_of[0] is None:
        run_cached_view(scene.tensors, scene.width, scene.height, scene.config, out.images[0])
    return None


def fuzz(seeds: Iterable[int], verbose: bool = False) -> FuzzReport:
    """Run the scenes of some seeds; any exception of a scene is a failure of its seed.

    Args:
        seeds: One scene each.
        verbose: Whether seeds are announced on standard output before they run, for a process that may be ended by one.
    """
    report = FuzzReport()
    threads = torch.get_num_threads()
    for seed in seeds:
        if verbose:
            print(f"seed {seed}", flush=True)
        scene = make_scene(seed)
        torch.set_num_threads(scene.threads)
        try:
            refused = run_scene(scene)
            run_layers(seed, POISON)
        except Exception as error:
            report.failures[seed] = f"{type(error).__name__}: {error}"
            continue
        finally:
            torch.set_num_threads(threads)
        report.finite += refused is None
        report.refused += refused is not None
    return report


def _rasterize(scene: FuzzScene, leaves: dict[str, Tensor]) -> Rendered:
    return rasterize(
        leaves["means"], leaves["quats"], leaves["scales"], scene.groups(leaves),
        leaves["viewmat"], leaves["K"], scene.width, scene.height, scene.config,
    )  # fmt: skip


def _pictures(out: Rendered) -> list[Tensor]:
    return [*out.images, *out.alphas]


def _differentiate(scene: FuzzScene, asked: Iterable[str], used: Iterable[int]) -> Rendered:
    """Some gradients of some pictures, all of which must be finite and of their tensor's shape."""
    leaves = scene.leaves(*asked)
    out = _rasterize(scene, leaves)
    pictures = _pictures(out)
    if out.mean2d.requires_grad:
        out.mean2d.retain_grad()
    for i, picture in enumerate(pictures):
        _require(bool(picture.isfinite().all()), f"picture {i} is not finite")
    _require(bool(out.mean2d.isfinite().all()), "mean2d is not finite")
    roots = [i for i in used if pictures[i].requires_grad]
    if roots:
        torch.autograd.backward([pictures[i] for i in roots], [scene.upstream[i] for i in roots])
    everything = set(asked) == set(scene.differentiable) and len(roots) == len(scene.upstream)
    for name, leaf in (*leaves.items(), ("mean2d", out.mean2d)):
        gradient = leaf.grad
        if gradient is None:
            _require(not (everything and leaf.requires_grad), f"{name} has no gradient")
            continue
        _require(gradient.shape == leaf.shape, f"gradient of {name} has shape {gradient.shape}")
        _require(bool(gradient.isfinite().all()), f"gradient of {name} is not finite")
    return out


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise AssertionError(otherwise)
