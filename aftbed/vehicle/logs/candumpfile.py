"""The candump format for any classic CAN bus; `vehicle.can.candump` is the narrow form of it that a replay
believes.

    (1533198917.000181) can1 215#EB30BAF740F62142        11 bits: three digits
    (1533198917.000190) can1 18DAF110#0210              29 bits: eight
    (1533198917.000200) can0 123#R8                     a remote frame, for eight bytes
    (1533198917.000300) can0 20000080#0000000000000000  an error frame: bit 29 is set

python-can reads this format too, but takes most error frames for data frames, forgets for how many bytes a
remote frame asks, and does not say in which line something is wrong; so it is read here, and strictly. Read
but not written are the direction (` R` or ` T`) behind a frame, and the 1000000 microseconds that asc2log of
can-utils writes where a second is full.

As in a replay, a last line without its newline counts as torn, even where it would parse: it is left out and
counted, for whoever kills a logger may cut its last line. Any other line that is not candump is an error.
"""

import re
from pathlib import Path
from typing import Final

from aftbed.core.errors import ConfigError, PeerError
from aftbed.vehicle.can.candump import LINE_SHOWN_CHARACTERS_MAX, Refusal
from aftbed.vehicle.logs.frames import EXTENDED_ID_MAX, Kind, Log, LoggedFrame, content

EXPECTED: Final = "(SECONDS.MICROSECONDS) INTERFACE ID#DATA, e.g. (0000000012.345678) can0 130#01020304"
FD: Final = "CAN FD frame"
ERROR_FLAG: Final = 0x20000000
_LINE: Final = re.compile(
    rb"\((?P<s>[0-9]{1,10})\.(?P<us>[0-9]{6}|1000000)\) (?P<interface>[!-~]{1,15}) "
    rb"(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    rb"(?:(?P<remote>[Rr])(?P<length>[0-9]?)|(?P<fd>#[0-9A-Fa-f](?:[0-9A-Fa-f]{2})*)|(?P<data>(?:[0-9A-Fa-f]{2})*))"
    rb"(?: (?P<way>[RT]))?\r?"
)


def read(path: Path) -> Log:
    """The log at `path`. Raises ConfigError naming file and line."""
    *lines, rest = content(path).split(b"\n")
    frames: list[LoggedFrame] = []
    fd = 0
    for number, line in enumerate(lines, 1):
        try:
            frame = parse(line)
        except PeerError as error:
            raise ConfigError(f"{path}: line {number}: {error}") from None
        if frame is None:
            fd += 1
        else:
            frames.append(frame)
    found = {FD: fd, str(Refusal.TORN): int(bool(rest))}
    return Log(tuple(frames), {reason: count for reason, count in found.items() if count})


def parse(line: bytes) -> LoggedFrame | None:
    """The frame in `line` (without its newline); None if it is one of CAN FD. Raises PeerError."""
    match = _LINE.fullmatch(line)
    if match is None:
        shown = line[:LINE_SHOWN_CHARACTERS_MAX].decode("ascii", "replace")
        raise PeerError(f"not a candump line: {shown!r}, expected {EXPECTED}")
    if match["fd"] is not None:
        return None
    can_id = int(match["id"], 16)
    is_error = len(match["id"]) > 3 and bool(can_id & ERROR_FLAG)
    kind = Kind.ERROR if is_error else Kind.REMOTE if match["remote"] else Kind.DATA
    if is_error and match["remote"]:
        raise PeerError("a frame cannot be an error frame and a remote frame")
    return LoggedFrame(
        t_us=int(match["s"]) * 1_000_000 + int(match["us"]),
        interface=match["interface"].decode("ascii"),
        can_id=can_id & ~ERROR_FLAG if is_error else can_id,
        data=bytes.fromhex((match["data"] or b"").decode("ascii")),
        extended=len(match["id"]) > 3,
        kind=kind,
        length=int(match["length"] or 0),
        sent=match["way"] == b"T",
    )


def write(log: Log, path: Path) -> None:
    """All frames, a line each."""
    path.write_text("".join(map(line_of, log.frames)), encoding="ascii", newline="\n")


def line_of(frame: LoggedFrame) -> str:
    """One line, newline included."""
    seconds, micros = divmod(frame.t_us, 1_000_000)
    can_id = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
    if frame.kind is Kind.ERROR:
        can_id = f"{ERROR_FLAG | frame.can_id & EXTENDED_ID_MAX:08X}"
    data = frame.data.hex().upper()
    if frame.kind is Kind.REMOTE:
        data = f"R{frame.length or ''}"
    return f"({seconds:010d}.{micros:06d}) {frame.interface} {can_id}#{data}\n"
