"""Imports Lightning without three packages that torchmetrics, which comes with it, loads wherever they are installed."""

import importlib.metadata
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.machinery import ModuleSpec
from types import ModuleType

_OPTIONAL = ("matplotlib", "scipy", "transformers")
"""For torchmetrics' plots, sound and BERT scores, which nothing here asks for: 1.8 s of CPU, beside 0.1 s for the rest of it."""


class _Hidden(importlib.metadata.DistributionFinder):
    """An import hook to which some packages are not installed."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = frozenset(names)

    def find_spec(
        self, fullname: str, path: Iterable[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Refuse what is hidden and leave all else to the hooks that follow."""
        if fullname.partition(".")[0] in self.names:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)
        return None

    def find_distributions(
        self, context: importlib.metadata.DistributionFinder.Context | None = None
    ) -> Iterable[importlib.metadata.Distribution]:
        """Likewise for what `importlib.metadata` is asked."""
        if context is not None and context.name in self.names:
            raise importlib.metadata.PackageNotFoundError(context.name)
        return ()


@contextmanager
def hidden(*names: str) -> Iterator[None]:
    """Let packages look as if they were not installed, except those that are loaded already."""
    hook = _Hidden([name for name in names if name not in sys.modules])
    sys.meta_path.insert(0, hook)
    try:
        yield
    finally:
        sys.meta_path.remove(hook)


def import_lightning() -> None:
    """Import Lightning. Where torchmetrics is loaded already, it stays as it is.

    Otherwise it takes its optional packages for missing as long as this process lives: a plugin that wants its plots or its BERT score
    imports torchmetrics before `vlgs.training`.
    """
    if "torchmetrics" not in sys.modules:
        # A version that could not do without them is imported again, with them, by Lightning.
        with suppress(ImportError), hidden(*_OPTIONAL):
            import torchmetrics  # noqa: F401
    import lightning  # noqa: F401
