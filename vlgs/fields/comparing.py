"""Three ways from rendered codes to the cosines of their embeddings with words: decoded, folded, and looked up in a table.

Decoding is what scores are made of. Folding leaves the last step of the head out and differs from it by rounding. For codes of three numbers a table
holds the cosines on a grid over code space. Its error is measured in every cell while it is filled, and it is used where that is within a bound.
"""

import logging
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vlgs.fields.similarity import SMALLEST_NORM, decoded_cosines, require_one_space, unit_words
from vlgs.heads import Head, lengths_count
from vlgs.heads.folded import Foldable, Folded
from vlgs.ops.code_table import LANES, Looked, code_table
from vlgs.values import require_range

log = logging.getLogger(__name__)

CELLS = (1 / 8, 1 / 16, 1 / 32, 1 / 64)
"""Widths of a table's cells, which are tried in turn."""
REACH = 1.5
"""On each axis a table reaches from minus to plus this. Codes are learned at unit length; what training makes longer than a table reaches is folded."""
_CHUNK = 2048
"""Codes that are folded at once: 2 MB of a hidden layer of 256."""
_NODES = 3
"""Most new nodes for each code that lacks one: where it needs more, folding is less work."""
_WORDS = 64
"""Most words of a table; more are folded."""
_TABLES = 4
"""Tables that are kept, each of other words."""


@runtime_checkable
class Comparing(Protocol):
    """The interface of a way to compare."""

    def __call__(
        self, codes: Float[Tensor, "h w d"], words: Float[Tensor, "k e"]
    ) -> Float[Tensor, "k h w"]:
        """Cosine of every word with the embedding of every code."""
        ...


class Decoding:
    """Embeddings are made, and compared.

    Args:
        head: Makes them.
    """

    def __init__(self, head: Head) -> None:
        self.head = head

    def __call__(
        self, codes: Float[Tensor, "h w d"], words: Float[Tensor, "k e"]
    ) -> Float[Tensor, "k h w"]:
        """See `Comparing`."""
        return decoded_cosines(
            self.head.decode, codes, words, least=_least(lengths_count(self.head))
        )


class Folding:
    """Words are compared with coordinates in the space of the embeddings (`vlgs.heads.folded`); the same but for rounding.

    Args:
        folded: A head without its last step.
    """

    def __init__(self, folded: Folded) -> None:
        self.folded = folded

    def __call__(
        self, codes: Float[Tensor, "h w d"], words: Float[Tensor, "k e"]
    ) -> Float[Tensor, "k h w"]:
        """See `Comparing`."""
        return self.flat(codes.flatten(0, 1), words).unflatten(1, codes.shape[:2])

    @torch.no_grad()
    def flat(
        self, codes: Float[Tensor, "p d"], words: Float[Tensor, "k e"]
    ) -> Float[Tensor, "k p"]:
        """Likewise, of codes in a row.

        Raises:
            ValueError: If words are not as wide as the embeddings.
        """
        basis = self.folded.basis
        require_one_space(len(basis), words.shape[-1])
        asked = unit_words(words.to(codes.dtype)) @ basis
        least = _least(self.folded.lengths_count)
        out = codes.new_empty(len(words), len(codes))
        for start in range(0, len(codes), _CHUNK):
            made = self.folded.coordinates(codes[start : start + _CHUNK])
            lengths = torch.linalg.vector_norm(made, dim=-1).clamp_min(least)
            torch.div(asked @ made.T, lengths, out=out[:, start : start + _CHUNK])
        return out


def _least(lengths_count: bool) -> float:
    """By what products with shorter embeddings are divided."""
    return 1.0 if lengths_count else SMALLEST_NORM


