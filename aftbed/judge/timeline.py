"""What happened in a recorded run, and when: one timeline for every report and export.

`node_journals`, `category_of` and `describe` give the records of the journals and their words;
`logged_events` the lines that were printed; `steps_of` and `links_of` the steps of the nodes on the path of
requests; `TimeAxis` one axis of time.

**The axis** is bus time, in ns since the car's run began. The bus log has bus time, the journals have the
host's monotonic clock. A request has both: the time of its radar cycle in its payload, and the time of
sending in the dialogue. At a fixed pace the two clocks differ by one offset. A request is never sent before
its cycle, so the smallest difference found is an upper bound of the offset: the error is the latency of the
fastest request, plus the 1 ms resolution of a request's time. In lockstep virtual time stands still while the
function works. A monotonic time is then placed at the cycle of the last request sent before it: the order is
right, durations are not shown, so messages carry the processes' time as well. What happened before the car's
run is placed at its beginning. Without a bus, the axis is the monotonic clock from the launch of the run.

**Steps.** A journal has the time at which a node took up a message, and the events of that step, which have
the same time. It has neither the duration of the step nor the sender of the message. Both are derived from
the mechanisms: `LED_TO` has the channel between each two events of which one leads to the other. If several
steps could have led to one, the last one before it is taken. A step is drawn until the first step that
followed from it began, so it includes the transmission; of a hop of 10 us that is most. A step without a
consequence, or with a late one (a crash), is drawn with `LEAST_NS` or `MOST_NS`. Limit: nodes that record
nothing (a Proxy that passes a request on, an After that asks for the state) are not seen, so a link may skip
them; it has the name of the last of its channels that is known.
"""

import itertools
import json
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterator, Sequence
from enum import Enum
from typing import Final, NamedTuple

from aftbed.core.errors import ConfigError, PeerError
from aftbed.core.events import FIRST_FAULT, REQUEST_EVENTS, STEP_EVENTS, Event
from aftbed.core.input_file import read_input
from aftbed.core.journal import EntryKind, Record
from aftbed.inject.model import FaultReport
from aftbed.inject.receipts import fault_and_bits
from aftbed.judge.record import RunRecord
from aftbed.runtime.unix.options import LoadRun
from aftbed.runtime.unix.run_directory import EVENT_LOG_NAME
from aftbed.vehicle.aeb.messages import AebInput, decode_request

EVENT_LOG_BYTES_MAX: Final = 1 << 30
FAILURES: Final = frozenset(
    (Event.DETECTED_STOP, Event.FOLLOWER_DIVERGED, Event.NODE_DIED, Event.WATCHDOG_SUSPECT)
)


# -- events ---------------------------------------------------------------------------------------


class Category(Enum):
    """What an event belongs to."""

    REQUEST = "request"  # the path of a request
    FAULT = "fault"  # injected
    FAILURE = "failure"  # something broke, or was seen broken
    RECOVERY = "recovery"
    ADAPTATION = "adaptation"


class NodeJournal(NamedTuple):
    """The records of one process; `incarnation` counts the processes of its node, from 1."""

    node: str
    incarnation: int
    records: Sequence[Record]


class LoggedEvent(NamedTuple):
    """A line that the run printed, at a time of the monotonic clock."""

    t_ns: int
    event: str
    text: str


def node_journals(run: RunRecord) -> Iterator[NodeJournal]:
    for name, records in run.history.journals.items():
        if records:
            number = name.rpartition(".")[2]
            yield NodeJournal(records[0].node, int(number) if number.isdigit() else 1, records)


def category_of(one: Record) -> Category:
    if one.event is Event.FAULT_APPLIED:
        return Category.FAULT
    if one.event in FAILURES:
        return Category.FAILURE
    if one.event in REQUEST_EVENTS or one.event is Event.DEDUPE_HIT:
        return Category.REQUEST
    return Category.ADAPTATION if str(one.event).startswith("adapt") else Category.RECOVERY


def describe(one: Record, faults: Sequence[FaultReport]) -> str:
    """A record in words: an applied fault in those of its user; others by event, request and step."""
    if one.event is Event.FAULT_APPLIED:
        number = fault_and_bits(one.detail)[0] - FIRST_FAULT
        return next((report.fault for report in faults if report.number == number), "a fault")
    if one.event is Event.NODE_DIED:
        return f"{one.event}: process {one.detail}"
    words = [str(one.event), *([f"#{one.request_id}"] if one.request_id else [])]
    return " ".join([*words, *([str(one.detail)] if one.event in STEP_EVENTS else [])])


