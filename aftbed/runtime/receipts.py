"""Receipts: what became of a fault, by what was seen and by what the struck nodes wrote down.

| receipt | meaning |
|---|---|
| armed | it never came to its point |
| applied | it was done |
| activated | it was done, and changed what the system did: see `docs/faults.md` for each kind |
| not_activated | it came to its point, and there was nothing to be done |
| inject_error | the injector itself failed |

A node writes before it acts, and its journal outlives it: a process that kills itself has said so.
"""

from collections.abc import Iterable, Sequence
from typing import Final

import msgspec

from aftbed.core.events import Event
from aftbed.core.fault import Fault, marked
from aftbed.core.journal import Record
from aftbed.core.valuefault import Byte, Flip, Place, Stuck, hit
from aftbed.runtime.diversion import BITTEN

ARMED, APPLIED, ACTIVATED = "armed", "applied", "activated"
NOT_ACTIVATED, INJECT_ERROR = "not_activated", "inject_error"
_USES: Final = (Event.SERVER_ENTER, Event.STATE_CAPTURED)  # of a state that was hit
_WORDS: Final = (Event.FAULT_APPLIED, Event.PEER_REFUSED)


class Receipt(msgspec.Struct, frozen=True):
    """`detail` says more, where there is more to say."""

    state: str = ARMED
    detail: str = ""


def told(number: int, records: Iterable[Record]) -> list[Record]:
    """What the records say of fault `number`."""
    return [r for r in records if r.event in _WORDS and marked(r.detail)[0] == number]


def of_flip(
    fault: Fault, flip: Flip, brick: str, draw: int, words: Sequence[Record], journal: Sequence[Record]
) -> Receipt:
    """Of a value fault: its words, and all that was recorded where the value could be used."""
    struck = [r for r in words if r.event is Event.FAULT_APPLIED]
    if not struck:
        return _missed(flip, brick, draw, words[0])
    about = struck[0].request_id
    bits = sorted({marked(r.detail)[1] for r in struck if r.request_id == about})
    which = f"bit{'s' * (len(bits) > 1)} {', '.join(map(str, bits))}"
    times = _more(len(struck) // len(bits))
    used = any(_is_used(fault, flip, record, journal) for record in struck)
    return Receipt(ACTIVATED if used else APPLIED, f"{which} {_of(flip, about, brick)}{times}")


def _is_used(fault: Fault, flip: Flip, struck: Record, journal: Sequence[Record]) -> bool:
    """Whether somebody worked with what was hit. Most of it leaves with the message that shows it."""
    if flip.place is Place.STATE and fault.event != Event.STATE_CAPTURED.label:
        after = (r for r in journal if r.t_ns >= struck.t_ns and r.node == struck.node)
        next_ = (r for r in after if r.event in (*_USES, Event.STATE_RESTORED))
        first = next((r for r in next_ if r.t_ns > struck.t_ns or r.event in _USES), None)
        return first is not None and first.event in _USES
    if flip.place is Place.LOG and fault.event != Event.DEDUPE_HIT.label:
        hits = (r for r in journal if r.event is Event.DEDUPE_HIT and r.request_id == struck.request_id)
        return any(r.t_ns >= struck.t_ns for r in hits)
    return True


def _missed(flip: Flip, brick: str, draw: int, word: Record) -> Receipt:
    """Nothing was hit: there are no such bits, they are so already, or the function refuses such a state."""
    _, size = marked(word.detail)
    of = _of(flip, word.request_id, brick)
    if isinstance(flip.pattern, Stuck) and flip.pattern.at < size:
        said = f"bit {flip.pattern.at} {of} is {flip.pattern.value} as it is, or was refused"
        return Receipt(NOT_ACTIVATED, said)
    bits = hit(flip.pattern, bytes(size // 8), draw)
    if bits is None:
        unit, count = ("bytes", size // 8) if isinstance(flip.pattern, Byte) else ("bits", size)
        return Receipt(NOT_ACTIVATED, f"there are {count} {unit} {of}")
    which = f"bit{'s' * (len(bits) > 1)} {', '.join(map(str, bits))}"
    return Receipt(NOT_ACTIVATED, f"the function refused {which} {of}")


def _of(flip: Flip, request_id: int, brick: str) -> str:
    return f"of the {flip.place.value} of request {request_id} in {brick}"


def _more(times: int) -> str:
    return f", and {times - 1} more times" if times > 1 else ""


def of_channel(brick: str, words: Sequence[Record]) -> Receipt:
    """Of a fault of a channel: STRUCK, where something was held back, BITTEN where that was the last word."""
    bitten = [r for r in words if marked(r.detail)[1] == BITTEN]
    request = (bitten or words)[0].request_id
    about = f"request {request}" if request else "no request"
    if not bitten:
        return Receipt(APPLIED, f"a message of {brick} about {about} was held back, and is late at most")
    return Receipt(ACTIVATED, f"a message of {brick} about {about}{_more(len(bitten))}")
