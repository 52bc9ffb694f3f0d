"""Cycle time at the client beside its limit, the bare ring, or beside another one; and the delay of one hop.

**Ring.** No mechanism over processes and sockets can be faster: as many hops as a request takes through the
mechanism, over the same kind of sockets, under the same scheduling policy and pinned alike, in the same
language, but with a plain read and a plain write per hop, without bricks, decoding or journal. Where the
leader sends to its backup (a checkpoint under `pbr`), the ring's process in its place first writes a packet
to a process on the backup's core, which reads and drops it.

**Turns.** In each round a run and a ring live side by side, and take turns of `TURN_NS` by the monotonic
clock: the load sends only in its turns, the ring turns in the others. So a machine that is slower for a tenth
of a second is slower for both. What began in the first tenth of a turn, with caches that the other side has
filled, is left out, and so is what did not end in its turn. A function of the user may take longer than a
turn: its cycle and the ring are measured one behind the other (`rounds.in_turn`).

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
(TR's executions) is left out. The limit is a turn of the bare ring, which takes turns with the run, divided
by its hops.

Limits: other work on the machine is in the upper quantiles. The journal's writes are part of a hop.
"""

import contextlib
import itertools
import os
import signal
import socket
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Final, NamedTuple

import msgspec

from aftbed.bench.rounds import (
    ROUNDS,
    InRounds,
    Rounds,
    as_node,
    become_node,
    beside_limit,
    cores,
    in_turn,
    shares,
    together,
)
from aftbed.bench.runs import (
    Percentiles,
    TimedSample,
    answered,
    endless_run,
    latencies_us,
    limited_run,
    percentiles,
    wait_until_ready,
)
from aftbed.campaign.statistics import quantile
from aftbed.core.errors import HarnessError
from aftbed.core.events import Event
from aftbed.core.graph import Graph
from aftbed.core.messages import PACKET_BYTES_MAX
from aftbed.core.progress import Show, unshown
from aftbed.ftm.compose import build, path
from aftbed.ftm.registry import BRICKS
from aftbed.functions.request_file import GivenRequests
from aftbed.functions.source import is_foreign
from aftbed.judge.record import RunRecord
from aftbed.runtime.unix import interrupts, linux
from aftbed.runtime.unix.options import Turns
from aftbed.vehicle.aeb.function import sample_requests

CYCLE_ROUNDS: Final = 2 * ROUNDS  # the ratios of two runs differ more than those of two turns
CYCLES: Final = 750 * CYCLE_ROUNDS  # a quarter of a second in each
WARM_UP: Final = 200  # requests, and turns of the ring
WARM_UP_SECONDS: Final = 0.2  # of what is measured by time
RING_BYTES, RING_COUNT = 64, 300  # a packet and the turns of `ring_p50_us`
READ_BYTES_MAX: Final = 4096
TURN_SECONDS_MAX: Final = 10.0  # of a packet through the ring
assert READ_BYTES_MAX <= PACKET_BYTES_MAX

TURN_NS: Final = 10_000_000  # some 80 cycles, and much less than what is taken for a hang
SETTLE_SHARE: Final = 10  # of a turn, the first
OURS, THEIRS = Turns(TURN_NS, 0), Turns(TURN_NS, 1)
SENT_MORE: Final = 100  # requests, and half as many as are wanted: for those that are left out

# -- cycle ------------------------------------------------------------------------------------------


class CycleResult(InRounds, frozen=True):
    """The document of `aftbed bench cycle`; `ratio_p50` is the median of `ratio_rounds`."""

    ftm: str
    placement: str
    requests: int
    cycle_us: Percentiles
    ring_us: Percentiles
    hops: int
    ratio_p50: float
    ratio_rounds: tuple[float, ...]


# What takes turns with others: it measures within the context, and its list is full behind it.
Side = Callable[[Turns], AbstractContextManager[list[TimedSample]]]


