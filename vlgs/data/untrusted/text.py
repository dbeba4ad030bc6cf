"""Text and JSON from others."""

import json
import re
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

from vlgs.data.diagnostics import Fault, SceneError
from vlgs.data.untrusted import COPY_AGAIN, read_bytes

_SURROGATE = re.compile(r"\\u[dD][89abAB]|\\u[dD][c-fC-F]")


def read_text(path: Path) -> str:
    """UTF-8 text, with or without a byte order mark.

    Raises:
        FileNotFoundError: If there is no such file.
        SceneError: If it is not UTF-8; names the byte.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        what = f"content must be UTF-8 text, got {error.object[error.start : error.start + 8]!r}"
        raise SceneError(
            Fault(str(path), what, "save it as UTF-8", f"byte {error.start}")
        ) from None


def read_json(path: Path, expected: str) -> Any:
    """The value of a JSON file.

    Args:
        path: The file.
        expected: What it should hold, for the error.

    Raises:
        FileNotFoundError: If there is no such file.
        SceneError: If it is not JSON, is nested too deeply, has a key twice in one place, or a text in it is no Unicode; names the line
            or the key.
    """
    text = read_text(path)
    try:
        content = json.loads(text, object_pairs_hook=partial(_mapping, path))
        if _SURROGATE.search(text):  # half of a pair cannot be printed or written
            json.dumps(content, ensure_ascii=False).encode()
    except RecursionError:
        raise SceneError(
            Fault(str(path), f"content must be {expected}, got lists within lists without end")
        ) from None
    except SceneError:
        raise
    except ValueError as error:
        what = f"content must be {expected}, got {type(error).__name__}: {error}"
        raise SceneError(Fault(str(path), what[:400], COPY_AGAIN)) from None
    return content


def _mapping(path: Path, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A mapping of JSON; Python's own reader would keep the last of the values that have one key.

    Raises:
        SceneError: If there are such.
    """
    content = dict(pairs)
    if len(content) < len(pairs):
        key, count = Counter(key for key, _ in pairs).most_common(1)[0]
        what = f"content must have every key once, got {key[:80]!r} {count} times"
        raise SceneError(Fault(str(path), what))
    return content
