"""AUTOSAR E2E protection: profiles 1, 2, 5 and 11, and the supervision of a message by its counter.

No signal of a safety frame is believed before `Receiver` says so. After the E2E Protocol Specification
(AUTOSAR PRS); the CRCs are those of the `autosar-e2e` library. A profile protects one message by a CRC, a
counter, and a data id that is part of the CRC and, except for a nibble, not in the frame: so an intact
frame of another message has a wrong CRC.

    profile  CRC                       counter              data id
    P01      8 bit, SAE J1850, 0x1D    low nibble, 0 to 14  16 bits; into the CRC go, by `mode`, `both` bytes,
                                                            the `low` one, one by turns (`alt`: low where the
                                                            counter is even), or the low one and a 0, with the
                                                            low `nibble` of the high byte sent in the frame
    P02      8 bit, H2F, 0x2F          low nibble, 0 to 15  sixteen bytes; the counter's goes into the CRC
    P05      16 bit, CCITT, 0x1021     a byte, 0 to 255     16 bits, both bytes
    P11      as P01                    low nibble, 0 to 14  as P01, `both` or `nibble`

Our own bus has P11. The header (CRC, then the counter in the next byte) is at byte `offset` of the data; in
P02 at the start.

The supervision is the same for all profiles, with the states of the PRS:

    per frame   OK             CRC right, counter one further than the last
                OK_SOMELOST    CRC right, counter 2 to `delta_max` further: usable, some are missing
                REPEATED       CRC right, counter as before: the same frame again
                WRONGSEQUENCE  CRC right, counter too far ahead, or there is no last one to compare with
                ERROR          wrong length, CRC or counter value: nothing in it can be believed
    per poll    NONEWDATA      a whole cycle has passed without a frame

and per message a window of the last statuses, from which the state of the channel follows:

    NODATA --any frame but ERROR--> INIT --enough good, few errors--> VALID <----> INVALID

A frame may be used if it is OK or OK_SOMELOST *and* the channel is VALID: `Receiver.usable`.

The counter alone is not enough. It wraps after 15 frames (16 in P02, 256 in P05), so a loss of exactly
15 (300 ms at 20 ms) looks like perfect continuity. A timeout in bus time closes the gap: after
`timeout_us` without a good frame the sequence is void, the window is cleared, the channel is INVALID, and
the next frame can only start a new sequence (WRONGSEQUENCE). Time is passed in.

Limits: P01 and P11 may, by the specification, have CRC and counter apart; the library has them side by side,
so we do. In `alt` of P01 and in P02 a flipped bit of the counter changes which byte of the data id is meant
as well: for one pair of bytes in 256 the two errors cancel out (`ambiguous`), and a frame seems lost or
repeated. In all others every single flipped bit is found.
"""

from collections import deque
from enum import Enum, auto
from itertools import combinations
from typing import Final, Literal, assert_never

import msgspec
from e2e.p01 import (
    E2E_P01_DATAID_ALT,
    E2E_P01_DATAID_BOTH,
    E2E_P01_DATAID_LOW,
    E2E_P01_DATAID_NIBBLE,
    e2e_p01_check,
    e2e_p01_protect,
)
from e2e.p02 import e2e_p02_check, e2e_p02_protect
from e2e.p05 import e2e_p05_check, e2e_p05_protect
from e2e.p11 import E2E_P11_DATAID_BOTH, E2E_P11_DATAID_NIBBLE, e2e_p11_check, e2e_p11_protect

P01Mode = Literal["both", "alt", "low", "nibble"]
P11Mode = Literal["both", "nibble"]

DATA_ID_MAX: Final = 0xFFFF
NIBBLE_ID_MAX: Final = 0x0FFF  # the high nibble would be neither sent nor in the CRC
LIST_IDS: Final = 16  # of P02: one for each value of the counter
LIST_ID_MAX: Final = 0xFF

_P01_MODES: Final = {
    "both": E2E_P01_DATAID_BOTH,
    "alt": E2E_P01_DATAID_ALT,
    "low": E2E_P01_DATAID_LOW,
    "nibble": E2E_P01_DATAID_NIBBLE,
}
_P11_MODES: Final = {"both": E2E_P11_DATAID_BOTH, "nibble": E2E_P11_DATAID_NIBBLE}


class P01(msgspec.Struct, frozen=True):
    """Profile 1. `offset`, of the header, is in bytes."""

    data_id: int
    mode: P01Mode = "both"
    offset: int = 0

    def __post_init__(self) -> None:
        """All of these are ours, or were checked."""
        assert 0 <= self.data_id <= (NIBBLE_ID_MAX if self.mode == "nibble" else DATA_ID_MAX)
        assert self.offset >= 0


class P02(msgspec.Struct, frozen=True):
    """Profile 2, with the list of sixteen data ids of a byte each."""

    data_ids: bytes

    def __post_init__(self) -> None:
        """All of these are ours, or were checked."""
        assert len(self.data_ids) == LIST_IDS


