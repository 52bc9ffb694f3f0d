"""The checkers: what was promised (G1 to G6), judged over the history that a run left behind.

A history is the records of all nodes and the client's dialogue; where it comes from, real processes or
the simulator, makes no difference. Each checker answers pass, fail or unknown, with its reasons; each
has a broken history in the tests that it must refuse.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final, Literal, NamedTuple

import msgspec

from aftbed.core.application import Field
from aftbed.core.errors import PeerError
from aftbed.core.events import FIRST_FAULT, RERUN, Event
from aftbed.core.graph import Graph
from aftbed.core.journal import Entry, EntryKind, History, Record
from aftbed.ftm.compose import REPLICAS, build, replication_of
from aftbed.inject.model import Fault, FaultReport, parse
from aftbed.inject.receipts import fault_and_bits
from aftbed.inject.targets import PRIMARY
from aftbed.judge import sources
from aftbed.judge.bare_server import ReferenceRun
from aftbed.judge.exercise import differs
from aftbed.judge.record import Excuses, RunRecord
from aftbed.runtime.deployment import Hosted, replica_of
from aftbed.runtime.unix.options import COMMAND_GONE, CarRun, ReplayRun, Work
from aftbed.vehicle.aeb.messages import AebOutput, decode_reply
from aftbed.vehicle.can.dbc_file import own_dbc
from aftbed.vehicle.can.hub import Stranger
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import broken_expectations

REASONS_MAX: Final = 5
REQUESTED_ENDS: Final = ("", "interrupted", "stopped")  # ends of a run that its user asked for
VEHICLE: Final = "vehicle"  # the name of the check of what a scenario expects of the car
NOTHING_EXCUSED: Final = Excuses()
LATE_NS: Final = 60_000_000  # of bus time: as long as the brake ECU holds the last request
HANG_NOTICED_NS: Final = 50_000_000  # after the end of a hang an alarm may still be about it

Finding = Literal["pass", "fail", "unknown"]


class Check(msgspec.Struct, frozen=True):
    """The answer of one checker; `reasons` are the first few of what is wrong."""

    finding: Finding
    reasons: tuple[str, ...] = ()


class Requests(msgspec.Struct, frozen=True):
    """The client's account. `late`: answered after `late_after_ns`; `wrong`: not the bare server's."""

    sent: int
    answered: int
    lost: int
    duplicated: int
    late: int
    wrong: int


class Failover(msgspec.Struct, frozen=True):
    """One change of master. Times count from the fault that ended the last one, else from the alarm.

    `fault` is that crash or hang, in its words, "" where the record names none. `blackout_ms` is the time
    without service: from when a request waited and no replica could answer it, to the first reply of the new
    master.
    """

    epoch: int
    cause: str
    detected_ms: float | None
    fenced_ms: float | None
    promoted_ms: float | None
    recovered_ms: float | None
    blackout_ms: float | None
    fault: str = ""


def _check(reasons: list[str]) -> Check:
    return Check("fail" if reasons else "pass", tuple(reasons[:REASONS_MAX]))


def at_most_once(history: History) -> Check:
    """G1: within the life of one Server ids only grow, over executions and applied checkpoints alike.

    A rerun of what the Server executed last is not a second effect: it began by restoring the state of
    before, so what it did stands in the place of what the run before it did.
    """
    reasons = []
    for name in history.journals:
        lasts: dict[int, tuple[int, bool]] = {}  # by the Server: a node may host two
        for record in history.events_of(name, Event.SERVER_EXIT, Event.STATE_RESTORED):
            last, executed = lasts.get(record.brick, (0, False))
            exits = record.event is Event.SERVER_EXIT
            again = exits and executed and record.detail == RERUN and record.request_id == last
            if record.request_id <= last and not again:
                reasons.append(f"{name}: request {record.request_id} ({record.event}) after {last}")
            lasts[record.brick] = record.request_id, exits
    return _check(reasons)


def exactly_one_answer(history: History, *, cut_off: bool = False) -> Check:
    """G2: each request sent has one reply. Of a history that was `cut_off`, what waited is not known."""
    answers = _answers(history)
    odd = sorted(i for i, count in answers.items() if count != 1)
    waiting = {i for i in odd if not answers[i]} if cut_off else set()
    reasons = [f"request {i}: {answers[i]} replies" for i in odd if i not in waiting]
    asked = {e.request_id for e in _sent(history)}
    reasons += [f"request {i}: answered, but never sent" for i in sorted(answers.keys() - asked)]
    strays = [r.request_id for r in _client_refusals(history) if r.request_id]
    reasons += [f"request {i}: one reply too many reached the client" for i in strays]
    if waiting and not reasons:
        return Check(
            "unknown", (f"requests {sorted(waiting)[:REASONS_MAX]} waited when the run was cut off",)
        )
    return _check(reasons) if answers else Check("unknown", ("no request was sent",))


def one_history(history: History, reference: ReferenceRun) -> Check:
    """G3: the replies are those of the bare server over the same requests in the order of ids."""
    if reference.unknown:
        return Check("unknown", (reference.unknown,))
    wrong = wrong_replies(history, reference)
    reasons = [f"request {i}: the reply is not the bare server's" for i in wrong]
    sent = 0
    for sent, entry in enumerate(_sent(history), 1):
        if entry.request_id != sent:
            reasons.append("the ids of the requests are not 1, 2, 3, ...")
            break
    return _check(reasons) if sent else Check("unknown", ("no request was sent",))


def one_master(history: History) -> Check:
    """G6: epochs only grow, each is one replica's, and the last master is fenced before the next.

    Where no reply was accepted there was no second master; G2 has what is wrong with such a run.
    """
    reasons: list[str] = []
    masters: dict[int, int] = {}
    fences = history.events(Event.REPLICA_FENCED)
    promoted_ns = {r.detail: r.t_ns for r in history.events(Event.REPLICA_PROMOTED)}
    epoch = 0
    for record in history.events(Event.REPLY_ACCEPTED):
        found, replica = record.detail >> 8, record.detail & 0xFF
        if found < epoch:
            reasons.append(f"a reply of epoch {found} accepted after one of epoch {epoch}")
        if masters.setdefault(found, replica) != replica:
            reasons.append(f"epoch {found}: replies of replicas {masters[found]} and {replica}")
        if epoch and found > epoch:
            # What was sent before the fence may be accepted after it, so its place is before the promotion.
            old, began_ns = masters[epoch], promoted_ns.get(epoch, 0)
            ended_ns = promoted_ns.get(found, began_ns)
            if not any(f.detail & 0xFF == old and began_ns <= f.t_ns <= ended_ns for f in fences):
                reasons.append(f"replica {old} was not fenced between epochs {epoch} and {found}")
        epoch = max(epoch, found)
    sent = any(True for _ in _sent(history))
    return _check(reasons) if sent else Check("unknown", ("no request was sent",))


def wrong_replies(history: History, reference: ReferenceRun) -> dict[int, bytes]:
    """The replies that differ from the bare server's by more than its function tolerates, by request."""
    expected, wrong = dict(reference.replies), dict[int, bytes]()
    for entry in history.dialogue:
        number = entry.request_id
        known = entry.kind is EntryKind.ANSWERED and number in expected
        if known and reference.is_wrong(number, entry.payload, expected[number]):
            wrong.setdefault(number, entry.payload)
    return dict(sorted(wrong.items()))


