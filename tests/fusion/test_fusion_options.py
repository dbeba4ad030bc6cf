from pathlib import Path

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

import vlgs.config  # noqa: F401 (its resolvers)
from vlgs.fusion.mlp import MLP
from vlgs.fusion.none import NoFusion

CONF = Path(__file__).parents[2] / "conf" / "fusion"


@pytest.mark.parametrize("option", ["self", "none", "mlp", "cross"])
@pytest.mark.parametrize("head_dim", [1, 3, 16])
@pytest.mark.parametrize(("levels", "codes"), [("single", 1), ("separate", 1), ("joint", 3)])
def test_option_takes_the_width_of_the_codes(option: str, head_dim: int, levels: str, codes: int):
    fusion = OmegaConf.load(CONF / f"{option}.yaml")
    cfg = OmegaConf.create({"head": {"dim": head_dim}, "levels": levels, "fusion": fusion})
    color, feature = torch.rand(5, 3), torch.randn(5, codes * head_dim)
    fused = instantiate(cfg.fusion)(color, feature)
    assert torch.equal(fused[0], color)
    assert torch.equal(fused[1], feature)


def test_no_fusion_returns_its_arguments():
    color, feature = torch.rand(5, 3), torch.randn(5, 4)
    fused = NoFusion()(color, feature)
    assert fused[0] is color
    assert fused[1] is feature


@pytest.mark.parametrize("residual", [True, False])
def test_mlp_by_hand(residual: bool):
    fuse = MLP(1, 1, residual)
    with torch.no_grad():
        fuse.mix.weight.copy_(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
        fuse.mix.bias.copy_(torch.tensor([10.0, 20.0]))
    color, feature = fuse(torch.tensor([[1.0]]), torch.tensor([[2.0]]))
    want = [[15.0 + residual], [31.0 + 2 * residual]]
    assert [color.flatten().tolist(), feature.flatten().tolist()] == want


def test_plain_mlp_starts_with_something_to_render():
    color, feature = MLP(3, 3, residual=False)(torch.rand(5, 3), torch.rand(5, 3))
    assert color.abs().max() > 0
    assert feature.abs().max() > 0


def test_mlp_refuses_bad_sizes():
    with pytest.raises(ValueError, match="feature_dim must be positive, got 3, 0"):
        MLP(3, 0)
    with pytest.raises(ValueError, match=r"MLP: channels .* must be \(3, 3\), got \(4, 3\)"):
        MLP(3, 3)(torch.rand(2, 4), torch.rand(2, 3))
