"""A scene made by hand that words can be asked of: two balls on a table, three cameras, no training."""

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from vlgs.fields.splat import SplatModel
from vlgs.fields.trained import SplatField
from vlgs.fusion.none import NoFusion
from vlgs.gaussians.sh import rgb_to_sh
from vlgs.heads.identity import Identity
from vlgs.indicator import Learned
from vlgs.opened import NamedCamera, OpenedRun
from vlgs.opened.files import SceneNotes
from vlgs.opened.words import Words
from vlgs.queries import LerfRelevancy
from vlgs.types import Camera, RasterConfig, Vocabulary

THINGS = ("red ball", "green ball", "table")
HOSTILE = "</script><img src=x onerror=\"document.title='taken'\"><b>&amp;{{about}}"
"""A word that would be markup if it were not text."""
_COLORS = torch.tensor([[0.9, 0.15, 0.1], [0.1, 0.7, 0.2], [0.5, 0.45, 0.4]])
_EACH = 160
"""Gaussians of a thing."""


def opened_scene(
    path: Path, name: str = "two balls", own_shape: bool = False, raster: RasterConfig | None = None
) -> OpenedRun:
    """As `vlgs.opened.open_run` would give it.

    Args:
        path: Which folder it says it is.
        name: Of the scene.
        own_shape: Whether language has covariances of its own.
        raster: Constants that it was trained with; None: those of `RasterConfig`.
    """
    model = SplatModel(
        *(_gaussians(own_shape), NoFusion(), Learned(), Identity(dim=4)),
        raster or RasterConfig(),
        sh_degree=3,
    )
    model.requires_grad_(False)
    words = (*THINGS, HOSTILE, *LerfRelevancy().negatives)
    # A thing's word has the direction of its code; what all are compared with lies between them.
    axes = torch.eye(4)
    between = normalize(torch.ones(1, 4))
    vectors = torch.cat([axes[:3], axes[:1], between.expand(4, 4)])
    vocabulary = Vocabulary(words, vectors)
    notes = SceneNotes(name, tuple(_cameras()), THINGS, vocabulary, (None,))
    known = Words.of(vocabulary, {}, None, None, "{}")
    return OpenedRun(path, SplatField(model), notes, LerfRelevancy(), known, None)


def unfinished(opened: OpenedRun, step: int) -> OpenedRun:
    """The same while it still trains."""
    return replace(opened, step=step)


def _gaussians(own_shape: bool) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    n = 3 * _EACH
    kind = torch.arange(3).repeat_interleave(_EACH)
    balls = normalize(draw(2 * _EACH, 3), dim=1) * 0.5 + torch.tensor([[-0.8, 0.0, 0.0]])
    balls[_EACH:, 0] += 1.6
    table = torch.cat([draw(_EACH, 1), torch.full((_EACH, 1), 0.6), draw(_EACH, 1)], dim=1)
    params = {
        "means": torch.cat([balls, table]),
        "quats": draw(n, 4),
        "log_scales": -2.9 + 0.7 * draw(n, 3),
        "sh0": rgb_to_sh(_COLORS[kind] + 0.08 * draw(n, 3)),
        "shN": 0.15 * draw(n, 15, 3),
        "opacity_logits": 1 + draw(n),
        "features": normalize(torch.eye(4)[kind] + 0.05 * draw(n, 4), dim=1),
        "indicator_logits": 1 + draw(n),
    }
    if own_shape:
        params["language_log_scales"] = params["log_scales"] + 0.5
        params["language_quats"] = draw(n, 4)
    return params


def _cameras() -> list[NamedCamera]:
    """On a ring, looking down at what stands on the table; the lens is not centred, and one camera is tilted."""
    cameras = []
    for index, (angle, tilt) in enumerate([(0.0, 0.0), (0.9, 0.0), (-0.7, 0.3)]):
        turn = torch.tensor(angle)
        eye = torch.stack([4 * turn.sin(), torch.tensor(-1.2), -4 * turn.cos()])
        viewmat = _looking(eye, tilt)
        K = torch.tensor([[110.0, 0.0, 52.0], [0.0, 108.0, 33.0], [0.0, 0.0, 1.0]])
        split = "test" if index == 1 else "train"
        cameras.append(NamedCamera(f"view_{index}", split, Camera(viewmat, K, 96, 72)))
    return cameras


def _looking(eye: Float[Tensor, " 3"], tilt: float) -> Float[Tensor, "4 4"]:
    """World to camera: from a point to the origin, with y down."""
    ahead = normalize(-eye, dim=0)
    right = normalize(torch.linalg.cross(torch.tensor([tilt, 1.0, 0.0]), ahead), dim=0)
    rows = torch.stack([right, torch.linalg.cross(ahead, right), ahead])
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rows, -rows @ eye
    return viewmat