def late_after_ns(work: Work) -> int:
    """After how long a reply is late, by the clock: `LATE_NS` at the pace of the run, if it has one."""
    pace = work.pace if isinstance(work, CarRun | ReplayRun) else None
    return LATE_NS if pace is None else round(LATE_NS / pace)


def answered_after_ns(history: History) -> list[int]:
    """How long each request that was answered waited for its first reply."""
    sent_ns = {e.request_id: e.t_ns for e in _sent(history)}
    firsts: dict[int, int] = {}
    for entry in history.dialogue:
        if entry.kind is EntryKind.ANSWERED:
            firsts[entry.request_id] = min(entry.t_ns, firsts.get(entry.request_id, entry.t_ns))
    return [t_ns - sent_ns[i] for i, t_ns in firsts.items() if i in sent_ns]


def requests(history: History, reference: ReferenceRun, late_ns: int = LATE_NS) -> Requests:
    """The client's account of its requests."""
    answers = _answers(history)
    sent = {e.request_id for e in _sent(history)}
    refused = sum(bool(r.request_id) for r in _client_refusals(history))
    return Requests(
        sent=len(sent),
        answered=sum(count > 0 for count in answers.values()),
        lost=sum(not answers[i] for i in sent),
        duplicated=sum(count > 1 for count in answers.values()) + refused,
        late=sum(waited_ns > late_ns for waited_ns in answered_after_ns(history)),
        wrong=len(wrong_replies(history, reference)),
    )


