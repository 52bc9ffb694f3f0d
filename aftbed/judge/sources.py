"""Whether the sources of a record agree, and which of them are missing (G8).

A run is told several times: by what was asked for (`run.json`), by the client's dialogue, by the journals of
its nodes, by the supervisor's `end.json`. Two that contradict each other cannot both be true: the record
fails. A source that is missing, where a run that ended in order has one, leaves something unknown.

What a request must have left, if it was answered:

    dialogue     sent, then answered, in the order of time, under the epoch of the reply that was accepted
    proxy        the reply accepted under that epoch, in between
    a server     executed, in between
    dialogue     the bytes that the seed draws, of a load
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import pairwise

from aftbed.core.events import FIRST_FAULT, Event
from aftbed.core.journal import Entry, EntryKind, Record
from aftbed.ftm.compose import build
from aftbed.inject.receipts import fault_and_bits
from aftbed.judge.record import RunEnd, RunRecord
from aftbed.judge.reference import ReferenceRun
from aftbed.runtime.unix import seal
from aftbed.runtime.unix.devices import LOAD_REQUESTS
from aftbed.runtime.unix.options import LoadRun
from aftbed.vehicle.aeb.function import sample_requests


def contradictions(record: RunRecord, reference: ReferenceRun) -> Iterator[str]:
    """What cannot be true together."""
    end = record.end
    yield from seal.changes(record.path)
    yield from _of_requests(record)
    yield from _of_faults(record)
    if end is not None:
        yield from _of_end(record, end)
        if _at_rest(end) and _comparable(record, reference):
            yield from (
                f"the state of {replica} at the end is not the bare server's"
                for replica, state in end.states.items()
                if state != reference.digest
            )


def _at_rest(end: RunEnd) -> bool:
    """Whether the run came to its end by itself, with a replica, and nothing was under way."""
    return not (end.reason or end.unfinished or end.lost)


def _comparable(record: RunRecord, reference: ReferenceRun) -> bool:
    """Whether the states have to be the bare server's: each request was answered, and no bit was flipped."""
    return reference.deterministic and not _flipped(record) and _all_answered(record, reference)


def _all_answered(record: RunRecord, reference: ReferenceRun) -> bool:
    """Only then are the replicas asked for their states."""
    answered = {entry.request_id for entry in record.history.dialogue if entry.kind is EntryKind.ANSWERED}
    return len(answered) == len(reference.replies)


def _flipped(record: RunRecord) -> bool:
    """Whether a fault was asked for that alters values."""
    return any(report.action.alters_value for report in record.faults)


def gaps(record: RunRecord, reference: ReferenceRun) -> Iterator[str]:
    """What a run that ended in order leaves, and this record does not have."""
    if record.end is None:
        return  # it was killed: what it lacks is not known
    if record.kept and not seal.sealed(record.path):
        yield f"the record has no {seal.NAME}: its command did not live to seal it, or it was removed"
    yield from (f"end.json has no {key!r}" for key in record.end.absent)
    for node in ("supervisor", *build(record.options.ftm, record.options.placement).nodes):
        name = f"{node.replace('/', '.')}.1"
        if name not in record.history.journals:
            yield f"the journal {name} is missing"
    if _at_rest(record.end):
        hosted = record.end.hosted
        if not record.end.leader or (hosted is not None and not hosted.leader):
            yield "no replica leads at the end, and no loss was reported"
        replicas = [replica for replica in (record.end.leader, record.end.backup) if replica]
        if reference.state and _all_answered(record, reference):  # a function may hand out none
            missing = [replica for replica in replicas if replica not in record.end.states]
            yield from (f"the state of {replica} at the end is missing" for replica in missing)


def _of_requests(record: RunRecord) -> Iterator[str]:
    """The dialogue against itself, the proxy, the servers and the seed."""
    accepted = _by_request(record.history.events(Event.REPLY_ACCEPTED))
    executed = _by_request(record.history.events(Event.SERVER_EXIT))
    sent: dict[int, Entry] = {}
    backwards = sum(after.t_ns < before.t_ns for before, after in pairwise(record.history.dialogue))
    if backwards:
        yield f"{backwards} entries of the dialogue are earlier than the ones before them"
    for entry in record.history.dialogue:
        number = entry.request_id
        if entry.kind is EntryKind.SENT:
            sent.setdefault(number, entry)
            continue
        before = sent.get(number)
        if before is None or entry.t_ns < before.t_ns:
            yield f"request {number}: answered before it was sent"
            continue
        between = (before.t_ns, entry.t_ns)
        if not any(r.detail >> 8 == entry.epoch for r in _within(accepted[number], *between)):
            yield f"request {number}: answered under epoch {entry.epoch}, which the proxy did not accept"
        if not any(True for _ in _within(executed[number], *between)):
            yield f"request {number}: answered, and no server executed it meanwhile"
    if isinstance(record.options.work, LoadRun) and not _flipped(record):
        drawn = _drawn(record.options.seed)
        yield from (
            f"request {number}: not what seed {record.options.seed} draws"
            for number, entry in sent.items()
            if entry.payload != drawn[(number - 1) % LOAD_REQUESTS]
        )


def _of_faults(record: RunRecord) -> Iterator[str]:
    """What was asked for, what has a receipt, what has struck."""
    told = [report.fault for report in record.faults if not report.live]
    if told != [str(fault) for fault in record.options.faults]:
        yield f"the receipts are not those of the faults that were asked for with the run: {told}"
    numbers = {fault_and_bits(r.detail)[0] - FIRST_FAULT for r in record.history.events(Event.FAULT_APPLIED)}
    struck = [number for number in numbers if number >= len(record.faults)]
    if struck:
        yield f"a fault has struck, and there is no receipt: number {min(struck) + 1}"


def _of_end(record: RunRecord, end: RunEnd) -> Iterator[str]:
    """The supervisor's last words against the rest."""
    ids = {entry.request_id for entry in record.history.dialogue if entry.kind is EntryKind.SENT}
    if end.lost and end.states:
        yield f"no replica was left, and {' and '.join(end.states)} had a state"
    if _at_rest(end) and end.client is not None and end.client.sent not in (None, len(ids)):
        yield f"the client sent {end.client.sent} requests, and its dialogue has {len(ids)}"
    if end.ended_ns:
        times = [entry.t_ns for entry in record.history.dialogue]
        times += [one.t_ns for records in record.history.journals.values() for one in records]
        outside = sum(not record.started_ns <= t_ns <= end.ended_ns for t_ns in times)
        if outside:
            yield f"{outside} records are of a time at which the run was not"


def _by_request(records: Iterable[Record]) -> dict[int, list[Record]]:
    found: dict[int, list[Record]] = defaultdict(list)
    for record in records:
        found[record.request_id].append(record)
    return found


def _within(records: Iterable[Record], first_ns: int, last_ns: int) -> Iterator[Record]:
    return (record for record in records if first_ns <= record.t_ns <= last_ns)


@lru_cache(maxsize=4)
def _drawn(seed: int) -> list[bytes]:
    """The requests of a load, which come again and again."""
    return sample_requests(seed, LOAD_REQUESTS)