class CycleRun(NamedTuple):
    """What is measured: one mechanism in one placement, a run of its own in each round.

    `application`: the function of a user, `given`: what it is sent; see `limited_run`.
    """

    ftm: str
    placement: str
    pin: bool = True
    application: str = ""
    given: GivenRequests | None = None

    def cycles_us(self, count: int) -> list[float]:
        """The cycles of `count` requests (us), after a warm-up. Raises HarnessError."""
        return latencies_us(self._record(count + WARM_UP), skip=WARM_UP)

    def cycles_beside(self, count: int, other: Side) -> tuple[list[float], list[float]]:
        """The first `count` cycles that `settled` leaves, after a warm-up, and what `other` measured in the
        turns between those of the load (us).

        Raises HarnessError.
        """
        with other(THEIRS) as measured:
            record = self._record(sent_for(count), OURS)
        ours = settled(answered(record, skip=WARM_UP), OURS, count)[:count]
        return [one.us for one in ours], _beside_us(measured, record)

    @contextlib.contextmanager
    def in_turns(self, turns: Turns, skip: int = WARM_UP) -> Iterator[list[TimedSample]]:
        """A `Side` that leaves out the first `skip` requests. Raises HarnessError."""
        found: list[TimedSample] = []
        run_of = partial(endless_run, self.ftm, self.placement, application=self.application, pin=self.pin)
        with run_of(turns=turns) as run:
            wait_until_ready(run.private)
            yield found
        found += answered(run.record, skip=skip)

    def _record(self, count: int, turns: Turns | None = None) -> RunRecord:
        return limited_run(
            self.ftm,
            self.placement,
            count,
            pin=self.pin,
            application=self.application,
            given=self.given,
            turns=turns,
        )


def sent_for(count: int) -> int:
    """How many requests are sent in turns, so that `settled` leaves `count` behind the warm-up."""
    return WARM_UP + count + count // 2 + SENT_MORE


def _beside_us(measured: Iterable[TimedSample], record: RunRecord) -> list[float]:
    """What was measured in the other turns, between the first and the last request of `record`."""
    sent = answered(record)
    began_ns, ended_ns = sent[0].began_ns, sent[-1].began_ns
    return _within_us(measured, THEIRS, began_ns, ended_ns)


def side_by_side(sides: Sequence[Side], turn_ns: int, seconds: float) -> list[list[float]]:
    """What each of `sides` measures within `seconds`, in turns of `turn_ns` (us). Raises HarnessError."""
    turns = [Turns(turn_ns, number, len(sides)) for number in range(len(sides))]
    with contextlib.ExitStack() as stack:
        measured = [stack.enter_context(side(its)) for side, its in zip(sides, turns, strict=True)]
        time.sleep(WARM_UP_SECONDS)
        began_ns = time.monotonic_ns()
        time.sleep(seconds)
        ended_ns = time.monotonic_ns()
    return [_within_us(of, its, began_ns, ended_ns) for of, its in zip(measured, turns, strict=True)]


def _within_us(measured: Iterable[TimedSample], turns: Turns, began_ns: int, ended_ns: int) -> list[float]:
    """What was measured in `turns`, between two times (us). Raises HarnessError where that is nothing."""
    found = settled((one for one in measured if began_ns <= one.began_ns <= ended_ns), turns, 1)
    if not found:
        raise HarnessError(
            f"one side measured nothing in its turns within {(ended_ns - began_ns) / 1e6:.0f} ms: the machine"
            " is too busy for this measurement; repeat it when less else runs, or let it measure for longer"
        )
    return [one.us for one in found]


def settled(measured: Iterable[TimedSample], turns: Turns, least: int) -> list[TimedSample]:
    """Those that began in one of `turns`, behind its first tenth, and ended within it.

    All, if these are fewer than `least`: on a machine so busy hardly anything ends within a turn.
    """
    everything = list(measured)
    found = [
        one
        for one in everything
        if not turns.left_ns(one.began_ns)
        and turns.ns // SETTLE_SHARE <= one.began_ns % turns.ns < turns.ns - one.us * 1e3
    ]
    return found if len(found) >= least else everything


