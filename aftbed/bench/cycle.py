"""Cycle time at the client beside its limit, the bare ring; and the delay of one hop.

**Ring.** No mechanism over processes and sockets can be faster: as many hops as a request takes through the
mechanism, over the same kind of sockets, pinned alike, in the same language, but with a plain read and a
plain write per hop, without bricks, decoding or journal. Cycle and ring are measured in turn in the same
run.

**Hop.** `bench_hops` reads the delay of one hop, as a distribution, from the journals of a run. All notes
of a step carry the time at which the step began, on a clock common to all nodes. So the time between the
notes of two bricks that are neighbours on the path of a request is one hop: the step of the first brick,
the encoding and the write, the wake-up of the second brick's process, its read and decoding.

Only pairs of notes *exactly* one hop apart are used, because the share of one hop in the time of several is
unknown, and its spread even more. The placement is `process`: each step to the next brick of the path is a
channel between two processes. Under `pbr` six of the twelve hops are used:

| from                        | to                       | the hop |
|-----------------------------|--------------------------|---------|
| protocol `request.received` | before `before.exit`     | pro2bfr |
| before `before.exit`        | proceed `proceed.enter`  | bfr2prd |
| proceed `proceed.enter`     | server `server.enter`    | prd2srv |
| server `state.captured`     | after `checkpoint.sent`  | srv2aft |
| protocol `reply.stored`     | proxy `reply.accepted`   | pro2pxy |
| proxy `reply.accepted`      | client `reply.delivered` | pxy2clt |

Not used are: `request.sent` to `request.received`, two hops, because the Proxy notes nothing of a request;
`server.exit` to `state.captured`, three hops, because neither Proceed nor After notes the reply that it
passes on; and `checkpoint.sent` to `reply.stored`, one hop, but with a second message written before it.
That message wakes a process on the other core: it costs about as much as a hop if that core sleeps, and
little if it is busy. Pairs of this kind are reported apart, as `beside`. Under another mechanism the pairs
follow by the same rules from the path of its requests; a brick that notes the same event in two visits
(TR's executions) is left out.

Limits: other work on the machine is in the upper quantiles. The journal's writes are part of a hop.
"""

import itertools
import os
import socket
import time
from collections import Counter
from typing import Final

import msgspec

from aftbed.bench.runs import Percentiles, latencies_us, limited_run, percentiles
from aftbed.campaign.statistics import quantile
from aftbed.core.errors import HarnessError
from aftbed.core.events import Event
from aftbed.core.graph import Graph
from aftbed.core.messages import PACKET_BYTES_MAX
from aftbed.ftm.compose import NONE, build, chain
from aftbed.ftm.registry import BRICKS
from aftbed.functions.request_file import GivenRequests
from aftbed.judge.record import RunRecord
from aftbed.runtime.unix import linux
from aftbed.vehicle.aeb.function import sample_requests

WARM_UP: Final = 200  # requests, and rounds of the ring
ROUNDS: Final = 5
RING_BYTES, RING_COUNT = 64, 300  # a packet and the rounds of `ring_p50_us`
READ_BYTES_MAX: Final = 4096
assert READ_BYTES_MAX <= PACKET_BYTES_MAX

# -- cycle ------------------------------------------------------------------------------------------


def path(graph: Graph) -> list[str]:
    """The bricks that a request and its reply pass, in order; what goes to the backup is left out."""
    if graph.ftm == NONE:
        return ["client", "proxy", "a/server", "proxy", "client"]
    found = ["client", "proxy"]
    for name in chain(graph, "a")[:-1]:
        found += [name, *["a/server", name] * BRICKS[graph.brick(name).kind].asks_server]
        if name.endswith("after"):
            found.append(f"{name.removesuffix('after')}protocol")
    return [*found, "proxy", "client"]


def hops(graph: Graph) -> int:
    """The number of channels between processes that a request and its reply pass."""
    return sum(a != b for a, b in itertools.pairwise(graph.node_of(name) for name in path(graph)))


