"""The same bits for any number of threads, and the same picture from any instruction set."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from instruction_sets import require_other
from render_scenes import random_splats, render_with_gradients

from vlgs.ops import _csrc


@pytest.mark.parametrize("channels", [(3, 3), (3, 100)])
def test_threads_and_repeats_do_not_change_a_bit(channels: tuple[int, ...]):
    small = random_splats(6000, seed=1, channels=channels, spread=0.3)
    # Enough tiles for every thread, and so faint that no Gaussian is hidden by those before it.
    splats = replace(
        small, width=185, height=145, K=small.K * torch.tensor([5.0, 5.0, 1.0])[:, None],
        scales=small.scales / 3, weights=tuple(0.05 * w for w in small.weights),
    ).to(torch.float32)  # fmt: skip
    # Kept buffers still hold the last run, so that a sum which does not wait for its terms finds the right ones there.
    other = replace(splats, values=tuple(-2 * v for v in splats.values))
    results = []
    # More threads than cores: some are always put aside in the middle of a tile.
    for threads in (1, 2, 3, 8, 8, 2):
        torch.set_num_threads(threads)
        render_with_gradients(other)
        out, grads = render_with_gradients(splats)
        results.append([*out.images, *out.alphas, out.visible, *grads.values()])
    assert (results[0][-1].abs().sum(1) > 0).double().mean() > 0.3
    for result in results[1:]:
        for a, b in zip(results[0], result, strict=True):
            assert torch.equal(a, b)


SCRIPT = """
import sys
sys.path.insert(0, sys.argv[1])
import torch
from render_scenes import random_splats, relative_error, render_with_gradients
from vlgs.ops import _csrc
torch.set_num_threads(1)
print(_csrc.isa())
for dtype, bound in ((torch.float32, 1e-4), (torch.float64, 1e-10)):
    for channels in ((3, 3), (3, 16), (5,)):
        splats = random_splats(60, seed=3, channels=channels)
        want, want_grads = render_with_gradients(splats, "reference")
        got, got_grads = render_with_gradients(splats.to(dtype))
        for a, b in zip(got.images, want.images, strict=True):
            assert relative_error(a.double(), b) < bound
        for name, grad in want_grads.items():
            assert relative_error(got_grads[name].double(), grad) < bound, (dtype, channels, name)
"""


@pytest.mark.parametrize("isa", ["base", "v3", "v4"])
def test_every_instruction_set_draws_the_reference(isa: str):
    require_other(isa)
    environment = os.environ | {"VLGS_ISA": isa}
    command = [sys.executable, "-c", SCRIPT, os.path.dirname(__file__)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == isa


def test_what_can_run_is_known_and_the_best_of_it_runs():
    known = [isa for isa in ("v4", "v3", "base") if isa in _csrc.isas().split()]
    assert known == _csrc.isas().split()
    if "VLGS_ISA" not in os.environ:
        assert _csrc.isa() == known[0]


def test_an_unknown_instruction_set_is_refused():
    command = [sys.executable, "-c", "from vlgs.ops import _csrc; _csrc.isa()"]
    environment = os.environ | {"VLGS_ISA": "avx9000"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert "VLGS_ISA: must be v4, v3 or base, got avx9000" in done.stderr


def test_the_instruction_set_has_a_name():
    assert _csrc.isa() in ("base", "v3", "v4")
