"""Every option of every group composes and constructs: none can rot unseen."""

import pytest
from omegaconf import OmegaConf
from tiny_runs import composed

from vlgs.config import CONF, check_targets, instantiate

CONSTRUCTED = (
    "gaussians",
    "sharing",
    "augment",
    "fusion",
    "indicator",
    "blend",
    "head",
    "loss",
    "raster",
    "trainer",
    "query",
    "text",
    "protocol",
)
OPTIONS = sorted(
    (path.parent.name, path.stem)
    for group in (*CONSTRUCTED, "data", "logger")
    for path in (CONF / group).glob("*.yaml")
    if path.stem != "base"
)


NEEDED = {
    "colmap": ["data.root=somewhere"],
    "nerfstudio": ["data.root=somewhere"],
    "lerf_ovs": ["data.root=somewhere", "data.scene=ramen"],
    "ovs3d": ["data.root=somewhere", "data.scene=bed"],
    "mipnerf360": ["data.root=somewhere", "data.scene=garden"],
    "mipnerf360_goi": ["data.root=a", "data.scene=room", "data.release.labels=b"],
    "mipnerf360_gags": ["data.root=a", "data.scene=room", "data.release.labels=b"],
}
"""What an option cannot do without."""


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_option_composes_and_constructs(group: str, option: str):
    overrides = [f"{group}={option}", *(NEEDED.get(option, ()) if group == "data" else ())]
    config = composed(*overrides)
    check_targets(config)
    OmegaConf.resolve(config)
    if group in CONSTRUCTED:
        assert instantiate(config[group]) is not None


def test_the_command_line_of_the_design_composes():
    config = composed("fusion=self", "indicator=learned", "blend=uniform")
    assert config.blend._target_.endswith("UniformBlend")


def test_paper_trainer_is_the_papers():
    config = composed("trainer=paper")
    assert config.trainer.iterations == 15_000
    assert config.loss.blended_view.weight == 1.2
    rates = config.trainer.learning_rates
    # the paper's Table 7
    assert (rates.means, rates.log_scales, rates.quats, rates.sh0) == (1.6e-4, 5e-3, 1e-3, 5e-3)
    assert (rates.opacity_logits, rates.features, rates.indicator_logits) == (5e-2, 5e-3, 5e-2)
