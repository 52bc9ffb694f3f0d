"""The checkers: what was promised (G1 to G6), judged over the history that a run left behind.

A history is the records of all nodes and the client's dialogue; where it comes from, real processes or
the simulator, makes no difference. Each checker answers pass, fail or unknown, with its reasons; each
has a broken history in the tests that it must refuse.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable
from itertools import starmap
from typing import Final, Literal

import msgspec

from aftbed.core.application import Application
from aftbed.core.errors import PeerError
from aftbed.core.events import RERUN, Event
from aftbed.core.fault import FIRED
from aftbed.core.graph import Graph
from aftbed.core.history import History
from aftbed.core.journal import Entry, EntryKind, Record
from aftbed.core.valuefault import BITFLIP
from aftbed.ftm.compose import build, replication_of
from aftbed.runtime.hosting import Hosted
from aftbed.vehicle.aeb.messages import AebOutput, decode_reply

REASONS_MAX: Final = 5
LATE_NS: Final = 60_000_000  # as long as the brake ECU holds the last request

Finding = Literal["pass", "fail", "unknown"]


class Check(msgspec.Struct, frozen=True):
    """The answer of one checker; `reasons` are the first few of what is wrong."""

    finding: Finding
    reasons: tuple[str, ...] = ()


class Requests(msgspec.Struct, frozen=True):
    """The client's account. `late`: answered after `LATE_NS`; `wrong`: not what the bare server says."""

    sent: int
    answered: int
    lost: int
    duplicated: int
    late: int
    wrong: int


class Failover(msgspec.Struct, frozen=True):
    """One change of master. Times count from the fault if that is in the history, else from the alarm.

    `blackout_ms` is the time without service: from when a request waited and nobody could answer it,
    to the first reply of the new master.
    """

    epoch: int
    cause: str
    detected_ms: float | None
    fenced_ms: float | None
    promoted_ms: float | None
    recovered_ms: float | None
    blackout_ms: float | None


def _check(reasons: list[str]) -> Check:
    return Check("fail" if reasons else "pass", tuple(reasons[:REASONS_MAX]))


def at_most_once(history: History) -> Check:
    """G1: within the life of one Server ids only grow, over executions and applied checkpoints alike.

    A rerun of what the Server executed last is not a second effect: it began by restoring the state of
    before, so what it did stands in the place of what the run before it did.
    """
    reasons = []
    for name, records in history.journals.items():
        lasts: dict[int, tuple[int, bool]] = {}  # by the Server: a node may host two
        for record in records:
            if record.event not in (Event.SERVER_EXIT, Event.STATE_RESTORED):
                continue
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
    waiting = [i for i, found in sorted(answers.items()) if not found] if cut_off else []
    reasons = [
        f"request {i}: {len(found)} replies"
        for i, found in sorted(answers.items())
        if len(found) != 1 and i not in waiting
    ]
    asked = {e.request_id for e in _sent(history)}
    reasons += [f"request {i}: answered, but never sent" for i in sorted(answers.keys() - asked)]
    strays = [r.request_id for r in _client_refusals(history) if r.request_id]
    reasons += [f"request {i}: one reply too many reached the client" for i in strays]
    if waiting and not reasons:
        return Check("unknown", (f"requests {waiting[:REASONS_MAX]} waited when the run was cut off",))
    return _check(reasons) if answers else Check("unknown", ("no request was sent",))


def one_history(history: History, bare: Application) -> Check:
    """G3: the replies are those of the bare server over the same requests in the order of ids."""
    reasons = [f"request {i}: the reply is not the bare server's" for i in wrong_replies(history, bare)]
    sent = [e.request_id for e in _sent(history)]
    if sent != list(range(1, len(sent) + 1)):
        reasons.append("the ids of the requests are not 1, 2, 3, ...")
    return _check(reasons) if sent else Check("unknown", ("no request was sent",))


def one_master(history: History) -> Check:
    """G6: epochs only grow, each is one replica's, and the last master is fenced before the next."""
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
    return _check(reasons) if masters else Check("unknown", ("no reply was accepted",))


