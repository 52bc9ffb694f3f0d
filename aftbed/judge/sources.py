"""Whether the sources of a record agree, and which of them are missing (G8).

A run is told several times: by what was asked for (`run.json`), by the client's dialogue, by the journals of
its nodes, by the supervisor's `end.json`. Two that contradict each other cannot both be true: the record
fails. A source that is missing, where a run that ended in order has one, leaves something unknown.

What a request must have left, if it was answered:

    dialogue     sent, then answered, in the order of time, under the epoch of the reply that was accepted
    proxy        the reply accepted under that epoch, in between
    a server     executed, in between
    dialogue     of a load, the bytes that the seed draws, or those that the user gave (`requests.msgpack`)
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

from aftbed.adapt.engine import DONE
from aftbed.core.errors import FUNCTION_FAILED, ConfigError
from aftbed.core.events import FIRST_FAULT, Event
from aftbed.core.input_file import open_input
from aftbed.core.journal import EntryKind, History, Record
from aftbed.core.script import RECIPES
from aftbed.ftm.compose import build
from aftbed.functions.source import is_foreign
from aftbed.inject.receipts import fault_and_bits
from aftbed.inject.targets import SUPERVISOR
from aftbed.judge.bare_server import ReferenceRun
from aftbed.judge.record import RunEnd, RunRecord
from aftbed.runtime.deployment import digest
from aftbed.runtime.unix import seal
from aftbed.runtime.unix.devices import load_requests
from aftbed.runtime.unix.options import LoadRun
from aftbed.runtime.unix.request_store import EXPECTED_NAME, REQUESTS_NAME
from aftbed.runtime.unix.run_directory import BUS_NAME

PROCESSES_LOG: Final = "processes.log"
PRINTED_BYTES_MAX: Final = 1_000_000  # that are searched: the first error counts
DRAINED: Final = RECIPES[0]
SINGLE: Final = "single"  # the placement whose only node hosts two Servers
SERVER: Final = "/server"  # ends the name of its brick
EFFECTS: Final = (Event.SERVER_EXIT, Event.STATE_RESTORED)
OF_A_NODE: Final = re.compile(r"^(?P<node>\S+) \(pid \d+\):")
FAILED: Final = re.compile(rf"{OF_A_NODE.pattern} (?P<stop>detected stop: )?{FUNCTION_FAILED}(?P<why>.*)$")
STDERR_LINES_MAX: Final = 3  # of a node that crashed
TRACEBACK: Final = "Traceback (most recent call last):"


def contradictions(record: RunRecord, reference: ReferenceRun) -> Iterator[str]:
    """What cannot be true together."""
    end = record.end
    yield from seal.changes(record.path)
    yield from _of_journals(record)
    yield from _of_requests(record)
    yield from _of_adaptations(record)
    yield from _of_faults(record)
    yield from _of_policy(record)
    if end is not None:
        yield from _of_end(record, end)
        yield from _of_bus(record, end)
        if _at_rest(end) and _comparable(record, reference):
            yield from (
                f"the state of {replica} at the end is not the bare server's"
                for replica, state in end.states.items()
                if state != digest(reference.state)
            )


def _at_rest(end: RunEnd) -> bool:
    """Whether the run came to its end by itself, with a replica, and nothing was under way."""
    return not (end.reason or end.unfinished or end.lost)


def _comparable(record: RunRecord, reference: ReferenceRun) -> bool:
    """Whether the states have to be the bare server's: each request is known and answered, no bit flipped."""
    known = not record.history.dropped and not _flipped(record)
    exact = reference.deterministic and not reference.tolerance
    return known and exact and _all_answered(record, reference)


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
    if not _flipped(record) and not _undone(record):  # either may well fail an assertion
        yield from _tracebacks(record.path / PROCESSES_LOG)
    yield from _given_missing(record)
    for node in ("supervisor", *build(record.options.ftm, record.options.placement).nodes):
        name = f"{node.replace('/', '.')}.1"
        if name not in record.history.journals:
            yield f"the journal {name} is missing"
    yield from effects_missing(record, record.end)
    if _at_rest(record.end):
        if not isinstance(record.options.work, LoadRun) and record.end.bus is None:
            yield "the hub did not report what happened on the bus"
        hosted = record.end.hosted
        if not record.end.leader or (hosted is not None and not hosted.leader):
            yield "no replica leads at the end, and no loss was reported"
        replicas = [replica for replica in (record.end.leader, record.end.backup) if replica]
        if reference.state and _all_answered(record, reference):  # a function may hand out none
            missing = [replica for replica in replicas if replica not in record.end.states]
            yield from (f"the state of {replica} at the end is missing" for replica in missing)


