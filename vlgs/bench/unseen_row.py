"""One line of unseen.csv."""

from dataclasses import dataclass


@dataclass(frozen=True)
class UnseenRow:
    """One line of unseen.csv: one training."""

    scene: str
    split: str
    """``20 views``, or of photographs ``every 8th`` or ``a tenth``: what was held out."""
    recipe: str
    seed: int
    run: str
    """Its id: a row that has it is not trained again."""
    results_version: int
    commit: str | None
    psnr: float
    """dB, mean over the held-out views."""
    worst: float
    """dB, of the worst held-out view."""
    worst_view: str
    ssim: float
    miou: float | None
    """Headline: the argmax over the classes, where every pixel has one."""
    miou_lerf_ovs: float | None
    """Words against the whole picture, skies included."""
    lonely: float
    """Share of the held-out pixels that are covered by Gaussians that fewer than two training views see (`share_lonely`)."""
    gaussians: int
    cpu_seconds: float
    """Of the training, over all threads."""
    unshown: float | None = None
    """Share of the held-out pixels whose surface no training photograph shows (`shown_pixels`); None of photographs of real scenes."""
    psnr_shown: float | None = None
    """As `psnr`, over the other pixels."""
    worst_shown: float | None = None
    """As `worst`, over the other pixels."""
