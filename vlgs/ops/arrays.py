"""Tensors as the compiled kernels take them.

A kernel that is given a tensor asks it for a DLPack capsule by its Python method, which takes 2.3 us; to hand over a capsule takes 0.3. In a
training step there are some 200. One capsule is good for one call.
"""

from collections.abc import Sequence
from typing import Any, TypeVar, TypeVarTuple

from torch.utils.dlpack import to_dlpack  # pyright: ignore[reportPrivateImportUsage]

Tensors = TypeVarTuple("Tensors")
OneOrNone = TypeVar("OneOrNone")


def arrays(*tensors: *Tensors) -> tuple[*Tensors]:
    """A capsule of each, which type checkers take for the tensor; None stays None."""
    made: Any = tuple(array_list(tensors))
    return made


def array_list(tensors: Sequence[OneOrNone]) -> list[OneOrNone]:
    """The same for an argument that is a list of tensors."""
    given: Sequence[Any] = tensors
    made: list[Any] = [None if tensor is None else to_dlpack(tensor) for tensor in given]
    return made