class MasterChange(NamedTuple):
    """What the record has of one change of master. `strike`: of the fault that ended the last one."""

    epoch: int
    strike: Record | None
    alarm: Record | None
    fence: Record | None
    promoted: Record

    @property
    def fault_number(self) -> int:
        """Which of the run's faults ended the last master, from 0 on; -1: none is known to."""
        return -1 if self.strike is None else number_of(self.strike)


def master_changes(history: History, faults: Sequence[FaultReport] = ()) -> list[MasterChange]:
    """Each one, in order. `faults` are those of the run."""
    fences, alarms = history.events(Event.REPLICA_FENCED), history.events(Event.WATCHDOG_SUSPECT)
    strikes = history.events(Event.FAULT_APPLIED)
    actions = {report.number: parse(report.fault) for report in faults}
    found, since_ns = [], 0
    for promoted in history.events(Event.REPLICA_PROMOTED):
        fence = _last_before(fences, promoted.t_ns)
        alarm = _last_before(alarms, (fence or promoted).t_ns)
        strike = _cause(strikes, actions, since_ns, alarm or fence or promoted, fence)
        found.append(MasterChange(promoted.detail, strike, alarm, fence, promoted))
        since_ns = promoted.t_ns
    return found


def failovers(history: History, faults: Sequence[FaultReport] = ()) -> list[Failover]:
    """Each change of master, in order. `faults` are those of the run."""
    words = {report.number: report.fault for report in faults}
    epochs = _epochs(history)
    found = []
    for change in master_changes(history, faults):
        epoch, fault, alarm, fence, promoted = change
        start_ns = (fault or alarm or fence or promoted).t_ns
        service = epochs.get(epoch)
        reply = service.first if service is not None else None
        blackout_ms = None
        if service is not None:  # no service from when a request waited, and the last master replied no more
            waiting_ns = max(start_ns, service.sent_ns or start_ns)
            before_ns = max((one.last_ns for e, one in epochs.items() if e < epoch), default=0)
            blackout_ms = round((service.first.t_ns - max(waiting_ns, before_ns)) / 1e6, 3)
        detected_ms, fenced_ms, promoted_ms, recovered_ms = (
            None if one is None else round((one.t_ns - start_ns) / 1e6, 3)
            for one in (alarm if fault else None, fence, promoted, reply)
        )
        cause = "fault" if fault else "alarm" if alarm else "unknown"
        times_ms = (detected_ms, fenced_ms, promoted_ms, recovered_ms, blackout_ms)
        found.append(Failover(epoch, cause, *times_ms, fault=words.get(change.fault_number, "")))
    return found


class _Service(NamedTuple):
    """Of one master: its first accepted reply, when that request was sent (0: unknown), and its last one."""

    first: Record
    sent_ns: int
    last_ns: int


def _epochs(history: History) -> dict[int, _Service]:
    """The service of each master, by epoch."""
    firsts: dict[int, Record] = {}
    lasts_ns: dict[int, int] = {}
    for name in history.journals:
        for record in history.events_of(name, Event.REPLY_ACCEPTED):
            epoch = record.detail >> 8
            first = firsts.setdefault(epoch, record)
            if record.t_ns < first.t_ns:
                firsts[epoch] = record
            lasts_ns[epoch] = max(record.t_ns, lasts_ns.get(epoch, 0))
    numbers = {record.request_id for record in firsts.values()}
    sent_ns = {e.request_id: e.t_ns for e in _sent(history) if e.request_id in numbers}
    return {
        epoch: _Service(first, sent_ns.get(first.request_id, 0), lasts_ns[epoch])
        for epoch, first in firsts.items()
    }


def served_by(history: History) -> list[tuple[int, str]]:
    """From when on each replica was the one whose replies were accepted, in the order of time."""
    firsts = sorted((service.first for service in _epochs(history).values()), key=lambda r: r.t_ns)
    return [(record.t_ns, _replica_in(record)) for record in firsts]