def bench_cycle(
    ours: CycleRun, count: int, *, rounds: int = CYCLE_ROUNDS, show: Show = unshown
) -> CycleResult:
    """`count` requests in rounds, in turn with the ring."""
    shape = ring_of(build(ours.ftm, ours.placement))
    fixed = is_foreign(ours.application)
    sent = ours.given.requests if ours.given is not None else sample_requests(0, 64, fixed=fixed)
    size = sum(map(len, sent)) // len(sent)
    found = _in_rounds(
        ours,
        shares(count, rounds),
        partial(ring_in_turns, shape, size, pin=ours.pin),
        partial(ring_us, shape, size, pin=ours.pin),
        show,
    )
    cycles, ring = ([us for one in values for us in one] for values in (found.figures, found.limits))
    beside = beside_limit(shape.name, found.figures, found.limits, 1)
    medians = [
        quantile(of_run, 0.5) / quantile(bare, 0.5)
        for of_run, bare in zip(found.figures, found.limits, strict=True)
    ]
    return CycleResult(
        ours.ftm,
        ours.placement,
        len(cycles),
        percentiles(cycles, 1),
        percentiles(ring, 1),
        shape.hops,
        beside.ratio.p50.median,
        tuple(round(ratio, 3) for ratio in medians),
        limit=beside.limit,
        ratio=beside.ratio,
        machine=found.machine,
    )


def _in_rounds(
    ours: CycleRun,
    share: list[int],
    other: Side,
    limit_us: Callable[[int], list[float]],
    show: Show,
) -> Rounds[list[float], list[float]]:
    """The cycles of `ours` and their limit: side by side, or what a user gives and `limit_us`, in turn."""
    if ours.application or ours.given is not None:
        return in_turn(
            len(share),
            lambda number: ours.cycles_us(share[number]),
            lambda number: limit_us(share[number]),
            show=show,
        )
    return together(len(share), lambda number: ours.cycles_beside(share[number], other), show)


class CycleBesideResult(InRounds, frozen=True):
    """The document of `aftbed bench cycle --beside`, whose limit is a cycle, too."""

    ftm: str
    placement: str
    requests: int
    cycle_us: Percentiles
    beside_ftm: str
    beside_placement: str


def bench_cycle_beside(
    ours: CycleRun, other: CycleRun, count: int, *, rounds: int = CYCLE_ROUNDS, show: Show = unshown
) -> CycleBesideResult:
    """`count` requests in rounds, in turn with as many of `other`."""
    for side in (ours, other):
        build(side.ftm, side.placement)  # refuses what there is none of, before anything is measured
    found = _in_rounds(ours, shares(count, rounds), other.in_turns, other.cycles_us, show)
    name = f"cycle under {other.ftm}, {other.placement}"
    beside = beside_limit(name, found.figures, found.limits, 1)
    cycles = list(itertools.chain.from_iterable(found.figures))
    return CycleBesideResult(
        ours.ftm,
        ours.placement,
        len(cycles),
        percentiles(cycles, 1),
        other.ftm,
        other.placement,
        limit=beside.limit,
        ratio=beside.ratio,
        machine=found.machine,
    )


# -- ring -------------------------------------------------------------------------------------------


class RingShape(NamedTuple):
    """`hops` channels in a ring, and the processes on it that send to the backup as well.

    The process that starts the packet is number 0, the reader of the first channel number 1, and so on.
    `beside`: the number of such a process, and the name of the backup's node that it sends to.
    """

    hops: int
    beside: tuple[tuple[int, str], ...] = ()

    @property
    def name(self) -> str:
        """`bare ring of 12 hops and 1 to the backup`."""
        return f"bare ring of {self.hops} hops" + f" and {len(self.beside)} to the backup" * bool(self.beside)


