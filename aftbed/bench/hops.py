"""The delay of one hop, as a distribution, out of the journals of a run under a synthetic load.

All notes of a step carry the time at which the step began, on a clock common to all nodes. So the time
between the notes of two bricks that are neighbours on the way of a request is one hop: the step of the
first brick, the encoding and the write, the wake-up of the second brick's process, its read and decoding.

Only pairs of notes that lie *exactly* one hop apart are used, for the share of one hop in the time of
several is not known, and its spread even less. Placement is `process`: each step to the next brick of the
way is a channel between two processes. Under `pbr` six of the twelve hops are used:

| from                        | to                       | the hop |
|-----------------------------|--------------------------|---------|
| protocol `request.received` | before `before.exit`     | pro2bfr |
| before `before.exit`        | proceed `proceed.enter`  | bfr2prd |
| proceed `proceed.enter`     | server `server.enter`    | prd2srv |
| server `state.captured`     | after `checkpoint.sent`  | srv2aft |
| protocol `reply.stored`     | proxy `reply.accepted`   | pro2pxy |
| proxy `reply.accepted`      | client `reply.delivered` | pxy2clt |

Not used: `request.sent` to `request.received`, two hops, since the Proxy notes nothing of a request;
`server.exit` to `state.captured`, three hops, since neither Proceed nor After notes the reply that it hands
on or asks about; and `checkpoint.sent` to `reply.stored`, one hop, but with a second message written before
it. That one wakes a process on the other core: it costs about as much as a hop where that core sleeps, and
little where it is busy. Pairs of this kind are shown apart, as `beside`. Under another mechanism the pairs
follow by the same rules from the way of its requests; where a brick notes the same event in two visits
(TR's trials), the visits cannot be told apart, and are left out.

Limits: what else runs on the machine is in the upper quantiles. The journal's writes are part of a hop.
"""

import itertools
import math
from collections import Counter
from typing import Final

import msgspec

from aftbed.bench.cycle import WARM_UP, path
from aftbed.bench.runs import finish, start
from aftbed.core.errors import HarnessError
from aftbed.core.events import Event
from aftbed.core.graph import Graph
from aftbed.ftm.compose import build
from aftbed.ftm.registry import BRICKS
from aftbed.judge.record import RunRecord
from aftbed.runtime.unix.options import LoadRun

PLACEMENT: Final = "process"
STEPS: Final = 128  # of `quantiles_ns`, evenly spaced
RUNS_MAX: Final = 5  # until one without an alarm
PERCENTS: Final = (*map(float, range(100)), 99.9, 100.0)
SHOWN: Final = {"p1": 1.0, "p10": 10.0, "p50": 50.0, "p90": 90.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}


class Place(msgspec.Struct, frozen=True):
    """A brick, which is a node of its own, and an event that it notes once per request."""

    brick: str
    event: Event

    def __str__(self) -> str:
        return f"{self.brick} {self.event}"


Pair = tuple[Place, Place]


class PairDelay(msgspec.Struct, frozen=True):
    """The hop between two notes, and its median (ns); one sample per request."""

    source: str
    sink: str
    p50_ns: int


class Hops(msgspec.Struct, frozen=True):
    """The delay of one hop, over all `pairs` and requests, by nearest rank; `beside` is not in it.

    `hop_ns`: a few quantiles by name; `percentiles_ns`: (percent, ns) for 0, 1, ..., 99, 99.9, 100;
    `quantiles_ns`: the 129 quantiles 0/128, 1/128, ..., 128/128.
    """

    ftm: str
    requests: int
    samples: int
    hop_ns: dict[str, int]
    percentiles_ns: tuple[tuple[float, int], ...]
    quantiles_ns: tuple[int, ...]
    pairs: tuple[PairDelay, ...]
    beside: tuple[PairDelay, ...]


