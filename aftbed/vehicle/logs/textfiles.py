"""ASC (Vector) and TRC (PEAK): the text formats, read and written by python-can, its quirks put right.

ASC. Its header says "timestamps absolute", and its times count from the begin of the trigger block, whose
date is in local time without a zone, in milliseconds that python-can writes without their zeros: `.005`
becomes `.5`. So a log is made to begin at a whole second. A date that cannot be read (there are languages),
or none, or one before 1990, makes a log that counts from its start. In "timestamps relative" each time
counts from the one before, whatever that was; python-can reads them as absolute, so such a file is refused.

TRC. Version 2.1 is written, 1.0 to 2.1 are read. The writer adds one to a channel, as all do, but the reader
does not take it off. It has no error frames, and python-can does not write remote frames: both are left out.

Whatever is not a frame (comments, statistics, status lines) is not counted: a text has too much of it.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from aftbed.core.errors import ConfigError
from aftbed.vehicle.can.python_can import lean
from aftbed.vehicle.logs.frames import DATED_US_MIN, Kind, Log, content, numbers, origin_us, without
from aftbed.vehicle.logs.messages import Memory, message_of, taken

if TYPE_CHECKING:
    from can import ASCReader, Message

TRC_LACKS: Final = (Kind.REMOTE, Kind.ERROR)
NO_DATE: Final = "Incompatible datetime string"  # so says python-can
_DATED_S_MIN: Final = DATED_US_MIN / 1e6


class _Lines(io.StringIO):
    """A text that knows which line was read last."""

    number = 0

    def __next__(self) -> str:  # type: ignore[override]  # a text yields text
        line = super().__next__()
        self.number += 1
        return line

    def where(self) -> str:
        return f"line {self.number}"


def _text(path: Path) -> str:
    return content(path).decode("latin-1")  # any bytes are a text then; what matters is ASCII


def read_asc(path: Path) -> Log:
    """The log at `path`. Raises ConfigError naming file and line."""
    text = _text(path)
    try:
        return _read_asc(path, text, dated=True)
    except ConfigError as error:
        if NO_DATE not in str(error):
            raise
    return _read_asc(path, text, dated=False)


def _read_asc(path: Path, text: str, *, dated: bool) -> Log:
    lean()
    from can import ASCReader  # noqa: PLC0415 - slow to import

    lines = _Lines(text)
    reader = ASCReader(lines, relative_timestamp=not dated)
    return taken(path, _asc_messages(path, reader), lines.where)


def _asc_messages(path: Path, reader: "ASCReader") -> Iterator["Message"]:
    for message in reader:
        if reader.timestamps_format == "relative":
            raise ConfigError(
                f"{path}: its times count from frame to frame; `timestamps absolute` is allowed"
            )
        if reader.start_time < _DATED_S_MIN:
            message.timestamp -= reader.start_time
        yield message


def write_asc(log: Log, path: Path) -> None:
    """All frames."""
    lean()
    from can import ASCWriter  # noqa: PLC0415

    channels = numbers(log.frames)
    memory = Memory()
    with ASCWriter(io.TextIOWrapper(memory, encoding="ascii")) as writer:
        writer.log_event("// written by aftbed", origin_us(log.frames) / 1e6)
        for frame in log.frames:
            writer.on_message_received(message_of(frame, channels[frame.interface]))
    path.write_bytes(memory.written)


def read_trc(path: Path) -> Log:
    """The log at `path`. Raises ConfigError naming file and line."""
    lean()
    from can import TRCReader  # noqa: PLC0415

    lines = _Lines(_text(path))
    return taken(path, TRCReader(lines), lines.where, channel_offset=1)


def write_trc(log: Log, path: Path) -> None:
    """The data frames."""
    lean()
    from can import TRCWriter  # noqa: PLC0415

    channels = numbers(log.frames)
    start_s = origin_us(log.frames) / 1e6
    memory = Memory()
    with TRCWriter(io.TextIOWrapper(memory, encoding="ascii")) as writer:
        writer.filepath = "written by aftbed"  # in the place of a path that is of no use to anybody else
        writer.first_timestamp = start_s
        writer.write_header(start_s)
        for frame in without(log, *TRC_LACKS).frames:
            writer.on_message_received(message_of(frame, channels[frame.interface]))
    path.write_bytes(memory.written)