def _given_missing(record: RunRecord) -> Iterator[str]:
    """What the user gave the run, and its record has no longer."""
    work = record.options.work
    if isinstance(work, LoadRun):
        if work.requests and record.given is None:
            yield f"{REQUESTS_NAME} is missing"
        if work.expect and record.expected is None:
            yield f"{EXPECTED_NAME} is missing"


def effects_missing(record: RunRecord, end: RunEnd) -> Iterator[str]:
    """A Server's effects follow request on request; those of a replica at the end go up to the last request.

    This is so where faults only end or stop processes, each node hosts one Server, and records found room. A
    Server that was put aside by an adaptation which was undone has not seen what happened meanwhile. A Server
    has none if it came after the last request, as a new backup or by an adaptation, or never came to be. The
    recipe of the paper destroys bricks with what is inside them, at any time of its blackout.
    """
    stopped = all(report.action.stops_process for report in record.faults)
    if _undone(record) or not stopped or record.options.placement == SINGLE or record.history.dropped:
        return
    destroyed_ns = [  # from when to when
        (one.opened_ns - round(one.blackout_ms * 1e6), one.opened_ns)
        for one in record.adaptations
        if one.recipe != DRAINED
    ]
    sent = ((e.request_id, e.t_ns) for e in record.history.dialogue if e.kind is EntryKind.SENT)
    last_sent, sent_ns = max(sent, default=(0, 0))
    ready_ns = [one.t_ns for one in record.history.events(Event.BACKUP_READY)]
    came_ns = [*ready_ns, *(one.opened_ns for one in record.adaptations)]
    came = bool(ready_ns) and max(came_ns) <= sent_ns
    newest: dict[str, tuple[str, int, int]] = {}  # by node: the journal, the last effect (0: none), its time
    for name in sorted(record.history.journals, key=_incarnation):
        last, last_ns = 0, 0
        for one in record.history.events_of(name, *EFFECTS):
            lost = any(last_ns < until_ns and since_ns < one.t_ns for since_ns, until_ns in destroyed_ns)
            if last and one.request_id > last + 1 and not lost:
                yield f"the journal {name} lacks what was between requests {last} and {one.request_id}"
            last, last_ns = one.request_id, one.t_ns
        node = name.rpartition(".")[0]
        if last or node in newest:
            newest[node] = name, last, last_ns
    if _at_rest(end) and end.states:
        serving = [replica for replica in (end.leader, end.backup) if replica]
        yield from (
            f"the journal {name} ends with request {last}, and {last_sent} was the last one"
            for node, (name, last, last_ns) in newest.items()
            if last != last_sent and (last or came) and node.partition(".")[0] in serving
            if last_ns >= max((until_ns for _, until_ns in destroyed_ns), default=0)
        )


def _undone(record: RunRecord) -> bool:
    """Whether an adaptation was rolled back or refused: its verdict is `adaptations_done`."""
    return any(one.outcome != DONE for one in record.adaptations)


def _incarnation(journal: str) -> int:
    number = journal.rpartition(".")[2]
    return int(number) if number.isdigit() else 0


def _tracebacks(path: Path) -> Iterator[str]:
    """The errors that ended processes, but for those that a flipped bit or an undone adaptation explains."""
    try:
        with open_input(path) as file:
            lines = file.read(PRINTED_BYTES_MAX).decode(errors="replace").splitlines()
    except FileNotFoundError:
        return
    except OSError as error:
        yield f"{path.name}: {error.strerror}"
        return
    for at, line in enumerate(lines):
        if line == TRACEBACK:
            error_line = next((one for one in lines[at + 1 :] if not one.startswith(" ")), "cut off")
            who = lines[at - 1] if at and lines[at - 1].endswith(":") else "a process:"
            yield f"{path.name} has a traceback of {who} {error_line}"


def function_failures(record: RunRecord) -> list[str]:
    """Of each node that stopped because its function ended or broke its contract, which one and why."""
    if record.simulated:
        return list(record.function_failures)
    try:
        with open_input(record.path / PROCESSES_LOG) as file:
            lines = file.read(PRINTED_BYTES_MAX).decode(errors="replace").splitlines()
    except OSError:
        return []
    found = ((at, FAILED.match(line)) for at, line in enumerate(lines))
    return [
        f"{one['node']}: {one['why']}{_printed_before(lines[:at]) * (not one['stop'])}"
        for at, one in found
        if one
    ]