class P05(msgspec.Struct, frozen=True):
    """Profile 5. `offset`, of the header, is in bytes."""

    data_id: int
    offset: int = 0

    def __post_init__(self) -> None:
        """All of these are ours, or were checked."""
        assert 0 <= self.data_id <= DATA_ID_MAX
        assert self.offset >= 0


class P11(msgspec.Struct, frozen=True):
    """Profile 11. `offset`, of the header, is in bytes."""

    data_id: int
    mode: P11Mode = "both"
    offset: int = 0

    def __post_init__(self) -> None:
        """All of these are ours, or were checked."""
        assert 0 <= self.data_id <= (NIBBLE_ID_MAX if self.mode == "nibble" else DATA_ID_MAX)
        assert self.offset >= 0


Profile = P01 | P02 | P05 | P11


def counter_count(profile: Profile) -> int:
    """How many values the counter has, from 0: after so many frames it is as it was."""
    match profile:
        case P01() | P11():
            return 15  # 15 is never sent
        case P02():
            return 16
        case P05():
            return 256
        case _:
            assert_never(profile)


def counter_place(profile: Profile) -> int:
    """The byte of the data that has the counter: all of it in P05, else in its low nibble."""
    match profile:
        case P01() | P11():
            return profile.offset + 1
        case P02():
            return 1
        case P05():
            return profile.offset + 2
        case _:
            assert_never(profile)


def bytes_min(profile: Profile) -> int:
    """The least number of data bytes in which the header has its place: it ends with the counter."""
    return counter_place(profile) + 1


def counter_of(profile: Profile, data: bytes) -> int:
    """The counter in `data`, which is long enough; right or wrong."""
    byte = data[counter_place(profile)]
    return byte if isinstance(profile, P05) else byte & 0x0F


def with_e2e(profile: Profile, data: bytes, counter: int) -> bytes:
    """`data` with the header in its place; its other bits stay as they are."""
    assert 0 <= counter < counter_count(profile)
    assert len(data) >= bytes_min(profile)
    frame = bytearray(_with_counter(profile, data, counter))
    match profile:
        case P01(data_id, mode, at):
            e2e_p01_protect(frame, data_id, data_id_mode=_P01_MODES[mode], offset=at, increment_counter=False)
        case P02(data_ids):
            e2e_p02_protect(frame, data_ids, increment_counter=False)
        case P05(data_id, at):
            e2e_p05_protect(frame, data_id, offset=at, increment_counter=False)
        case P11(data_id, mode, at):
            e2e_p11_protect(frame, data_id, data_id_mode=_P11_MODES[mode], offset=at, increment_counter=False)
        case _:
            assert_never(profile)
    return bytes(frame)


def is_intact(profile: Profile, data: bytes) -> bool:
    """True if the CRC, the counter's value and a sent nibble are right; says nothing about the sequence."""
    if len(data) < bytes_min(profile):
        return False
    frame = bytearray(data)  # the library wants to be able to write, and does not
    match profile:
        case P01(data_id, mode, at):
            return e2e_p01_check(frame, data_id, data_id_mode=_P01_MODES[mode], offset=at)
        case P02(data_ids):
            return e2e_p02_check(frame, data_ids)
        case P05(data_id, at):
            return e2e_p05_check(frame, data_id, offset=at)
        case P11(data_id, mode, at):
            return e2e_p11_check(frame, data_id, data_id_mode=_P11_MODES[mode], offset=at)
        case _:
            assert_never(profile)


def ambiguous(profile: Profile, length: int) -> list[tuple[int, int]]:
    """Pairs of counters one bit apart that these data ids do not tell apart in frames of `length` bytes.

    A frame with one of a pair whose counter becomes the other on its way is still taken for whole. Its
    other bits are as they were sent, so what remains is that a frame seems lost or repeated. A CRC is
    linear, so what is true of one content is true of all. Only `alt` of P01 and P02 can have such pairs.
    """
    counters = range(counter_count(profile))
    frames = [with_e2e(profile, bytes(length), counter) for counter in counters]
    return [
        (one, other)
        for one, other in combinations(counters, 2)
        if (one ^ other).bit_count() == 1 and is_intact(profile, _with_counter(profile, frames[one], other))
    ]


def _with_counter(profile: Profile, data: bytes, counter: int) -> bytes:
    """`data` with another counter, and the CRC as it was."""
    place = counter_place(profile)
    byte = counter if isinstance(profile, P05) else (data[place] & 0xF0) | counter
    return data[:place] + bytes([byte]) + data[place + 1 :]


# -- supervision ----------------------------------------------------------------------------


COUNTER_COUNT: Final = 15  # of profile 11, 0 to 14: 15 is never sent


class Status(Enum):
    """What is said of one frame, or of its absence."""

    OK = auto()
    OK_SOMELOST = auto()
    REPEATED = auto()
    WRONGSEQUENCE = auto()
    ERROR = auto()
    NONEWDATA = auto()


GOOD: Final = frozenset({Status.OK, Status.OK_SOMELOST})


class ChannelState(Enum):
    """What is said of one message's channel as a whole."""

    NODATA = auto()
    INIT = auto()
    VALID = auto()
    INVALID = auto()


