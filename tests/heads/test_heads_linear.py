"""The head of Feature-3DGS: its gradient, and what it is compared with."""

import pytest
import torch
from torch import Tensor

from vlgs.heads import Head
from vlgs.heads.linear import Linear
from vlgs.losses import masked_l1


def test_its_loss_has_the_gradient_of_finite_differences():
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    head, target = Linear(dim=3, width=5).double(), 10 + draw(4, 2, 5)
    valid = torch.tensor([[True, False], [True, True], [False, True], [True, True]])

    def loss(codes: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        shown = torch.nn.functional.linear(codes, weight, bias)
        return masked_l1(shown, target, valid)

    inputs = [draw(4, 2, 3), head.map.weight.detach().clone(), head.map.bias.detach().clone()]
    assert torch.autograd.gradcheck(loss, [value.requires_grad_() for value in inputs])  # pyright: ignore
    codes = inputs[0].detach().clone().requires_grad_()
    masked_l1(head.predict(codes), target, valid).backward()
    loss(*inputs).backward()
    for got, want in zip((codes, head.map.weight, head.map.bias), inputs, strict=True):
        assert got.grad is not None
        # Sums are made in blocks, in another order: off by 1e-17 of 0.04 here.
        torch.testing.assert_close(got.grad, want.grad, rtol=1e-12, atol=1e-15)


def test_it_is_compared_in_embeddings_and_decodes_to_unit_length():
    head, vectors = Linear(dim=3, width=8), torch.nn.functional.normalize(torch.randn(5, 8), dim=1)
    assert isinstance(head, Head)
    head.fit(vectors, torch.ones(5))
    assert torch.equal(head.targets(vectors), vectors)
    decoded = head.decode(torch.randn(2, 4, 3))
    torch.testing.assert_close(decoded.norm(dim=-1), torch.ones(2, 4))
    with pytest.raises(ValueError, match="width must be the embedding width 8, got 9"):
        Linear(dim=3, width=9).fit(vectors, torch.ones(5))
