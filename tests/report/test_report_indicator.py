"""The histogram of l - o counts pixels under the kind of their true class."""

from dataclasses import replace

import pytest
import torch
from report_fakes import FakeField
from torch import Tensor

from vlgs.report.indicator import ANY, Histogram
from vlgs.types import IGNORE_ID, Camera, DenseLabels, View


class Flat(FakeField):
    """A field whose pixel i is Gaussian i alone."""

    def __init__(self, language: list[float], opacity: list[float]) -> None:
        super().__init__()
        self.language, self.opacity = torch.tensor(language), torch.tensor(opacity)

    def language_weights(self) -> Tensor:
        return self.language

    def opacities(self) -> Tensor:
        return self.opacity

    def render_values(self, camera: Camera, values: Tensor, weight: Tensor) -> Tensor:
        return (values * weight[:, None]).reshape(camera.height, camera.width, -1)


def view_of(ids: Tensor) -> View:
    height, width = ids.shape
    camera = Camera(torch.eye(4), torch.eye(3), width, height)
    return View(
        name="a",
        camera=camera,
        read_image=lambda: torch.zeros(height, width, 3, dtype=torch.uint8),
        read_dense_labels=lambda: DenseLabels(ids),
    )


def test_pixels_count_under_the_kind_of_their_class():
    histogram = Histogram(["glass", "wall"], {"glass": "translucent_reflective", "wall": "other"})
    ids = torch.tensor([[0, 0, 1], [1, IGNORE_ID, 1]], dtype=torch.uint8)
    field = Flat([0.9, 0.83, 0.52, 0.53, 0.9, 0.3], [0.18, 0.1, 0.5, 0.5, 0.1, 0.78])
    histogram.add(view_of(ids), field)
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
    field = Flat([0.5, 0.5], [0.5, 0.5])
    histogram.add(unlabelled, field)
    assert histogram.shares() is None
    histogram.add(view_of(ids), field)
    assert set(histogram.shares() or {}) == {"edges", ANY}
