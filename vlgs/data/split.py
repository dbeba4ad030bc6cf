"""Which views train and which are held out."""

import difflib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field

from vlgs.data.diagnostics import Fault, listing

KINDS = ("llff", "holdout", "all", "list")


@dataclass(frozen=True)
class Split:
    """A rule that tells training views from test views.

    ``llff``: every `every`-th view in order of name is held out, from the first on. ``holdout``: the labelled views are.
    ``all``: every view trains and the labelled ones are tested as well, as LangSplat does it (conf/README.md, D.22). ``list``: the views
    of `test` are held out. With `train_views` only so many of the others train, spread evenly; the rest is as if it had not been taken.
    """

    kind: str = "llff"
    test: tuple[str, ...] = ()
    every: int = 8
    # Not in the repr, of which fingerprints are made that are older than it.
    train_views: int | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"split: kind must be one of {listing(KINDS)}, got {self.kind!r}")
        if self.every < 2:
            raise ValueError(f"split: every must be at least 2, got {self.every}")
        if self.train_views is not None and (self.train_views < 1 or self.kind == "all"):
            raise ValueError(
                f"split: train_views must be at least 1 and is not for split=all, got {self.train_views} with split={self.kind}"
            )
        if bool(self.test) != (self.kind == "list"):
            raise ValueError(
                f"split: test must name views with split=list and only then, got split={self.kind} and "
                f"test={list(self.test)}"
            )

    @property
    def name(self) -> str:
        """The rule's name, which becomes part of the protocol's name: ``llff8``, or ``llff8-12`` with 12 `train_views`."""
        rule = f"llff{self.every}" if self.kind == "llff" else self.kind
        return rule if self.train_views is None else f"{rule}-{self.train_views}"

    def divide(
        self, names: Sequence[str], labelled: Collection[str]
    ) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the training and of the test views, in the order of `names`."""
        if self.kind == "llff":
            held = set(names[:: self.every])
        else:
            held = set(self.test) if self.kind == "list" else set(labelled)
        test = tuple(name for name in names if name in held)
        train = tuple(name for name in names if self.kind == "all" or name not in held)
        return _spread(train, self.train_views), test

    def faults(
        self, names: Sequence[str], labelled: Collection[str], source: str
    ) -> Iterator[Fault]:
        """What keeps the rule from being applied to these views; `source` is what the fault is reported of."""
        for name in self.test:
            if name not in names:
                near = difflib.get_close_matches(name, names, n=5, cutoff=0.4) or names[:5]
                what = f"test view must be the stem of a registered image, got {name!r}"
                yield Fault(source, what, f"near it are {listing(near)}")
        if self.kind == "holdout" and not labelled:
            yield Fault(source, "split=holdout must have labelled views to hold out, got none")
        train, _ = self.divide(names, labelled)
        if names and not train:
            what = (
                f"training views must be at least 1, got 0 of {len(names)} with split={self.name}"
            )
            yield Fault(source, what, "choose another split")


def _spread(names: tuple[str, ...], count: int | None) -> tuple[str, ...]:
    """So many of them, from the first to the last; all where there are no more."""
    if count is None or count >= len(names):
        return names
    step = (len(names) - 1) / max(1, count - 1)
    return tuple(names[round(i * step)] for i in range(count))