def _replica_in(record: Record) -> str:
    """The replica that a fence or a reply is about; "" for a number that none has, in a damaged record."""
    return dict(enumerate(REPLICAS, 1)).get(record.detail & 0xFF, "")


def _cause(
    strikes: Sequence[Record],
    faults: Mapping[int, Fault],
    since_ns: int,
    alarm: Record,
    fence: Record | None,
) -> Record | None:
    """The strike that ended the fenced leader: of a crash, or of a hang that was not over before the alarm.

    Only a fault aimed at that replica while it led, from `since_ns` on, is one. What else ends a replica (a
    signal from outside, a value fault that a self-test finds) is not named by a strike.
    """

    def ended_it(strike: Record) -> bool:
        fault = faults.get(number_of(strike))
        if fence is None or fault is None or not since_ns <= strike.t_ns <= alarm.t_ns:
            return False
        fenced = _replica_in(fence)
        if not fault.action.stops_process or (fault.target != PRIMARY and replica_of(fault.target) != fenced):
            return False
        lasts_ns = fault.action.lasts_ms * 1_000_000
        return not lasts_ns or alarm.t_ns <= strike.t_ns + lasts_ns + HANG_NOTICED_NS

    return _last_before(filter(ended_it, strikes), alarm.t_ns)


def number_of(strike: Record) -> int:
    """Which of the run's faults has struck, from 0 on."""
    return fault_and_bits(strike.detail)[0] - FIRST_FAULT


def _last_before(records: Iterable[Record], t_ns: int) -> Record | None:
    return max((r for r in records if r.t_ns <= t_ns), key=lambda r: r.t_ns, default=None)


def _sent(history: History) -> Iterator[Entry]:
    return (e for e in history.dialogue if e.kind is EntryKind.SENT)


def _answers(history: History) -> dict[int, int]:
    """How many replies each request has that was sent or answered."""
    found: dict[int, int] = defaultdict(int)
    for entry in history.dialogue:
        found[entry.request_id] += entry.kind is EntryKind.ANSWERED
    return found


def _client_refusals(history: History) -> list[Record]:
    return [r for r in history.events(Event.PEER_REFUSED) if r.node == "client"]


def missing(hosted: Iterable[tuple[str, str]], whole: Graph) -> list[str]:
    """G5: what differs between the bricks that live, with their kinds, and those of a whole graph."""
    found, wanted = Counter(hosted), Counter((b.name, b.kind) for b in whole.bricks)
    reasons = [f"{name} ({kind}) is missing" for name, kind in sorted(wanted - found)]
    return reasons + [f"{name} ({kind}) should not be there" for name, kind in sorted(found - wanted)]


def corruptions(history: History, reference: ReferenceRun) -> list[str]:
    """Each reply that is not the bare server's, and what it asks for instead, by request."""
    right = dict(reference.replies)
    wrong = wrong_replies(history, reference).items()
    return [
        f"request {i}: sdc: {_difference(reply, right[i], reference.rule(i).fields)}" for i, reply in wrong
    ]


def _difference(wrong: bytes, right: bytes, fields: Sequence[Field]) -> str:
    """The demand on the brakes, or the first of the function's `fields` that differs; and what is right."""
    found, expected = _decoded(wrong), _decoded(right)
    if isinstance(expected, str):  # of a function of the user
        return f"the reply is wrong: {differs(wrong, right, fields)} ({wrong.hex()} instead of {right.hex()})"
    if isinstance(found, str):
        return f"{found} instead of {_demand(expected)}"
    values = [(f, getattr(found, f), getattr(expected, f)) for f in AebOutput.__struct_fields__]
    differing = [f"{name} {a} instead of {b}" for name, a, b in values if a != b]
    return ", ".join(differing) or f"the same demand in other bytes ({wrong.hex()})"


def _demand(output: AebOutput) -> str:
    return f"stage {output.stage} at {output.deceleration_ms2} m/s2"


def _decoded(reply: bytes) -> AebOutput | str:
    """The demand; or words for what is none."""
    try:
        return decode_reply(reply)
    except PeerError:
        return f"what is no demand ({reply.hex() or 'empty'})"


