"""Language supervision of one view: exact regions, spoilt the way SAM and CLIP spoil them.

Four levels, as LangSplat numbers them: 0 default, 1 subpart, 2 part, 3 whole. Each level divides the image; at level 1 a
mask is a patch of one colour, at 2 a part, at 3 a thing (a mug with its handle, the table with its leg). Level 0 is what an
automatic segmenter returns when it is not asked for a granularity: whole things, over which about half of the parts and of
the subparts are laid.

Every mask meets at most one of three fates: it is missed, it is merged with a mask that it touches (and then both carry
the mean of their vectors by area), or it is mislabelled. Borders are displaced by a smooth random field. All draws are
functions of (seed, scene, view, level, mask), so that views err independently and a view does not depend on how many there are.

Levels of one photograph do not err independently: what a segmenter overlooks, or an encoder takes for something else, it does so at
any granularity. A part or a patch has the fate of the whole thing that it is of, at the rate `LabelNoise.shared`, and otherwise one of its own.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from vlgs.data.synthetic.language import WIDTH, mask_vector

LEVELS = (1, 2, 3)
"""Subpart, part, whole; level 0 is made of them."""
_SMALLEST = 5e-4  # share of the image below which a region gets no mask
_FIELD_CELL = 6  # pixels between the knots of the border displacement
_FATES, _NOISE, _BORDERS, _LAYING, _SHARED = range(5)  # purposes of draws
_WHOLE = 3

Describe = Callable[[str, str, int, float, np.random.Generator], Float[np.ndarray, " e"]]
"""Class, piece, level, length of noise and what draws it, to the unit vector of a mask: `vlgs.data.synthetic.language.mask_vector`."""


@dataclass(frozen=True)
class LabelNoise:
    """How often and how much supervision errs; a rate that is None is the difficulty's own (see `resolve`)."""

    missed: float | None = None
    """Share of masks that are not there."""
    merged: float | None = None
    """Share of masks that are swallowed by a neighbour, of those that have one."""
    mislabelled: float | None = None
    """Share of masks that carry the vector of another class of the scene."""
    noise: float | None = None
    """Length of the noise on a mask vector, relative to a text vector."""
    ragged: float | None = None
    """Root mean square displacement of borders, in pixels per axis."""
    shared: float | None = None
    """Share of parts and patches that are missed, merged or mislabelled as the whole thing is; 0: three levels err as three photographs would."""

    def __post_init__(self):
        rates = [r or 0.0 for r in (self.missed, self.merged, self.mislabelled)]
        if min(rates) < 0 or sum(rates) > 1:
            raise ValueError(f"LabelNoise: rates must be >= 0 with a sum <= 1, got {rates}")
        if self.shared is not None and not 0 <= self.shared <= 1:
            raise ValueError(f"LabelNoise: shared must be in [0, 1], got {self.shared}")
        for name, value in (("noise", self.noise), ("ragged", self.ragged)):
            if value is not None and not 0 <= value < 100:
                raise ValueError(f"LabelNoise: {name} must be in [0, 100), got {value}")

    def resolve(self, difficulty: str) -> "LabelNoise":
        """These faults with every None replaced by the value that belongs to ``easy`` or ``hard``."""
        own = {
            "easy": LabelNoise(0.05, 0.03, 0.05, 0.3, 1.0, 0.8),
            "hard": LabelNoise(0.10, 0.06, 0.10, 0.6, 1.6, 0.8),
        }
        filled = {
            k: v if v is not None else vars(own[difficulty])[k] for k, v in vars(self).items()
        }
        return LabelNoise(**filled)