def ring_of(graph: Graph) -> RingShape:
    """The ring of as many hops as a request takes through `graph`, its way to the backup included."""
    visits: list[str] = []  # of nodes
    last: dict[str, int] = {}  # visit of a brick: it sends to the backup in that one
    for brick in path(graph):
        node = graph.node_of(brick)
        if not visits or visits[-1] != node:
            visits.append(node)
        last[brick] = len(visits) - 1
    beside = []
    for link in graph.links:
        source, sink = graph.brick(link.source), graph.brick(link.sink)
        crosses = source.replica and sink.replica and source.replica != sink.replica and not link.standby
        if crosses and link.source in last and graph.node_of(link.source) != graph.node_of(link.sink):
            beside.append((last[link.source], graph.node_of(link.sink)))
    return RingShape(len(visits) - 1, tuple(sorted(beside)))


def ring_p50_us(ftm: str, placement: str) -> float:
    """The median turn of a ring with as many hops as a request takes."""
    return round(quantile(ring_us(ring_of(build(ftm, placement)), RING_BYTES, RING_COUNT), 0.5), 1)


class RingWork(NamedTuple):
    """What the ring does for a state with each packet to the backup.

    Both are called once, in the processes that do the work. They return what is done each time: the leader's
    makes the packet, the backup's takes it.
    """

    of_leader: Callable[[], Callable[[], bytes | memoryview]]
    of_backup: Callable[[], Callable[[bytes], None]]


def ring_us(
    shape: RingShape,
    packet_bytes: int,
    count: int,
    *,
    pin: bool = True,
    warm_up: int = WARM_UP,
    work: RingWork | None = None,
) -> list[float]:
    """The times of `count` turns (us) of a packet through the ring, after a warm-up; run as the nodes are.

    Raises HarnessError if a packet does not come back.
    """
    with _ring(shape, packet_bytes, pin=pin, work=work) as turn_us, as_node(cores(pin=pin)[0]):
        times = [turn_us() for _ in range(warm_up + count)]
    return times[warm_up:]


@contextlib.contextmanager
def ring_in_turns(
    shape: RingShape, packet_bytes: int, turns: Turns, *, pin: bool, work: RingWork | None = None
) -> Iterator[list[TimedSample]]:
    """A `Side` that turns a ring, from a process of its own.

    Raises HarnessError if a packet does not come back.
    """
    found: list[TimedSample] = []
    ours, theirs = socket.socketpair()
    with ours:
        ours.settimeout(2 * TURN_SECONDS_MAX)
        with theirs:
            serve = partial(_turn_until_told, theirs, shape, packet_bytes, turns, pin=pin, work=work)
            child = _forked(os.getpid(), cores(pin=pin)[0], [ours, theirs], [theirs], serve)
        data = array("q")
        try:
            yield found
        finally:
            with contextlib.suppress(OSError):  # it has ended already
                ours.shutdown(socket.SHUT_WR)
            with ours.makefile("rb") as got, contextlib.suppress(TimeoutError):
                data.frombytes(got.read())
            os.kill(child, signal.SIGKILL)  # it has ended, or it hangs
            os.waitpid(child, 0)
    if not data or len(data) != 1 + data[0]:
        raise HarnessError("the bare ring: one of its processes died")
    found += [
        TimedSample(began_ns, took_ns / 1e3) for began_ns, took_ns in zip(data[1::2], data[2::2], strict=True)
    ]


def _turn_until_told(
    line: socket.socket,
    shape: RingShape,
    packet_bytes: int,
    turns: Turns,
    *,
    pin: bool,
    work: RingWork | None,
) -> None:
    """Turn a ring in `turns` until the line ends; then send how many numbers follow, and of each turn two.

    These are when it began, and its time (ns).
    """
    os.setsid()  # as a run has: the kernel shares a core among sessions, and starved a run beside a busy one
    taken = array("q")
    with _ring(shape, packet_bytes, pin=pin, work=work) as turn_us:
        while not linux.readable((line.fileno(),), turns.left_ns(time.monotonic_ns()) / 1e9):
            while not turns.left_ns(began_ns := time.monotonic_ns()):
                taken.extend((began_ns, round(turn_us() * 1e3)))
    line.sendall(array("q", [len(taken), *taken]).tobytes())


