"""gsplat's documented image model, dense and in float64: written from its documentation and papers, shares no code with the package.

Covariances are matrices here, inverted as such; every Gaussian is evaluated at every pixel.
"""

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

ALPHA_MIN, ALPHA_MAX, STOP, MARGIN = 1 / 255, 0.999, 1e-4, 0.3


@dataclass(frozen=True)
class Settings:
    """Arguments of `rasterization` beside tensors."""

    width: int = 23
    height: int = 17
    near: float = 0.01
    far: float = 1e10
    radius_clip: float = 0.0
    eps2d: float = 0.3
    antialiased: bool = False
    mode: str = "RGB"
    sh_degree: int | None = None


@dataclass
class Picture:
    image: Tensor
    alpha: Tensor
    mean2d: Tensor
    radii: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    seen: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.seen = self.radii[:, 0] > 0


def picture(
    splats: dict[str, Tensor], colors: Tensor, viewmat: Tensor, K: Tensor, s: Settings,
    background: Tensor | None = None,
) -> Picture:  # fmt: skip
    """One image of n Gaussians: colours [n, d], or coefficients [n, k, 3]."""
    W, t = viewmat[:3, :3], viewmat[:3, 3]
    x = splats["means"] @ W.T + t
    z = x[:, 2]
    front = (z >= s.near) & (z <= s.far)
    x = torch.where(front[:, None], x, torch.ones_like(x))
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    mean2d = torch.stack([fx * x[:, 0] / x[:, 2] + cx, fy * x[:, 1] / x[:, 2] + cy], 1)
    half = MARGIN * torch.stack([s.width / fx, s.height / fy]) / 2
    low = -torch.stack([cx / fx, cy / fy]) - half
    high = torch.stack([(s.width - cx) / fx, (s.height - cy) / fy]) + half
    tx, ty = torch.clamp(x[:, :2] / x[:, 2:], low, high).unbind(1)
    zero = torch.zeros_like(tx)
    J = (
        torch.stack([fx + zero, zero, -fx * tx, zero, fy + zero, -fy * ty], 1).view(-1, 2, 3)
        / x[:, 2, None, None]
    )
    R = rotation(splats["quats"])
    M = J @ W @ R @ torch.diag_embed(splats["scales"])
    cov = M @ M.transpose(1, 2)
    blurred = cov + s.eps2d * torch.eye(2).double()
    opacities = splats["opacities"]
    if s.antialiased:
        opacities = (
            opacities * (torch.linalg.det(cov) / torch.linalg.det(blurred)).clamp_min(0).sqrt()
        )
    conic = torch.linalg.inv(blurred)

    extent = (2 * (opacities.detach() / ALPHA_MIN).log()).clamp_min(0).sqrt().clamp_max(3.33)
    radii = (extent[:, None] * blurred.detach().diagonal(dim1=1, dim2=2).sqrt()).ceil()
    size = torch.tensor([s.width, s.height])
    seen = front & (opacities >= ALPHA_MIN) & (radii > s.radius_clip).any(1)
    seen &= ((mean2d + radii > 0) & (mean2d - radii < size)).all(1)
    radii = torch.where(seen[:, None], radii, 0).int()

    order = z.argsort(stable=True)
    order = order[seen[order]]
    v, u = torch.meshgrid(torch.arange(s.height) + 0.5, torch.arange(s.width) + 0.5, indexing="ij")
    d = torch.stack([u.flatten(), v.flatten()], 1).double() - mean2d[order, None]
    power = 0.5 * torch.einsum("npi,nij,npj->np", d, conic[order], d)
    alpha = (opacities[order, None] * torch.exp(-power)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
    after = torch.cumprod(1 - alpha, 0)
    alpha = torch.where(after > STOP, alpha, 0)
    left = torch.cumprod(1 - alpha, 0)
    before = torch.cat(
        [torch.ones_like(left[:1]) if len(left) else left.new_ones(1, d.shape[1]), left]
    )
    weights = alpha * before[:-1]
    total = 1 - before[-1]

    shade = colors
    if s.sh_degree is not None:
        eye = -W.T @ t
        towards = torch.nn.functional.normalize(splats["means"] - eye, dim=1)
        basis = harmonics(towards)[:, : (s.sh_degree + 1) ** 2]
        shade = (torch.einsum("nk,nkc->nc", basis, colors[:, : basis.shape[1]]) + 0.5).clamp_min(0)
    parts = []
    if "RGB" in s.mode:
        rgb = weights.T @ shade[order]
        parts.append(rgb if background is None else rgb + (1 - total)[:, None] * background)
    if "D" in s.mode:
        depth = weights.T @ z[order, None]
        parts.append(depth / total.clamp_min(1e-10)[:, None] if "ED" in s.mode else depth)
    image = torch.cat(parts, 1).view(s.height, s.width, -1)
    conics = torch.stack([conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1]], 1)
    return Picture(image, total.view(s.height, s.width, 1), mean2d, radii, conics, z, opacities)


def rotation(quats: Tensor) -> Tensor:
    """v -> q v q*, column by column."""
    w, *a = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    axis = torch.stack(a, 1)
    columns = []
    for e in torch.eye(3).double():
        e = e.expand_as(axis)
        c = torch.linalg.cross(axis, e)
        columns.append(e + 2 * w[:, None] * c + 2 * torch.linalg.cross(axis, c))
    return torch.stack(columns, 2)


def harmonics(d: Tensor) -> Tensor:
    """Real spherical harmonics of degrees 0 to 3 with the signs of 3DGS, from their normalisation."""
    x, y, z = d.unbind(1)
    pi = math.pi
    a, b, c = math.sqrt(3 / (4 * pi)), math.sqrt(15 / (4 * pi)), math.sqrt(5 / (16 * pi))
    e, f, g, h = (math.sqrt(k / (32 * pi)) for k in (35, 210, 21, 14))
    rows = [
        torch.full_like(x, math.sqrt(1 / (4 * pi))), -a * y, a * z, -a * x,
        b * x * y, -b * y * z, c * (3 * z * z - 1), -b * x * z, b / 2 * (x * x - y * y),
        -e * y * (3 * x * x - y * y), 2 * f * x * y * z, -g * y * (5 * z * z - 1),
        h * z * (5 * z * z - 3), -g * x * (5 * z * z - 1), f * z * (x * x - y * y),
        -e * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1)
