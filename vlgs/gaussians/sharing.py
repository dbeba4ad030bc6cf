"""What colour and language have in common (Table 17; conf/README.md, D.16). Mirrored by conf/sharing."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Sharing:
    """Whether the two modalities share centres and covariances; opacities are `vlgs.indicator`'s matter.

    Raises:
        ValueError: If covariances are shared by Gaussians that are not, or lifted language should have its own.
    """

    means: bool = True
    """Off: two sets of Gaussians, one for colour and one for language, each trained by its own losses."""
    covariances: bool = True
    """Off: a second rotation and scale per Gaussian, with which language is blended."""
    lifted: bool = False
    """On: language is not trained, but lifted onto what colour alone has learned (`vlgs.module.lift`)."""

    def __post_init__(self) -> None:
        if self.covariances and not self.means:
            raise ValueError("sharing: covariances must be false where means is false, got true")
        if self.lifted and not self.covariances:
            raise ValueError("sharing: covariances must be true where lifted is true, got false")
