"""When a fault harms the car most: a drive on the simulator, again with a fault at each of many instants.

The paper (Section IV) gives an outage in metres at 50 km/h. What those metres cost depends on when they are
lost: before anything was in sight, nothing; at the cycle that would have begun the braking, all of them. So
the fault is tried at many instants, and the worst is reported with the words that repeat it:

    coarse  each cycle whose reply asks for another stage, and each `STEP_CYCLES`th from the first with a
            target to standstill, or to the end of the last braking; without either, of the whole drive
    fine    around the worst so far, at ever smaller distances, down to the next cycle
    inside  of that cycle: each event on the request's way; and the time before it, down to 1 ms

Harm is, in this order: a broken promise, a faster impact, a smaller gap, more braking. Of two instants that
harm alike the one that was tried first is reported, so those at an event: they mean the same in a real run.

They are tried in copies of one drive: the process that simulates is forked shortly before the fault is to
strike. The copy strikes, drives on until it is decided, and reports what came of it; the original drives on
to the next instant. So no copy repeats what lies before its fault, and none drives on when all is over. In a
copy the fault is armed when the drive has begun, so chance (the delays of hops, microseconds each) is drawn
in another order than in a run with the same fault from its start; the two can differ by a step of the brakes.
So each of the `CONFIRMED` worst is then run whole, by its words, and the worst of these is reported.

All times are milliseconds of bus time, which begins with the drive. Limits: it is a search and no proof:
between two coarse instants harm is taken to have one peak, and one that is narrower than `STEP_CYCLES` and at
no change of stage is not found.
"""

import gc
import os
import select
import signal
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Final

import msgspec
from msgspec.structs import replace

from aftbed.core.errors import HarnessError
from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.ftm.compose import build
from aftbed.ftm.registry import EMITTERS
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault, FaultAction
from aftbed.inject.targets import Roles, emitting_node
from aftbed.judge.checks import VEHICLE
from aftbed.judge.simulated import breaches
from aftbed.runtime.sim.world import Run, Setup, World, simulate
from aftbed.runtime.unix import interrupts, linux
from aftbed.vehicle.aeb.messages import STAGE_NONE, decode_reply, decode_request
from aftbed.vehicle.plant import VehicleResult

LEADER, BACKUP = "a", "b"  # as every run begins
LATER: Final = Fault(Crash(), "primary", Trigger(after_ms=3_600_000.0))
ARMED: Final = "armed"
ANCHOR: Final = Event.SERVER_ENTER.label  # under every mechanism: the function is about to be called


# -- a drive, and the same drive with a fault -----------------------------------------------------


class DriveCycle(msgspec.Struct, frozen=True):
    """A radar cycle; `stage` is what its reply asked for."""

    request_id: int
    t_ms: int
    stage: int
    target: bool
    moving: bool


class Course(msgspec.Struct, frozen=True):
    """A drive without a fault. `broken` are promises.

    It has the place of an instant in all the ways in which a fault can be aimed: by the radar cycle; by the
    time since the arming; and `nths`, by event and request: the number, among the events of its kind, of the
    first one of that request.
    """

    setup: Setup
    result: VehicleResult
    broken: tuple[str, ...]
    cycles: tuple[DriveCycle, ...]
    nths: dict[str, dict[int, int]]
    began_ns: int
    armed_ms: float  # when faults are armed


class StruckDrive(msgspec.Struct, frozen=True):
    """A drive with a fault. `t_ms` is when it struck, if a record has it."""

    setup: Setup
    result: VehicleResult
    broken: tuple[str, ...]
    fired: bool
    t_ms: float | None

    @property
    def fault(self) -> Fault:
        return self.setup.faults[0]


def course_of(setup: Setup) -> Course:
    """Drive `setup.scenario` without a fault. Raises HarnessError if the simulator breaks down."""
    assert not setup.faults
    run, result, broken = _driven(setup)
    dialogue = run.history.dialogue
    sent = {e.request_id: e.t_ns for e in dialogue if e.kind is EntryKind.SENT}
    asked = {e.request_id: decode_request(e.payload) for e in dialogue if e.kind is EntryKind.SENT}
    answers = (e for e in dialogue if e.kind is EntryKind.ANSWERED)
    stages = {e.request_id: decode_reply(e.payload).stage for e in answers}
    began_ns = min(t_ns - asked[request_id].t_ms * 1_000_000 for request_id, t_ns in sent.items())
    world = World(replace(setup, faults=(LATER,)))  # faults are armed before the first request is made
    world.start()
    armed_ns = next(t_ns for t_ns, event, _ in world.logged if event == ARMED)
    return Course(
        setup=setup,
        result=result,
        broken=broken,
        cycles=tuple(
            DriveCycle(name, of.t_ms, stages.get(name, STAGE_NONE), bool(of.targets), of.ego_speed_ms > 0.0)
            for name, of in sorted(asked.items())
        ),
        nths=_nths(run, setup),
        began_ns=began_ns,
        armed_ms=(armed_ns - began_ns) / 1e6,
    )