def _printed_before(lines: list[str]) -> str:
    """What a node may have printed that crashed: the log has it before the crash, without the node's name."""
    printed: list[str] = []
    while len(printed) < STDERR_LINES_MAX and lines and not OF_A_NODE.match(lines[-1]):
        printed.insert(0, lines.pop())
    return f"; the log has before it: {' | '.join(printed)}" if printed else ""


def _of_requests(record: RunRecord) -> Iterator[str]:
    """The dialogue against itself, the proxy, the servers and the seed.

    What one source has and another lacks proves nothing where records found no room: `whole_history` says so.
    """
    listed = _listed_requests(record)
    sent_ns: dict[int, int] = {}
    spans: dict[int, _Span] = {}  # of the first answer: a second one breaks G2
    backwards, last_ns, not_listed = 0, 0, []
    for entry in record.history.dialogue:
        number = entry.request_id
        backwards += entry.t_ns < last_ns
        last_ns = entry.t_ns
        if entry.kind is EntryKind.ANSWERED:
            before_ns = sent_ns.get(number)
            if before_ns is None or entry.t_ns < before_ns:
                yield f"request {number}: answered before it was sent"
            elif number not in spans:
                spans[number] = _Span(before_ns, entry.t_ns, entry.epoch)
        elif number not in sent_ns:
            sent_ns[number] = entry.t_ns
            if listed and entry.payload != listed[(number - 1) % len(listed)]:
                not_listed.append(number)
    if backwards:
        yield f"{backwards} entries of the dialogue are earlier than the ones before them"
    origin = f"what seed {record.options.seed} draws" if record.given is None else f"that of {REQUESTS_NAME}"
    yield from (f"request {number}: not {origin}" for number in not_listed)
    if record.history.dropped:
        return
    effects = (one for name in record.history.journals for one in record.history.events_of(name, *EFFECTS))
    never = {one.request_id for one in effects} - sent_ns.keys() - {0}
    yield from (f"request {number}: executed, but never sent" for number in sorted(never))
    del sent_ns
    for number in _without(
        Event.REPLY_ACCEPTED, spans, record.history, lambda r, s: r.detail >> 8 == s.epoch
    ):
        yield f"request {number}: answered under epoch {spans[number].epoch}, which the proxy did not accept"
    for number in _without(Event.SERVER_EXIT, spans, record.history, lambda r, s: True):
        yield f"request {number}: answered, and no server executed it meanwhile"


def _listed_requests(record: RunRecord) -> Sequence[bytes]:
    """Those that a load sends again and again; none where they are not known, or a fault altered them."""
    work = record.options.work
    if not isinstance(work, LoadRun) or _flipped(record):
        return ()
    return (
        record.given or ()
        if work.requests
        else _drawn(record.options.seed, work.count, fixed=is_foreign(record.options.application))
    )


class _Span(NamedTuple):
    """Of a request: when it was sent and answered, and under which epoch."""

    sent_ns: int
    answered_ns: int
    epoch: int


def _without(
    event: Event, spans: dict[int, _Span], history: History, fits: Callable[[Record, _Span], bool]
) -> list[int]:
    """The requests that have no such record within their spans."""
    left = set(spans)
    for journal in history.journals:
        for record in history.events_of(journal, event):
            span = spans.get(record.request_id)
            if span is not None and span.sent_ns <= record.t_ns <= span.answered_ns and fits(record, span):
                left.discard(record.request_id)
    return sorted(left)


def _of_journals(record: RunRecord) -> Iterator[str]:
    """Each is that of its node, and has records of the bricks that the node has hosted."""
    graphs = [build(ftm, record.options.placement) for ftm in {record.options.ftm, *_adapted_to(record)}]
    for name, records in record.history.journals.items():
        if not records:
            continue
        node = records[0].node
        bricks = [graph.nodes.get(node, ()) for graph in graphs]
        if node.replace("/", ".") != name.rpartition(".")[0]:
            yield f"the journal {name} is that of {node}"
        servers = {
            number for hosted in bricks for number, brick in enumerate(hosted) if brick.endswith(SERVER)
        }
        if any(one.brick not in servers for one in record.history.events_of(name, *EFFECTS)):
            yield f"the journal {name} has effects of what is no server of {node}"


