"""A published table of the road, driven on the simulator: without a fault, or with one at its worst instant.

A table is driven once for each `Line`: a mechanism with or without a fault, or an *outage*. In an outage
the function does not answer for so long, unnoticed. It is stopped under `none`, as the paper's
adaptation stops the Protocol (SIGSTOP, then SIGCONT): a request meanwhile waits, and is answered then.
The paper's 1 to 2 ms of recovery and 300 ms of adaptation are such outages, to be seen beside ours.

A row fails if the car breaks what the table asks for, or if the run breaks a promise. A row whose
fault never struck proves nothing (G8): it is no pass, and is shown apart.

Rows that begin alike are driven once: the tables ask for different things of the same drive.
"""

from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from math import sqrt
from typing import Final

import msgspec
from msgspec.structs import replace

from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.runtime.sim.world import Setup
from aftbed.runtime.unix.worker_pool import each
from aftbed.search.worst_instant import Course, StruckDrive, course_of, impact_kmh, strike, worst_instant
from aftbed.vehicle.plant import KMH_PER_MS, VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import Scenario
from aftbed.vehicle.scenarios.tables import Case, broken, colour

COLOURED: Final = "ncap"
NONE: Final = "none"
PRIMARY: Final = "primary"


class RoadLine(msgspec.Struct, frozen=True):
    """How a table is driven. `searched`: at the worst instant, whatever the trigger of the fault is."""

    name: str
    ftm: str
    fault: Fault | None = None
    searched: bool = False
    outage_ms: int | None = None


class RoadDrive(msgspec.Struct, frozen=True):
    """A drive, and the rows that it is for: they begin alike."""

    cases: tuple[Case, ...]
    line: RoadLine
    seed: int


class DrivenRow(msgspec.Struct, frozen=True):
    """A row that was driven. `impact_kmh` is 0 without contact.

    With a fault: its words, when it struck, the worst of how many instants that is, and what was lost against
    the drive without it. `closed_form_kmh`, of an outage, is the most that it can lead to (`residual`).
    """

    case: str
    line: str
    ftm: str
    speed_kmh: float
    limit_kmh: float
    impact_kmh: float
    min_gap_m: float | None
    warning_s: float | None
    passed: bool = msgspec.field(name="pass")
    because: tuple[str, ...] = ()
    colour: str | None = None
    struck: bool = True
    fault: str | None = None
    at_s: float | None = None
    instants: int | None = None
    loss_m: float | None = None
    loss_kmh: float | None = None
    closed_form_kmh: float | None = None
    must_fail: str = ""  # why an outage of this length has to fail this row
    repeat: tuple[str, ...] = ()


def outage(length_ms: int) -> RoadLine:
    """The function is stopped for so long, and nothing takes its place."""
    fault = Fault(Hang(length_ms), PRIMARY, Trigger())
    return RoadLine(f"outage {length_ms}ms", NONE, fault, searched=True, outage_ms=length_ms)


def drives(cases: Sequence[Case], lines: Iterable[RoadLine], seed: int) -> list[RoadDrive]:
    """What is to be driven for all rows of all lines."""
    alike: dict[object, list[Case]] = {}
    for case in cases:
        scenario = load_scenario(case.name)
        alike.setdefault((scenario.plant, scenario.duration_ms), []).append(case)
    return [RoadDrive(tuple(rows), line, seed) for line in lines for rows in alike.values()]


def driven(todo: Sequence[RoadDrive], jobs: int) -> Generator[tuple[DrivenRow, ...], None, None]:
    """The rows of each drive, in order. Raises HarnessError if the simulator breaks down."""
    with closing(each(drive, todo, jobs)) as found:
        for _, _, rows in found:
            yield rows


def drive(todo: RoadDrive) -> tuple[DrivenRow, ...]:
    """Drive, and judge it as each of its rows."""
    line = todo.line
    course = course_of(Setup(line.ftm, seed=todo.seed, scenario=todo.cases[0].name))
    if line.fault is None:
        return tuple(_row(case, line, course) for case in todo.cases)
    struck, instants = None, None
    if not line.searched:
        struck = strike(course, line.fault)
    elif worst := worst_instant(course, line.fault.action, line.fault.target):
        struck, instants = worst.struck, worst.instants
    else:
        instants = 0
    return tuple(_with_fault(case, line, course, struck, instants) for case in todo.cases)


# -- rows -----------------------------------------------------------------------------------------


def _row(case: Case, line: RoadLine, of: Course | StruckDrive) -> DrivenRow:
    """What came of it, judged as `case`."""
    result, impact = of.result, impact_kmh(of.result)
    because = (*of.broken, *broken(case, result))
    return DrivenRow(
        case=case.name,
        line=line.name,
        ftm=line.ftm,
        speed_kmh=case.speed_kmh,
        limit_kmh=case.limit_kmh,
        impact_kmh=round(impact, 3),
        min_gap_m=None if result.min_gap_m is None else round(result.min_gap_m, 4),
        warning_s=result.warning_s,
        passed=not because,
        because=because,
        colour=colour(impact) if case.table == COLOURED else None,
        repeat=repeat(replace(of.setup, scenario=case.name)),
    )


