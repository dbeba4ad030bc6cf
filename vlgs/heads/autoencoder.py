"""LangSplat's autoencoder of one scene's embeddings, trained in seconds (Qin et al., CVPR 2024)."""

import hashlib
import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from torch import Tensor, nn
from torch.nn.functional import normalize

from vlgs.heads.fitted_weights import read_weights, write_weights
from vlgs.heads.folded import Folded, fold_linear
from vlgs.heads.spread import spread_codes
from vlgs.heads.threads import one_thread
from vlgs.values import require_range

log = logging.getLogger(__name__)

FORMAT = "vlgs-autoencoder-4"
"""Part of the cache key: a change of the code that moves the weights, or of the file, changes it."""
CHECKS = 5
"""Times that the reconstruction is measured over the last fifth of the steps; the best weights stay."""
WIDEST = 8192
"""Two layers of this width take half a gigabyte."""
MEASURED = 8192
"""Most embeddings that a measurement uses, evenly spaced among the sorted ones. Measuring all of 81 000 would take longer than the fit."""
SPREAD_WEIGHT = 0.3
"""Of squared distances from the places of `AutoencoderTraining.spread` at the first step, falling to 0 at the last."""


@dataclass(frozen=True)
class AutoencoderTraining:
    """How the autoencoder is trained: Adam on a one-cycle schedule."""

    steps: int = 600
    batch: int = 256
    learning_rate: float = 2e-3
    """At the top of the cycle."""
    area_power: float = 0.25
    """A mask is drawn in proportion to its area to this power: at 1 a thing that covers little is never seen apart
    from its neighbours, at 0 every mask counts the same as in LangSplat. At most 2: higher powers of areas overflow."""
    code_noise: float = 0.15
    """Standard deviation of the noise on the codes at the last step, rising from 0: it holds the codes of different
    things apart, because a rendered code is never quite the one that was learnt."""
    min_coverage: float = 0.5
    """Codes are shortened by a factor drawn from this to 1, as rendering does where the weights do not add up to 1."""
    seed: int = 0
    draws: int = 1
    """Fits that differ in their seed alone, of which the one that reconstructs best stays. One fit is a matter of luck: with 3 numbers for a code
    others lie 3.6 points of mIoU apart on a scene, as a standard deviation (table ``draws`` in results/synthetic)."""
    spread: int = 0
    """Clusters of embeddings whose codes are placed apart on the sphere before the fit (`vlgs.heads.spread`), which begins drawn to these places and ends free;
    0: every code finds its own place, and now and then two things share one. With 32 fits lie 1.4 points apart, and 4 points higher on average (table ``draws``)."""
    faint: float = 0.0
    """Length up to which codes decode to what all masks have in common, which fits no word well: that of a pixel of which few masks say anything, or none. At 0
    they decode to whatever lies there, now and then to one thing: a sky answered to "chrome ball". Codes of `min_coverage` and more are a thing's."""

    def __post_init__(self) -> None:
        require_range("autoencoder", 1, 1000, draws=self.draws)
        require_range("autoencoder", 0, 256, spread=self.spread)
        require_range("autoencoder", 2, 10**7, steps=self.steps)
        require_range("autoencoder", 2, 2**20, batch=self.batch)
        require_range("autoencoder", 0, 10, code_noise=self.code_noise)
        require_range("autoencoder", 0, 1, faint=self.faint)
        require_range("autoencoder", 0, 2, area_power=self.area_power)
        require_range("autoencoder", 0, 2**63 // self.draws - 1, seed=self.seed)
        if not 0.0 < self.learning_rate <= 1.0:
            raise ValueError(
                f"autoencoder: learning_rate must be above 0 and at most 1, got {self.learning_rate}"
            )
        if not 0.0 < self.min_coverage <= 1.0:
            raise ValueError(
                f"autoencoder: min_coverage must be in (0, 1], got {self.min_coverage}"
            )


DEFAULT_TRAINING = AutoencoderTraining()


class Autoencoder(nn.Module):
    """A few numbers per Gaussian in place of an embedding of hundreds.

    Encoder and decoder have LangSplat's layers, names and unit outputs. The loss is one minus the cosine of each
    embedding and its reconstruction. LangSplat's MSE + 0.001 (1 - cos) is a multiple of it between unit vectors, which
    Adam does not see; its own cosine runs over the batch instead of over the features, an oddity that is left out.

    The embedding width comes from the data, or from the state dict that is loaded. The weights are fixed once fitted,
    and batch statistics are never used outside `fit`.

    Args:
        dim: Code width d.
        encoder_widths: Hidden widths from the embedding to the code.
        decoder_widths: Hidden widths from the code to the embedding.
        center: Whether the mean embedding of the scene is subtracted before the encoder and added after the decoder.
            Embeddings of one space share a large common direction; without it the layers see what differs. False is
            LangSplat's.
        training: Schedule and weights of the fit.
        cache_dir: Folder of fitted weights by content of data and settings; None keeps nothing.
        weights: File of weights that take the place of a fit (`vlgs.formats.load_weights` reads it), such as those that
            LangSplat's codes were made with.

    Raises:
        ValueError: If a width is not positive or there is no hidden layer.
    """

    untrained: ClassVar[bool] = True
    """It is fitted before the Gaussians are trained."""
    learning_rate: float | None = None
    mean: Tensor
    fitted_reconstruction: Tensor

    def __init__(
        self,
        dim: int = 3,
        encoder_widths: Sequence[int] = (256, 128, 64, 32),
        decoder_widths: Sequence[int] = (16, 32, 64, 128, 256, 256),
        center: bool = True,
        training: AutoencoderTraining = DEFAULT_TRAINING,
        cache_dir: str | Path | None = None,
        weights: str | None = None,
    ) -> None:
        super().__init__()
        widths = (dim, *encoder_widths, *decoder_widths)
        inside = all(1 <= width <= WIDEST for width in widths)
        if not inside or not encoder_widths or not decoder_widths:
            raise ValueError(
                f"autoencoder: dim and one width or more on each side must be 1 to {WIDEST}, got "
                f"{dim}, {list(encoder_widths)}, {list(decoder_widths)}"
            )
        self.dim = dim
        self.encoder_widths = tuple(encoder_widths)
        self.decoder_widths = tuple(decoder_widths)
        self.center = center
        self.fit_settings = training
        self.weights = weights
        self.cache_dir = None if cache_dir is None else Path(cache_dir)
        self.encoder, self.decoder = nn.Sequential(), nn.Sequential()
        self.register_buffer("mean", torch.zeros(0))
        self.register_buffer("fitted_reconstruction", torch.tensor(torch.nan))
        self.register_load_state_dict_pre_hook(_build_for_state)
        self.eval()

    @property
    def reconstruction(self) -> float:
        """Mean cosine of at most `MEASURED` fitted embeddings and their reconstructions, by area; NaN before `fit`."""
        return self.fitted_reconstruction.item()

    def train(self, mode: bool = True) -> "Autoencoder":
        """Stay in evaluation mode: the codes of a scene must not depend on what else is in the batch."""
        return super().train(False)

    def fit(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> None:
        """Learn the codes of one scene, or read them from the cache; see `vlgs.heads.Head`.

        The result depends on the set of embeddings, not on their order, and the global generator is left alone.

        Raises:
            ValueError: If there are no vectors, or one is not finite, or areas are negative or all zero.
        """
        vectors, areas = _distinct(vectors.detach().float(), areas.detach().float())
        path = self._cache_path(vectors, areas)
        if path is None or not self._read_cache(path, vectors.shape[1]):
            with one_thread():
                self._fit(vectors, areas)
            if path is not None:
                write_weights(path, self.state_dict())
        self.requires_grad_(False)

    def rehearse(self, steps: int) -> None:
        """See `vlgs.heads.FittedHead`."""
        steps = min(steps, self.fit_settings.steps)
        self.fit_settings, self.cache_dir = replace(self.fit_settings, steps=steps), None

    def encode(self, vectors: Float[Tensor, "m e"]) -> Float[Tensor, "m d"]:
        """Codes of unit length.

        Raises:
            ValueError: If nothing has been fitted or loaded.
        """
        self._require_fitted()
        return normalize(self.encoder(vectors - self.mean), dim=-1)

    def targets(self, vectors: Float[Tensor, "m e"]) -> Float[Tensor, "m d"]:
        """Codes, see `encode`."""
        return self.encode(vectors)

    def predict(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d"]:
        """The codes as they are: one is compared with another."""
        return codes

    def decode(self, codes: Float[Tensor, "*b d"]) -> Float[Tensor, "*b e"]:
        """Unit embeddings of codes of any length; as in LangSplat the codes are not normalised first.

        Raises:
            ValueError: If nothing has been fitted or loaded.
        """
        self._require_fitted()
        return normalize(self.decoder(codes) + self.mean, dim=-1)

    def fold(self) -> Folded:
        """See `vlgs.heads.folded.Foldable`: the decoder without its last layer.

        Raises:
            ValueError: If nothing has been fitted or loaded.
        """
        self._require_fitted()
        *hidden, last = self.decoder
        assert isinstance(last, nn.Linear)  # `build`
        return fold_linear(last.weight, last.bias + self.mean, nn.Sequential(*hidden))

    def build(self, embedding_dim: int) -> None:
        """Lay out both networks for an embedding width; indices and shapes are those of LangSplat's checkpoints."""
        self.encoder = nn.Sequential(nn.Linear(embedding_dim, self.encoder_widths[0]))
        for before, after in pairwise((*self.encoder_widths, self.dim)):
            self.encoder.extend([nn.BatchNorm1d(before), nn.ReLU(), nn.Linear(before, after)])
        self.decoder = nn.Sequential(nn.Linear(self.dim, self.decoder_widths[0]))
        for before, after in pairwise((*self.decoder_widths, embedding_dim)):
            self.decoder.extend([nn.ReLU(), nn.Linear(before, after)])
        self.mean = torch.zeros(embedding_dim)
        self.eval()

    def _fit(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> None:
        first = self.fit_settings.seed * self.fit_settings.draws  # no two seeds share a draw
        fits = (self._draw(vectors, areas, first + i) for i in range(self.fit_settings.draws))
        _, weights = max(fits, key=lambda fit: fit[0])
        self.load_state_dict(weights)

    def _draw(
        self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"], seed: int
    ) -> tuple[float, dict[str, Tensor]]:
        """One fit: its reconstruction and its weights."""
        settings = self.fit_settings
        generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.build(vectors.shape[1])
        if self.center:
            self.mean = areas @ vectors / areas.sum()
        common = normalize(vectors.mean(dim=0), dim=0)
        places = None
        if settings.spread:
            places = spread_codes(vectors, settings.spread, self.dim, seed)
        optimizer = torch.optim.Adam(self.parameters(), lr=settings.learning_rate, fused=True)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, settings.learning_rate, total_steps=settings.steps, pct_start=0.1
        )
        draws = settings.steps * settings.batch
        rows = torch.multinomial(areas**settings.area_power, draws, True, generator=generator)
        best: tuple[float, dict[str, Tensor]] = (-torch.inf, {})
        for step, batch in enumerate(rows.split(settings.batch), start=1):
            optimizer.zero_grad()
            drawn = None if places is None else places[batch]
            loss = self._loss(vectors[batch], drawn, step / settings.steps, generator)
            if settings.faint:
                loss = loss + self._faint_loss(common, generator)
            loss.backward()
            optimizer.step()
            schedule.step()
            if step in _checked_steps(settings.steps):
                score = self._measure(vectors, areas)
                if score > best[0]:
                    best = score, {k: v.clone() for k, v in self.state_dict().items()}
        optimizer.zero_grad()  # weights that stay as they are need no room for gradients
        return best

    def _loss(
        self,
        vectors: Float[Tensor, "m e"],
        places: Float[Tensor, "m d"] | None,
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """Mean of 1 - cos over a batch whose codes are disturbed as rendering disturbs them, and what draws these to their places."""
        settings = self.fit_settings
        self.encoder.train()
        codes = self.encode(vectors)
        self.encoder.eval()
        away = 0.0 if places is None else (codes - places).square().sum(dim=-1).mean()
        noise = torch.randn(codes.shape, generator=generator)
        shortening = torch.rand(len(codes), 1, generator=generator) * (1 - settings.min_coverage)
        codes = (codes + progress * settings.code_noise * noise) * (1 - progress * shortening)
        lost = 1 - (self.decode(codes) * vectors).sum(dim=-1).mean()
        return lost + SPREAD_WEIGHT * (1 - progress) * away

    def _faint_loss(
        self, common: Float[Tensor, " e"], generator: torch.Generator
    ) -> Float[Tensor, ""]:
        """Mean of 1 - cos between what all masks have in common and what faint codes decode to."""
        settings = self.fit_settings
        towards = torch.randn(settings.batch, self.dim, generator=generator)
        lengths = settings.faint * torch.rand(settings.batch, 1, generator=generator)
        return 1 - (self.decode(lengths * normalize(towards, dim=-1)) @ common).mean()

    @torch.no_grad()
    def _measure(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> float:
        every = -(-len(vectors) // MEASURED)
        vectors, areas = vectors[::every], areas[::every]
        cosines = (self.decode(self.encode(vectors)) * vectors).sum(dim=-1)
        self.fitted_reconstruction = areas @ cosines / areas.sum()
        return self.reconstruction

    def _require_fitted(self) -> None:
        if len(self.encoder) == 0:
            raise ValueError(
                "autoencoder: fit or a state dict must come before encoding, got neither"
            )

    def _cache_path(self, vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]) -> Path | None:
        if self.cache_dir is None:
            return None
        layout = [self.dim, self.encoder_widths, self.decoder_widths, self.center]
        settings = json.dumps([FORMAT, layout, asdict(self.fit_settings), list(vectors.shape)])
        key = hashlib.blake2b(settings.encode(), digest_size=16)
        key.update(vectors.numpy().tobytes())
        key.update(areas.numpy().tobytes())
        return self.cache_dir / f"autoencoder_{key.hexdigest()}.safetensors"

    def _read_cache(self, path: Path, width: int) -> bool:
        try:
            state = read_weights(path)
            first = state.get("encoder.0.weight", torch.empty(0))
            if first.shape != (self.encoder_widths[0], width):
                raise ValueError(f"it must take vectors of {width}, got {list(first.shape)}")
            self.load_state_dict(state)
            if not all(value.isfinite().all() for value in state.values()):
                raise ValueError("weights must be finite")
        except FileNotFoundError:
            return False
        except (OSError, SafetensorError, RuntimeError, ValueError) as error:
            log.warning("autoencoder: cache %s is not usable, fitting again: %s", path, error)
            return False
        return True


def _build_for_state(module: nn.Module, state: dict[str, Tensor], prefix: str, *_: object) -> None:
    """Before a state dict is loaded: lay the networks out for the embedding width it was fitted to."""
    assert isinstance(module, Autoencoder)
    first = state.get(f"{prefix}encoder.0.weight")
    if first is not None and first.dim() == 2 and module.mean.shape[0] != first.shape[1]:
        module.build(first.shape[1])
        module.requires_grad_(False)


def _distinct(
    vectors: Float[Tensor, "m e"], areas: Float[Tensor, " m"]
) -> tuple[Float[Tensor, "k e"], Float[Tensor, " k"]]:
    """Unit rows that differ, sorted, with the areas of equal ones summed."""
    if vectors.shape[0] == 0:
        raise ValueError("autoencoder: vectors must have at least 1 row, got 0")
    bad = int((~vectors.isfinite().all(dim=1) | (vectors.norm(dim=1) < 1e-6)).sum())
    if bad:
        raise ValueError(
            f"autoencoder: vectors must be finite and not zero, got {bad} of {len(vectors)} rows that are not"
        )
    if not (areas.isfinite() & (areas >= 0)).all() or areas.sum() <= 0:
        raise ValueError(
            "autoencoder: areas must be finite, at least 0 and not all 0, got "
            f"{areas.min().item():g} to {areas.max().item():g}"
        )
    rows, group = torch.unique(vectors, dim=0, return_inverse=True)
    summed = torch.zeros(len(rows)).index_add_(0, group, areas)
    return normalize(rows, dim=-1), summed


def _checked_steps(steps: int) -> set[int]:
    first = steps - steps // 5
    return {steps - (steps - first) * check // CHECKS for check in range(CHECKS)}