def logged_events(run: RunRecord) -> Iterator[LoggedEvent]:
    """The lines of the event log, up to the first torn one."""
    path = run.path / EVENT_LOG_NAME
    try:
        lines = read_input(path, EVENT_LOG_BYTES_MAX).splitlines()
    except FileNotFoundError:
        return
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    for line in lines:
        try:
            found = json.loads(line)
            t_ns = run.started_ns + int(found["t_ms"] * 1e6)
            yield LoggedEvent(t_ns, str(found["event"]), str(found["text"]))
        except (ValueError, KeyError, TypeError, RecursionError):
            return


# -- the axis of time -----------------------------------------------------------------------------


class SentRequest(NamedTuple):
    """A request that was sent at `t_ns` of the monotonic clock."""

    t_ns: int
    request: AebInput


def sent_requests(run: RunRecord) -> Iterator[SentRequest]:
    """The requests in the order of the dialogue, without those that cannot be decoded."""
    for entry in run.history.dialogue:
        if entry.kind is EntryKind.SENT:
            try:
                yield SentRequest(entry.t_ns, decode_request(entry.payload))
            except PeerError:  # changed by a fault, or of another function
                continue


class TimeAxis:
    """Converts times of the monotonic clock into times on the axis."""

    def __init__(self, run: RunRecord) -> None:
        work = run.options.work
        self._pace: float | None = 1.0
        self._start_ns = run.started_ns
        self._anchors: list[tuple[int, int]] = []  # in lockstep: monotonic time, bus time from then on
        if isinstance(work, LoadRun):
            return
        self._pace = work.pace
        pairs = [(one.t_ns, one.request.t_ms * 1_000_000) for one in sent_requests(run)]
        if work.pace is not None:
            self._start_ns = min((t - int(bus / work.pace) for t, bus in pairs), default=self._start_ns)
            return
        latest = 0
        for t_ns, bus_ns in pairs:
            latest = max(latest, bus_ns)
            self._anchors.append((t_ns, latest))

    def at(self, t_ns: int) -> int:
        """The place of the monotonic time `t_ns` on the axis, in ns; at least 0."""
        if self._pace is not None:
            return max(0, int((t_ns - self._start_ns) * self._pace))
        at = bisect_right(self._anchors, t_ns, key=lambda anchor: anchor[0])
        return self._anchors[at - 1][1] if at else 0


# -- steps on the path of requests ----------------------------------------------------------------

LEAST_NS, MOST_NS = 1_000, 200_000
LED_TO: Final[dict[tuple[Event, Event], str]] = {  # the cause, what followed: the channel
    (Event.REQUEST_SENT, Event.REQUEST_RECEIVED): "pxy2pro",
    (Event.REQUEST_SENT, Event.DEDUPE_HIT): "pxy2pro",
    (Event.REQUEST_SENT, Event.SERVER_ENTER): "pxy2pro",  # none
    (Event.REQUEST_RECEIVED, Event.BEFORE_EXIT): "pro2bfr",
    (Event.REQUEST_RECEIVED, Event.FOLLOWER_FORWARDED): "pro2bfr",
    (Event.REQUEST_RECEIVED, Event.STATE_CAPTURED): "bfr2srv",  # tr
    (Event.BEFORE_EXIT, Event.STATE_CAPTURED): "bfr2srv",  # x+tr
    (Event.STATE_CAPTURED, Event.BEFORE_EXIT): "srv2bfr",
    (Event.BEFORE_EXIT, Event.PROCEED_ENTER): "bfr2prd",
    (Event.PROCEED_ENTER, Event.SERVER_ENTER): "prd2srv",
    (Event.SERVER_EXIT, Event.SERVER_ENTER): "prd2srv",  # tr: again
    (Event.SERVER_EXIT, Event.VOTE_COMPARED): "prd2aft",
    (Event.SERVER_EXIT, Event.STATE_CAPTURED): "aft2srv",
    (Event.VOTE_COMPARED, Event.STATE_CAPTURED): "aft2srv",
    (Event.STATE_CAPTURED, Event.CHECKPOINT_SENT): "srv2aft",
    (Event.SERVER_EXIT, Event.FOLLOWER_NOTIFIED): "prd2aft",
    (Event.VOTE_COMPARED, Event.FOLLOWER_NOTIFIED): "pro2pxy",
    (Event.CHECKPOINT_SENT, Event.REPLY_STORED): "aft2pro",
    (Event.FOLLOWER_NOTIFIED, Event.REPLY_STORED): "aft2pro",
    (Event.VOTE_COMPARED, Event.REPLY_STORED): "aft2pro",
    (Event.STATE_CAPTURED, Event.REPLY_STORED): "aft2pro",  # without a backup
    (Event.SERVER_EXIT, Event.REPLY_STORED): "aft2pro",
    (Event.STATE_RESTORED, Event.CHECKPOINT_APPLIED): "srv2aft",
    (Event.REPLY_SENT, Event.REPLY_ACCEPTED): "pro2pxy",
    (Event.DEDUPE_HIT, Event.REPLY_ACCEPTED): "pro2pxy",
    (Event.SERVER_EXIT, Event.REPLY_ACCEPTED): "srv2prd",  # none
    (Event.REPLY_ACCEPTED, Event.REPLY_DELIVERED): "pxy2clt",
}
ACROSS: Final[dict[tuple[Event, Event], str]] = {  # from one replica to the other
    (Event.CHECKPOINT_SENT, Event.STATE_RESTORED): "aft2aft",
    (Event.FOLLOWER_FORWARDED, Event.BEFORE_EXIT): "bfr2bfr",
}


