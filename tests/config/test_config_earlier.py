"""What an earlier version recorded is read in today's words, and is the run that it was."""

from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf
from tiny_runs import composed

from vlgs.config import check_targets
from vlgs.earlier import as_today
from vlgs.identity import run_id

MOVED = {
    "vlgs.heads.": "vlgs.codec.",
    "vlgs.training.settings.": "vlgs.module.settings.",
    "vlgs.training.augment.": "vlgs.module.augment.",
    "vlgs.training.sharing.choose_sharing": "vlgs.gaussians.Sharing",
    "vlgs.view_blend.": "vlgs.blend.",
    "vlgs.indicator.Opacity": "vlgs.indicator.ColourOpacity",
    "vlgs.data.synthetic.LabelNoise": "vlgs.data.synthetic.Faults",
}


def as_before(config: DictConfig) -> dict[str, Any]:
    """The same as the version before these renames recorded it, with the language loss over all pixels."""
    text = OmegaConf.to_yaml(config, resolve=True)
    for now, before in MOVED.items():
        assert now in text
        text = text.replace(now, before)
    plain = OmegaConf.to_container(OmegaConf.create(text))
    assert isinstance(plain, dict)
    plain["codec"] = plain.pop("head")
    plain["loss"] = {
        "_target_": "vlgs.losses.Losses", "rgb_loss": "l1_dssim", "lang_loss": "mse", "lang_pixels": "all",
        "blend_weight": 0.5,
    }  # fmt: skip
    del plain["gaussians"]["background"], plain["trainer"]["exposure"], plain["stages"]
    plain["trainer"]["skip"]["fuse_visible"] = True
    return {str(key): value for key, value in plain.items()}


def test_a_recorded_configuration_is_the_run_that_it_was():
    config = composed(
        "indicator=opacity", "gaussians.background=0", "head.dim=4", "loss.language.pixels=all",
        "loss.blended_view.weight=0.5", "loss.language.weight=1.0", "loss.language.error=mse",
        "loss.language.support=0.0",
    )  # fmt: skip
    again = as_today(OmegaConf.create(as_before(config)))
    check_targets(again, plugins=())
    assert again.loss.language.pixels == "all"
    assert again.head._target_ == "vlgs.heads.autoencoder.Autoencoder"
    assert run_id(again, "f") == run_id(config, "f")


def test_a_class_that_is_gone_is_named():
    plain = as_before(composed("indicator=opacity"))
    plain["fusion"] = {"_target_": "vlgs.fusion.sum.Sum"}
    with pytest.raises(ValueError, match=r"fusion._target_ must be a class of this version, got vlgs.fusion.sum.Sum"):  # fmt: skip
        as_today(OmegaConf.create(plain))


def test_a_plugin_stays():
    plain = as_before(composed("indicator=opacity"))
    plain["fusion"] = {"_target_": "my_lab.Gated", "gate": 0.5}
    assert as_today(OmegaConf.create(plain)).fusion == plain["fusion"]
