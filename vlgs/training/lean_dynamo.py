"""Postpones the import of torch's compiler, 1.8 s of CPU, which Lightning and torch's optimizers ask for without compiling anything.

Lightning reads one class of it, to know compiled modules (lightning#12786); every step of an optimizer calls two functions of it that do nothing outside of a
compilation (pytorch#162595). A module with these three stands for it until something else of it is wanted; one of
`importlib.util.LazyLoader` would be loaded by the first of them.
"""

import importlib.util
import sys
from collections.abc import Callable, Iterable
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

NAME = "torch._dynamo"


class _Postponed(ModuleType):
    """The compiler, loaded when it is asked for what it does not have yet."""

    def __getattr__(self, name: str) -> Any:
        _load(self)
        return getattr(self, name)


def _load(module: ModuleType) -> None:
    """Let it become the compiler; whoever holds this module holds that one then."""
    spec = module.__spec__
    assert spec is not None
    assert spec.loader is not None
    module.__class__ = ModuleType
    sys.meta_path[:] = [one for one in sys.meta_path if not isinstance(one, _WholeFirst)]
    spec.loader.exec_module(module)


class _WholeFirst(MetaPathFinder):
    """Who imports one module of the compiler has the compiler imported first, as is usual in a package."""

    def find_spec(
        self, fullname: str, path: Iterable[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The module that came with the compiler, or nothing: then the finders that follow look for it."""
        whole = sys.modules.get(NAME)
        if not isinstance(whole, _Postponed) or not fullname.startswith(f"{NAME}."):
            return None
        _load(whole)
        came = sys.modules.get(fullname)
        return None if came is None else ModuleSpec(fullname, _Came(came))


class _Came(Loader):
    """Of a module that is loaded already."""

    def __init__(self, module: ModuleType) -> None:
        self.module, self.spec = module, module.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self.module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self.spec  # that of this loader stands there by now


class _AsLoaded(type):
    """Of a class that stands for one of the compiler: its instances are those of the one that is loaded, if it is."""

    def __instancecheck__(cls, instance: object) -> bool:
        loaded = vars(sys.modules[NAME])[cls.__name__]
        return loaded is not cls and isinstance(instance, loaded)


class OptimizedModule(metaclass=_AsLoaded):
    """Stands for what `torch.compile` makes of a module."""


def _disable(function: Callable[..., Any], *_: object, **__: object) -> Callable[..., Any]:
    return function


def _graph_break(*_: object, **__: object) -> None:
    pass


def postpone_dynamo() -> None:
    """Let `torch._dynamo` be loaded when it is needed, unless it is loaded already or torch has none."""
    import torch

    spec = None if NAME in sys.modules else importlib.util.find_spec(NAME)
    if spec is None:
        return
    module = importlib.util.module_from_spec(spec)
    vars(module).update(OptimizedModule=OptimizedModule, disable=_disable, graph_break=_graph_break)
    module.__class__ = _Postponed
    sys.modules[NAME] = torch._dynamo = module
    sys.meta_path.insert(0, _WholeFirst())
