"""What a browser asks to see."""

from dataclasses import dataclass
from typing import Literal, get_args

from vlgs.opened.answers import SHARE
from vlgs.view.eye import Eye

Output = Literal[
    "render", "depth", "language", "indicator - opacity", "relevancy", "mask"
]  # in the order of the list on the screen
OUTPUTS: tuple[Output, ...] = get_args(Output)
ASKING: tuple[Output, ...] = ("relevancy", "mask")
"""What shows the answer to a word."""

Layout = Literal["one", "divided", "beside"]
LAYOUTS: tuple[Layout, ...] = get_args(Layout)


@dataclass(frozen=True)
class Wish:
    """All that decides a picture, apart from the runs themselves."""

    eye: Eye
    output: Output = "render"
    word: str = ""
    """What is asked for; empty: nothing."""
    level: int | None = None
    """Mask level that answers, as the data number them; None: the one with the best score."""
    share: float = SHARE
    """How far up in a word's range of relevancy the mask begins."""
    opacity: float = 0.65
    """Of what is painted over the picture."""
    layout: Layout = "one"
    """Of two runs: the first alone, one picture divided, or two pictures beside each other."""
    division: float = 0.5
    """Where a divided picture goes over from one run to the other, as a share of its width."""