class CycleResult(msgspec.Struct, frozen=True):
    """The document of `aftbed bench cycle`; `ratio_p50` is the median of `ratio_rounds`."""

    ftm: str
    placement: str
    requests: int
    cycle_us: Percentiles
    ring_us: Percentiles
    hops: int
    ratio_p50: float
    ratio_rounds: tuple[float, ...]


def bench_cycle(
    ftm: str,
    placement: str,
    count: int,
    *,
    pin: bool = True,
    rounds: int = ROUNDS,
    application: str = "",
    given: GivenRequests | None = None,
) -> CycleResult:
    """Cycle and ring in turn, `rounds` times; of a function of the user, and what it is sent, if given."""
    wanted = hops(build(ftm, placement))
    cpu = _pinned_cpu() if pin else None
    sent = given.requests if given is not None else sample_requests(0, 64)
    size = sum(map(len, sent)) // len(sent)
    cycles: list[float] = []
    ring: list[float] = []
    ratios: list[float] = []
    for _ in range(rounds):
        share = -(-count // rounds)
        bare = ring_us(wanted, size, share, cpu)
        run = limited_run(ftm, placement, share + WARM_UP, pin=pin, application=application, given=given)
        ours = latencies_us(run, skip=WARM_UP)
        ratios.append(quantile(ours, 0.5) / quantile(bare, 0.5))
        cycles += ours
        ring += bare
    return CycleResult(
        ftm,
        placement,
        len(cycles),
        percentiles(cycles, 1),
        percentiles(ring, 1),
        wanted,
        round(quantile(ratios, 0.5), 3),
        tuple(round(ratio, 3) for ratio in ratios),
    )


# -- ring -------------------------------------------------------------------------------------------


def ring_p50_us(ftm: str, placement: str) -> float:
    """The median round of a ring with as many hops as a request takes."""
    hop_count = hops(build(ftm, placement))
    return round(quantile(ring_us(hop_count, RING_BYTES, RING_COUNT, _pinned_cpu()), 0.5), 1)


def _pinned_cpu() -> int | None:
    """The core on which runs pin their chain: the first, if there are several."""
    cpus = sorted(os.sched_getaffinity(0))
    return cpus[0] if len(cpus) > 1 else None


def ring_us(hops: int, packet_bytes: int, count: int, cpu: int | None) -> list[float]:
    """The times of `count` rounds (us) of a packet through `hops` channels, after a warm-up."""
    before = os.sched_getaffinity(0)
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(hops)]
    parent = os.getpid()
    children = [_node(parent, pairs, i) for i in range(hops - 1)]
    try:
        write_fd, read_fd = pairs[0][0].fileno(), pairs[-1][1].fileno()
        packet, times = bytes(packet_bytes), []
        for _ in range(WARM_UP + count):
            began_ns = time.perf_counter_ns()
            os.write(write_fd, packet)
            os.read(read_fd, READ_BYTES_MAX)
            times.append((time.perf_counter_ns() - began_ns) / 1e3)
        return times[WARM_UP:]
    finally:
        for write, read in pairs:
            write.close()
            read.close()
        for child in children:
            os.waitpid(child, 0)
        os.sched_setaffinity(0, before)


def _node(parent: int, pairs: list[tuple[socket.socket, socket.socket]], index: int) -> int:
    """A process that passes on what it reads, until its channel is closed."""
    child = os.fork()
    if child:
        return child
    try:
        linux.die_with(parent)
        source, sink = pairs[index][1].fileno(), pairs[index + 1][0].fileno()
        for write, read in pairs:
            for end in (write, read):
                if end.fileno() not in (source, sink):
                    end.close()
        while True:
            packet = os.read(source, READ_BYTES_MAX)
            if not packet:
                break
            os.write(sink, packet)
    finally:
        os._exit(0)


# -- hops -------------------------------------------------------------------------------------------

