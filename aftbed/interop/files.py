"""Files that exist completely or not at all."""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from aftbed.core.errors import ConfigError

Answer = TypeVar("Answer")


def write_whole(sink: Path, write: Callable[[Path], Answer]) -> Answer:
    """Call `write` with the path of a temporary file beside `sink`, then rename that file to `sink`.

    Returns what `write` returns. An error leaves `sink` as it was; an OSError is raised as ConfigError.
    """
    beside = sink.with_name(f".{sink.name}.{os.getpid()}.part")
    try:
        found = write(beside)
        beside.replace(sink)
    except OSError as error:
        raise ConfigError(f"{sink}: cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
    return found
