"""Files that exist completely or not at all."""

from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

from aftbed.core.errors import ConfigError
from aftbed.runtime.unix.interrupts import scratch_directory

NAME_SHOWN_MAX: Final = 60  # characters, in the name of the directory

Answer = TypeVar("Answer")


def write_whole(sink: Path, write: Callable[[Path], Answer]) -> Answer:
    """Call `write` with the path of a file in a new directory beside `sink`, then rename it to `sink`.

    Returns what `write` returns. A link at `sink` is replaced, not followed. An error leaves `sink` as it
    was. An OSError is raised as ConfigError.
    """
    try:
        with scratch_directory(f".{sink.name[:NAME_SHOWN_MAX]}.", sink.parent) as folder:
            beside = folder / sink.name  # a directory of this user alone: no one has put a link there
            found = write(beside)
            beside.replace(sink)
    except OSError as error:
        raise ConfigError(f"{sink}: cannot be written: {error.strerror or error}") from None
    return found


def write_text_whole(sink: Path, text: str) -> None:
    """Write `text` to `sink`, in UTF-8, as `write_whole` does."""
    data = text.encode()
    write_whole(sink, lambda path: path.write_bytes(data))
