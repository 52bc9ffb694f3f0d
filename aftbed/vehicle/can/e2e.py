"""AUTOSAR E2E protection: profiles 1, 2, 5 and 11, and the supervision of a message by its counter.

No signal of a safety frame is used unless `Receiver.usable` holds. After the E2E Protocol Specification
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
                ERROR          wrong length, CRC or counter value: its content is unknown
    per poll    NONEWDATA      a whole cycle has passed without a frame

and per message a window of the last statuses, from which the state of the channel follows:

    NODATA --any frame but ERROR--> INIT --enough good, few errors--> VALID <----> INVALID

A frame may be used if it is OK or OK_SOMELOST *and* the channel is VALID: `Receiver.usable`.

The counter wraps after 15 frames (16 in P02, 256 in P05), so a loss of exactly 15 (300 ms at 20 ms) looks
like perfect continuity. A timeout in bus time covers that: after `timeout_us` without a good frame the
sequence is void, the window is cleared, the channel is INVALID, and the next frame can only start a new
sequence (WRONGSEQUENCE). Time is passed in.

Limits: P01 and P11 may, by the specification, have CRC and counter apart; the library has them side by side,
so we do. In `alt` of P01 and in P02 a flipped bit of the counter changes which byte of the data id is meant
as well: for one pair of bytes in 256 the two errors cancel out, and a frame seems lost or
repeated. In all others every single flipped bit is found.
"""

from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum, auto
from typing import ClassVar, Final, Literal, assert_never

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


# -- profiles -----------------------------------------------------------------------------------


class Profile(msgspec.Struct, frozen=True):
    """How one message is protected: where its header is, and the CRC over it."""

    counter_count: ClassVar[int] = 15  # values of the counter, from 0; in P01 and P11, 15 is never sent
    counter_mask: ClassVar[int] = 0x0F  # of the byte with the counter
    crc_bytes: ClassVar[int] = 1

    @property
    def counter_place(self) -> int:
        """The byte of the data that has the counter, the last one of the header."""
        return self.crc_bytes

    @abstractmethod
    def _write_crc(self, frame: bytearray) -> None:
        """Put in the CRC, and a nibble of the data id where one is sent."""

    @abstractmethod
    def _check(self, frame: bytearray) -> bool:
        """Whether CRC, counter value and sent nibble are right. The library needs it writable."""

    @property
    def bytes_min(self) -> int:
        return self.counter_place + 1

    def counter_of(self, data: bytes) -> int:
        """The counter in `data`, which is long enough; right or wrong."""
        return data[self.counter_place] & self.counter_mask

    def protect(self, data: bytes, counter: int) -> bytes:
        """`data` with the header in its place; its other bits stay as they are."""
        assert 0 <= counter < self.counter_count
        assert len(data) >= self.bytes_min
        frame, place = bytearray(data), self.counter_place
        frame[place] = data[place] & ~self.counter_mask | counter
        self._write_crc(frame)
        return bytes(frame)

    def is_intact(self, data: bytes) -> bool:
        """True if CRC, counter value and a sent nibble are right; the sequence is not checked."""
        return len(data) >= self.bytes_min and self._check(bytearray(data))


class _ProfileWithId(Profile, frozen=True):
    """`offset`, of the header, is in bytes."""

    data_id: int
    mode: P01Mode = "both"
    offset: int = 0

    def __post_init__(self) -> None:
        assert 0 <= self.data_id <= (NIBBLE_ID_MAX if self.mode == "nibble" else DATA_ID_MAX)
        assert self.offset >= 0

    @property
    def counter_place(self) -> int:
        return self.offset + self.crc_bytes


class P01(_ProfileWithId, frozen=True):
    def _write_crc(self, frame: bytearray) -> None:
        mode = _P01_MODES[self.mode]
        e2e_p01_protect(frame, self.data_id, data_id_mode=mode, offset=self.offset, increment_counter=False)

    def _check(self, frame: bytearray) -> bool:
        return e2e_p01_check(frame, self.data_id, data_id_mode=_P01_MODES[self.mode], offset=self.offset)


class P02(Profile, frozen=True):
    """With the list of sixteen data ids of a byte each."""

    counter_count: ClassVar[int] = 16

    data_ids: bytes

    def __post_init__(self) -> None:
        assert len(self.data_ids) == LIST_IDS

    def _write_crc(self, frame: bytearray) -> None:
        e2e_p02_protect(frame, self.data_ids, increment_counter=False)

    def _check(self, frame: bytearray) -> bool:
        return e2e_p02_check(frame, self.data_ids)


class P05(_ProfileWithId, frozen=True):
    """Its mode is `both`."""

    counter_count: ClassVar[int] = 256
    counter_mask: ClassVar[int] = 0xFF
    crc_bytes: ClassVar[int] = 2

    def _write_crc(self, frame: bytearray) -> None:
        e2e_p05_protect(frame, self.data_id, offset=self.offset, increment_counter=False)

    def _check(self, frame: bytearray) -> bool:
        return e2e_p05_check(frame, self.data_id, offset=self.offset)


class P11(_ProfileWithId, frozen=True):
    """Its mode is `both` or `nibble`."""

    def _write_crc(self, frame: bytearray) -> None:
        mode = _P11_MODES[self.mode]
        e2e_p11_protect(frame, self.data_id, data_id_mode=mode, offset=self.offset, increment_counter=False)

    def _check(self, frame: bytearray) -> bool:
        return e2e_p11_check(frame, self.data_id, data_id_mode=_P11_MODES[self.mode], offset=self.offset)


