"""That types and shapes are checked while tests run, as `tests/type_checks.py` does it."""

from collections.abc import Iterator
from dataclasses import dataclass

import jaxtyping
import pytest
import torch
import type_checks
from beartype import beartype
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.losses import masked_mse
from vlgs.metrics.dense import confusion
from vlgs.types import Camera

IMAGE = torch.zeros(2, 3, 1)


def check(fn):
    """As the import hook decorates what it finds in a module."""
    return jaxtyping.jaxtyped(typechecker=beartype)(fn)


def test_functions_and_data_of_the_project_are_checked():
    assert masked_mse(IMAGE, IMAGE) == 0
    with pytest.raises(jaxtyping.TypeCheckError, match=r"(?s)render.*3 expected by the type hint"):
        masked_mse(IMAGE[0], IMAGE)
    with pytest.raises(jaxtyping.TypeCheckError, match="dtype int32"):
        masked_mse(IMAGE.int(), IMAGE)
    assert Camera(torch.eye(4), torch.eye(3), 2, 2).width == 2
    with pytest.raises(jaxtyping.TypeCheckError, match=r"(?s)K.*size 4 does not equal 3"):
        Camera(torch.eye(4), torch.eye(4), 2, 2)
    with pytest.raises(jaxtyping.TypeCheckError, match="width"):
        Camera(torch.eye(4), torch.eye(3), 2.0, 2)  # type: ignore[arg-type]


def test_a_letter_is_one_size_within_a_call_and_another_in_the_next():
    @check
    def halved(
        x: Float[Tensor, "n c"], y: Float[Tensor, "n c"], wrong: bool = False
    ) -> Float[Tensor, " n"]:
        if y.shape[0] > 2:
            halved(x[:2], y[:2])  # has sizes of its own, and leaves these
        return x[wrong:, 0]

    for size in (2, 3):
        x = torch.zeros(size, 4)
        assert halved(x, x).shape == (size,)
        with pytest.raises(jaxtyping.TypeCheckError, match=f"size of dimension n is {size - 1}"):
            halved(x, x, wrong=True)
        with pytest.raises(
            jaxtyping.TypeCheckError, match=r"(?s)y.*dimension c is 3 .* value of 4"
        ):
            halved(x, x[:, :3])


def test_a_size_named_after_an_argument_is_checked():
    ids = torch.zeros(2, 2)
    assert confusion(ids.long(), ids.byte(), 3).shape == (3, 3)

    @check
    def square(n: int) -> Int[Tensor, "{n} {n}"]:
        return torch.zeros(3, n, dtype=torch.int64)

    square(3)
    with pytest.raises(jaxtyping.TypeCheckError):
        square(4)


def test_hints_that_only_a_type_checker_knows_are_left_out_alone():
    @check
    def summed(a: list["Nobody"], b: "Float[Tensor, '3']") -> "int":  # type: ignore[name-defined] # noqa: F821
        return int(b.sum())

    assert summed([], torch.ones(3)) == 3
    with pytest.raises(jaxtyping.TypeCheckError):
        summed([], torch.ones(4))


def test_a_generator_is_checked_when_it_is_called():
    @check
    def rows(x: Float[Tensor, "3 c"]) -> Iterator[Tensor]:
        yield from x

    assert len(list(rows(torch.ones(3, 2)))) == 3
    with pytest.raises(jaxtyping.TypeCheckError):
        rows(torch.ones(4, 2))


def test_data_of_a_subclass_and_methods_of_each_kind_are_checked():
    @check
    @dataclass
    class Base:
        x: Float[Tensor, " n"]
        y: Float[Tensor, " n"]

    @check
    class Sub(Base):
        @property
        @check
        def first(self) -> int:
            return self.x[0].item()  # type: ignore[return-value]

        @staticmethod
        @check
        def count(x: Float[Tensor, " n"], *, by: int = 1) -> int:
            return len(x) // by

    two, three = torch.zeros(2), torch.zeros(3)
    assert Sub.count(Sub(two, two).y, by=2) == 1
    for wrong in (
        lambda: Sub(two, three),
        lambda: Sub(two, two).first,
        lambda: Sub.count(torch.zeros(2, 2)),
    ):
        with pytest.raises(jaxtyping.TypeCheckError):
            wrong()


def test_they_can_be_switched_off(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    assert Camera(torch.eye(4), torch.eye(4), 2, 2).height == 2
    assert jaxtyping.jaxtyped is type_checks.checked
