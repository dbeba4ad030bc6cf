"""What is taken from the viewer: the Gaussians that answer a word, and the first picture without a browser."""

from vlgs.fields import NO_GAUSSIANS
from vlgs.gaussians.ply import encode_ply
from vlgs.opened.answers import select_gaussians
from vlgs.view.eye import eye_of
from vlgs.view.paint import Picture
from vlgs.view.session import Session
from vlgs.view.shown import Shown
from vlgs.view.wish import Wish

_SIZE = (960, 540)
"""Of a picture without a browser."""


def answering_ply(shown: Shown, wish: Wish) -> tuple[bytes, int]:
    """A PLY file of the Gaussians that answer a wish's word above its threshold, and how many they are.

    Raises:
        ValueError: If there is no word, no Gaussians, or none that answers.
    """
    if wish.word not in shown.asked:
        raise ValueError("view: a word must be asked before its Gaussians are saved, got none")
    if shown.gaussians is None:
        raise ValueError(f"view: what is saved must be Gaussians: {NO_GAUSSIANS}")
    level = shown.place(wish.level)
    threshold = shown.range(wish.word, level).threshold(wish.share)
    field, asked = shown.run.field, shown.asked[wish.word]
    own, chosen = select_gaussians(field, asked, 0, threshold, level)
    if not chosen.any():
        raise ValueError(
            f"view: a Gaussian must answer {wish.word!r}, got none above a relevancy of {threshold:.3f}; a lower threshold chooses more"
        )
    cloud = own.point_cloud([one.camera for one in shown.run.cameras("train")])
    params = {name: value[chosen] for name, value in cloud.params.items()}
    return encode_ply(params, notes=cloud.notes), int(chosen.sum())


def first_picture(runs: list[Shown], word: str | None) -> Picture:
    """What a browser sees first, of two runs divided in the middle; `word` was learnt by all of them.

    Raises:
        ValueError: If it cannot be drawn.
    """
    eye = eye_of(runs[0].run.held_out()[0].camera, *_SIZE)
    layout = "one" if len(runs) == 1 else "divided"
    wish = Wish(eye, layout=layout)
    if word is not None:
        wish = Wish(eye, "relevancy", word, layout=layout)
    return Session(runs, lambda _: None, lambda _: None).full(wish)