def wrong_replies(history: History, bare: Application) -> list[int]:
    """The ids whose reply differs from the bare server's; `bare` is a fresh one."""
    answers = _answers(history)
    wrong = []
    for entry in _sent(history):
        try:
            expected = bare.execute(entry.payload)
        except PeerError:
            expected = b""
        if any(a.payload != expected for a in answers[entry.request_id]):
            wrong.append(entry.request_id)
    return wrong


def requests(history: History, bare: Application) -> Requests:
    """The client's account of its requests."""
    answers = _answers(history)
    sent_ns = {e.request_id: e.t_ns for e in _sent(history)}
    firsts = {i: min(a.t_ns for a in found) for i, found in answers.items() if found}
    refused = sum(bool(r.request_id) for r in _client_refusals(history))
    return Requests(
        sent=len(sent_ns),
        answered=len(firsts),
        lost=sum(i not in firsts for i in sent_ns),
        duplicated=sum(len(a) > 1 for a in answers.values()) + refused,
        late=sum(t_ns - sent_ns[i] > LATE_NS for i, t_ns in firsts.items() if i in sent_ns),
        wrong=len(wrong_replies(history, bare)),
    )


def failovers(history: History) -> list[Failover]:
    """Each change of master, in order."""
    accepted = history.events(Event.REPLY_ACCEPTED)
    firsts: dict[int, int] = {}
    lasts: dict[int, int] = {}
    for record in accepted:
        firsts.setdefault(record.detail >> 8, record.t_ns)
        lasts[record.detail >> 8] = record.t_ns
    promotions = history.events(Event.REPLICA_PROMOTED)
    return [_failover(history, p, firsts, lasts) for p in promotions]


def _failover(history: History, promoted: Record, firsts: dict[int, int], lasts: dict[int, int]) -> Failover:
    fence = _last_before(history.events(Event.REPLICA_FENCED), promoted.t_ns)
    alarm = _last_before(history.events(Event.WATCHDOG_SUSPECT), (fence or promoted).t_ns)
    epoch = promoted.detail
    before_ns = max((t for e, t in lasts.items() if e < epoch), default=0)
    faults = [f for f in history.events(Event.FAULT_APPLIED) if f.t_ns <= (alarm or fence or promoted).t_ns]
    fault = faults[-1] if faults and (alarm or fence or promoted).t_ns - faults[-1].t_ns < 10**9 else None
    start_ns = fault.t_ns if fault else (alarm or fence or promoted).t_ns
    reply_ns = firsts.get(epoch)
    sent_ns = {e.request_id: e.t_ns for e in _sent(history)}
    first_id = next((r.request_id for r in history.events(Event.REPLY_ACCEPTED) if r.detail >> 8 == epoch), 0)
    waiting_ns = max(start_ns, sent_ns.get(first_id, start_ns))

    def ms(t_ns: int | None) -> float | None:
        return None if t_ns is None else round((t_ns - start_ns) / 1e6, 3)

    return Failover(
        epoch=epoch,
        cause="fault" if fault else ("alarm" if alarm else "unknown"),
        detected_ms=ms(alarm.t_ns) if alarm and fault else None,
        fenced_ms=ms(fence.t_ns) if fence else None,
        promoted_ms=ms(promoted.t_ns),
        recovered_ms=ms(reply_ns),
        blackout_ms=None if reply_ns is None else round((reply_ns - max(waiting_ns, before_ns)) / 1e6, 3),
    )


def _last_before(records: Iterable[Record], t_ns: int) -> Record | None:
    return max((r for r in records if r.t_ns <= t_ns), key=lambda r: r.t_ns, default=None)


def _sent(history: History) -> list[Entry]:
    return [e for e in history.dialogue if e.kind is EntryKind.SENT]


def _answers(history: History) -> dict[int, list[Entry]]:
    found: dict[int, list[Entry]] = defaultdict(list)
    for entry in history.dialogue:
        if entry.kind is EntryKind.SENT:
            found[entry.request_id] = found[entry.request_id]
        elif entry.kind is EntryKind.ANSWERED:
            found[entry.request_id].append(entry)
    return found


