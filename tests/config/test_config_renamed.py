"""Names of before: ids of runs keep them, and whoever writes them is told the new one."""

import pytest
from omegaconf import OmegaConf
from tiny_runs import composed as unchecked

from vlgs.command import check_command, composed
from vlgs.config import check_targets
from vlgs.convert import main as convert
from vlgs.identity import identity, run_id
from vlgs.known import FORMER, former, renamed


@pytest.mark.parametrize("given", ["codec=identity", "+codec=identity", "codec.training.steps=3", "codec.dim=1,2"])  # fmt: skip
def test_an_old_override_is_told_its_new_name(given: str):
    key = given.lstrip("+").partition("=")[0]
    message = f"{key} must be given as {key.replace('codec', 'head')}, its new name, got"
    with pytest.raises(ValueError, match=message):
        composed([given])
    with pytest.raises(ValueError, match=message):
        check_command(["-m", given])


def test_an_old_file_is_told_the_new_name():
    config = unchecked("fusion=none")
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    plain["codec"] = plain.pop("head")
    with pytest.raises(ValueError, match=r"codec must be a key that is read, .*did you mean head"):
        check_targets(OmegaConf.create(plain))
    with pytest.raises(ValueError, match="codec is called head now"):
        composed(["fusion.feature_dim=${codec.dim}"])


def test_ids_have_the_old_names():
    config = unchecked(
        "head.weights=/x/best_ckpt.pth",
        "head.dim=4",
        "gaussians.near_share=0",
        "trainer.codes_apart=0",
        "trainer.codes_faint=0",
        "trainer.indicator_reach=0",
        "trainer.language_weight=1",
        "trainer.language_error=mse",
        "trainer.language_support=0",
        "gaussians.background_opacity=null",
        "gaussians.max_angle=0",
        "gaussians.densify.by_error=false",
        "gaussians.densify.long_axis=false",
        "raster.eps2d=0.3",
        "raster.near_sigmas=0",
        "trainer.dropout=0",
    )
    assert run_id(config, "f") == "22d7fa10565160f3"
    assert identity(config).recipe == "cee97baba7e9d96c"
    for new, old in FORMER.items():
        assert former(f"{new}.a") == f"{old}.a"
        assert renamed(f"{old}.a") == f"{new}.a"
    assert (former("heads"), renamed("codecs")) == ("heads", None)


def test_an_old_flag_is_told_its_new_name(capsys: pytest.CaptureFixture):
    with pytest.raises(SystemExit):
        convert(["a", "b", "--codec", "best_ckpt.pth"])
    assert "--codec must be given as --head, its new name" in capsys.readouterr().err