def _with_fault(
    case: Case, line: RoadLine, course: Course, struck: StruckDrive | None, instants: int | None
) -> DrivenRow:
    """The same, and what the fault took. Of one that never struck, there is the drive alone."""
    if struck is None or not struck.fired:
        words = str(line.fault)
        row = replace(_row(case, line, course), fault=words, instants=instants)
        return replace(row, passed=False, struck=False, because=(f"never struck: {words}",), repeat=())
    free_m, struck_m = course.result.min_gap_m, struck.result.min_gap_m
    row = replace(
        _row(case, line, struck),
        fault=str(struck.fault),
        at_s=None if struck.t_ms is None else round(struck.t_ms / 1000, 6),
        instants=instants,
        loss_m=None if free_m is None or struck_m is None else round(free_m - struck_m, 4),
        loss_kmh=round(impact_kmh(struck.result) - impact_kmh(course.result), 3),
    )
    closing_ms = closing_speed_ms(load_scenario(case.name))
    if line.outage_ms is None or closing_ms is None:
        return row
    most_kmh = round(residual_kmh(course.result, closing_ms, line.outage_ms), 3)
    must = ""
    if not row.passed and most_kmh > case.limit_kmh:
        taken_m, left = closing_ms * line.outage_ms / 1000, left_m(course.result)
        must = f"{line.outage_ms} ms take {taken_m:.2f} m of the braking distance; {left:.2f} m were left"
    return replace(row, closed_form_kmh=most_kmh, must_fail=must)


def repeat(setup: Setup) -> tuple[str, ...]:
    """The commands that drive it again: in the simulator, and on processes where the words mean the same.

    In lockstep nothing is lost while the function is stopped: the drive waits. And a time since the arming is
    one of the wall, so no instant of the drive.
    """
    asked = f"--scenario {setup.scenario} --ftm {setup.ftm} --seed {setup.seed}"
    if not setup.faults:
        return f"aftbed sim {asked}", f"aftbed run {asked} --pace max"
    fault = setup.faults[0]
    simulated = f'aftbed sim {asked} --inject "{fault}"'
    if fault.trigger.after_ms:
        return (simulated,)
    pace = "real" if fault.action.takes_real_time else "max"
    return simulated, f'aftbed run {asked} --pace {pace} --inject "{fault}"'


# -- what an outage can cost at most --------------------------------------------------------------
#
# In closed form: the speed at which the car still hits what is ahead. The paper (Section IV) gives an outage
# of t in metres: v0 t at the speed v0. An outage that delays the whole of a braking by t brings the car to
# every place with the speed that it would have had v0 t metres before. Where the braking left a gap of d0,
# and ends with a constant deceleration a, that is an impact at
#
#     v = sqrt(2 a (v0 t - d0))     none where v0 t <= d0, and never more than v0
#
# and, from a drive that ends in an impact at u anyway, v = sqrt(u u + 2 a v0 t). With d0 = 0, the car that
# would have just stopped, it is sqrt(2 a v0 t). Here v0 is the speed at which the gap closes before the car
# brakes, and a the greatest deceleration of the drive without the outage.
#
# Where the function goes from nothing to full braking at once, that is what happens. Where it asks for a
# part of it before, an outage delays less than the whole, and what is lost is made up for in part: the form
# is a bound then. Beside it an outage costs up to `SLACK_MS` more: a reply counts from the next step of the
# brakes on. Limits: a car ahead that brakes has no such v0.

SLACK_MS: Final = 2.0


def closing_speed_ms(scenario: Scenario) -> float | None:
    """How fast the gap closes before the car brakes; None where it does not, or the car ahead brakes."""
    lead = scenario.plant.lead
    if lead is None or lead.braking is not None or lead.speeds:
        return None
    closing_ms = scenario.plant.speed_ms - lead.speed_ms
    return closing_ms if closing_ms > 0.0 else None


def residual_kmh(free: VehicleResult, closing_ms: float, outage_ms: float) -> float:
    """The impact to which an outage of the drive `free` can lead at most; 0 is none."""
    already_ms = impact_kmh(free) / KMH_PER_MS
    taken_m = closing_ms * outage_ms / 1000 - left_m(free)
    return speed_left_ms(closing_ms, taken_m, free.max_deceleration_ms2, already_ms) * KMH_PER_MS


def speed_left_ms(speed_ms: float, taken_m: float, deceleration_ms2: float, already_ms: float = 0.0) -> float:
    """What is left of `speed_ms` where `taken_m` of the way to brake on are missing; see above."""
    square = already_ms**2 + 2.0 * deceleration_ms2 * taken_m
    return min(sqrt(square), speed_ms) if square > 0.0 else 0.0


def left_m(free: VehicleResult) -> float:
    """The gap that the braking leaves; 0 where it ends in contact."""
    return 0.0 if free.collision or free.min_gap_m is None else free.min_gap_m
