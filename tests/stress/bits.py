"""Bit-identity: one build, CPU and instruction set give one result for any number of threads and any repeat (N12)."""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from tests.stress.case import CannotRunError, Case, Verdict
from tests.stress.splats import make_splats, render_with_gradients, tensors_of
from tests.stress.training import make_module, train
from vlgs.ops import machine

THREADS = (1, 2, 3)
"""Three are more than a small machine has cores: one is always put aside in the middle of a tile."""


def digest(tensors: list[Tensor]) -> str:
    """A hash of every bit."""
    hasher = hashlib.blake2b(digest_size=8)
    for tensor in tensors:
        hasher.update(tensor.detach().contiguous().numpy().tobytes())
    return hasher.hexdigest()


def measure(full: bool) -> dict[str, list[str]]:
    """Digests of image and gradients, and of a short training, over threads and repeats, on the instruction set of this process."""
    n, size = (40_000, (320, 240)) if full else (6000, (185, 145))
    # Faint, so that no Gaussian is hidden and every slot of every tile has something to add.
    scenes = []
    for channels in ((3, 3), (3, 16)):
        splats = make_splats(n, seed=1, size=size, channels=channels)
        scenes.append(
            replace(
                splats, scales=0.3 * splats.scales, weights=tuple(0.05 * w for w in splats.weights)
            )
        )
    # Other numbers in the kernel's kept buffers than the right ones.
    others = [replace(scene, values=tuple(-2 * v for v in scene.values)) for scene in scenes]
    before = torch.get_num_threads()
    pictures, trainings = [], []
    try:
        for threads in THREADS:
            torch.set_num_threads(threads)
            for _ in range(5 if full else 2):
                for scene in others:
                    render_with_gradients(scene)
                results = [tensors_of(*render_with_gradients(scene)) for scene in scenes]
                pictures.append(digest([t for result in results for t in result]))
            for _ in range(5 if full else 1):
                trainings.append(_train(200 if full else 12))
    finally:
        torch.set_num_threads(before)
    return {"pictures": pictures, "trainings": trainings}


def _train(iterations: int) -> str:
    module = make_module(
        f"trainer.iterations={iterations}", f"trainer.sh_every={iterations // 4}",
        f"gaussians.densify={{start: 2, stop: {iterations}, every: {iterations // 6}, reset_every: {iterations // 2}, grad_threshold: 1e-6}}",
        "trainer.checkpoint_every=0", wide=True,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        train(module, Path(folder))
    moments = [t for state in module.optimizer.state.values() for t in state.values()]
    return digest([*module.model.state_dict().values(), *moments])


def on(isa: str) -> Callable[[bool], Verdict]:
    """The check on one instruction set."""

    def threads_and_repeats(full: bool) -> Verdict:
        """1, 2 and 3 threads, five repeats each, on this instruction set: images, gradients and 200 training steps have the same bits."""
        if isa not in machine.instruction_sets():
            raise CannotRunError(
                f"this machine and this build have {' '.join(machine.instruction_sets())}"
            )
        digests = measure(full) if isa == machine.instruction_set() else _in_process(isa, full)
        parts = [f"{len(set(runs))} of {len(runs)} {what}" for what, runs in digests.items()]
        passed = all(len(set(runs)) == 1 for runs in digests.values())
        return Verdict(f"different results: {', '.join(parts)}", passed)

    return threads_and_repeats


def _in_process(isa: str, full: bool) -> dict[str, list[str]]:
    """The instruction set is chosen when the kernel is imported, so each needs a process."""
    script = (
        f"import json; from tests.stress.bits import measure; print(json.dumps(measure({full})))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | {"VLGS_ISA": isa},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"stress: {isa} must run to its end, got {done.stderr[-500:]}")
    return json.loads(done.stdout.splitlines()[-1])


BITS = tuple(
    Case(f"N12 threads and repeats, {isa}", on(isa), minutes=3) for isa in ("v4", "v3", "base")
)
