"""AUTOSAR E2E profile 11: no signal of a safety frame is believed before this says so.

Layout: byte 0 is the CRC (SAE J1850, over the data id and all other bytes), the low nibble of byte 1
a counter that runs 0 to 14 and round. 15 does not occur; a frame that carries it is wrong. The CRC
is the `autosar-e2e` library's, the counter and its supervision are ours, with the states of the
AUTOSAR PRS E2E protocol:

    per frame   OK             CRC right, counter one further than the last
                OK_SOMELOST    CRC right, counter 2 to `delta_max` further: usable, some are missing
                REPEATED       CRC right, counter as before: the same frame again
                WRONGSEQUENCE  CRC right, counter too far ahead, or there is no last one to compare with
                ERROR          wrong length, CRC or counter value: nothing in it can be believed
    per look    NONEWDATA      a whole cycle has passed without a frame

and per message a window of the last statuses, from which the state of the channel follows:

    NODATA --any frame but ERROR--> INIT --enough good, few errors--> VALID <----> INVALID

A frame may be used if it is OK or OK_SOMELOST *and* the channel is VALID: `Receiver.usable`.

The counter alone is not enough. It wraps after 15 frames, so a loss of exactly 15 (300 ms at 20 ms)
looks like perfect continuity to it. A timeout in bus time closes the hole: after
`timeout_us` without a good frame the sequence is void, the window is forgotten, the channel is
INVALID, and the next frame can only start a new sequence (WRONGSEQUENCE). Time is passed in.
"""

from collections import deque
from enum import Enum, auto
from typing import Final

import msgspec
from e2e.p11 import e2e_p11_check, e2e_p11_protect

COUNTER_COUNT: Final = 15  # 0 to 14: 15 is never sent
PROTECTED_BYTES_MIN: Final = 2


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
    """How one message is watched. The counter must not be able to wrap within `timeout_us`."""

    data_id: int
    cycle_us: int
    timeout_us: int
    length: int = 8
    delta_max: int = 3
    window_size: int = 5
    ok_min: int = 1
    errors_max: int = 2

    def __post_init__(self) -> None:
        """All of these are ours, never a peer's."""
        assert 0 <= self.data_id <= 0xFFFF
        assert self.length >= PROTECTED_BYTES_MIN
        assert 1 <= self.delta_max < COUNTER_COUNT
        assert self.cycle_us < self.timeout_us < COUNTER_COUNT * self.cycle_us
        assert 1 <= self.ok_min <= self.window_size
        assert 0 <= self.errors_max < self.window_size


def protect(data: bytes, data_id: int, counter: int) -> bytes:
    """`data` with the counter and the CRC in their places; its other bits stay as they are."""
    assert 0 <= counter < COUNTER_COUNT
    assert len(data) >= PROTECTED_BYTES_MIN
    frame = bytearray(data)
    frame[1] = (frame[1] & 0xF0) | counter
    e2e_p11_protect(frame, data_id, increment_counter=False)
    return bytes(frame)


def intact(data: bytes, data_id: int) -> bool:
    """True if the CRC and the counter's value are right; says nothing about the sequence."""
    return len(data) >= PROTECTED_BYTES_MIN and e2e_p11_check(bytearray(data), data_id)


class Receiver:
    """Supervision of one message. `check` for each frame, `poll` where time passes without one."""

    def __init__(self, supervision: Supervision) -> None:
        self.supervision = supervision
        self.state = ChannelState.NODATA
        self._counter: int | None = None  # None: no sequence to compare with
        self._good_us = 0  # when the last frame with a right CRC came
        self._looked_us = 0  # when time was last accounted for, by a frame or by NONEWDATA
        self._window: deque[Status] = deque(maxlen=supervision.window_size)

    def check(self, data: bytes, now_us: int) -> Status:
        """Judge one frame that arrived at `now_us`, and move the channel's state."""
        self._expire(now_us)
        status = self._judge(data)
        if status is not Status.ERROR:
            self._counter = data[1] & 0x0F
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

    def timed_out(self, now_us: int) -> bool:
        """True if no good frame came for longer than the timeout, or none ever."""
        return self._counter is None or now_us - self._good_us > self.supervision.timeout_us

    def _judge(self, data: bytes) -> Status:
        if len(data) != self.supervision.length or not intact(data, self.supervision.data_id):
            return Status.ERROR
        if self._counter is None:
            return Status.WRONGSEQUENCE
        delta = ((data[1] & 0x0F) - self._counter) % COUNTER_COUNT
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
