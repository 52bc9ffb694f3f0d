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
        """Whether the fault happened."""
        return self in (ReceiptState.APPLIED, ReceiptState.ACTIVATED)


class Receipt(msgspec.Struct, frozen=True):
    """`detail` says more, for people, where there is more to say."""

    state: ReceiptState = ReceiptState.ARMED
    detail: str = ""


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
