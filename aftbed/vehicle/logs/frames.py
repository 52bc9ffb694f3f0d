"""What a log of a CAN bus holds, whatever its format: frames, each with its time and where it was seen.

Wider than what aftbed's own bus carries (`vehicle.can.frame`), since the logs of other buses are to be
converted as well: identifiers of 11 and 29 bits, remote frames, error frames. Narrower than what exists:
CAN FD is left out, and so is what a format has beside the frames (statistics, comments, triggers). What is
left out is counted by its reason and never silently gone; what is malformed is an error and not left out.

Times are whole microseconds from the origin of the log: from its start, or since 1970 (Unix time) where the
log knows the date. Formats that have a date of their own get one that is a whole second, so that nothing is
lost in rounding; a log whose times begin before 1990 has no date, and is dated 1970, as by python-can.

Numbered and named interfaces: candump has names, all others have numbers. A name that ends in digits has
their number; any other, and one whose number is taken, gets the lowest that is free. Back again, n is `canN`.
"""

import re
from collections.abc import Iterable
from enum import Enum
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError, PeerError
from aftbed.vehicle.can.candump import LOG_BYTES_MAX
from aftbed.vehicle.can.frame import CAN_ID_MAX, DATA_LENGTH_MAX

EXTENDED_ID_MAX: Final = 0x1FFFFFFF
TIME_US_MAX: Final = 2**32 * 1_000_000 - 1  # in 2106; a float holds microseconds up to there
DATED_US_MIN: Final = 631_152_000 * 1_000_000  # 1990: what is earlier counts from the start of its log
CHANNELS_MAX: Final = 255  # MF4 has a byte for it
LENGTH_CODE_MAX: Final = 15  # what four bits hold; more than 8 means 8 bytes
_NUMBER: Final = re.compile(r"\D*?(\d{1,3})")


class Kind(Enum):
    """What a frame is."""

    DATA = "data frame"
    REMOTE = "remote frame"
    ERROR = "error frame"


class LoggedFrame(msgspec.Struct, frozen=True):
    """A frame; `length` is that which a remote frame asks for. Of an error frame, `can_id` is its class.

    `sent`: by who wrote the log. Raises PeerError on what cannot be.
    """

    t_us: int
    interface: str
    can_id: int
    data: bytes = b""
    extended: bool = False
    kind: Kind = Kind.DATA
    length: int = 0
    sent: bool = False

    def __post_init__(self) -> None:
        id_max = EXTENDED_ID_MAX if self.extended else CAN_ID_MAX
        if not 0 <= self.can_id <= id_max:
            raise PeerError(f"CAN id {self.can_id:#x}, allowed is 0 to {id_max:#x}")
        if len(self.data) > DATA_LENGTH_MAX:
            raise PeerError(f"{len(self.data)} bytes, allowed are 0 to {DATA_LENGTH_MAX}")
        if not 0 <= self.length <= DATA_LENGTH_MAX:
            raise PeerError(f"a remote frame for {self.length} bytes, allowed are 0 to {DATA_LENGTH_MAX}")
        if not 0 <= self.t_us <= TIME_US_MAX:
            raise PeerError(f"time {self.t_us / 1e6:.6f} s, allowed is 0 to {TIME_US_MAX // 10**6} s")


class Log(msgspec.Struct, frozen=True):
    """Frames in the order of their file, and what was not taken over, by its reason."""

    frames: tuple[LoggedFrame, ...]
    left_out: dict[str, int] = {}


def without(log: Log, *kinds: Kind) -> Log:
    """The same for a format that does not have these kinds."""
    kept = tuple(frame for frame in log.frames if frame.kind not in kinds)
    left_out = dict(log.left_out)
    for kind in kinds:
        if count := sum(frame.kind is kind for frame in log.frames):
            left_out[kind.value] = left_out.get(kind.value, 0) + count
    return Log(kept, left_out)


def origin_us(frames: Iterable[LoggedFrame]) -> int:
    """The time at which a log with a date begins: a whole second; 0 for one without a date."""
    first_us = min((frame.t_us for frame in frames), default=0)
    return first_us - first_us % 1_000_000 if first_us >= DATED_US_MIN else 0


def numbers(frames: Iterable[LoggedFrame]) -> dict[str, int]:
    """The number of each interface. Raises ConfigError where there are more than any format can tell."""
    names = list(dict.fromkeys(frame.interface for frame in frames))
    if len(names) > CHANNELS_MAX:
        raise ConfigError(f"{len(names)} interfaces in one log, allowed are {CHANNELS_MAX}")
    found: dict[str, int] = {}
    for name in sorted(names, key=lambda n: (n != f"can{_own_number(n)}", names.index(n))):
        number = _own_number(name)
        if number is not None and number not in found.values():
            found[name] = number
    free = iter(sorted(set(range(CHANNELS_MAX)) - set(found.values())))
    return {name: found[name] if name in found else next(free) for name in names}


def _own_number(name: str) -> int | None:
    match = _NUMBER.fullmatch(name)
    return int(match[1]) if match is not None and int(match[1]) < CHANNELS_MAX else None


def interface(number: int) -> str:
    """The name of the interface with that number."""
    return f"can{max(number, 0)}"


def content(path: Path) -> bytes:
    """The bytes of the log at `path`. Raises ConfigError if they cannot be read, or are none."""
    try:
        size_bytes = path.stat().st_size
        if size_bytes > LOG_BYTES_MAX:
            raise ConfigError(f"{path}: {size_bytes} bytes, a log may have {LOG_BYTES_MAX}")
        found = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    if not found:
        raise ConfigError(f"{path}: the file is empty")
    return found