def half_a_graph(hosted: Hosted, expected: str) -> list[str]:
    """What of the graph of FTM `expected` is missing, or should not be there; [] if it is whole.

    Of a run that ended before redundancy was back, the bricks of the backup are not required.
    """
    if not hosted.leader:
        return ["no replica leads"]
    if hosted.leader not in REPLICAS:
        return [f"{hosted.leader!r} leads, which is no replica"]
    if hosted.ftm != expected:
        return [f"{hosted.ftm} runs, though the adaptations came to {expected}"]
    duplex = bool(replication_of(expected))
    whole = build(expected, hosted.placement, hosted.leader)
    joining = "" if hosted.backup or not duplex else ("b" if hosted.leader == "a" else "a")
    return [r for r in missing(hosted.bricks, whole) if not joining or not r.startswith(f"{joining}/")]


# -- The checks of a run: whether each promise holds in its record.


class Evidence(msgspec.Struct, frozen=True):
    """The input of a check: the record of a run, and what the bare server made of the same requests."""

    record: RunRecord
    reference: ReferenceRun

    @property
    def excuses(self) -> Excuses:
        """What the faults of this run allow."""
        return self.record.excuses or NOTHING_EXCUSED


class Checker(NamedTuple):
    """A check by its name in the verdict, and the promise that it is about ("" of none of G1 to G8).

    `check` gives None where it does not apply to a run of this kind.
    """

    name: str
    promise: str
    check: Callable[[Evidence], Check | None]

    def __str__(self) -> str:
        return f"{self.name} ({self.promise})" if self.promise else self.name


def check_exactly_one_answer(evidence: Evidence) -> Check:
    record = evidence.record
    cut_off = record.end is None or record.end.reason == COMMAND_GONE or evidence.excuses.service_lost
    if record.simulated and record.lost and not cut_off:
        names = ", ".join(evidence.excuses.struck)
        struck = f"only {names}" if names else "no node"
        return Check("fail", (f"the service is lost, though {struck} was struck",))
    return exactly_one_answer(record.history, cut_off=cut_off)


def check_one_history(evidence: Evidence) -> Check | None:
    if evidence.excuses.values or not evidence.reference.rules[0].deterministic:
        return None
    return one_history(evidence.record.history, evidence.reference)


def check_value(evidence: Evidence) -> Check | None:
    """G4, judged by the replies alone, whatever mechanism ran.

    Only TR promises it: without TR a flipped bit is expected to come through, as silent data corruption
    (sdc). Without a flipped bit the check does not apply.
    """
    record = evidence.record
    flips = [f for f in record.faults if f.action.alters_value]
    if not flips or evidence.excuses.values:
        return None
    if evidence.reference.unknown:
        return Check("unknown", (evidence.reference.unknown,))
    wrong = corruptions(record.history, evidence.reference)
    if wrong:
        return Check("fail", tuple(wrong[:REASONS_MAX]))
    if not any(f.fired for f in flips):
        return Check("unknown", ("no value fault was applied",))
    return Check("pass")


def check_whole_graph(evidence: Evidence) -> Check:
    """G5: at the end lives a whole graph, the one to which the adaptations came, unless none is left."""
    record = evidence.record
    if record.end is None or record.end.hosted is None:
        return Check("unknown", ("the supervisor did not live to report the graph",))
    if record.lost or evidence.excuses.service_lost:
        return Check("pass")  # no service is left: the other checks judge that
    if record.end.unfinished and not record.simulated:
        return Check("unknown", (f"the run ended before it was at rest: {'; '.join(record.end.unfinished)}",))
    return _check(half_a_graph(record.end.hosted, record.ftm))


def check_at_rest(evidence: Evidence) -> Check | None:
    """A simulated run lasts until nothing is under way, or so long that it never will."""
    record = evidence.record
    if not record.simulated or record.end is None or record.lost or evidence.excuses.service_lost:
        return None
    return _check(["; ".join(record.end.unfinished)] if record.end.unfinished else [])


def check_assertions(evidence: Evidence) -> Check | None:
    """An assert that failed in a brick of a simulated run is a bug, whatever came of it."""
    if not evidence.record.simulated:
        return None
    return _check(list(evidence.record.failures[:1]))