def strike(course: Course, fault: Fault) -> StruckDrive:
    """The drive of `course` with `fault`. Raises HarnessError if the simulator breaks down."""
    setup = replace(course.setup, faults=(fault,))
    run, result, broken = _driven(setup)
    fired = all(found.fired for found in run.faults)
    struck = run.history.events(Event.FAULT_APPLIED)
    t_ms = (struck[0].t_ns - course.began_ns) / 1e6 if fired and struck else None
    return StruckDrive(setup, result, broken, fired, t_ms)


def _driven(setup: Setup) -> tuple[Run, VehicleResult, tuple[str, ...]]:
    """The run, the car's result, and what breaks beside what the scenario expects of the car."""
    try:
        run = simulate(setup)
    except AssertionError as error:
        raise HarnessError(
            f"{setup.scenario} under {setup.ftm}: the simulator broke down: {error}"
        ) from error
    assert run.vehicle is not None, "a course has a car"
    return run, run.vehicle, tuple(str(breach) for breach in breaches(run) if breach.check != VEHICLE)


def _nths(run: Run, setup: Setup) -> dict[str, dict[int, int]]:
    """By event that the leader's side emits under this mechanism: see `Course`."""
    found: dict[str, dict[int, int]] = {}
    begun = Roles(build(setup.ftm, setup.placement), LEADER, BACKUP)
    ended = Roles(run.rest.graph, LEADER, BACKUP)
    for event, (_, of_backup) in EMITTERS.items():
        if not of_backup and emitting_node(begun, event.label) is not None:
            node = emitting_node(ended, event.label)
            nths = found[event.label] = {}
            for nth, record in enumerate((r for r in run.history.events(event) if r.node == node), 1):
                nths.setdefault(record.request_id, nth)
    return found


# -- one drive, copied at many instants -----------------------------------------------------------

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
    parent, pid = os.getpid(), interrupts.fork()
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
        os.kill(pid, signal.SIGKILL)  # ours, and not reaped yet, so no other process has this pid
    with open(reader, "rb") as file:
        answer = file.read()
    os.waitpid(pid, 0)
    if not answer:
        what = f"is not decided after {DECIDED_SECONDS_MAX:g} s" if late else "died"
        raise HarnessError(f"{fault}: the copy of the simulator {what}, {world.setup.scenario}")
    return msgspec.msgpack.decode(answer, type=BranchOutcome)


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
            return BranchOutcome(result, any(fault.fired for fault in found.faults))


# -- the search -----------------------------------------------------------------------------------

STEP_CYCLES: Final = 20  # 0.4 s
FINER_CYCLES: Final = (10, 5, 2, 1)
STEP_MS: Final = 5
FINER_MS: Final = (2, 1)
ARM_MS: Final = 1.0  # so long before its cycle a fault is armed: an order takes some 50 us
AFTER_MS: Final = 3000.0  # so long after the last instant and the end of a fault a copy drives on at most
CONFIRMED: Final = 3

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


Make = Callable[[Iterable[int]], Iterator[Instant]]


def worst_instant(course: Course, action: FaultAction, target: str) -> Worst | None:
    """Search; None if the fault struck at none of the instants. Raises HarnessError."""
    search, cycles = _Search(course, action, target), course.cycles
    first, last = span(cycles)

    def anchored(places: Iterable[int]) -> Iterator[Instant]:
        return (instant for at in places for instant in _events(course, at, (ANCHOR,)))

    def moments(times_ms: Iterable[int]) -> Iterator[Instant]:
        """These times, from the arming on."""
        for t_ms in times_ms:
            after_ms = round(t_ms - course.armed_ms, 6)
            if after_ms > 0.0:
                yield Instant(Trigger(after_ms=after_ms), float(t_ms), Trigger(), t_ms)

    begin = list(anchored(coarse(cycles, first, last)))
    at = search.narrow(begin, anchored, FINER_CYCLES, range(first, last + 1))
    search.attempt(list(_events(course, at, course.nths)))
    t_ms = cycles[at].t_ms
    before_ms = cycles[at - 1].t_ms if at else t_ms
    begin = list(moments(range(t_ms - 1, before_ms, -STEP_MS)))
    search.narrow(begin, moments, FINER_MS, range(before_ms + 1, t_ms))
    struck = sorted(
        ((found, words) for words, found in search.found.items() if found is not None), key=lambda one: one[0]
    )
    whole = [strike(course, Fault(action, target, words)) for _, words in reversed(struck[-CONFIRMED:])]
    whole = [one for one in whole if one.fired]
    if not whole:
        return None
    return Worst(max(whole, key=lambda one: harm(one.result, one.broken)), len(struck))


