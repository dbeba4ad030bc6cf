"""What the Gaussians have to know of what colour and language have in common; the options are in `vlgs.training.sharing`."""

from typing import Protocol, runtime_checkable


@runtime_checkable
class Sharing(Protocol):
    """The interface of an option of conf/sharing."""

    @property
    def own_shape(self) -> bool:
        """Whether language is blended with a rotation and a scale of its own."""
        ...