@contextlib.contextmanager
def _ring(
    shape: RingShape, packet_bytes: int, *, pin: bool, work: RingWork | None = None
) -> Iterator[Callable[[], float]]:
    """A ring; what it yields sends a packet through it, and returns its time (us)."""
    here, there = cores(pin=pin)
    packet = bytes(packet_bytes)
    pairs = [_channel() for _ in range(shape.hops)]
    backups = {node: _channel() for node in dict.fromkeys(node for _, node in shape.beside)}
    ends = [end for pair in (*pairs, *backups.values()) for end in pair]
    parent = os.getpid()
    children: list[int] = []
    try:
        for _, source in backups.values():
            serve = partial(_take, source, work)
            children.append(_forked(parent, there, ends, [source], serve))
        for number in range(1, shape.hops):
            source, sink = pairs[number - 1][1], pairs[number][0]
            beside = [backups[node][0] for at, node in shape.beside if at == number]
            serve = partial(_pass_on, source, sink, beside, packet, work)
            children.append(_forked(parent, here, ends, [source, sink, *beside], serve))
        ours = pairs[0][0], pairs[-1][1]
        for end in set(ends) - set(ours):  # so the death of any of them ends the ring
            end.close()
        yield partial(_turn_us, *ours, packet)
    finally:
        for end in ends:
            end.close()
        for child in children:
            os.waitpid(child, 0)


def _channel() -> tuple[socket.socket, socket.socket]:
    pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in pair:
        linux.set_timeouts(end, TURN_SECONDS_MAX, TURN_SECONDS_MAX)
    return pair


def _turn_us(sink: socket.socket, source: socket.socket, packet: bytes) -> float:
    write_fd, read_fd = sink.fileno(), source.fileno()
    try:
        began_ns = time.perf_counter_ns()
        os.write(write_fd, packet)
        back = os.read(read_fd, READ_BYTES_MAX)
        ended_ns = time.perf_counter_ns()
    except OSError as error:  # a timeout, too
        raise HarnessError(f"the bare ring: {error.strerror}") from None
    if not back and packet:
        raise HarnessError("the bare ring: one of its processes died")
    return (ended_ns - began_ns) / 1e3


def _forked(
    parent: int,
    cpu: int | None,
    ends: list[socket.socket],
    keep: list[socket.socket],
    serve: Callable[[], None],
) -> int:
    """Fork a process of the ring, which keeps only its own ends and dies with `parent`."""
    child = interrupts.fork()
    if child:
        return child
    try:
        linux.die_with(parent)
        become_node(cpu)
        for end in set(ends) - set(keep):
            end.close()
        serve()
    finally:
        os._exit(0)


def _pass_on(
    source: socket.socket,
    sink: socket.socket,
    beside: list[socket.socket],
    message: bytes,
    work: RingWork | None,
) -> None:
    """Pass on what is read, until the channel is closed; before it, send to the backup."""
    read_fd, write_fd, others = source.fileno(), sink.fileno(), [end.fileno() for end in beside]
    make = work.of_leader() if work is not None and others else lambda: message
    while packet := os.read(read_fd, READ_BYTES_MAX):
        for other in others:
            os.write(other, make())
        os.write(write_fd, packet)


def _take(source: socket.socket, work: RingWork | None) -> None:
    """What the backup does with what is sent to it, until the channel is closed."""
    read_fd = source.fileno()
    take = work.of_backup() if work is not None else lambda packet: None
    while packet := os.read(read_fd, PACKET_BYTES_MAX):
        take(packet)


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


