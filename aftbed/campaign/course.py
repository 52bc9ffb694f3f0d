"""A drive on the simulator, and the same drive with a fault in it: what a table of the road is made of.

A `Course` is the drive without the fault. It knows where an instant of the drive is, in all the ways in which
a fault can be aimed: by the radar cycle, by the how manieth event of its kind, by the time since the arming.
A `Struck` is what became of the drive when the fault struck, and when that was.

All times are milliseconds of bus time, which begins with the drive.
"""

from collections.abc import Iterator
from typing import Final

import msgspec
from msgspec.structs import replace

from aftbed.campaign.simulated import breaches
from aftbed.core.errors import HarnessError
from aftbed.core.events import Event
from aftbed.core.fault import FIRED, Crash, Fault, Trigger
from aftbed.core.journal import Entry, EntryKind
from aftbed.ftm.compose import build
from aftbed.ftm.registry import EMITTERS
from aftbed.runtime.sim.world import Run, Setup, World, simulate
from aftbed.runtime.targets import emitter
from aftbed.vehicle.aeb.messages import STAGE_NONE, decode_reply, decode_request
from aftbed.vehicle.plant import VehicleResult

LEADER, BACKUP = "a", "b"  # as every run begins
LATER: Final = Fault(Crash(), "primary", Trigger(after_ms=3_600_000.0))
ARMED: Final = "armed"


class Cycle(msgspec.Struct, frozen=True):
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
    cycles: tuple[Cycle, ...]
    nths: dict[str, dict[int, int]]
    began_ns: int
    armed_ms: float  # when faults are armed


class Struck(msgspec.Struct, frozen=True):
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
            Cycle(name, of.t_ms, stages.get(name, STAGE_NONE), bool(of.targets), of.ego_speed_ms > 0.0)
            for name, of in sorted(asked.items())
        ),
        nths={event: dict(_counted(run, event)) for event in _events(setup)},
        began_ns=began_ns,
        armed_ms=(_armed_ns(setup) - began_ns) / 1e6,
    )


def strike(course: Course, fault: Fault) -> Struck:
    """The drive of `course` with `fault`. Raises HarnessError if the simulator breaks down."""
    setup = replace(course.setup, faults=(fault,))
    run = _run(setup)
    fired = all(found["receipt"] in FIRED for found in run.faults)
    records = (record for journal in run.history.journals.values() for record in journal)
    struck_ns = min((r.t_ns for r in records if r.event is Event.FAULT_APPLIED), default=None)
    t_ms = (struck_ns - course.began_ns) / 1e6 if fired and struck_ns is not None else None
    return Struck(setup, _result(run), _promises(run), fired, t_ms)


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
    return tuple(str(breach) for breach in breaches(run))


def _entries(run: Run, kind: EntryKind) -> list[Entry]:
    return [entry for entry in run.history.dialogue if entry.kind is kind]


def _events(setup: Setup) -> Iterator[str]:
    """What is emitted on the leader's side under this mechanism."""
    graph = build(setup.ftm, setup.placement)
    for event, (_, of_backup) in EMITTERS.items():
        if not of_backup and emitter(graph, event.label, LEADER, BACKUP) is not None:
            yield event.label


def _counted(run: Run, event: str) -> Iterator[tuple[int, int]]:
    """Each request with the how manieth of these events its first one is."""
    node = emitter(run.rest.graph, event, LEADER, BACKUP)
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