class Supervision(msgspec.Struct, frozen=True):
    """How one message is watched. The counter must not be able to wrap within `timeout_us`.

    `protection` is its profile; a data id alone is profile 11 with it, as all of our own messages have.
    """

    protection: Profile | int
    cycle_us: int
    timeout_us: int
    length: int = 8
    delta_max: int = 3
    window_size: int = 5
    ok_min: int = 1
    errors_max: int = 2

    def __post_init__(self) -> None:
        """All of these are ours, never a peer's."""
        count = counter_count(self.profile)
        assert self.length >= bytes_min(self.profile)
        assert 1 <= self.delta_max < count
        assert self.cycle_us < self.timeout_us < count * self.cycle_us
        assert 1 <= self.ok_min <= self.window_size
        assert 0 <= self.errors_max < self.window_size

    @property
    def profile(self) -> Profile:
        """What the frames are protected by."""
        return P11(self.protection) if isinstance(self.protection, int) else self.protection


def protect(data: bytes, data_id: int, counter: int) -> bytes:
    """`data` with counter and CRC by profile 11, as on our own bus; its other bits stay as they are."""
    return with_e2e(P11(data_id), data, counter)


def intact(data: bytes, data_id: int) -> bool:
    """True if CRC and counter are right by profile 11, as on our own bus; says nothing about the sequence."""
    return is_intact(P11(data_id), data)


class Receiver:
    """Supervision of one message. `check` for each frame, `poll` where time passes without one."""

    def __init__(self, supervision: Supervision) -> None:
        self.supervision = supervision
        self.state = ChannelState.NODATA
        self._profile = supervision.profile
        self._counter_count = counter_count(self._profile)
        self._counter: int | None = None  # None: no sequence to compare with
        self._good_us = 0  # when the last frame with a right CRC came
        self._looked_us = 0  # when time was last accounted for, by a frame or by NONEWDATA
        self._window: deque[Status] = deque(maxlen=supervision.window_size)

    def check(self, data: bytes, now_us: int) -> Status:
        """Judge one frame that arrived at `now_us`, and move the channel's state."""
        self._expire(now_us)
        status = self._judge(data)
        if status is not Status.ERROR:
            self._counter = counter_of(self._profile, data)
            self._good_us = now_us
        self._looked_us = now_us
        self._add(status)
        return status

    def poll(self, now_us: int) -> Status | None:
        """NONEWDATA, counted once for each whole cycle without a frame; None if it is not due yet."""
        if self.state is ChannelState.NODATA:
            return Status.NONEWDATA  # nothing has ever come: there is no cycle to miss
        missed = (now_us - self._looked_us) // self.supervision.cycle_us
        if missed < 1:
            return None
        for _ in range(min(missed, self.supervision.window_size)):
            self._add(Status.NONEWDATA)
        self._looked_us += missed * self.supervision.cycle_us
        self._expire(now_us)
        return Status.NONEWDATA

    def usable(self, status: Status) -> bool:
        """True if the frame that was just judged `status` may be believed."""
        return status in GOOD and self.state is ChannelState.VALID

    def refusal(self, data: bytes, status: Status) -> str | None:
        """Why the frame that was just judged `status` may not be believed, in a word; None if it may."""
        if self.usable(status):
            return None
        match status:
            case Status.ERROR:
                return "length" if len(data) != self.supervision.length else "checksum"
            case Status.REPEATED:
                return "repeated"
            case Status.WRONGSEQUENCE:
                return "sequence"
            case Status.OK | Status.OK_SOMELOST | Status.NONEWDATA:
                return "channel"
            case _:
                assert_never(status)

    def timed_out(self, now_us: int) -> bool:
        """True if no good frame came for longer than the timeout, or none ever."""
        return self._counter is None or now_us - self._good_us > self.supervision.timeout_us

    def _judge(self, data: bytes) -> Status:
        if len(data) != self.supervision.length or not is_intact(self._profile, data):
            return Status.ERROR
        if self._counter is None:
            return Status.WRONGSEQUENCE
        delta = (counter_of(self._profile, data) - self._counter) % self._counter_count
        if delta == 0:
            return Status.REPEATED
        if delta == 1:
            return Status.OK
        return Status.OK_SOMELOST if delta <= self.supervision.delta_max else Status.WRONGSEQUENCE

    def _expire(self, now_us: int) -> None:
        """Void the sequence after a silence in which the counter may have wrapped unseen."""
        if self._counter is not None and self.timed_out(now_us):
            self._counter = None
            self._window.clear()
            self.state = ChannelState.INVALID

    def _add(self, status: Status) -> None:
        """The window state machine of the PRS, with one set of limits for all states."""
        if self.state is ChannelState.NODATA:
            if status is Status.ERROR:
                return
            self.state = ChannelState.INIT
        self._window.append(status)
        good = sum(entry in GOOD for entry in self._window)
        errors = self._window.count(Status.ERROR)
        if errors > self.supervision.errors_max:
            self.state = ChannelState.INVALID
        elif good >= self.supervision.ok_min:
            self.state = ChannelState.VALID
        elif self.state is ChannelState.VALID:
            self.state = ChannelState.INVALID
