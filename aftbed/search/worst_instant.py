"""A drive on the simulator, and the same drive with a fault in it: what a table of the road is made of.

A `Course` is the drive without the fault. It knows where an instant of the drive is, in all the ways in which
a fault can be aimed: by the radar cycle, by the how manieth event of its kind, by the time since the arming.
A `Struck` is what became of the drive when the fault struck, and when that was.

All times are milliseconds of bus time, which begins with the drive.
"""

import gc
import os
import select
import signal
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import msgspec
from msgspec.structs import replace

from aftbed.core.errors import HarnessError
from aftbed.core.events import Event
from aftbed.core.journal import Entry, EntryKind
from aftbed.ftm.compose import build
from aftbed.ftm.registry import EMITTERS
from aftbed.inject.crash import Crash
from aftbed.inject.model import Fault, FaultAction
from aftbed.inject.targets import Roles, emitting_node
from aftbed.inject.timing import Trigger
from aftbed.judge.checks import VEHICLE
from aftbed.judge.simulated import breaches
from aftbed.runtime.sim.world import Run, Setup, World, simulate
from aftbed.runtime.unix import linux
from aftbed.vehicle.aeb.messages import STAGE_NONE, decode_reply, decode_request
from aftbed.vehicle.plant import VehicleResult

LEADER, BACKUP = "a", "b"  # as every run begins
LATER: Final = Fault(Crash(), "primary", Trigger(after_ms=3_600_000.0))
ARMED: Final = "armed"


class DriveCycle(msgspec.Struct, frozen=True):
    """A radar cycle; `stage` is what its reply asked for."""

    request_id: int
    t_ms: int
    stage: int
    target: bool
    moving: bool


class Course(msgspec.Struct, frozen=True):
    """A drive without a fault. `broken` are promises.

    `nths` tells, by event and request, the how manieth of its kind the first one of that request was.
    """

    setup: Setup
    result: VehicleResult
    broken: tuple[str, ...]
    cycles: tuple[DriveCycle, ...]
    nths: dict[str, dict[int, int]]
    began_ns: int
    armed_ms: float  # when faults are armed


class StruckDrive(msgspec.Struct, frozen=True):
    """A drive with a fault. `t_ms` is when it struck, if a record says so."""

    setup: Setup
    result: VehicleResult
    broken: tuple[str, ...]
    fired: bool
    t_ms: float | None

    @property
    def fault(self) -> Fault:
        """The one there is."""
        return self.setup.faults[0]


def course_of(setup: Setup) -> Course:
    """Drive `setup.scenario` without a fault. Raises HarnessError if the simulator breaks down."""
    assert not setup.faults
    run = _run(setup)
    asked = {e.request_id: decode_request(e.payload) for e in _entries(run, EntryKind.SENT)}
    stages = {e.request_id: decode_reply(e.payload).stage for e in _entries(run, EntryKind.ANSWERED)}
    began_ns = min(e.t_ns - asked[e.request_id].t_ms * 1_000_000 for e in _entries(run, EntryKind.SENT))
    return Course(
        setup=setup,
        result=_result(run),
        broken=_promises(run),
        cycles=tuple(
            DriveCycle(name, of.t_ms, stages.get(name, STAGE_NONE), bool(of.targets), of.ego_speed_ms > 0.0)
            for name, of in sorted(asked.items())
        ),
        nths={event: dict(_counted(run, event)) for event in _events(setup)},
        began_ns=began_ns,
        armed_ms=(_armed_ns(setup) - began_ns) / 1e6,
    )


def strike(course: Course, fault: Fault) -> StruckDrive:
    """The drive of `course` with `fault`. Raises HarnessError if the simulator breaks down."""
    setup = replace(course.setup, faults=(fault,))
    run = _run(setup)
    fired = all(found.fired for found in run.faults)
    records = (record for journal in run.history.journals.values() for record in journal)
    struck_ns = min((r.t_ns for r in records if r.event is Event.FAULT_APPLIED), default=None)
    t_ms = (struck_ns - course.began_ns) / 1e6 if fired and struck_ns is not None else None
    return StruckDrive(setup, _result(run), _promises(run), fired, t_ms)


def _run(setup: Setup) -> Run:
    try:
        return simulate(setup)
    except AssertionError as error:
        raise HarnessError(
            f"{setup.scenario} under {setup.ftm}: the simulator broke down: {error}"
        ) from error


def _result(run: Run) -> VehicleResult:
    assert run.vehicle is not None, "a course has a car"
    return run.vehicle


