"""Numbers of a step on several threads, as a run computes them: `python -m warm_child THREADS OUT` writes them to a file."""

import hashlib
import sys
from pathlib import Path

import torch

from vlgs.ops.rasterize import rasterize
from vlgs.types import ChannelGroup


def main(threads: str, out: str) -> None:
    torch.set_num_threads(int(threads))
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(3000, 3, generator=generator) * 2 - 1
    means[:, 2] += 3
    means.requires_grad_()
    quats = torch.randn(3000, 4, generator=generator)
    scales = torch.full((3000, 3), 0.05)
    colors = torch.rand(3000, 3, generator=generator, requires_grad=True)
    group = ChannelGroup(colors, torch.full((3000,), 0.8))
    camera = torch.tensor([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]])
    done = rasterize(means, quats, scales, (group,), torch.eye(4), camera, 128, 96)
    mixed = done.images[0].reshape(-1, 3) @ torch.randn(
        3, 512, generator=generator
    )  # on all threads
    (mixed.tanh() ** 2).sum().backward()
    digest = hashlib.sha256()
    for tensor in (done.images[0], means.grad, colors.grad):
        assert tensor is not None
        digest.update(tensor.detach().numpy().tobytes())
    Path(out).write_text(f"{torch.get_num_threads()} {digest.hexdigest()}")


if __name__ == "__main__":
    main(*sys.argv[1:3])
