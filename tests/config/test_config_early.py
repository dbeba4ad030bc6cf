"""What would end a method after its first stage, minutes into a run, ends it before: heads, losses, views, codes."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from slow import with_slow
from tiny_runs import TINY, composed

from vlgs.config import check_config
from vlgs.experiment import construct
from vlgs.prepare import prepare
from vlgs.training.augment import Offline
from vlgs.training.build import build_module
from vlgs.types import Scene

KEPT = tuple(one for one in TINY if not one.startswith("head."))


def begun(*overrides: str) -> None:
    config = composed(*KEPT, *overrides)
    check_config(config)
    prepare(construct(config))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["method=lift", "head.dim=768"], "identity head: dim must be the embedding width 512, got 768"),
        (["method=goi", "head.width=768"], "lookup head: width must be the embedding width 512, got 768"),
        pytest.param(["method=langsplat_v2", "head.width=8"], "codebook head: width must be the embedding width 512, got 8", marks=pytest.mark.slow),
        (["method=best", "head.dim=600"], "principal head: dim must be at most the embedding width 512, got 600"),
        (["method=langsplat", "head.weights=conf/config.yaml"], "conf/config.yaml"),
        (["method=goi", "loss=langsplat"], "loss must be goi with head=lookup, as its scores of rows are no embeddings, got langsplat"),
        pytest.param(["method=legaussians", "loss=default"], "loss must be legaussians with head=quantised, as .*, got default", marks=pytest.mark.slow),
        (["method=langsplat", "loss=gs3d"], "loss must be .* with a stage without colour, as it trains language alone, got gs3d"),
        (["method=best", "gaussians.codes=sparse"], "gaussians must be default with language that is lifted, as codes=sparse .*, got default with other values"),
        (["gaussians.init_features=lifted", "gaussians.codes=sparse"], "codes must be none or unit with init_features=lifted, .*, got sparse"),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("unchecked")
def test_it_is_refused_before_anything_is_trained(overrides: list[str], message: str):
    with pytest.raises((ValueError, OSError), match=message):
        begun(*overrides)


@pytest.mark.parametrize(
    "method",
    with_slow(["vlgs", "langsplat", "goi", "legaussians", "lift", "best"], ["langsplat", "lift"]),
)
@pytest.mark.usefixtures("unchecked")
def test_methods_as_they_stand_are_not(method: str):
    begun(f"method={method}")


def test_a_loss_without_a_term_trains_nothing(tiny_scene: Scene):
    parts = construct(composed(*TINY)).parts
    with pytest.raises(ValueError, match="there must be a term of what is trained, got none"):
        build_module(tiny_scene, replace(parts, loss={}), 0)
    mute = replace(tiny_scene, mask_vectors=torch.zeros(0, 512), mask_areas=torch.zeros(0))
    language = {name: term for name, term in parts.loss.items() if name != "photometric"}
    with pytest.raises(ValueError, match="as the scene has no language, got none"):
        build_module(mute, replace(parts, loss=language), 0)


def test_a_term_that_is_null_is_left_out():
    parts = construct(composed(*TINY, "loss.blended_view=null", "blend=none", "fusion=none")).parts
    assert set(parts.loss) == {"photometric", "language"}


def test_views_of_as_many_sizes_have_none_between_them(tiny_scene: Scene):
    wider = tuple(
        replace(view, camera=replace(view.camera, width=view.camera.width + place))
        for place, view in enumerate(tiny_scene.train)
    )
    with pytest.raises(ValueError, match="two training views must have one image size, got none"):
        Offline().require({None: replace(tiny_scene, train=wider)})
    Offline().require({None: tiny_scene})


def test_runs_that_look_for_other_objects_have_the_same_models(tmp_path: Path):
    ids = []
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}.npy").write_bytes(name.encode())
        config = composed(
            *KEPT, "method=gs_grouping", "query=objects", f"query.masks={tmp_path / name}"
        )
        ready = prepare(construct(config))
        ids.append((ready.run_id, ready.trained_id))
    assert ids[0][0] != ids[1][0]
    assert ids[0][1] == ids[1][1]