NO_NOISE = LabelNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Exact masks with exact vectors."""


@dataclass(frozen=True)
class Region:
    """What a segmenter could find: its class and which piece of a thing it is."""

    word: str
    piece: str


@dataclass(frozen=True)
class LevelMasks:
    """Masks of one view at one level."""

    index: Int[np.ndarray, "h w"]
    """Row of `vectors` per pixel, -1 where no mask lies; int32."""
    vectors: Float[np.ndarray, "m e"]
    """Unit length; every row covers at least one pixel. float32."""


def view_masks(
    regions: Mapping[int, Int[np.ndarray, "h w"]],
    names: Mapping[int, Mapping[int, Region]],
    words: tuple[str, ...],
    faults: LabelNoise,
    key: tuple[int, ...],
    describe: Describe = mask_vector,
    width: int = WIDTH,
) -> tuple[LevelMasks, LevelMasks, LevelMasks, LevelMasks]:
    """Supervision of one view at levels 0, 1, 2 and 3; `level_masks` makes one of them alone.

    Args:
        regions: Level in 1 to 3 -> exact region number per pixel.
        names: Level -> region number -> what it is; a region without a name is never found.
        words: Classes that a mask may be mislabelled as.
        faults: Resolved rates.
        key: Seed, scene and number of the view: what the draws are functions of, besides the mask.
        describe: What gives a mask its vector.
        width: Of these.
    """
    levels = {
        level: _level_masks(
            regions[level],
            regions[_WHOLE],
            names[level],
            words,
            faults,
            (*key, level),
            describe,
            width,
        )
        for level in LEVELS
    }
    whole, part, subpart = levels[3], levels[2], levels[1]
    index, offset = whole.index, whole.vectors.shape[0]
    for level, finer in ((2, part), (1, subpart)):
        rng = np.random.default_rng([_LAYING, *key, level])
        laid = rng.random(max(finer.vectors.shape[0], 1)) < 0.5
        index = np.where((finer.index >= 0) & laid[finer.index], finer.index + offset, index)
        offset += finer.vectors.shape[0]
    rows, compact = np.unique(index, return_inverse=True)
    vectors = np.concatenate([whole.vectors, part.vectors, subpart.vectors])[rows[rows >= 0]]
    first = int(rows[0] < 0)
    default = LevelMasks((compact.reshape(index.shape) - first).astype(np.int32), vectors)
    return default, subpart, part, whole


def level_masks(
    regions: Mapping[int, Int[np.ndarray, "h w"]],
    names: Mapping[int, Mapping[int, Region]],
    words: tuple[str, ...],
    faults: LabelNoise,
    key: tuple[int, ...],
    level: int,
) -> LevelMasks:
    """Supervision of one view at one level of 0 to 3, see `view_masks`; regions of the levels 1 and 2 are needed for these and for 0 alone."""
    if level == 0:
        return view_masks(regions, names, words, faults, key)[0]
    own, wholes = regions[level], regions[_WHOLE]
    return _level_masks(own, wholes, names[level], words, faults, (*key, level), mask_vector, WIDTH)


def _level_masks(
    regions: Int[np.ndarray, "h w"],
    wholes: Int[np.ndarray, "h w"],
    names: Mapping[int, Region],
    words: tuple[str, ...],
    faults: LabelNoise,
    key: tuple[int, ...],
    describe: Describe,
    width: int,
) -> LevelMasks:
    ragged = _displace(regions, faults.ragged or 0.0, np.random.default_rng([_BORDERS, *key]))
    numbers, local = np.unique(ragged, return_inverse=True)
    local = local.reshape(ragged.shape)
    areas = np.bincount(local.ravel(), minlength=numbers.size)
    present = areas >= _SMALLEST * ragged.size

    draws = _draws(numbers, _owners(regions, wholes), faults.shared or 0.0, key)
    bounds = np.cumsum([faults.missed or 0.0, faults.merged or 0.0, faults.mislabelled or 0.0])
    fate = np.searchsorted(
        bounds, draws[:, 0], side="right"
    )  # 0 missed, 1 merged, 2 mislabelled, 3 sound
    present &= fate != 0
    present &= np.array(
        [int(n) in names for n in numbers]
    )  # others are nothing that could be found
    group = _merge(local, present, fate == 1, draws[:, 1])

    vectors = np.zeros((numbers.size, width))
    for i in np.flatnonzero(present):
        region = names[int(numbers[i])]
        others = [w for w in words if w != region.word]
        word = others[int(draws[i, 2] * len(others))] if fate[i] == 2 and others else region.word
        rng = np.random.default_rng([_NOISE, *key, int(numbers[i])])
        vector = describe(word, region.piece, key[-1], faults.noise or 0.0, rng)
        vectors[group[i]] += areas[i] * vector
    masks = np.unique(group[present])
    rows = np.full(numbers.size, -1, np.int32)
    rows[present] = np.searchsorted(masks, group[present])
    kept = vectors[masks]
    kept /= np.maximum(np.linalg.norm(kept, axis=1, keepdims=True), 1e-12)
    return LevelMasks(rows[local], kept.astype(np.float32))


def _owners(regions: Int[np.ndarray, "h w"], wholes: Int[np.ndarray, "h w"]) -> Mapping[int, int]:
    """Region -> the whole thing that it is of. Regions lie inside of things, so that any pixel tells."""
    numbers, first = np.unique(regions, return_index=True)
    return dict(zip(numbers.tolist(), wholes.ravel()[first].tolist(), strict=True))


def _draws(
    numbers: Int[np.ndarray, " r"], owners: Mapping[int, int], shared: float, key: tuple[int, ...]
) -> Float[np.ndarray, "r 3"]:
    """What decides the fate of each region: numbers of its own, or those of the thing that it is of."""
    *place, level = key
    rows = []
    for number in numbers.tolist():
        own = np.random.default_rng([_SHARED, *key, number]).random() >= shared
        decided = (level, number) if own or level == _WHOLE else (_WHOLE, owners[number])
        rows.append(np.random.default_rng([_FATES, *place, *decided]).random(3))
    return np.stack(rows)


def _merge(
    local: Int[np.ndarray, "h w"],
    present: np.ndarray,
    merged: np.ndarray,
    draws: Float[np.ndarray, " r"],
) -> Int[np.ndarray, " r"]:
    """Representative of the group of every region, after each `merged` one has joined a present neighbour."""
    beside = np.zeros((present.size, present.size), bool)
    for one, other in ((local[1:], local[:-1]), (local[:, 1:], local[:, :-1])):
        beside[one, other] = True
    beside = (beside | beside.T) & present
    np.fill_diagonal(beside, False)
    group = np.arange(present.size)
    for i in np.flatnonzero(merged & present & beside.any(1)):
        neighbours = np.flatnonzero(beside[i])
        chosen = neighbours[int(draws[i] * neighbours.size)]
        group[group == group[i]] = group[chosen]
    return group


def _displace(
    regions: Int[np.ndarray, "h w"], amount: float, rng: np.random.Generator
) -> Int[np.ndarray, "h w"]:
    """Look every pixel up a little beside itself: borders fray, nothing overlaps, nothing is left open."""
    height, width = regions.shape
    rows, columns = _weights(height), _weights(width)
    knots = amount * rng.normal(size=(2, rows.shape[1], columns.shape[1]))
    dy, dx = np.einsum("hk,akw->ahw", rows, np.einsum("akl,wl->akw", knots, columns))
    y = np.clip(np.round(np.arange(height)[:, None] + dy), 0, height - 1).astype(np.intp)
    x = np.clip(np.round(np.arange(width) + dx), 0, width - 1).astype(np.intp)
    return regions[y, x]


def _weights(size: int) -> Float[np.ndarray, "size knots"]:
    """Interpolation between knots of unit variance such that the variance is one everywhere, not only at the knots."""
    knot, rest = np.divmod(np.arange(size), _FIELD_CELL)
    weights = np.zeros((size, size // _FIELD_CELL + 2))
    weights[np.arange(size), knot] = np.cos(np.pi / 2 * rest / _FIELD_CELL)
    weights[np.arange(size), knot + 1] = np.sin(np.pi / 2 * rest / _FIELD_CELL)
    return weights
