"""Readers for files from others. A damaged or hostile file gives one error, which says which file, where, what and what to do.

Sizes that a file declares (elements, pixels, arrays) are compared with its length before memory is allocated: a small file
needs little memory and little time. Every error is a `vlgs.data.diagnostics.SceneError`.
"""

import os
import stat
from pathlib import Path

from vlgs.data.diagnostics import Fault, SceneError

COPY_AGAIN = "the file is truncated or damaged: copy it again"


def file_size(path: Path) -> int:
    """Bytes of a regular file. A pipe or a device would be waited for without end.

    Raises:
        FileNotFoundError: If there is nothing.
        SceneError: If it is something else, or may not be looked at.
    """
    try:
        status = os.stat(path)
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:
        raise SceneError(
            Fault(str(path), f"must be a file that can be read, got {error}")
        ) from None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe or a device"
        raise SceneError(Fault(str(path), f"must be a file, got {kind}"))
    return status.st_size


def read_bytes(path: Path) -> bytes:
    """The whole content of a regular file.

    Raises:
        FileNotFoundError: If there is nothing.
        SceneError: If it is no regular file, or may not be read.
    """
    file_size(path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise SceneError(
            Fault(str(path), f"must be a file that can be read, got {error}")
        ) from None