def bench_hops(ftm: str, count: int, *, pin: bool = True) -> Hops:
    """Run `count` requests under `ftm` in a closed loop, after a warm-up, and read the hops off its record.

    Raises HarnessError where the run ended early, or no run of RUNS_MAX went without an alarm.
    """
    pairs, beside = single_hops(build(ftm, PLACEMENT))
    record = undisturbed(ftm, count + WARM_UP, pin=pin)
    delays = {pair: delays_ns(record, pair, WARM_UP) for pair in (*pairs, *beside)}
    for (source, sink), found in delays.items():
        if len(found) != count:
            raise HarnessError(f"{len(found)} of {count} requests have both notes: {source}, {sink}")
    ordered = sorted(itertools.chain.from_iterable(delays[pair] for pair in pairs))
    return Hops(
        ftm=ftm,
        requests=count,
        samples=len(ordered),
        hop_ns={name: nearest(ordered, percent / 100) for name, percent in SHOWN.items()},
        percentiles_ns=tuple((percent, nearest(ordered, percent / 100)) for percent in PERCENTS),
        quantiles_ns=tuple(nearest(ordered, step / STEPS) for step in range(STEPS + 1)),
        pairs=tuple(_pair_delay(pair, delays[pair]) for pair in pairs),
        beside=tuple(_pair_delay(pair, delays[pair]) for pair in beside),
    )


def undisturbed(ftm: str, count: int, *, pin: bool = True) -> RunRecord:
    """The record of a run in which the replica that led first led to its end, and kept its backup.

    On a machine that is busy with other things a Watchdog may take a chain for a hung one. Raises
    HarnessError where that happened in RUNS_MAX runs.
    """
    for _ in range(RUNS_MAX):
        record = finish(start(ftm, PLACEMENT, LoadRun(count, 0.0), pin=pin))
        if not record.history.events(Event.WATCHDOG_SUSPECT):
            return record
    raise HarnessError(f"an alarm in each of {RUNS_MAX} runs: the machine is too busy for this measurement")


def single_hops(graph: Graph) -> tuple[tuple[Pair, ...], tuple[Pair, ...]]:
    """The pairs of notes one hop apart, in the order of a request: those to use, and those beside.

    See the module for the difference.
    """
    visits = _visits(graph)
    once = {place for place, count in Counter(visits).items() if count == 1}
    pairs: list[Pair] = []
    beside: list[Pair] = []
    for source, sink in itertools.pairwise(visits):
        if source is not None and sink is not None and {source, sink} <= once:
            more = BRICKS[graph.brick(source.brick).kind].sends_beside
            (beside if more else pairs).append((source, sink))
    return tuple(pairs), tuple(beside)


def _visits(graph: Graph) -> list[Place | None]:
    """For each brick on the way of a request and its reply: what it notes there, None if nothing."""
    found: list[Place | None] = []
    seen: Counter[str] = Counter()
    asker = ""
    for brick in path(graph):
        kind = graph.brick(brick).kind
        if kind.endswith("server"):  # what it notes depends on what it is asked for
            asks_state = asker.endswith(("before", "after"))
            event: Event | None = Event.STATE_CAPTURED if asks_state else Event.SERVER_ENTER
        else:
            notes = BRICKS[kind].visits
            event = notes[seen[brick]] if seen[brick] < len(notes) else None
        found.append(Place(brick, event) if event else None)
        seen[brick] += 1
        asker = kind
    return found


def delays_ns(record: RunRecord, pair: Pair, skip: int) -> list[int]:
    """The time between the notes of `pair` (ns), of each request behind the first `skip` that has both."""
    source, sink = (_times_ns(record, place) for place in pair)
    return [t_ns - source[i] for i, t_ns in sink.items() if i in source and i > skip]


def _times_ns(record: RunRecord, place: Place) -> dict[int, int]:
    """When each request came to `place` (ns, monotonic)."""
    return {
        r.request_id: r.t_ns
        for records in record.history.journals.values()
        for r in records
        if r.node == place.brick and r.event is place.event
    }


def _pair_delay(pair: Pair, found: list[int]) -> PairDelay:
    return PairDelay(str(pair[0]), str(pair[1]), nearest(sorted(found), 0.5))


def nearest(ordered: list[int], share: float) -> int:
    """The value that `share` of the ascending `ordered` do not exceed (nearest rank); 0 is the least one."""
    assert ordered and 0 <= share <= 1
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]