def _promises(run: Run) -> tuple[str, ...]:
    """What the run breaks beside what its scenario expects of the car."""
    return tuple(str(breach) for breach in breaches(run) if breach.check != VEHICLE)


def _entries(run: Run, kind: EntryKind) -> list[Entry]:
    return [entry for entry in run.history.dialogue if entry.kind is kind]


def _events(setup: Setup) -> Iterator[str]:
    """What is emitted on the leader's side under this mechanism."""
    graph = build(setup.ftm, setup.placement)
    for event, (_, of_backup) in EMITTERS.items():
        if not of_backup and emitting_node(Roles(graph, LEADER, BACKUP), event.label) is not None:
            yield event.label


def _counted(run: Run, event: str) -> Iterator[tuple[int, int]]:
    """Each request with the how manieth of these events its first one is."""
    node = emitting_node(Roles(run.rest.graph, LEADER, BACKUP), event)
    records = (record for journal in run.history.journals.values() for record in journal)
    found = sorted((r for r in records if r.node == node and r.event.label == event), key=lambda r: r.t_ns)
    seen: set[int] = set()
    for nth, record in enumerate(found, 1):
        if record.request_id not in seen:
            seen.add(record.request_id)
            yield record.request_id, nth


def _armed_ns(setup: Setup) -> int:
    """Faults are armed before the first request is made, when the clock of the car goes already."""
    world = World(replace(setup, faults=(LATER,)))
    world.start()
    return next(t_ns for t_ns, event, _ in world.told if event == ARMED)


# -- One drive, copied at many instants: what a fault would do at each of them, for less than a run each.
#
# The process that simulates is copied (`fork`) shortly before the fault is to strike. The copy strikes,
# drives on until it is decided, and says what came of it; the original drives on to the next instant. So no
# copy repeats what lies before its fault, and none drives on when all is over: half of the time for a table
# whose cars ahead stand or move, more where they move.
#
# In a copy the fault is armed when the drive has begun, so chance (the delays of hops, microseconds each)
# is
# drawn in another order than in a run with the same fault from its start. The two can differ by a step of
# the brakes: whoever tells a result takes it from a whole run.


LOOK_NS: Final = 100_000_000  # of virtual time, between two looks at whether it is decided
DECIDED_SECONDS_MAX: Final = 60.0  # a drive takes a tenth of a second


class Branch(msgspec.Struct, frozen=True):
    """`fault`, armed at `at_ms` of bus time."""

    at_ms: float
    fault: Fault


class BranchOutcome(msgspec.Struct, frozen=True):
    """What came of it."""

    result: VehicleResult
    fired: bool


def branched(course: Course, branches: Iterable[Branch], over_ms: float) -> Iterator[BranchOutcome]:
    """The outcome of each, at `over_ms` of bus time or before; the earliest comes first.

    Raises HarnessError if a copy dies, or does not come to an end.
    """
    world = World(course.setup)
    world.start()
    last_ns = course.began_ns + round(min(over_ms, float(course.cycles[-1].t_ms)) * 1e6)
    for branch in branches:
        world.advance(course.began_ns + round(branch.at_ms * 1e6))
        yield _branch(world, branch.fault, last_ns)


def _branch(world: World, fault: Fault, last_ns: int) -> BranchOutcome:
    """In a copy of this process, which dies with it."""
    reader, writer = os.pipe()
    parent, pid = os.getpid(), os.fork()
    if pid == 0:
        try:
            linux.die_with(parent)
            gc.disable()  # it would only copy pages
            os.write(writer, msgspec.msgpack.encode(_decided(world, fault, last_ns)))
        except BaseException:  # noqa: BLE001 - the last frame of this process
            traceback.print_exc()
            sys.stderr.flush()
        finally:
            os._exit(0)
    os.close(writer)
    poll = select.poll()
    poll.register(reader, select.POLLIN)
    late = not poll.poll(DECIDED_SECONDS_MAX * 1e3)
    if late:
        os.kill(pid, signal.SIGKILL)  # ours, and not reaped yet: so this pid is nobody else's
    with open(reader, "rb") as file:
        said = file.read()
    os.waitpid(pid, 0)
    if not said:
        what = f"is not decided after {DECIDED_SECONDS_MAX:g} s" if late else "died"
        raise HarnessError(f"{fault}: the copy of the simulator {what}, {world.setup.scenario}")
    return msgspec.msgpack.decode(said, type=BranchOutcome)


