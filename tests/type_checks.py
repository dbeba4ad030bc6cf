"""jaxtyping's checks of types and shapes at run time, at a third of their price: they took two fifths of a training run's time.

pytest's option `--jaxtyping-packages` decorates every function of vlgs by `jaxtyping.jaxtyped`, which binds each call to the signature and
checks the arguments twice, before the call and again with what is returned, all to word its error. Here beartype checks a call
once, and functions that are never called are not prepared. A size has one value within a call, as there.
"""

import dataclasses
import functools
import inspect
import types
from collections.abc import Callable
from typing import Any, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype

_checking = beartype(conf=BeartypeConf(violation_type=jaxtyping.TypeCheckError))
_original = jaxtyping.jaxtyped
_sizes_of_a_call = jaxtyping.jaxtyped("context")


def install() -> None:
    """Let modules of vlgs that are imported from now on be checked by this module."""
    jaxtyping.jaxtyped = checked


def checked(fn: Any = None, *, typechecker: Any) -> Any:
    """What stands for `jaxtyping.jaxtyped(typechecker=...)` above every function and class of a module."""
    if fn is None:
        return functools.partial(checked, typechecker=typechecker)
    if not inspect.isclass(fn):
        return _checked_function(fn, typechecker)
    if dataclasses.is_dataclass(fn) and not hasattr(fn.__init__, "__wrapped__"):
        fn.__init__ = _checked_function(fn.__init__, typechecker)  # type: ignore[method-assign]
    return fn


def _checked_function(fn: Callable[..., Any], typechecker: Any) -> Callable[..., Any]:
    checked: Callable[..., Any] | None = None

    @functools.wraps(fn)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        if jaxtyping.config.jaxtyping_disable:
            return fn(*args, **kwargs)
        if checked is None:
            checked = _prepared(fn, typechecker)
        return checked(*args, **kwargs)

    return wrapper


def _prepared(fn: Callable[..., Any], typechecker: Any) -> Callable[..., Any]:
    """The function that checks a call and does it."""
    hints = {name: _resolved(hint, fn) for name, hint in fn.__annotations__.items()}
    named, checked = str([*hints.values()]), _checking(_with_hints(fn, hints))
    if "jaxtyping." not in named:
        return checked
    # A size named after an argument, which jaxtyping looks up; a generator, of which beartype checks the arguments when the call is over.
    if "{" in named or inspect.isgeneratorfunction(fn):
        return _original(fn, typechecker=typechecker)

    def with_sizes(*args: Any, **kwargs: Any) -> Any:
        with _sizes_of_a_call:
            return checked(*args, **kwargs)

    return with_sizes


def _resolved(hint: Any, fn: Callable[..., Any]) -> Any:
    """A hint without strings in it; one with a name that only a static type checker imports is not checked."""
    alone = types.SimpleNamespace(__annotations__={"hint": hint})
    try:
        return get_type_hints(alone, fn.__globals__, include_extras=True)["hint"]
    except NameError:
        return Any


def _with_hints(fn: Callable[..., Any], hints: dict[str, Any]) -> Callable[..., Any]:
    """The same function under other annotations; its own stay, for whoever reads them."""
    copy = types.FunctionType(
        fn.__code__, fn.__globals__, fn.__name__, fn.__defaults__, fn.__closure__
    )
    copy.__qualname__, copy.__kwdefaults__, copy.__annotations__ = (
        fn.__qualname__,
        fn.__kwdefaults__,
        hints,
    )
    copy.__dict__.update(fn.__dict__)
    return copy
