"""The steps of the nodes on the path of requests, and which step followed from which.

A journal tells at which time a node took a message up, and what it did then (the notes of one step have one
time). Neither how long the step took nor from whom the message came is in it. Both follow from the
mechanisms: `LED_TO` has, for each two events of which one leads to the other, the channel between them. Of
several steps that could have led to one, the last before it did. A step is drawn until the first that
followed from it was begun, so it includes the way there: for a hop of 10 us, most of what is seen is way.
Where nothing followed, or not for long (a crash), it is drawn as short as `LEAST_NS`, or as `MOST_NS`.

Limits: nodes that note nothing (a Proxy that passes a request on, an After that asks for the state) are not
seen, so an arrow may go past them; it is called by the last of its channels that is known.
"""

from collections import defaultdict
from collections.abc import Iterator
from typing import Final, NamedTuple

from aftbed.campaign.runfiles.happened import Kind, journals, kind_of
from aftbed.core.events import Event
from aftbed.judge.record import RunRecord

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
    (Event.STATE_CAPTURED, Event.REPLY_STORED): "aft2pro",  # nobody backs up
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


class Step(NamedTuple):
    """What brick number `brick` of the `life`th process that was `node` did at `t_ns` for a request."""

    t_ns: int
    node: str
    life: int
    brick: int
    request_id: int
    events: tuple[Event, ...]

    @property
    def process(self) -> tuple[str, int]:
        """Its name, and the how manyeth of that name it is."""
        return self.node, self.life

    @property
    def replica(self) -> str:
        """`a` or `b`; "" for a node outside of the replicas."""
        head, slash, _ = self.node.partition("/")
        return head if slash or head in ("a", "b") else ""


class Followed(NamedTuple):
    """`effect` followed from `cause`, over a channel; both are places in a list of steps."""

    cause: int
    effect: int
    channel: str


def steps_of(record: RunRecord) -> list[Step]:
    """All steps for requests, by time."""
    found: list[Step] = []
    for node, life, records in journals(record):
        for one in records:
            if not one.request_id or kind_of(one) is not Kind.REQUEST:
                continue
            step = Step(one.t_ns, node, life, one.brick, one.request_id, (one.event,))
            last = found[-1] if found else None
            # `server.enter` again is another step, also where its time is the same
            if last is not None and last[:5] == step[:5] and one.event not in last.events:
                found[-1] = last._replace(events=(*last.events, one.event))
            else:
                found.append(step)
    return sorted(found, key=lambda step: step.t_ns)


def followed(steps: list[Step]) -> list[Followed]:
    """For each step, the one from which it followed, if that is known."""
    before: defaultdict[int, list[int]] = defaultdict(list)
    found: list[Followed] = []
    for at, step in enumerate(steps):
        cause = max(_causes(steps, before[step.request_id], step), default=None)
        before[step.request_id].append(at)
        if cause is not None:
            found.append(Followed(cause[0], at, cause[1]))
    return found


def between_processes(steps: list[Step], all_followed: list[Followed]) -> list[Followed]:
    """Those that were messages: bricks that share a process speak without."""
    return [one for one in all_followed if steps[one.cause].process != steps[one.effect].process]


def _causes(steps: list[Step], before: list[int], step: Step) -> Iterator[tuple[int, str]]:
    for at in before:
        other = steps[at]
        across = bool(step.replica and other.replica and step.replica != other.replica)
        table = ACROSS if across else LED_TO
        for cause in other.events:
            for effect in step.events:
                if (channel := table.get((cause, effect))) is not None:
                    yield at, channel


def ends_ns(steps: list[Step], all_followed: list[Followed]) -> list[int]:
    """When each step ends, as far as it is drawn: no step of a process reaches into its next one."""
    ends = [step.t_ns + LEAST_NS for step in steps]
    first: dict[int, int] = {}
    for one in all_followed:
        cause, effect = steps[one.cause], steps[one.effect]
        if (cause.process, cause.brick) != (effect.process, effect.brick):  # a Server waits to be asked again
            first.setdefault(one.cause, effect.t_ns)
    for at, t_ns in first.items():
        ends[at] = min(max(ends[at], t_ns), steps[at].t_ns + MOST_NS)
    later: dict[tuple[str, int], int] = {}
    for at in range(len(steps) - 1, -1, -1):
        process = steps[at].process
        ends[at] = min(ends[at], later.get(process, ends[at]))
        later[process] = steps[at].t_ns
    return ends