def _events(course: Course, index: int, events: Iterable[str]) -> Iterator[Instant]:
    """These events of that cycle, as far as it has them."""
    cycle = course.cycles[index]
    for event in events:
        nth = course.nths[event].get(cycle.request_id)
        if nth is not None:
            yield Instant(Trigger(event, nth), cycle.t_ms - ARM_MS, Trigger(event), index)


def impact_kmh(result: VehicleResult) -> float:
    """The relative speed at contact; 0 without one."""
    return (result.impact_speed_kmh or 0.0) if result.collision else 0.0


def harm(result: VehicleResult, broken: tuple[str, ...] = ()) -> Harm:
    """The greater, the worse. Rounded, since what is finer than that is noise of the last digits."""
    gap_m = result.min_gap_m if result.min_gap_m is not None else float("inf")
    return bool(broken), round(impact_kmh(result), 4), -round(gap_m, 4), result.demand_max_ms2


class _Search:
    """`found`: harm of each instant, and a number, greater the earlier it was tried; None: no strike."""

    def __init__(self, course: Course, action: FaultAction, target: str) -> None:
        self._course, self._action, self._target = course, action, target
        # All is over when the fault has ended after the last instant, and what it led to.
        self._over_ms = course.cycles[span(course.cycles)[1]].t_ms + action.lasts_ms + AFTER_MS
        self.found: dict[Trigger, tuple[Harm, int] | None] = {}

    def narrow(self, instants: list[Instant], make: Make, steps: Sequence[int], places: range) -> int:
        """Try `instants`, then ever nearer to the worst of them. The place of the worst of all."""
        self.attempt(instants)
        at = self._worst_place(instants, places.start)
        for step in steps:
            more = list(make(near for near in (at - step, at + step) if near in places))
            self.attempt(more)
            instants += more
            at = self._worst_place(instants, at)
        return at

    def attempt(self, instants: Sequence[Instant]) -> None:
        """Those that are new, in the order of time; the one that is proposed first counts as tried first."""
        fresh = {instant.words: instant for instant in instants if instant.words not in self.found}
        order = {words: -len(self.found) - at for at, words in enumerate(fresh)}
        todo = sorted(fresh.values(), key=lambda instant: instant.branch_ms)
        branches = (Branch(i.branch_ms, Fault(self._action, self._target, i.branch)) for i in todo)
        for instant, outcome in zip(todo, branched(self._course, branches, self._over_ms), strict=True):
            found = (harm(outcome.result), order[instant.words]) if outcome.fired else None
            self.found[instant.words] = found

    def _worst_place(self, instants: Iterable[Instant], otherwise: int) -> int:
        found = [(tried, i.place) for i in instants if (tried := self.found[i.words]) is not None]
        return max(found)[1] if found else otherwise


def span(cycles: Sequence[DriveCycle]) -> tuple[int, int]:
    """The first and the last cycle of the search, by index."""
    first = next((at for at, cycle in enumerate(cycles) if cycle.target), 0)
    still = next((at for at, cycle in enumerate(cycles) if at > first and not cycle.moving), None)
    return first, still or max((at for at in _changes(cycles) if at > first), default=len(cycles) - 1)


def coarse(cycles: Sequence[DriveCycle], first: int, last: int) -> list[int]:
    """Where the search begins: the changes of stage first, since it is there that a delay matters."""
    changes = [at for at in _changes(cycles) if first <= at <= last]
    return list(dict.fromkeys((*changes, *range(first, last + 1, STEP_CYCLES), last)))


def _changes(cycles: Sequence[DriveCycle]) -> list[int]:
    """The cycles that ask for another stage than those before them."""
    return [at for at, (a, b) in enumerate(pairwise(cycles), 1) if a.stage != b.stage]