def _decided(world: World, fault: Fault, last_ns: int) -> BranchOutcome:
    """Strike, and drive on until nothing can become worse: in contact, at rest, or at the end."""
    world.inject(fault)
    until_ns = world.loop.ns
    while True:
        until_ns += LOOK_NS
        world.advance(until_ns)
        found = world.outcome()
        result = found.vehicle
        assert result is not None, "a course has a car"
        if result.collision or result.stop_gap_m is not None or until_ns > last_ns:
            return BranchOutcome(result, all(told.fired for told in found.faults))


# -- The worst instant: when a fault harms the car most, searched on the simulator.
#
# The paper (Section IV) tells an outage in metres at 50 km/h. What those metres cost depends on when they
# are lost: before anything was in sight, nothing; at the cycle that would have begun the braking, all of
# them. So the fault is tried at many instants, and the one that harms most is told, with the words that
# repeat it.
#
#     coarse  each cycle whose reply asks for another stage, and each `STEP_CYCLES`th from the first with a
#             target to standstill, or to the end of the last braking; without either, of the whole drive
#     fine    around the worst so far, at ever smaller distances, down to the next cycle
#     inside  of that cycle: each event on the request's way; and the time before it, down to 1 ms
#
# They are tried in copies of one drive (`branching`). Of the `CONFIRMED` worst each is then run whole, by
# its
# words, and the worst of these is told: so what is told is what the words repeat.
#
# Harm is, in this order: a broken promise, a faster impact, a smaller gap, more braking. Of two instants
# that
# harm alike the one that was tried first is told, so those at an event: they mean the same in a real run.
#
# Limits. It is a search and no proof: between two coarse instants harm is taken to have one peak. One that
# is
# narrower than `STEP_CYCLES` and at no change of stage is not found. `instants` is how many were tried.


STEP_CYCLES: Final = 20  # 0.4 s
FINER_CYCLES: Final = (10, 5, 2, 1)
STEP_MS: Final = 5
FINER_MS: Final = (2, 1)
ARM_MS: Final = 1.0  # so long before its cycle a fault is armed: an order takes some 50 us
AFTER_MS: Final = 3000.0  # so long after the last instant and the end of a fault a copy drives on at most
CONFIRMED: Final = 3
ANCHOR: Final = Event.SERVER_ENTER.label  # under every mechanism: the function is about to be called

Harm = tuple[bool, float, float, float]


class Worst(msgspec.Struct, frozen=True):
    """The worst of the `instants` at which the fault was tried, and struck."""

    struck: StruckDrive
    instants: int


class Instant(msgspec.Struct, frozen=True):
    """When: in the words of a whole run; and in a copy of the drive, which is made at `branch_ms`.

    `place` is the index of the cycle, or the millisecond, by which a search goes on from here.
    """

    words: Trigger
    branch_ms: float
    branch: Trigger
    place: int


def worst_instant(course: Course, action: FaultAction, target: str) -> Worst | None:
    """Search; None if the fault struck at none of the instants. Raises HarnessError."""
    return _Search(course, action, target).run()


def harm(result: VehicleResult, broken: tuple[str, ...] = ()) -> Harm:
    """The greater, the worse. Rounded, since what is finer than that is noise of the last digits."""
    impact_kmh = (result.impact_speed_kmh or 0.0) if result.collision else 0.0
    gap_m = result.min_gap_m if result.min_gap_m is not None else float("inf")
    return bool(broken), round(impact_kmh, 4), -round(gap_m, 4), result.demand_max_ms2


class _Tried(NamedTuple):
    harm: Harm
    earlier: int  # the greater, the earlier it was tried


