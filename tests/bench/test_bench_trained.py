"""A trained scene is measured as its model renders it."""

from pathlib import Path

import torch

from vlgs.bench.outcome import render
from vlgs.bench.presets import load_run, raster_presets, train_or_load
from vlgs.bench.quality import measure_quality
from vlgs.bench.scenes import view_of
from vlgs.bench.train import QUICK


def test_a_trained_view_is_what_the_model_renders_and_its_run_loads(tmp_path: Path):
    overrides = [*QUICK, "head.cache_dir=null", "progress=false", "trainer.iterations=25"]
    trained = train_or_load(overrides, tmp_path)
    module, camera = trained.module, trained.scene.test[0].camera
    assert module.model.sh_degree > 0
    view = view_of(module.model, camera, seed=0)
    want = module.model.render(camera)
    color, feature = render(view, module.model.raster)
    assert want.color is not None
    assert want.feature is not None
    assert torch.equal(color, want.color)
    assert torch.equal(feature, want.feature)

    folder = next((tmp_path / "runs").iterdir())
    config = folder / "config.yaml"  # as it was before these classes moved
    config.write_text(config.read_text().replace("vlgs.training.", "vlgs.module."))
    again = load_run(folder).module.model
    for name, parameter in module.model.splats.items():
        assert torch.equal(again.splats[name], parameter)

    presets = raster_presets()
    same = measure_quality(trained, presets["exact"], presets["exact"])
    assert same.psnr is not None
    assert same.psnr_change == 0.0
    assert measure_quality(None, presets["exact"], presets["exact"]).psnr is None
