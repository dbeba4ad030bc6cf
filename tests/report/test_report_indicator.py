"""The histogram of l - o counts pixels under the kind of their true class."""

from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from vlgs.report.answer import RenderedView
from vlgs.report.indicator import ANY, Histogram
from vlgs.types import IGNORE_ID, Camera, DenseLabels, Gaussians, View


@dataclass
class Flat:
    """A model whose pixel i is Gaussian i alone."""

    codec: Any = None

    def fuse(self) -> Any:
        raise NotImplementedError

    def render(
        self, camera: Camera, color: bool = True, language: bool = True, fused: Any = None
    ) -> RenderedView:
        raise NotImplementedError

    def render_values(self, camera: Camera, values: Tensor, weight: Tensor) -> Tensor:
        return (values * weight[:, None]).reshape(camera.height, camera.width, -1)


@dataclass
class Shared:
    gaussians: Gaussians
    feature: Tensor
    language_weight: Tensor


def view_of(ids: Tensor) -> View:
    height, width = ids.shape
    camera = Camera(torch.eye(4), torch.eye(3), width, height)
    return View(
        name="a",
        camera=camera,
        read_image=lambda: torch.zeros(height, width, 3, dtype=torch.uint8),
        read_dense_labels=lambda: DenseLabels(ids),
    )


def shared_of(language: list[float], opacity: list[float]) -> Shared:
    n = len(language)
    gaussians = Gaussians(
        means=torch.zeros(n, 3),
        quats=torch.zeros(n, 4),
        scales=torch.ones(n, 3),
        opacities=torch.tensor(opacity),
        indicators=torch.tensor(language),
        sh0=torch.zeros(n, 3),
        shN=torch.zeros(n, 15, 3),
        features=torch.zeros(n, 3),
    )
    return Shared(gaussians, gaussians.features, gaussians.indicators)


def test_pixels_count_under_the_kind_of_their_class():
    histogram = Histogram(["glass", "wall"], {"glass": "translucent_reflective", "wall": "other"})
    ids = torch.tensor([[0, 0, 1], [1, IGNORE_ID, 1]], dtype=torch.uint8)
    fused = shared_of([0.9, 0.83, 0.52, 0.53, 0.9, 0.3], [0.18, 0.1, 0.5, 0.5, 0.1, 0.78])
    histogram.add(view_of(ids), Flat(), fused)
    shares = histogram.shares()
    assert shares is not None
    edges = torch.tensor(shares["edges"])
    assert len(edges) == len(shares["other"]) + 1

    def share_at(kind: str, difference: float) -> float:
        return shares[kind][int(torch.searchsorted(edges, difference, right=True)) - 1]

    assert share_at("translucent_reflective", 0.72) == pytest.approx(1.0)
    assert share_at("other", 0.02) == pytest.approx(2 / 3)
    assert share_at("other", -0.48) == pytest.approx(1 / 3)


def test_without_labels_or_kinds():
    histogram = Histogram(["a"], {})
    ids = torch.zeros(1, 2, dtype=torch.uint8)
    unlabelled = replace(view_of(ids), read_dense_labels=None)
    fused = shared_of([0.5, 0.5], [0.5, 0.5])
    histogram.add(unlabelled, Flat(), fused)
    assert histogram.shares() is None
    histogram.add(view_of(ids), Flat(), fused)
    assert set(histogram.shares() or {}) == {"edges", ANY}