class NodeStep(NamedTuple):
    """The events that brick number `brick` of a process recorded at `t_ns` for one request."""

    t_ns: int
    node: str
    incarnation: int
    brick: int
    request_id: int
    events: tuple[Event, ...]

    @property
    def process(self) -> tuple[str, int]:
        return self.node, self.incarnation

    @property
    def replica(self) -> str:
        """`a` or `b`; "" for a node outside of the replicas."""
        head, slash, _ = self.node.partition("/")
        return head if slash or head in ("a", "b") else ""


class StepLink(NamedTuple):
    """Step `effect` followed from step `cause`, over a channel; both are indices into the list of steps."""

    cause: int
    effect: int
    channel: str


def steps_of(run: RunRecord) -> list[NodeStep]:
    """All steps on the path of requests, by time."""
    found: list[NodeStep] = []
    for node, incarnation, records in node_journals(run):
        for one in records:
            if not one.request_id or category_of(one) is not Category.REQUEST:
                continue
            step = NodeStep(one.t_ns, node, incarnation, one.brick, one.request_id, (one.event,))
            last = found[-1] if found else None
            # an event that occurs again, as `server.enter`, is another step even at the same time
            if last is not None and last[:5] == step[:5] and one.event not in last.events:
                found[-1] = last._replace(events=(*last.events, one.event))
            else:
                found.append(step)
    return sorted(found, key=lambda step: step.t_ns)


def links_of(steps: list[NodeStep]) -> list[StepLink]:
    """For each step with a known cause, the link from the last step that can be its cause."""
    before: defaultdict[int, list[int]] = defaultdict(list)
    found: list[StepLink] = []
    for at, step in enumerate(steps):
        for cause in reversed(before[step.request_id]):
            if channel := _channel(steps[cause], step):
                found.append(StepLink(cause, at, channel))
                break
        before[step.request_id].append(at)
    return found


def _channel(cause: NodeStep, effect: NodeStep) -> str:
    """The channel from one step to the other; "" if the one did not lead to the other."""
    across = bool(cause.replica and effect.replica and cause.replica != effect.replica)
    table = ACROSS if across else LED_TO
    pairs = itertools.product(cause.events, effect.events)
    return max((table.get(pair, "") for pair in pairs), default="")


def between_processes(steps: list[NodeStep], links: list[StepLink]) -> list[StepLink]:
    """The links that were messages between processes."""
    return [one for one in links if steps[one.cause].process != steps[one.effect].process]


def ends_ns(steps: list[NodeStep], links: list[StepLink]) -> list[int]:
    """The drawn end of each step; it is not after the start of the next step of the same process."""
    ends = [step.t_ns + LEAST_NS for step in steps]
    first: dict[int, int] = {}
    for one in links:
        cause, effect = steps[one.cause], steps[one.effect]
        if (*cause.process, cause.brick) != (*effect.process, effect.brick):  # a Server's next is no effect
            first.setdefault(one.cause, effect.t_ns)
    for at, t_ns in first.items():
        ends[at] = min(max(ends[at], t_ns), steps[at].t_ns + MOST_NS)
    later: dict[tuple[str, int], int] = {}
    for at, step in reversed(list(enumerate(steps))):
        ends[at] = min(ends[at], later.get(step.process, ends[at]))
        later[step.process] = step.t_ns
    return ends
