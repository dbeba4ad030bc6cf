r"""Escapes text from others (names of classes, scenes and machines, labels, captions), so that no reader takes it for commands.

There is one function for each kind of output: terminal, spreadsheet, LaTeX, Markdown, plot. Ordinary text stays unchanged. Imports no
torch.
"""

import logging
import re
import unicodedata
from collections.abc import Iterable

_HIDDEN = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Unicode categories of control characters, turners of the reading direction, halves of characters and line breaks."""

_HARMLESS = frozenset("\u00ad\u200c\u200d")
"""Of these only the soft hyphen and the (non-)joiners, which words of some scripts are spelled with."""


def visible(text: str) -> str:
    r"""One line without characters that act instead of being shown: each is written as Python spells it.

    Example:
        >>> visible("cup\n\x1b[31mred")
        'cup\\n\\x1b[31mred'
    """
    if text.isprintable():
        return text
    return "".join(
        char.encode("unicode_escape").decode()
        if unicodedata.category(char) in _HIDDEN and char not in _HARMLESS
        else char
        for char in text
    )


def to_bytes(text: str) -> bytes:
    """UTF-8; halves of characters, which it cannot write, are spelled out."""
    return text.encode("utf-8", "backslashreplace")


def screen(text: str) -> str:
    """Lines for a terminal: line breaks stay, every other character that acts is made visible."""
    return "\n".join(map(visible, text.split("\n")))


class ScreenFormatter(logging.Formatter):
    """Log lines for a terminal."""

    def __init__(self, format: str = "%(message)s") -> None:
        super().__init__(format)

    def format(self, record: logging.LogRecord) -> str:
        """The message as `screen` shows it."""
        return screen(super().format(record))


_FORMULA = re.compile("'*[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
"""Starts of cells that a spreadsheet computes, or would once a leading quote is taken for its mark of text."""

_QUOTED = re.compile('[",#\r\n]|^\\s|\\s$')


def csv_line(cells: Iterable[str | int | float | None], digits: int | None = None) -> str:
    """Cells of a row, without the line break; text that a spreadsheet would compute begins with a quote, numbers stay numbers.

    `csv_text` takes the quote off again. Cells with a ``#`` are in quotation marks, so that readers of comments leave them whole.

    Args:
        cells: Text, or numbers, of which None and NaN leave a cell empty.
        digits: Of floats after the point; all of them without it.

    Example:
        >>> print(csv_line(["=1+1", -1.5, "a, b", None]))
        '=1+1,-1.5,"a, b",
    """
    return ",".join(csv_cell(cell, digits) for cell in cells)


def csv_cell(value: str | int | float | None, digits: int | None = None) -> str:
    """One cell of `csv_line`."""
    if not isinstance(value, str):
        if value is None or value != value:
            return ""
        return str(value) if digits is None or isinstance(value, int) else f"{value:.{digits}f}"
    text = f"'{value}" if _FORMULA.match(value) else value
    return '"' + text.replace('"', '""') + '"' if _QUOTED.search(text) else text


def csv_text(cell: str) -> str:
    """The text that `csv_line` was given, from what a reader of csv makes of its cell."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
}


def latex(text: str) -> str:
    r"""Plain text for LaTeX.

    Example:
        >>> latex("50% of sake_cup +- 1")
        '50\\% of sake\\_cup $\\pm$ 1'
    """
    return "".join(_LATEX.get(c, c) for c in visible(text)).replace("+-", r"$\pm$")


_MARKDOWN = re.compile(
    r"[\\|`*$~]"  # code, emphasis, cells, mathematics, wherever they stand
    r"|(?<![^\W_])_|_(?![^\W_])"  # emphasis, but not within a word
    r"|(?<=\])[(\[:]|\]$"  # what makes a link of brackets
    r"|^\s*[#+=-](?=\s|$)|^(?<=\d)[.)]"  # headings and lists
)
_HTML = {"<": "&lt;", ">": "&gt;"}


def markdown(text: str) -> str:
    r"""Plain text for a paragraph, a list item or a cell of Markdown, where HTML counts too.

    Example:
        >>> print(markdown("a|b <script> sake_cup [x](y)"))
        a\|b &lt;script&gt; sake_cup [x]\(y)
    """
    text = re.sub(r"&(?=#|\w+;)", "&amp;", visible(text))
    text = _MARKDOWN.sub(lambda match: match[0][:-1] + "\\" + match[0][-1], text)
    return re.sub("[<>]", lambda match: _HTML[match[0]], text)


def plot(text: str) -> str:
    """Plain text for matplotlib, which would set what stands between dollars as mathematics and hide a label that begins with _."""
    text = visible(text).replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text
