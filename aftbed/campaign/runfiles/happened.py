"""What happened in a run beside the requests, and in which words: the records of all journals, and what was
told.

A fault that was applied is called by its own words, as `aftbed run` was given them; others are called by
the name of their event. `Kind` says what it belongs to, so that a reader can keep apart what broke from
what mended it.
"""

import json
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Final, NamedTuple

from aftbed.core.events import FIRST_FAULT, REQUEST_EVENTS, STEP_EVENTS, Event
from aftbed.core.journal import Record
from aftbed.inject.receipts import fault_and_bits
from aftbed.judge.record import RunRecord

DUE: Final = "an adaptation is due"  # its trigger is armed as a fault is
TOLD_NAME: Final = "events.jsonl"
FAILURES: Final = frozenset(
    (Event.DETECTED_STOP, Event.FOLLOWER_DIVERGED, Event.NODE_DIED, Event.WATCHDOG_SUSPECT)
)


class Kind(Enum):
    """What a happening belongs to."""

    REQUEST = "request"  # the path of a request
    FAULT = "fault"  # what was done to the system
    FAILURE = "failure"  # what broke, or was seen broken
    RECOVERY = "recovery"
    ADAPTATION = "adaptation"


class Told(NamedTuple):
    """A line for people, when it was told by the monotonic clock."""

    t_ns: int
    event: str
    text: str


def journals(record: RunRecord) -> Iterator[tuple[str, int, list[Record]]]:
    """For each process: its node, the how manyeth process of that name it is, and its records."""
    for name, records in record.history.journals.items():
        if records:
            life = name.rpartition(".")[2]
            yield records[0].node, int(life) if life.isdigit() else 1, records


def kind_of(one: Record) -> Kind:
    if one.event is Event.FAULT_APPLIED:
        return Kind.FAULT
    if one.event in FAILURES:
        return Kind.FAILURE
    if one.event in REQUEST_EVENTS or one.event is Event.DEDUPE_HIT:
        return Kind.REQUEST
    return Kind.ADAPTATION if str(one.event).startswith("adapt") else Kind.RECOVERY


def words_of(one: Record, record: RunRecord) -> str:
    """A record in words; a fault in its own."""
    if one.event is Event.FAULT_APPLIED:
        return _fault(fault_and_bits(one.detail)[0] - FIRST_FAULT, record)
    if one.event is Event.NODE_DIED:
        return f"{one.event}: process {one.detail}"
    words = [str(one.event), *([f"#{one.request_id}"] if one.request_id else [])]
    return " ".join([*words, *([str(one.detail)] if one.event in STEP_EVENTS else [])])


def _fault(at: int, record: RunRecord) -> str:
    """The end of a run tells of faults that were asked for while it lived, too."""
    return record.faults[at].fault if 0 <= at < len(record.faults) else "a fault"


def told_in(record: RunRecord) -> Iterator[Told]:
    """The lines for people, up to one that was cut off."""
    path: Path = record.path / TOLD_NAME
    for line in path.read_bytes().splitlines() if path.exists() else ():
        try:
            found = json.loads(line)
            t_ns = record.started_ns + int(found["t_ms"] * 1e6)
            yield Told(t_ns, str(found["event"]), str(found["text"]))
        except (ValueError, KeyError, TypeError):
            return
