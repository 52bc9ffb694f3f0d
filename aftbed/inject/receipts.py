"""Receipts: the proof that a fault really happened.

| state | meaning |
|---|---|
| armed | the fault never came to its point |
| applied | it was done |
| activated | it was done, and changed what the system did: see `docs/faults.md` for each kind |
| not_activated | it came to its point, and there was nothing to do |
| inject_error | the injector itself failed |

A node records a strike before it acts, and its journal outlives it: a process that kills itself has left
its record.
"""

from collections.abc import Iterable
from enum import Enum
from typing import Final

import msgspec

from aftbed.core.events import Event
from aftbed.core.journal import Record

_BITS_SHIFT: Final = 32
_STRIKES: Final = (Event.FAULT_APPLIED, Event.PEER_REFUSED)


class ReceiptState(Enum):
    """What became of a fault, as the table above has it."""

    ARMED = "armed"
    APPLIED = "applied"
    ACTIVATED = "activated"
    NOT_ACTIVATED = "not_activated"
    INJECT_ERROR = "inject_error"
    UNKNOWN = "unknown"  # the supervisor did not live to write the receipt

    @property
    def fired(self) -> bool:
        return self in (ReceiptState.APPLIED, ReceiptState.ACTIVATED)


class BusTimes(msgspec.Struct, frozen=True):
    """When a fault of the bus was handled, in bus time; None: never.

    `noticed_us`: a receiver refused a struck frame, or missed it. `good_us`: every receiver that had objected
    used the frames again; if none has, a receiver took in a frame that came late. `fallback_us`: the last
    fallback of the brake ECU before that. `believed`: a receiver took in a struck frame, and none noticed.
    """

    struck_us: int
    noticed_us: int | None = None
    good_us: int | None = None
    fallback_us: int | None = None
    believed: bool = False


class Receipt(msgspec.Struct, frozen=True):
    """`detail` says more, for people, where there is more to say. `bus`: of a fault of it that struck."""

    state: ReceiptState = ReceiptState.ARMED
    detail: str = ""
    bus: BusTimes | None = None


def record_detail(number: int, bits: int = 0) -> int:
    """The detail of a journal record about fault `number`; `bits`: which bit, or how many there are."""
    return bits << _BITS_SHIFT | number


def fault_and_bits(detail: int) -> tuple[int, int]:
    """What `record_detail` was made of."""
    return detail & (1 << _BITS_SHIFT) - 1, detail >> _BITS_SHIFT


def records_about(number: int, records: Iterable[Record]) -> list[Record]:
    """The records of a node about fault `number`: struck, or nothing to strike."""
    return [r for r in records if r.event in _STRIKES and fault_and_bits(r.detail)[0] == number]


def more_times(times: int) -> str:
    """For the end of a detail: how often a lasting fault has struck beyond the first time."""
    return f", and {times - 1} more times" if times > 1 else ""


class RadarReport(msgspec.Struct, frozen=True):
    """What the radar reports of a fault. `waits`: for its condition, which has not held yet."""

    number: int
    receipt: Receipt
    waits: bool = False


class BusReport(msgspec.Struct, frozen=True):
    """What the bus reports of a fault: how many frames it struck, the first, which node noticed it, and how.

    `believed`: a node that took in a struck frame without an objection. `error` is of the injector itself.
    """

    number: int
    frames: int = 0
    first_us: int = 0
    first_id: int = 0
    noticed: str = ""
    believed: str = ""
    began: bool = False  # an act on nodes took hold, whatever frames there were
    error: str = ""
    waits: bool = False  # for its condition, which has not held yet
    times: BusTimes | None = None

    @property
    def receipt(self) -> Receipt:
        """A fault that has not struck yet is armed."""
        if self.error:
            return Receipt(ReceiptState.INJECT_ERROR, self.error)
        if not self.frames and not self.began:
            return Receipt()
        seen = self.noticed or self.believed
        state = ReceiptState.ACTIVATED if seen else ReceiptState.APPLIED
        return Receipt(state, self._detail(), self.times)

    def _detail(self) -> str:
        if not self.frames:
            return "took hold, of no frame"
        many = f"{self.frames} frame{'s' if self.frames > 1 else ''}"
        first = f"{'the first ' if self.frames > 1 else ''}at {self.first_us / 1e6:.6f} s"
        known = f"noticed by {self.noticed}" if self.noticed else "not noticed"
        if self.believed and not self.noticed:
            known = f"believed by {self.believed}"
        return f"{many}, {first}, id {self.first_id:03X}; {known}"
