"""SAM's automatic masks on a model of random weights, against transformers' own pieces of the same procedure."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from vlgs.features.nms import MaskNms
from vlgs.features.sam import GridPrompts, MaskFilter, SamSegmenter, crop_windows, grid_points
from vlgs.features.weights import Pretrained

PROMPTS = GridPrompts(points_per_side=4, crop_layers=1, batch=5)
KEEP = MaskFilter(predicted_iou=0.05, stability=0.5, least_area=0)
EVERYTHING = MaskNms(iou=1.0, score=-1e9, inner=0.0)


def photograph(height: int = 45, width: int = 70) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 3, y * 5, 100 + 100 * np.sin(x / 7)], axis=-1).astype(np.uint8)


def segmenter(weights: Path, prompts: GridPrompts = PROMPTS, **options) -> SamSegmenter:
    pretrained = Pretrained(name="facebook/sam-vit-huge", weights=str(weights))
    return SamSegmenter(pretrained, prompts, replace(KEEP, **options), EVERYTHING)


@pytest.mark.parametrize("size", [(45, 70), (1080, 607), (64, 64)])
@pytest.mark.parametrize("layers", [0, 1, 2])
def test_windows_are_those_of_transformers(size: tuple[int, int], layers: int):
    pytest.importorskip("transformers")
    from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil

    image = np.zeros((*size, 3), np.uint8)
    boxes, _, _, _ = SamImageProcessorPil().generate_crop_boxes(
        image, 64, crop_n_layers=layers, points_per_crop=4
    )
    got = [(c.x1, c.y1, c.x2, c.y2) for c in crop_windows(size, GridPrompts(4, layers))]
    assert got == [tuple(box) for box in boxes.tolist()]


def test_points_are_middles_of_a_grid():
    want = [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]]
    torch.testing.assert_close(grid_points(2), torch.tensor(want))


def test_candidates_are_those_of_transformers(weights: Path):
    """Same pixels, same logits, same thresholds, same border rule; masks and boxes agree to the pixel."""
    pytest.importorskip("transformers")
    from transformers import SamModel
    from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil

    image = photograph()
    ours = segmenter(weights)
    processor = SamImageProcessorPil(
        size={"longest_edge": 64}, pad_size={"height": 64, "width": 64}
    )
    model = SamModel.from_pretrained(weights / "sam-vit-huge").eval()
    compared = 0
    for crop in crop_windows(image.shape[:2], PROMPTS):
        window = image[crop.y1 : crop.y2, crop.x1 : crop.x2]
        inputs = processor(window, return_tensors="pt")
        height, width = inputs["reshaped_input_sizes"][0].tolist()
        points = (grid_points(4) * torch.tensor([width, height]))[None, :, None]
        with torch.no_grad():
            out = model(pixel_values=inputs["pixel_values"], input_points=points)
        masks = processor.post_process_masks(
            out.pred_masks,
            inputs["original_sizes"],
            inputs["reshaped_input_sizes"],
            binarize=False,
        )[0]
        found = ours._candidates(image, crop, image.shape[:2])
        for k in range(3):
            candidates = [c for batch in found[k] for c in batch]
            _, scores, boxes = processor.filter_masks(
                masks[:, k : k + 1], out.iou_scores[0, :, k : k + 1], image.shape[:2],
                [crop.x1, crop.y1, crop.x2, crop.y2], 0.05, 0.5,
            )  # fmt: skip
            # Scores of random weights reach 11; points decoded 5 at a time differ from 16 at a time by up to 3.1e-5 in
            # float32 (a CPU without AVX-512; float32 itself is off float64 by up to 3e-3).
            found_scores = [c.predicted_iou for c in candidates]
            np.testing.assert_allclose(found_scores, scores, rtol=1e-4, atol=1e-4)
            got = np.array([c.mask.box for c in candidates]).reshape(-1, 4) - [0, 0, 1, 1]
            np.testing.assert_allclose(got, boxes.reshape(-1, 4))
            compared += len(candidates)
    assert compared > 10


def test_levels_are_all_outputs_and_each_of_them(weights: Path):
    default, *apart = segmenter(weights)(photograph())
    assert all(apart)
    assert {m.key for m in default} <= {m.key for level in apart for m in level}
    assert len(default) >= max(map(len, apart))


def test_batches_of_points_do_not_matter(weights: Path):
    first = segmenter(weights)(photograph())
    second = segmenter(weights, replace(PROMPTS, batch=16))(photograph())
    assert [[m.box for m in level] for level in first] == [
        [m.box for m in level] for level in second
    ]


def test_half_precision_finds_nearly_the_same(weights: Path):
    ours = segmenter(weights)
    ours.pretrained = replace(ours.pretrained, dtype="bfloat16")
    half, full = ours(photograph()), segmenter(weights)(photograph())
    assert ours._loaded[0].mask_decoder.iou_token.weight.dtype == torch.float32
    counts = [len(level) for level in half], [len(level) for level in full]
    np.testing.assert_allclose(*counts, rtol=0.5, atol=3)


def test_thresholds_that_nothing_passes_give_no_masks(weights: Path):
    assert [len(m) for m in segmenter(weights, predicted_iou=1e9)(photograph())] == [0] * 4


def test_bad_options_are_refused():
    with pytest.raises(ValueError, match="crop_overlap must be in"):
        GridPrompts(crop_overlap=1.0)
    with pytest.raises(ValueError, match="counts of the prompts must be positive"):
        GridPrompts(points_per_side=0)
    with pytest.raises(ValueError, match="dtype must be one of float32"):
        Pretrained(name="a/b", dtype="float8")
