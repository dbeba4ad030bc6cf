"""Which code computes an operation: decided by the device of its tensors."""

from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Generic, TypeVar

import torch
from torch import Tensor

Kernel = TypeVar("Kernel")


class Kernels(Generic[Kernel]):
    """What computes one operation, by type of device (``cpu``, ``cuda``, ...).

    Another device joins in one new file, ``vlgs/ops/<operation>_<device>.py``. It has the signature of the CPU's code and puts
    itself into the table: ``KERNELS["cuda"] = ...``. It is imported when the first tensor of that device comes.

    Args:
        operation: Name of the module in `vlgs.ops` that holds the table.
        cpu: What computes it on the CPU.

    Example:
        >>> Kernels("rasterize_to_pixels", cpu=len).of(torch.zeros(3))
        <built-in function len>
    """

    def __init__(self, operation: str, cpu: Kernel) -> None:
        self.operation = operation
        self._by_device = {"cpu": cpu}

    def __setitem__(self, device: str, kernel: Kernel) -> None:
        self._by_device[device] = kernel

    def of(self, tensor: Tensor) -> Kernel:
        """What computes the operation where the tensor is.

        Raises:
            ValueError: If nothing does.
        """
        # Asked a dozen times a step; the name of a device takes seven times as long as this question (`vlgs.bench.seams`).
        device = "cpu" if tensor.is_cpu else tensor.device.type
        kernel = self._by_device.get(device)
        return self._look_for(device) if kernel is None else kernel

    def _look_for(self, device: str) -> Kernel:
        home = f"{__package__}.{self.operation}_{device}"
        if find_spec(home) is not None:
            import_module(home)
        if device not in self._by_device:
            raise ValueError(
                f"{self.operation}: tensors must be on {' or '.join(self._by_device)}, got {device} (another device joins in "
                f"one file, {home.replace('.', '/')}.py; see CONTRIBUTING)"
            )
        return self._by_device[device]


def differentiated(tensors: Sequence[Tensor]) -> bool:
    """Whether a backward pass may follow; if not, an operation need keep nothing for it."""
    return torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
