"""Conversion of a log: which formats there are, and a file that is there whole or not at all.

A format is known by the ending of the file, or said. The output is written beside its place under another
name and put there at the end, so that an error leaves what was there before.
"""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, TypeVar

import msgspec

from aftbed.core.errors import ConfigError, unknown
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.python_can import lean
from aftbed.vehicle.logs import blffile, candumpfile, mf4file, signals, textfiles
from aftbed.vehicle.logs.frames import Log, without
from aftbed.vehicle.replay.map_file import find_dbc

Answer = TypeVar("Answer")
CSV: Final = "csv"
ENDINGS: Final = {
    ".log": "candump",
    ".candump": "candump",
    ".asc": "asc",
    ".blf": "blf",
    ".trc": "trc",
    ".mf4": "mf4",
    ".csv": CSV,
}
READERS: Final[dict[str, Callable[[Path], Log]]] = {
    "candump": candumpfile.read,
    "asc": textfiles.read_asc,
    "blf": blffile.read,
    "trc": textfiles.read_trc,
    "mf4": mf4file.read,
}
WRITERS: Final[dict[str, Callable[[Log, Path], None]]] = {
    "candump": candumpfile.write,
    "asc": textfiles.write_asc,
    "blf": blffile.write,
    "trc": textfiles.write_trc,
    "mf4": mf4file.write,
}


class Converted(msgspec.Struct, frozen=True):
    """`frames` were written, from one format to the other; `left_out` were not, by reason."""

    source: str
    sink: str
    frames: int
    left_out: dict[str, int]


def format_of(path: Path, said: str | None, option: str, allowed: tuple[str, ...]) -> str:
    """The format `said`, or that of the ending of `path`. Raises ConfigError with all there are."""
    if said is not None:
        if said not in allowed:
            raise unknown(f"format of {option}", said, allowed)
        return said
    found = ENDINGS.get(path.suffix.lower())
    if found not in allowed:
        ending = f"the ending {path.suffix!r}" if path.suffix else "a name without an ending"
        raise ConfigError(
            f"{path}: {ending} says no format; {option} does (one of: {', '.join(sorted(allowed))})"
        )
    return found


def convert(
    source: Path,
    sink: Path,
    from_format: str | None = None,
    to_format: str | None = None,
    dbc: Path | None = None,
) -> Converted:
    """Write the log `source` to `sink`. Raises ConfigError; then `sink` is as it was."""
    read_as = format_of(source, from_format, "--from", tuple(READERS))
    write_as = format_of(sink, to_format, "--to", (*WRITERS, CSV))
    if dbc is not None and write_as != CSV:
        raise ConfigError(
            f"--dbc says what is in the frames, which only {CSV} asks: {write_as} keeps them as they are"
        )
    if sink.exists() and source.exists() and sink.samefile(source):
        raise ConfigError(f"{sink}: would be written over itself")
    lean()
    codec = _codec(dbc) if write_as == CSV else None
    log = READERS[read_as](source)
    if not log.frames:
        counted = "; ".join(f"{count} times {reason}" for reason, count in log.left_out.items())
        raise ConfigError(
            f"{source}: no frame in it, read as {read_as}" + (f" ({counted})" if counted else "")
        )
    if codec is not None:
        kept = written(sink, lambda path: signals.write(log, codec, path))
    else:
        kept = without(log, *textfiles.TRC_LACKS) if write_as == "trc" else log
        written(sink, lambda path: WRITERS[write_as](kept, path))
    return Converted(read_as, write_as, len(kept.frames), kept.left_out)


def _codec(dbc: Path | None) -> Codec:
    """A DBC that contradicts itself will do: what lies in its messages is decoded."""
    return load_dbc() if dbc is None else load_dbc(find_dbc(str(dbc)), strict=False)


def written(sink: Path, write: Callable[[Path], Answer]) -> Answer:
    """What `write` answers, which gets the path of another file that becomes `sink` when all is well."""
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
