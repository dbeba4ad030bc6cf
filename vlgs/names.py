"""Safe file names for names from others, such as those of classes, views and scenes. Imports no torch."""

import hashlib
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable

LONGEST = 100
"""Longest name in bytes. File systems allow 255, and prefix and suffix are added to the name."""

_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names that are devices on Windows, whatever comes after a dot."""


def file_names(texts: Iterable[str]) -> dict[str, str]:
    """A name on disk for each text, as much like it as every file system allows.

    Whatever is no letter, digit, dot or dash becomes ``_``. Texts that would share a name, also where capitals or ways to write an
    accent count for nothing, that are too long, or that a system keeps for itself, are cut and carry a hash of the text.

    Args:
        texts: Whose files lie in one folder.

    Example:
        >>> file_names(["sake cup", "a/b", "a b"])
        {'sake cup': 'sake_cup', 'a/b': 'a_b-295d2248', 'a b': 'a_b-9ef6bacd'}
    """
    plain = {text: re.sub(r"[^\w.-]+", "_", text).strip(".") or "_" for text in texts}
    claims = Counter(map(_same, plain.values()))
    names = {
        text: name
        for text, name in plain.items()
        if claims[_same(name)] == 1
        and len(name.encode()) <= LONGEST
        and not _RESERVED.fullmatch(name)
    }
    taken = set(map(_same, names.values()))
    for text, name in plain.items():
        if text not in names:
            names[text] = _hashed(text, name, taken)
            taken.add(_same(names[text]))
    return {text: names[text] for text in plain}


def _hashed(text: str, name: str, taken: set[str]) -> str:
    """A name that no other text has, one that was made up to look like this one included."""
    digest = hashlib.blake2b(text.encode("utf-8", "surrogatepass"))
    start = name.encode()[: LONGEST - 20].decode(errors="ignore").replace(".", "_")
    while True:
        found = f"{start}-{digest.hexdigest()[:8]}"
        if _same(found) not in taken:
            return found
        digest.update(b"again")


def _same(name: str) -> str:
    """A key that is equal for names which some file system takes for the same."""
    return unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold())
