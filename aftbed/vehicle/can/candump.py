"""The candump log format: one frame in one line, read strictly and written in one form.

    (0000000012.345678) can0 130#0102030405060708

It is what the hub records, and `candump -l` of can-utils writes; `interop.logs` reads all that such programs
write. The log of a hub is evidence: a line that is not exactly this is refused and counted by its reason,
with the number of the first line that had it. A last line without its newline counts as torn even where it
would parse: `130#01020304` may be all that was written of eight bytes.

Read but not written: the direction (` R` or ` T`) that python-can's logger appends. Refused, being
no classic CAN data frame with an 11-bit identifier: extended, remote, error and FD frames.

Time is compared with the last frame that was accepted, over all interfaces, because the interfaces of a log
share one clock.
"""

import re
from collections.abc import Iterable, Iterator
from enum import StrEnum
from typing import Final

import msgspec

from aftbed.vehicle.can.frame import CAN_ID_MAX, DATA_LENGTH_MAX, Frame

_LINE: Final = re.compile(rb"\(([0-9]{1,10})\.([0-9]{6})\) ([!-~]{1,15}) ([!-~]{1,600}?)(?: [RT])?")
_IDENTIFIER: Final = re.compile(rb"[0-9A-Fa-f]{3}")
_DATA: Final = re.compile(rb"(?:[0-9A-Fa-f]{2})*")


class Refusal(StrEnum):
    TORN = "torn last line"
    SYNTAX = "not a candump line"
    IDENTIFIER = "not an 11-bit data frame"
    DATA = "odd, long or non-hexadecimal data"
    TIME = "time runs backwards"


class LogFrame(msgspec.Struct, frozen=True):
    """A frame of a log, its time in microseconds by the log's own clock, and its interface."""

    interface: str
    frame: Frame


class LogCounts(msgspec.Struct):
    """Lines of a log by what became of them; `first_line` counts from 1, by reason."""

    lines: int = 0
    frames: int = 0
    refused: dict[Refusal, int] = {}
    first_line: dict[Refusal, int] = {}

    def refuse(self, reason: Refusal, line_number: int) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1
        self.first_line.setdefault(reason, line_number)


def log_line(frame: Frame, interface: str) -> str:
    """With its newline."""
    seconds, micros = divmod(frame.t_us, 1_000_000)
    return f"({seconds:010d}.{micros:06d}) {interface} {frame.can_id:03X}#{frame.data.hex().upper()}\n"


def parse_line(line: bytes) -> LogFrame | Refusal:
    """The frame in `line` (without its newline), or the reason to refuse it."""
    match = _LINE.fullmatch(line)
    if match is None:
        return Refusal.SYNTAX
    seconds, micros, interface, text = match.groups()
    identifier, mark, data = text.partition(b"#")
    if not mark:
        return Refusal.SYNTAX
    if _IDENTIFIER.fullmatch(identifier) is None or int(identifier, 16) > CAN_ID_MAX:
        return Refusal.IDENTIFIER
    if data[:1] in (b"R", b"r", b"#"):
        return Refusal.IDENTIFIER
    if _DATA.fullmatch(data) is None or len(data) > 2 * DATA_LENGTH_MAX:
        return Refusal.DATA
    t_us = int(seconds) * 1_000_000 + int(micros)
    frame = Frame(t_us, int(identifier, 16), bytes.fromhex(data.decode("ascii")))
    return LogFrame(interface.decode("ascii"), frame)


def parse_lines(lines: Iterable[bytes], counts: LogCounts) -> Iterator[LogFrame]:
    """The frames of `lines`, each line with its newline as in a file; `counts` is kept up to date."""
    last_us = 0
    for line in lines:
        counts.lines += 1
        found = parse_line(line[:-1]) if line.endswith(b"\n") else Refusal.TORN
        if isinstance(found, LogFrame) and found.frame.t_us < last_us:
            found = Refusal.TIME
        if isinstance(found, Refusal):
            counts.refuse(found, counts.lines)
            continue
        counts.frames += 1
        last_us = found.frame.t_us
        yield found