@dataclass
class CodeTable:
    """Cosines of some words on a grid over codes of three numbers, filled where codes come.

    A node costs as much as folding one code. Between nodes cosines are linear along each axis.
    """

    cell: float
    """Width of a cell; `REACH` is a multiple."""
    words: Float[Tensor, "k e"]
    error: float = 0.0
    """The largest in the middle of a filled cell. Between nodes it is about the largest there is: on trained scenes 0.6 to 1.25 times the largest of all pixels."""
    places: Int[Tensor, "side side side"] = field(init=False)
    """Row of each node; -1 where it is not filled."""
    rows: Float[Tensor, "m padded"] = field(init=False)

    def __post_init__(self) -> None:
        side = round(2 * REACH / self.cell) + 1
        self.places = torch.full((side, side, side), -1, dtype=torch.int32)
        self.rows = torch.empty(0, -(-len(self.words) // LANES) * LANES)

    @property
    def nbytes(self) -> int:
        """Bytes that it takes."""
        return self.places.nbytes + self.rows.nbytes

    def fill(self, codes: Float[Tensor, "p 3"], folding: Folding, most: int) -> bool:
        """Have all nodes that codes need, and measure the error in the middle of their cells.

        Args:
            codes: Those outside of the table need nothing.
            folding: Makes the cosines.
            most: New nodes; if more are needed, nothing is done and the answer is False.
        """
        inside = codes[((codes >= -REACH) & (codes < REACH)).all(dim=1)]
        first, new = self._cells_and_new_nodes(inside)
        if len(new) > most:
            return False
        made = self.rows.new_zeros(len(new), self.rows.shape[1])
        made[:, : len(self.words)] = folding.flat(self._codes(new), self.words).T
        self.places.view(-1)[new] = torch.arange(len(new), dtype=torch.int32) + len(self.rows)
        self.rows = torch.cat([self.rows, made])
        if len(first):
            middles = self._codes(first) + self.cell / 2
            off = self.look_up(middles).answers - folding.flat(middles, self.words)
            self.error = max(self.error, float(off.abs().max()))
        return True

    def look_up(self, codes: Float[Tensor, "p 3"]) -> Looked:
        """What it says of codes; see `vlgs.ops.code_table.code_table`."""
        return code_table(codes, REACH, self.places, self.rows, len(self.words))

    def _cells_and_new_nodes(
        self, codes: Float[Tensor, "p 3"]
    ) -> tuple[Int[Tensor, " c"], Int[Tensor, " n"]]:
        """The first corners of the codes' cells, and the corners that are not filled, as places in the cube row by row."""
        side = len(self.places)
        cells = ((codes + REACH) / self.cell).long()
        first = ((cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2]).unique()
        steps = [(x * side + y) * side + z for x in (0, 1) for y in (0, 1) for z in (0, 1)]
        nodes = (first[:, None] + torch.tensor(steps)).unique()
        return first, nodes[self.places.view(-1)[nodes] < 0]

    def _codes(self, nodes: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        side = len(self.places)
        at = torch.stack([nodes // side**2, nodes // side % side, nodes % side], dim=1)
        return at * self.cell - REACH


class Tabulating:
    """Codes of three numbers are looked up in a table of the words; what it does not have is folded.

    Cells are made narrower until the error that is measured is within the bound. Where the narrowest are too wide, the words are folded.

    Args:
        folding: What fills tables.
        within: The largest error of a cosine, measured in the middle of every cell that is used.
        cells: Widths of cells that may be used, the widest first.

    Raises:
        ValueError: If the bound is not positive.
    """

    def __init__(self, folding: Folding, within: float, cells: tuple[float, ...] = CELLS) -> None:
        require_range("code table", 1e-9, 2, within=within)
        self.folding = folding
        self.within = within
        self.cells = list(cells)
        self.tables: OrderedDict[bytes, CodeTable] = OrderedDict()

    def __call__(
        self, codes: Float[Tensor, "h w d"], words: Float[Tensor, "k e"]
    ) -> Float[Tensor, "k h w"]:
        """See `Comparing`."""
        flat = codes.reshape(-1, codes.shape[-1])
        return self._answer(flat, words).unflatten(1, codes.shape[:2])

    @torch.no_grad()
    def _answer(
        self, codes: Float[Tensor, "p 3"], words: Float[Tensor, "k e"]
    ) -> Float[Tensor, "k p"]:
        while self.cells and 0 < len(words) <= _WORDS and codes.dtype == torch.float32:
            table = self._table(words)
            answers, lacking = table.look_up(codes)
            if not lacking:
                return answers
            at = answers[0].isnan().nonzero()[:, 0]
            rest = codes[at]
            filled = table.fill(rest, self.folding, _NODES * len(rest))
            if table.error > self.within:
                self._narrow(table)
                continue
            if filled:
                answers[:, at] = table.look_up(rest).answers
                at = answers[0].isnan().nonzero()[:, 0]  # outside
            answers[:, at] = self.folding.flat(codes[at], words)
            return answers
        return self.folding.flat(codes, words)

    def _table(self, words: Float[Tensor, "k e"]) -> CodeTable:
        key = words.numpy().tobytes()
        if key not in self.tables:
            self.tables[key] = CodeTable(self.cells[0], words)
            if len(self.tables) > _TABLES:
                self.tables.popitem(last=False)
        self.tables.move_to_end(key)
        return self.tables[key]

    def _narrow(self, table: CodeTable) -> None:
        """Go on without cells as wide as a table's, which was found too wide."""
        log.info("cells of %g are off by %.2g, above %g", table.cell, table.error, self.within)
        self.cells = [cell for cell in self.cells if cell < table.cell]
        self.tables.clear()


def comparing(head: Head, within: float) -> Comparing:
    """The way with the least work whose cosines are off by a bound at most.

    Args:
        head: Its training is over.
        within: See `Tabulating`; 0: by rounding alone.
    """
    if not isinstance(head, Foldable):
        return Decoding(head)
    folding = Folding(head.fold())
    return Tabulating(folding, within) if within > 0 and head.dim == 3 else folding