WITH_ONE_ID: Final[Mapping[str, tuple[Callable[[int, P01Mode, int], Profile], tuple[P01Mode, ...]]]] = {
    "p01": (P01, ("both", "alt", "low", "nibble")),  # and their modes
    "p05": (P05, ("both",)),
    "p11": (P11, ("both", "nibble")),
}


def protect(data: bytes, data_id: int, counter: int) -> bytes:
    """`data` with counter and CRC by profile 11, as on our own bus."""
    return P11(data_id).protect(data, counter)


def intact(data: bytes, data_id: int) -> bool:
    """True if CRC and counter are right by profile 11, as on our own bus."""
    return P11(data_id).is_intact(data)


# -- supervision --------------------------------------------------------------------------------


class FrameStatus(Enum):
    OK = auto()
    OK_SOMELOST = auto()
    REPEATED = auto()
    WRONGSEQUENCE = auto()
    ERROR = auto()
    NONEWDATA = auto()


GOOD: Final = frozenset({FrameStatus.OK, FrameStatus.OK_SOMELOST})


class ChannelState(Enum):
    NODATA = auto()
    INIT = auto()
    VALID = auto()
    INVALID = auto()


class Supervision(msgspec.Struct, frozen=True):
    """How one message is supervised. The counter must not be able to wrap within `timeout_us`."""

    profile: Profile
    cycle_us: int
    timeout_us: int
    length: int = 8
    delta_max: int = 3
    window_size: int = 5
    ok_min: int = 1
    errors_max: int = 2

    def __post_init__(self) -> None:
        count = self.profile.counter_count
        assert self.length >= self.profile.bytes_min
        assert 1 <= self.delta_max < count
        assert self.cycle_us < self.timeout_us < count * self.cycle_us
        assert 1 <= self.ok_min <= self.window_size
        assert 0 <= self.errors_max < self.window_size


class Receiver:
    """Supervision of one message. `check` for each frame, `poll` where time passes without one."""

    def __init__(self, supervision: Supervision) -> None:
        self.supervision = supervision
        self.state = ChannelState.NODATA
        self._profile = supervision.profile
        self._counter_count = self._profile.counter_count
        self._counter: int | None = None  # None: no sequence to compare with
        self._good_us = 0  # when the last frame with a right CRC came
        self._looked_us = 0  # when time was last accounted for, by a frame or by NONEWDATA
        self._window: deque[FrameStatus] = deque(maxlen=supervision.window_size)

    def check(self, data: bytes, now_us: int) -> FrameStatus:
        """Judge one frame that arrived at `now_us`, and move the channel's state."""
        self._expire(now_us)
        status = self._judge(data)
        if status is not FrameStatus.ERROR:
            self._counter = self._profile.counter_of(data)
            self._good_us = now_us
        self._looked_us = now_us
        self._add(status)
        return status

    def poll(self, now_us: int) -> FrameStatus | None:
        """NONEWDATA, counted once for each whole cycle without a frame; None if it is not due yet."""
        if self.state is ChannelState.NODATA:
            return FrameStatus.NONEWDATA  # nothing has ever come: there is no cycle to miss
        missed = (now_us - self._looked_us) // self.supervision.cycle_us
        if missed < 1:
            return None
        for _ in range(min(missed, self.supervision.window_size)):
            self._add(FrameStatus.NONEWDATA)
        self._looked_us += missed * self.supervision.cycle_us
        self._expire(now_us)
        return FrameStatus.NONEWDATA

    def usable(self, status: FrameStatus) -> bool:
        """True if the frame that was just judged `status` may be used."""
        return status in GOOD and self.state is ChannelState.VALID

    def refusal(self, data: bytes, status: FrameStatus) -> str | None:
        """Why the frame that was just judged `status` may not be used, in a word; None if it may."""
        if self.usable(status):
            return None
        match status:
            case FrameStatus.ERROR:
                return "length" if len(data) != self.supervision.length else "checksum"
            case FrameStatus.REPEATED:
                return "repeated"
            case FrameStatus.WRONGSEQUENCE:
                return "sequence"
            case FrameStatus.OK | FrameStatus.OK_SOMELOST | FrameStatus.NONEWDATA:
                return "channel"
            case _:
                assert_never(status)

    def timed_out(self, now_us: int) -> bool:
        """True if no good frame came for longer than the timeout, or none ever."""
        return self._counter is None or now_us - self._good_us > self.supervision.timeout_us

    def _judge(self, data: bytes) -> FrameStatus:
        if len(data) != self.supervision.length or not self._profile.is_intact(data):
            return FrameStatus.ERROR
        if self._counter is None:
            return FrameStatus.WRONGSEQUENCE
        delta = (self._profile.counter_of(data) - self._counter) % self._counter_count
        if delta == 0:
            return FrameStatus.REPEATED
        if delta == 1:
            return FrameStatus.OK
        return FrameStatus.OK_SOMELOST if delta <= self.supervision.delta_max else FrameStatus.WRONGSEQUENCE

    def _expire(self, now_us: int) -> None:
        """Void the sequence after a silence in which the counter may have wrapped unseen."""
        if self._counter is not None and self.timed_out(now_us):
            self._counter = None
            self._window.clear()
            self.state = ChannelState.INVALID

    def _add(self, status: FrameStatus) -> None:
        """The window state machine of the PRS, with one set of limits for all states."""
        if self.state is ChannelState.NODATA:
            if status is FrameStatus.ERROR:
                return
            self.state = ChannelState.INIT
        self._window.append(status)
        good = sum(entry in GOOD for entry in self._window)
        errors = self._window.count(FrameStatus.ERROR)
        if errors > self.supervision.errors_max:
            self.state = ChannelState.INVALID
        elif good >= self.supervision.ok_min:
            self.state = ChannelState.VALID
        elif self.state is ChannelState.VALID:
            self.state = ChannelState.INVALID
