"""Opens files that others have made: only regular ones, and no more of them than is allowed.

A name in a folder of a stranger may be a device without an end, or a FIFO at which a reader waits for ever.
"""

import os
import stat
from pathlib import Path
from typing import BinaryIO


def open_input(path: Path) -> BinaryIO:
    """Raises OSError, also where it is no regular file."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    file = os.fdopen(descriptor, "rb")
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        file.close()
        raise OSError(0, "not a regular file", str(path))
    return file


def read_input(path: Path, bytes_max: int) -> bytes:
    """Raises OSError, also where it is no regular file, or larger."""
    with open_input(path) as file:
        data = file.read(bytes_max + 1)
        size_bytes = max(len(data), os.fstat(file.fileno()).st_size)
    if size_bytes > bytes_max:
        raise OSError(0, f"{size_bytes} bytes, allowed are {bytes_max}", str(path))
    return data
