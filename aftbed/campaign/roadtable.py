"""A published table of the road, driven on the simulator: without a fault, or with one at its worst instant.

A table is driven once for each `Line`: a mechanism with or without a fault, or an *outage*. In an outage
the function does not answer for so long and nobody notices. It is stopped under `none`, as the paper's
adaptation stops the Protocol (SIGSTOP, then SIGCONT): what is asked meanwhile waits, and is answered then.
The paper's 1 to 2 ms of recovery and 300 ms of adaptation are such outages, to be seen beside ours.

A row fails if the car breaks what the table asks for, or if the run breaks a promise (design 3). A row whose
fault never struck proves nothing (G8): it is no pass, and is told apart.

Rows that begin alike are driven once: the tables ask for different things of the same drive.
"""

from collections.abc import Generator, Iterable, Sequence
from typing import Final

import msgspec
from msgspec.structs import replace

from aftbed.campaign.course import Course, Struck, course_of, strike
from aftbed.campaign.residual import closing_speed_ms, impact_kmh, left_m, residual_kmh
from aftbed.campaign.workers import each
from aftbed.campaign.worstinstant import worst_instant
from aftbed.core.fault import Fault, Hang, Slow, Trigger
from aftbed.runtime.sim.world import Setup
from aftbed.vehicle.plant import VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.tables import Case, broken, colour

COLOURED: Final = "ncap"
NONE: Final = "none"
PRIMARY: Final = "primary"


class Line(msgspec.Struct, frozen=True):
    """How a table is driven. `searched`: at the worst instant, whatever the trigger of the fault says."""

    name: str
    ftm: str
    fault: Fault | None = None
    searched: bool = False
    outage_ms: int | None = None


class Drive(msgspec.Struct, frozen=True):
    """A drive, and the rows that it is for: they begin alike."""

    cases: tuple[Case, ...]
    line: Line
    seed: int


class Row(msgspec.Struct, frozen=True):
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


def outage(length_ms: int) -> Line:
    """The function is stopped for so long, and nothing stands in for it."""
    fault = Fault(Hang(length_ms), PRIMARY, Trigger())
    return Line(f"outage {length_ms}ms", NONE, fault, searched=True, outage_ms=length_ms)


def drives(cases: Sequence[Case], lines: Iterable[Line], seed: int) -> list[Drive]:
    """What is to be driven for all rows of all lines."""
    alike: dict[object, list[Case]] = {}
    for case in cases:
        scenario = load_scenario(case.name)
        alike.setdefault((scenario.plant, scenario.duration_ms), []).append(case)
    return [Drive(tuple(rows), line, seed) for line in lines for rows in alike.values()]


def driven(todo: Sequence[Drive], jobs: int) -> Generator[tuple[Row, ...], None, None]:
    """The rows of each drive, in order. Raises HarnessError if the simulator breaks down."""
    for _, _, rows in each(drive, todo, jobs):
        yield rows


def drive(todo: Drive) -> tuple[Row, ...]:
    """Drive, and judge it as each of its rows."""
    line = todo.line
    course = course_of(Setup(line.ftm, seed=todo.seed, scenario=todo.cases[0].name))
    if line.fault is None:
        return tuple(_row(case, line, course) for case in todo.cases)
    if not line.searched:
        return tuple(_with_fault(case, line, course, strike(course, line.fault), None) for case in todo.cases)
    worst = worst_instant(course, line.fault.action, line.fault.target)
    struck, instants = (None, 0) if worst is None else (worst.struck, worst.instants)
    return tuple(_with_fault(case, line, course, struck, instants) for case in todo.cases)


# -- rows -----------------------------------------------------------------------------------------


def _row(case: Case, line: Line, of: Course | Struck) -> Row:
    """What came of it, judged as `case`."""
    result, impact = of.result, impact_kmh(of.result)
    because = (*of.broken, *broken(case, result))
    return Row(
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


def _with_fault(case: Case, line: Line, course: Course, struck: Struck | None, instants: int | None) -> Row:
    """The same, and what the fault took. Of one that never struck, there is the drive alone."""
    if struck is None or not struck.fired:
        words = str(line.fault)
        row = replace(_row(case, line, course), fault=words, instants=instants)
        return replace(row, passed=False, struck=False, because=(f"never struck: {words}",), repeat=())
    row = replace(
        _row(case, line, struck),
        fault=str(struck.fault),
        at_s=None if struck.t_ms is None else round(struck.t_ms / 1000, 6),
        instants=instants,
        loss_m=_lost_m(course.result, struck.result),
        loss_kmh=round(impact_kmh(struck.result) - impact_kmh(course.result), 3),
    )
    return row if line.outage_ms is None else _of_outage(case, row, course.result, line.outage_ms)


def _of_outage(case: Case, row: Row, free: VehicleResult, outage_ms: int) -> Row:
    """What it can take at most, and whether it has to fail."""
    closing_ms = closing_speed_ms(load_scenario(case.name))
    if closing_ms is None:
        return row
    most_kmh = round(residual_kmh(free, closing_ms, outage_ms), 3)
    must = ""
    if not row.passed and most_kmh > case.limit_kmh:
        taken_m = closing_ms * outage_ms / 1000
        must = f"{outage_ms} ms take {taken_m:.2f} m of the braking distance; {left_m(free):.2f} m were left"
    return replace(row, closed_form_kmh=most_kmh, must_fail=must)


def _lost_m(free: VehicleResult, struck: VehicleResult) -> float | None:
    if free.min_gap_m is None or struck.min_gap_m is None:
        return None
    return round(free.min_gap_m - struck.min_gap_m, 4)


def repeat(setup: Setup) -> tuple[str, ...]:
    """The commands that drive it again: in the simulator, and on processes where the words mean the same.

    In lockstep nothing is lost while the function is stopped: the drive waits. And a time since the arming is
    one of the wall, so no instant of the drive.
    """
    asked = f"--scenario {setup.scenario} --ftm {setup.ftm} --seed {setup.seed}"
    if not setup.faults:
        return f"aftbed sim {asked}", f"aftbed run {asked} --pace max"
    fault = setup.faults[0]
    simulated = f'aftbed sim {asked} --faults "{fault}"'
    if fault.trigger.after_ms:
        return (simulated,)
    pace = "real" if isinstance(fault.action, Hang | Slow) else "max"
    return simulated, f'aftbed run {asked} --pace {pace} --inject "{fault}"'
