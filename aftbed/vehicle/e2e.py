"""AUTOSAR E2E: no signal of a safety frame is believed before this says so.

On our own bus it is profile 11: byte 0 is the CRC (SAE J1850, over the data id and all other bytes), the
low nibble of byte 1 a counter that runs 0 to 14 and round. 15 does not occur; a frame that carries it is
wrong. Other people's buses have other profiles: see `e2eprofiles`. The CRC is the `autosar-e2e` library's,
the supervision of the counter is ours, the same for all, with the states of the AUTOSAR PRS E2E protocol:

    per frame   OK             CRC right, counter one further than the last
                OK_SOMELOST    CRC right, counter 2 to `delta_max` further: usable, some are missing
                REPEATED       CRC right, counter as before: the same frame again
                WRONGSEQUENCE  CRC right, counter too far ahead, or there is no last one to compare with
                ERROR          wrong length, CRC or counter value: nothing in it can be believed
    per look    NONEWDATA      a whole cycle has passed without a frame

and per message a window of the last statuses, from which the state of the channel follows:

    NODATA --any frame but ERROR--> INIT --enough good, few errors--> VALID <----> INVALID

A frame may be used if it is OK or OK_SOMELOST *and* the channel is VALID: `Receiver.usable`.

The counter alone is not enough. It wraps after 15 frames (16 in P02, 256 in P05), so a loss of exactly
15 (300 ms at 20 ms) looks like perfect continuity to it. A timeout in bus time closes the hole: after
`timeout_us` without a good frame the sequence is void, the window is forgotten, the channel is
INVALID, and the next frame can only start a new sequence (WRONGSEQUENCE). Time is passed in.
"""

from collections import deque
from enum import Enum, auto
from typing import Final, assert_never

import msgspec

from aftbed.vehicle.e2eprofiles import P11, Profile, bytes_min, counter_count, counter_of, is_intact, with_e2e

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