def _client_refusals(history: History) -> list[Record]:
    return [r for r in history.events(Event.PEER_REFUSED) if r.node == "client"]


def missing(hosted: Iterable[tuple[str, str]], whole: Graph) -> list[str]:
    """G5: what differs between the bricks that live, with their kinds, and those of a whole graph."""
    found, wanted = Counter(hosted), Counter((b.name, b.kind) for b in whole.bricks)
    reasons = [f"{name} ({kind}) is missing" for name, kind in sorted(wanted - found)]
    return reasons + [f"{name} ({kind}) should not be there" for name, kind in sorted(found - wanted)]


# -- G4: a value fault never reaches the client. And where one does: what it asks the brakes for.
#
# Judged by the replies alone, whatever mechanism there was: only TR promises it, without TR a flipped bit
# is expected to come through, as silent data corruption (sdc). A run without a flipped bit proves nothing.


def value(history: History, bare: Application, faults: list[dict[str, str]]) -> Check | None:
    """The check, by the receipts of a run; None where no value fault was asked for. `bare` is a fresh one."""
    flips = [f for f in faults if f["fault"].split()[0] == BITFLIP]
    if not flips:
        return None
    wrong = corruptions(history, bare)
    if wrong:
        return Check("fail", tuple(wrong[:REASONS_MAX]))
    if not any(f["receipt"] in FIRED for f in flips):
        return Check("unknown", ("no value fault was applied",))
    return Check("pass")


def corruptions(history: History, bare: Application) -> list[str]:
    """Each reply that is not the bare server's, and what it says instead; in the order of the requests."""
    answers: dict[int, list[bytes]] = defaultdict(list)
    for entry in history.dialogue:
        if entry.kind is EntryKind.ANSWERED:
            answers[entry.request_id].append(entry.payload)
    found = []
    for entry in history.dialogue:
        if entry.kind is EntryKind.SENT:
            try:
                right = bare.execute(entry.payload)
            except PeerError:
                right = b""
            wrong = next((a for a in answers[entry.request_id] if a != right), None)
            if wrong is not None:
                found.append(f"request {entry.request_id}: sdc: {_difference(wrong, right)}")
    return found


def _difference(wrong: bytes, right: bytes) -> str:
    """What the brake ECU is asked for, and what it should have been asked for."""
    expected, found = _read(right), _read(wrong)
    if expected is None or found is None:
        return f"{_text(found, wrong)} instead of {_text(expected, right)}"
    fields = [(f, getattr(found, f), getattr(expected, f)) for f in AebOutput.__struct_fields__]
    differing = [(f, a, b) for f, a, b in fields if a != b]
    said = starmap("{} {} instead of {}".format, differing)
    return ", ".join(said) or f"the same demand in other bytes ({wrong.hex()})"


def _read(reply: bytes) -> AebOutput | None:
    try:
        return decode_reply(reply)
    except PeerError:
        return None


def _text(output: AebOutput | None, reply: bytes) -> str:
    if output is None:
        return f"what is no demand ({reply.hex() or 'empty'})"
    return f"stage {output.stage} at {output.deceleration_ms2} m/s2"


# -- G5: what lives at the end of a run is a whole graph, the one to which its adaptations came.
#
# "An adaptation either completes or leaves the graph that was there: never half of one" (design 3). Of a
# run
# that ended before redundancy was back, the backup's bricks are not asked for.


def half_a_graph(hosted: Hosted, expected: str) -> list[str]:
    """What is missing, or should not be there, where `expected` is the FTM that should run; [] if whole."""
    if not hosted.leader:
        return ["nobody leads"]
    if hosted.ftm != expected:
        return [f"{hosted.ftm} runs, though the adaptations came to {expected}"]
    duplex = bool(replication_of(expected))
    whole = build(expected, hosted.placement, hosted.leader if duplex else "a")
    joining = "" if hosted.backup or not duplex else ("b" if hosted.leader == "a" else "a")
    return [r for r in missing(hosted.bricks, whole) if not joining or not r.startswith(f"{joining}/")]