class HopDelays(InRounds, frozen=True):
    """The delay of one hop, over all `pairs` and requests, by nearest rank; `beside` is not in it.

    `hop_ns`: a few quantiles by name; `percentiles_ns`: (percent, ns) for 0, 1, ..., 99, 99.9, 100;
    `quantiles_ns`: the 129 quantiles 0/128, 1/128, ..., 128/128. The limit is in ns, too.
    """

    ftm: str
    requests: int
    samples: int
    hop_ns: dict[str, int]
    percentiles_ns: tuple[tuple[float, int], ...]
    quantiles_ns: tuple[int, ...]
    pairs: tuple[PairDelay, ...]
    beside: tuple[PairDelay, ...]


def bench_hops(
    ftm: str, count: int, *, pin: bool = True, rounds: int = CYCLE_ROUNDS, show: Show = unshown
) -> HopDelays:
    """Read the hops of `count` requests off the records of runs in a closed loop, in turn with the ring.

    Raises HarnessError where a run ended early, or no run of RUNS_MAX went without an alarm.
    """
    graph = build(ftm, PLACEMENT)
    shape, (pairs, beside) = ring_of(graph), single_hops(graph)
    sent = sample_requests(0, 64)
    ring = partial(ring_in_turns, shape, sum(map(len, sent)) // len(sent), pin=pin)
    share = shares(count, rounds)

    def both(number: int) -> tuple[dict[NotePair, list[int]], list[float]]:
        with ring(THEIRS) as measured:
            record = undisturbed(ftm, sent_for(share[number]), pin=pin, turns=OURS)
        hops = {
            pair: settled(delays(record, pair, WARM_UP), OURS, share[number])[: share[number]]
            for pair in (*pairs, *beside)
        }
        for (source, sink), of_pair in hops.items():
            if len(of_pair) != share[number]:
                raise HarnessError(
                    f"{len(of_pair)} of {share[number]} requests have both notes: {source}, {sink}"
                )
        in_ns = {pair: [round(one.us * 1e3) for one in of_pair] for pair, of_pair in hops.items()}
        return in_ns, [us * 1e3 / shape.hops for us in _beside_us(measured, record)]

    found = together(len(share), both, show)
    figures = [[ns for pair in pairs for ns in of_round[pair]] for of_round in found.figures]
    ordered = sorted(itertools.chain.from_iterable(figures))
    in_rounds = beside_limit(f"hop of the {shape.name}", figures, found.limits, 0)

    def delay(pair: NotePair) -> PairDelay:
        of_pair = [ns for of_round in found.figures for ns in of_round[pair]]
        return PairDelay(str(pair[0]), str(pair[1]), quantile(of_pair, 0.5))

    return HopDelays(
        ftm=ftm,
        requests=count,
        samples=len(ordered),
        hop_ns={name: quantile(ordered, percent / 100) for name, percent in SHOWN.items()},
        percentiles_ns=tuple((percent, quantile(ordered, percent / 100)) for percent in PERCENTS),
        quantiles_ns=tuple(quantile(ordered, step / STEPS) for step in range(STEPS + 1)),
        pairs=tuple(map(delay, pairs)),
        beside=tuple(map(delay, beside)),
        limit=in_rounds.limit,
        ratio=in_rounds.ratio,
        machine=found.machine,
    )


def undisturbed(ftm: str, count: int, *, pin: bool = True, turns: Turns | None = None) -> RunRecord:
    """The record of a run in which the replica that led first led to its end, and kept its backup.

    On a machine that is busy with other things a Watchdog may take a chain for a hung one. Raises
    HarnessError where that happened in RUNS_MAX runs.
    """
    for _ in range(RUNS_MAX):
        record = limited_run(ftm, PLACEMENT, count, pin=pin, turns=turns)
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


def delays(record: RunRecord, pair: NotePair, skip: int) -> list[TimedSample]:
    """From the first note of `pair` to the second, of each request behind the first `skip` that has both."""
    source, sink = (
        {r.request_id: r.t_ns for r in record.history.events(place.event) if r.node == place.brick}
        for place in pair
    )
    return [
        TimedSample(source[i], (t_ns - source[i]) / 1e3)
        for i, t_ns in sink.items()
        if i in source and i > skip
    ]