PLACEMENT: Final = "process"
STEPS: Final = 128  # of `quantiles_ns`, evenly spaced
RUNS_MAX: Final = 5  # until one without an alarm
PERCENTS: Final = (*map(float, range(100)), 99.9, 100.0)
SHOWN: Final = {"p1": 1.0, "p10": 10.0, "p50": 50.0, "p90": 90.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}


class NotePlace(msgspec.Struct, frozen=True):
    """A brick, which is a node of its own, and an event that it notes once per request."""

    brick: str
    event: Event

    def __str__(self) -> str:
        return f"{self.brick} {self.event}"


NotePair = tuple[NotePlace, NotePlace]


class PairDelay(msgspec.Struct, frozen=True):
    """The hop between two notes, and its median (ns); one sample per request."""

    source: str
    sink: str
    p50_ns: int


class HopDelays(msgspec.Struct, frozen=True):
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


def bench_hops(ftm: str, count: int, *, pin: bool = True) -> HopDelays:
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

    def delay(pair: NotePair) -> PairDelay:
        return PairDelay(str(pair[0]), str(pair[1]), quantile(delays[pair], 0.5))

    return HopDelays(
        ftm=ftm,
        requests=count,
        samples=len(ordered),
        hop_ns={name: quantile(ordered, percent / 100) for name, percent in SHOWN.items()},
        percentiles_ns=tuple((percent, quantile(ordered, percent / 100)) for percent in PERCENTS),
        quantiles_ns=tuple(quantile(ordered, step / STEPS) for step in range(STEPS + 1)),
        pairs=tuple(map(delay, pairs)),
        beside=tuple(map(delay, beside)),
    )


def undisturbed(ftm: str, count: int, *, pin: bool = True) -> RunRecord:
    """The record of a run in which the replica that led first led to its end, and kept its backup.

    On a machine that is busy with other things a Watchdog may take a chain for a hung one. Raises
    HarnessError where that happened in RUNS_MAX runs.
    """
    for _ in range(RUNS_MAX):
        record = limited_run(ftm, PLACEMENT, count, pin=pin)
        if not record.history.events(Event.WATCHDOG_SUSPECT):
            return record
    raise HarnessError(f"an alarm in each of {RUNS_MAX} runs: the machine is too busy for this measurement")


def single_hops(graph: Graph) -> tuple[tuple[NotePair, ...], tuple[NotePair, ...]]:
    """The pairs of notes one hop apart, in the order of a request: those to use, and those beside.

    See the module for the difference.
    """
    visits = _visits(graph)
    once = {place for place, count in Counter(visits).items() if count == 1}
    pairs: list[NotePair] = []
    beside: list[NotePair] = []
    for source, sink in itertools.pairwise(visits):
        if source is not None and sink is not None and {source, sink} <= once:
            more = BRICKS[graph.brick(source.brick).kind].sends_beside
            (beside if more else pairs).append((source, sink))
    return tuple(pairs), tuple(beside)


def _visits(graph: Graph) -> list[NotePlace | None]:
    """For each brick on the way of a request and its reply: what it notes there, None if nothing."""
    found: list[NotePlace | None] = []
    seen: Counter[str] = Counter()
    asker = ""
    for brick in path(graph):
        kind = graph.brick(brick).kind
        if kind.endswith("server"):  # what it notes depends on the message that it got
            asks_state = asker.endswith(("before", "after"))
            event: Event | None = Event.STATE_CAPTURED if asks_state else Event.SERVER_ENTER
        else:
            notes = BRICKS[kind].visits
            event = notes[seen[brick]] if seen[brick] < len(notes) else None
        found.append(NotePlace(brick, event) if event else None)
        seen[brick] += 1
        asker = kind
    return found


def delays_ns(record: RunRecord, pair: NotePair, skip: int) -> list[int]:
    """The time between the notes of `pair` (ns), of each request behind the first `skip` that has both."""
    source, sink = (
        {r.request_id: r.t_ns for r in record.history.events(place.event) if r.node == place.brick}
        for place in pair
    )
    return [t_ns - source[i] for i, t_ns in sink.items() if i in source and i > skip]