class _Search:
    def __init__(self, course: Course, action: FaultAction, target: str) -> None:
        self._course, self._action, self._target = course, action, target
        self._over_ms = _over_ms(course, action)
        self._tried: dict[Trigger, _Tried | None] = {}  # None where the fault did not strike

    def run(self) -> Worst | None:
        """From coarse to fine."""
        first, last = span(self._course)
        begin = list(self._cycles(coarse(self._course, first, last)))
        at = self._narrow(begin, self._cycles, FINER_CYCLES, range(first, last + 1))
        self._try(list(self._events(at, self._course.nths)))
        t_ms = self._course.cycles[at].t_ms
        before_ms = self._course.cycles[at - 1].t_ms if at else t_ms
        begin = list(self._moments(range(t_ms - 1, before_ms, -STEP_MS)))
        self._narrow(begin, self._moments, FINER_MS, range(before_ms + 1, t_ms))
        return self._confirmed()

    # -- instants -----------------------------------------------------------------------------

    def _cycles(self, indices: Iterable[int]) -> Iterator[Instant]:
        """The beginning of each of these cycles, as the function sees it."""
        for index in indices:
            yield from self._events(index, (ANCHOR,))

    def _events(self, index: int, events: Iterable[str]) -> Iterator[Instant]:
        """These events of that cycle, as far as it has them."""
        cycle = self._course.cycles[index]
        for event in events:
            nth = self._course.nths[event].get(cycle.request_id)
            if nth is not None:
                yield Instant(Trigger(event, nth), cycle.t_ms - ARM_MS, Trigger(event), index)

    def _moments(self, times_ms: Iterable[int]) -> Iterator[Instant]:
        """These times, from the arming on."""
        for t_ms in times_ms:
            after_ms = round(t_ms - self._course.armed_ms, 6)
            if after_ms > 0.0:
                yield Instant(Trigger(after_ms=after_ms), float(t_ms), Trigger(), t_ms)

    # -- trying -------------------------------------------------------------------------------

    def _narrow(
        self,
        found: list[Instant],
        make: Callable[[Iterable[int]], Iterator[Instant]],
        steps: Sequence[int],
        places: range,
    ) -> int:
        """Try `found`, then ever nearer to the worst of them. The place of the worst of all."""
        self._try(found)
        at = self._worst_place(found, places.start)
        for step in steps:
            more = list(make(near for near in (at - step, at + step) if near in places))
            self._try(more)
            found += more
            at = self._worst_place(found, at)
        return at

    def _try(self, instants: Sequence[Instant]) -> None:
        """Those that are new, in the order of time; who is proposed first counts as tried first."""
        fresh = {instant.words: instant for instant in instants if instant.words not in self._tried}
        order = {words: -len(self._tried) - at for at, words in enumerate(fresh)}
        todo = sorted(fresh.values(), key=lambda instant: instant.branch_ms)
        faults = (Fault(self._action, self._target, instant.branch) for instant in todo)
        branches = (Branch(i.branch_ms, fault) for i, fault in zip(todo, faults, strict=True))
        for instant, outcome in zip(todo, branched(self._course, branches, self._over_ms), strict=True):
            found = _Tried(harm(outcome.result), order[instant.words]) if outcome.fired else None
            self._tried[instant.words] = found

    def _worst_place(self, instants: Iterable[Instant], otherwise: int) -> int:
        found = [(tried, i.place) for i in instants if (tried := self._tried[i.words]) is not None]
        return max(found)[1] if found else otherwise

    def _confirmed(self) -> Worst | None:
        """The worst of the worst, run whole."""
        struck = sorted(((t, words) for words, t in self._tried.items() if t is not None), key=_by_harm)
        whole = [self._strike(words) for _, words in struck[-CONFIRMED:]]
        whole = [one for one in reversed(whole) if one.fired]
        if not whole:
            return None
        return Worst(max(whole, key=lambda one: harm(one.result, one.broken)), len(struck))

    def _strike(self, words: Trigger) -> StruckDrive:
        return strike(self._course, Fault(self._action, self._target, words))


def _by_harm(one: tuple[_Tried, Trigger]) -> _Tried:
    return one[0]


def span(course: Course) -> tuple[int, int]:
    """The first and the last cycle of the search, by index."""
    cycles = course.cycles
    first = next((at for at, cycle in enumerate(cycles) if cycle.target), 0)
    still = next((at for at, cycle in enumerate(cycles) if at > first and not cycle.moving), None)
    return first, still or max((at for at in _changes(course) if at > first), default=len(cycles) - 1)


def coarse(course: Course, first: int, last: int) -> list[int]:
    """Where the search begins: the changes of stage first, since it is there that a delay matters."""
    changes = [at for at in _changes(course) if first <= at <= last]
    return list(dict.fromkeys((*changes, *range(first, last + 1, STEP_CYCLES), last)))


def _changes(course: Course) -> list[int]:
    """The cycles that ask for another stage than those before them."""
    return [at for at, (a, b) in enumerate(pairwise(course.cycles), 1) if a.stage != b.stage]


def _over_ms(course: Course, action: FaultAction) -> float:
    """When all is over: after the last instant of the search the fault ends, and what it led to."""
    length_ms = action.lasts_ms
    return course.cycles[span(course)[1]].t_ms + length_ms + AFTER_MS