def _adapted_to(record: RunRecord) -> Iterator[str]:
    """The mechanisms to which adaptations led, or would have led."""
    for ftm in {name for one in record.adaptations for name in (one.ftm, one.tried_ftm)}:
        with suppress(ConfigError):
            build(ftm, record.options.placement)
            yield ftm
    for asked in record.options.adaptations:
        if asked.goal.expression:
            yield asked.goal.expression


def _of_adaptations(record: RunRecord) -> Iterator[str]:
    """What was asked for with the run, and what has an outcome."""
    asked = dict(enumerate(record.options.adaptations, 1))
    for one in record.adaptations:
        option = asked.get(one.scheduled)
        same = option is not None and (str(option), option.goal.recipe, option.goal.may_fail) == (
            one.asked,
            one.recipe,
            one.may_fail,
        )
        if one.scheduled and not same:
            yield f"adaptation {one.number}, {one.asked!r}, is not the one that was asked for with the run"


def _of_faults(record: RunRecord) -> Iterator[str]:
    """What was asked for, what has a receipt, what has struck. What the supervisor does, it does once."""
    told = [report.fault for report in record.faults if not report.live]
    if told != [str(fault) for fault in record.options.faults]:
        yield f"the receipts are not those of the faults that were asked for with the run: {told}"
    strikes = record.history.events(Event.FAULT_APPLIED)
    numbers = {fault_and_bits(strike.detail)[0] - FIRST_FAULT for strike in strikes}
    acts = Counter(strike.detail - FIRST_FAULT for strike in strikes if strike.node == SUPERVISOR)
    counted = Counter(report.number for report in record.faults)
    if twice := [number for number, count in counted.items() if count > 1]:
        yield f"two receipts have the number of one fault: number {min(twice) + 1}"
    if struck := numbers - counted.keys():
        yield f"a fault has struck, and there is no receipt: number {min(struck) + 1}"
    if again := [number for number, count in acts.items() if count > 1]:
        yield f"the supervisor has applied one fault {acts[min(again)]} times: number {min(again) + 1}"


def _of_policy(record: RunRecord) -> Iterator[str]:
    """What the closed loop reports, what it proposed, and what came of it."""
    if record.options.policy is None:
        if record.policy is not None or record.proposals:
            yield "a policy was followed, and none was asked for"
        return
    if record.policy is None:
        return  # the closed loop did not live to report
    proposed = Counter(one.rule for one in record.proposals)
    yield from (
        f"{rule.rule} proposed {rule.proposed} times, and there are {proposed[rule.rule]} proposals of it"
        for rule in record.policy.rules
        if proposed[rule.rule] != rule.proposed
    )
    done = Counter(one.ftm for one in record.adaptations if one.outcome == DONE and not one.scheduled)
    missing = Counter(one.target for one in record.proposals if one.outcome == DONE) - done
    yield from (f"the proposal of {target} was done, and no adaptation led there" for target in missing)


def _of_end(record: RunRecord, end: RunEnd) -> Iterator[str]:
    """The supervisor's last words against the rest."""
    ids = {entry.request_id for entry in record.history.dialogue if entry.kind is EntryKind.SENT}
    if end.hosted is not None and (end.leader, end.backup) != (end.hosted.leader, end.hosted.backup):
        yield f"{end.leader or 'none'} led at the end, and {end.hosted.leader or 'none'} led the graph"
    if end.lost and end.states:
        yield f"no replica was left, and {' and '.join(end.states)} had a state"
    whole = not record.history.dropped
    if whole and _at_rest(end) and end.client is not None and end.client.sent not in (None, len(ids)):
        yield f"the client sent {end.client.sent} requests, and its dialogue has {len(ids)}"
    if end.ended_ns:
        first_ns, last_ns = record.started_ns, end.ended_ns
        outside = sum(not first_ns <= t_ns <= last_ns for t_ns in record.history.times())
        if outside:
            yield f"{outside} records are of a time at which the run was not"


def _of_bus(record: RunRecord, end: RunEnd) -> Iterator[str]:
    """What the hub says of the bus against its log, and against what was asked for."""
    if end.bus is None:
        return
    if end.bus.open_to_all != record.options.bus_open:
        yield "run.json and end.json do not agree whether the bus was open to all"
    if record.frames < end.bus.frames:  # it may have carried more since it reported
        yield f"the hub carried {end.bus.frames} frames, and {BUS_NAME} has {record.frames}"


@lru_cache(maxsize=4)
def _drawn(seed: int, count: int, *, fixed: bool) -> list[bytes]:
    """The requests of a load, which come again and again."""
    return load_requests(seed, count, fixed=fixed)