def check_clean_exit(evidence: Evidence) -> Check | None:
    """G7, as far as the supervisor saw it; a run without its end is trouble of the harness."""
    end = evidence.record.end
    if evidence.record.simulated:
        return None
    if end is None:
        return Check("unknown", ("the supervisor did not live to end the run",))
    if end.left:
        return Check("fail", (f"left behind: {list(end.left)}",))
    if end.reason not in REQUESTED_ENDS:
        return Check("unknown", (end.reason,))
    return Check("pass")


def strangers(record: RunRecord) -> list[Stranger]:
    """What strangers did on the bus, by user; messages of the car are called by their names."""
    found = record.end.bus.strangers if record.end is not None and record.end.bus is not None else []
    if not any(one.forged for one in found):
        return found
    codec = own_dbc()
    names = {f"{codec.can_id(name):03X}": name for name in codec.names()}
    return [
        msgspec.structs.replace(one, forged={names.get(i, f"0x{i}"): n for i, n in one.forged.items()})
        for one in found
    ]


def stranger_line(one: Stranger) -> str:
    """What it did, for people."""
    forged = f" (forged: {counted(one.forged)})" if one.forged else ""
    figures = (
        (one.connections, "on the bus"),
        (one.turned_away, "turned away"),
        (one.frames, f"frames{forged}"),
        (one.refused, "elements refused"),
        (one.commands_refused, "of them commands"),
        (one.put_out_fast, "put out as too fast"),
        (one.put_out_slow, "put out as too slow"),
        (one.put_out_oversized, "put out for an element over the limit"),
    )
    return f"{one}: " + ", ".join(f"{count} {what}" for count, what in figures if count)


def check_no_forged_frames(evidence: Evidence) -> Check | None:
    """G8: what a stranger sent in the name of a node of the run is a fault that was not asked for.

    What the function then did proves nothing about what was asked for, unless the bus was open to all: then
    strangers are a part of it.
    """
    record = evidence.record
    if record.simulated or record.end is None or record.end.bus is None:
        return None
    forged = [f"{one} sent {counted(one.forged)}" for one in strangers(record) if one.forged]
    if not forged or record.options.bus_open:
        return Check("pass")
    return Check("unknown", tuple(f"{one}, which was not asked for" for one in forged[:REASONS_MAX]))


def counted(frames: Mapping[str, int]) -> str:
    """`3 AEB_REQ, 1 RADAR_TRACK`."""
    return ", ".join(f"{count} {name}" for name, count in frames.items())


def check_sources(evidence: Evidence) -> Check | None:
    """G8: what the sources of a record tell fits together, and none is missing."""
    if evidence.record.simulated:
        return None
    wrong = tuple(sources.contradictions(evidence.record, evidence.reference))
    missing = tuple(sources.gaps(evidence.record, evidence.reference))
    finding: Finding = "fail" if wrong else "unknown" if missing else "pass"
    return Check(finding, (*wrong, *missing)[:REASONS_MAX])


def check_whole_history(evidence: Evidence) -> Check:
    """G8: a journal that was full has not seen everything."""
    lost = evidence.record.history.dropped
    return Check("unknown", (f"{lost} records found no room in the journals",)) if lost else Check("pass")


def check_vehicle(evidence: Evidence) -> Check | None:
    """What the scenario expects of the car; a drive that was broken off is judged by what it did."""
    record = evidence.record
    work = record.options.work
    if not isinstance(work, CarRun) or (record.simulated and record.lost):
        return None  # without a service no drive is promised to end well
    if record.vehicle is None:
        return Check("unknown", ("the car did not report",))
    if record.drive is not None and record.drive.end == "stopped" and not record.vehicle.collision:
        return Check("pass")
    broken = broken_expectations(load_scenario(work.scenario), record.vehicle)
    if broken and work.pace is not None:
        broken = [*broken, *_lateness(record.history, work.pace, late_after_ns(work))]
    return Check("fail" if broken else "pass", tuple(broken))


def _lateness(history: History, pace: float, late_ns: int) -> list[str]:
    """What a car in real time may have missed: the replies that came late, by bus time."""
    late = sorted(waited_ns for waited_ns in answered_after_ns(history) if waited_ns > late_ns)
    if not late:
        return []
    latest_s, limit_ms = late[-1] * pace / 1e9, LATE_NS // 1_000_000
    return [
        f"{len(late)} replies came more than {limit_ms} ms of bus time after their requests, the latest"
        f" after {latest_s:.2f} s: is this machine too slow or too busy for this pace?"
    ]
