"""Train a scene on a CPU with gsplat's names: `python -m vlgs.gsplat.example [--root SCENE]`; gsplat densifies it where it is installed."""

import argparse
import sys
from typing import Any

import torch
from torch.nn import Parameter, ParameterDict

from vlgs.data import colmap, synthetic
from vlgs.gaussians.neighbors import mean_squared_distance
from vlgs.geometry import scene_extent
from vlgs.gsplat import rasterization
from vlgs.losses import l1_dssim
from vlgs.types import Camera, Scene, View

RATES = {
    "means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4,
}  # fmt: skip
"""Those of 3DGS; that of the means is in units of the scene."""


def start(scene: Scene) -> ParameterDict:
    """One Gaussian per sparse point."""
    n, near = len(scene.points), mean_squared_distance(scene.points).clamp(1e-7, 1e2).sqrt()
    quats = torch.tensor([1.0, 0, 0, 0]).expand(n, 4)
    values = [scene.points, near.log()[:, None].expand(n, 3), quats, torch.full((n,), 0.1).logit()]
    values += [(scene.point_colors[:, None] / 255 - 0.5) / 0.28209479, torch.zeros(n, 15, 3)]
    return ParameterDict(
        {k: Parameter(v.float().clone()) for k, v in zip(RATES, values, strict=True)}
    )


def draw(splats: ParameterDict, camera: Camera, degree: int) -> tuple[torch.Tensor, Any]:
    """The image of a camera, and gsplat's info."""
    image, _, info = rasterization(
        splats["means"], splats["quats"], splats["scales"].exp(), splats["opacities"].sigmoid(),
        torch.cat([splats["sh0"], splats["shN"]], 1), camera.viewmat[None], camera.K[None],
        camera.width, camera.height, sh_degree=degree, packed=False,
    )  # fmt: skip
    return image[0], info


def valid(view: View) -> torch.Tensor:
    """The pixels that a photograph covers; undistortion leaves borders."""
    size = view.camera.height, view.camera.width
    return view.read_valid() if view.read_valid else torch.ones(size, dtype=torch.bool)


def train(scene: Scene, steps: int, strategy: Any = None) -> tuple[ParameterDict, list[float]]:
    """Gaussians and the loss of every step; a strategy of gsplat decides how many Gaussians there are."""
    splats = start(scene)
    extent = scene_extent(torch.stack([view.camera.viewmat for view in scene.train]))
    rates = RATES | {"means": RATES["means"] * extent}
    optimizers = {k: torch.optim.Adam([splats[k]], lr=rate, eps=1e-15) for k, rate in rates.items()}
    state = strategy.initialize_state(scene_scale=extent) if strategy else {}
    rng, losses = torch.Generator().manual_seed(0), []
    for step in range(steps):
        view = scene.train[int(torch.randint(len(scene.train), (), generator=rng))]
        image, info = draw(splats, view.camera, degree=min(step // 500, 3))
        if strategy:
            strategy.step_pre_backward(splats, optimizers, state, step, info)
        loss = l1_dssim(image, view.read_image() / 255, valid(view))
        loss.backward()
        losses.append(loss.item())
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        if strategy:
            strategy.step_post_backward(splats, optimizers, state, step, info)
    return splats, losses


def strategy_of(steps: int) -> Any:
    """The `DefaultStrategy` of gsplat for so many steps; None where gsplat is not installed."""
    try:
        from gsplat import DefaultStrategy  # pyright: ignore
    except ImportError:
        return None
    return DefaultStrategy(refine_start_iter=steps // 10, refine_stop_iter=steps // 2)


def main(arguments: list[str] | None = None) -> None:
    """Train, then print how near held-out views are to their photographs."""
    parser = argparse.ArgumentParser(prog="python -m vlgs.gsplat.example", description=__doc__)
    parser.add_argument(
        "--root", help="folder with images/ and sparse/0/; default: a procedural scene"
    )
    parser.add_argument("--resize", type=float, default=0.25, help="of the photographs")
    parser.add_argument("--steps", type=int, default=2000)
    given = parser.parse_args(arguments)
    try:
        photographs = given.root and colmap.load_scene(given.root, resize=given.resize)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    scene, strategy = photographs or synthetic.load_scene(), strategy_of(given.steps)
    if strategy is None:
        sys.stdout.write("no densification: that takes gsplat (pip install gsplat==1.5.3)\n")
    splats, _ = train(scene, given.steps, strategy)
    with torch.no_grad():
        errors = [
            (draw(splats, view.camera, 3)[0] - view.read_image() / 255)[valid(view)].square().mean()
            for view in scene.test
        ]
    psnr = -10 * torch.stack(errors).log10().mean()
    sys.stdout.write(f"{len(splats['means'])} Gaussians, PSNR of held-out views {psnr:.2f} dB\n")


if __name__ == "__main__":
    main()
