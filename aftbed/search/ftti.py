"""The fault tolerant time interval (FTTI, ISO 26262-1:2018, 3.61) of a drive, measured: how long a fault of
the function may last, from the instant at which it is worst, before the row of the table is broken.

    omission     a request made in that time gets no reply; the function goes on
    hang         the function stands: requests wait, and are answered when it goes on
    stuck        each reply in that time is the last one before it, byte for byte
    wrong-value  each reply in that time asks for no braking, well formed; where the row allows no braking,
                 for full braking

The function is bare and answers in no time, so the fault is the only delay: what a mechanism takes is
compared with the FTTI afterwards (`margins`). The bus, E2E, the brake ECU and the car are those of every
run (`vehicle.drive_virtual`), with a brake ECU that latches or one that releases.

The FTTI is the length of the shortest fault, to 1 ms, that breaks the row; handled sooner, the row holds. It
is searched as `worst_instant` does: at each change of stage and each `STEP_CYCLES`th cycle, then near the
worst, down to the next cycle. At an instant that breaks the row with less than the shortest so far, the
length is bisected. Only instants at which a request is made are tried: a fault that begins between two
has no effect before the next one.

A scenario is judged by the rows of `r152` and `ncap` whose drive is the same, by itself if it is one, and by
its own `expect` if there are none.

The closed form is the least of two. A whole braking may come late by the gap at its first demand, less the
way that the brakes need (dead time and lag, then a constant deceleration a), over the speed v at which it
closes:

    FTTI = (gap - v (dead time + lag) - (v v - u u) / 2 a - gap to be left) / v

u is the impact that the row allows. And a warning may come late by what it lasts without a fault, less what
the row asks for. The form is given where the gap closes at a constant speed and no driver brakes; not for
`wrong-value`, which can also end a braking. It is the form of a braking that begins late, so it is not given
where a fault behind the first demand is worse: within a partial braking the brakes are released.
Replies are lost in whole cycles of 20 ms: so far the FTTI of `omission` and `stuck` can be below it.

Limits: a search and no proof. To break a row is taken to need one length, beyond which every fault breaks it.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import Final

import msgspec
from msgspec.structs import replace

from aftbed.core.errors import ConfigError
from aftbed.core.yaml_file import read_yaml
from aftbed.runtime.unix.worker_pool import each
from aftbed.search.road_table import closing_speed_ms
from aftbed.search.worst_instant import FINER_CYCLES, DriveCycle, coarse, span
from aftbed.vehicle.aeb.function import DEMAND_MS2, AebFunction
from aftbed.vehicle.aeb.messages import (
    STAGE_FULL,
    STAGE_NONE,
    STAGE_PARTIAL,
    decode_reply,
    decode_request,
    encode_reply,
)
from aftbed.vehicle.drive_virtual import VirtualCar
from aftbed.vehicle.ecus import BrakePolicy
from aftbed.vehicle.plant import KMH_PER_MS, VehicleResult
from aftbed.vehicle.scenarios import tables
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import broken_expectations

FTTI_MAX_MS: Final = 2000
JUDGES: Final = ("r152", "ncap")
NS_PER_MS: Final = 1_000_000


class FunctionFault(StrEnum):
    OMISSION = "omission"
    HANG = "hang"
    STUCK = "stuck"
    WRONG_VALUE = "wrong-value"


class Fhti(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Fault handling time interval of a mechanism, ms; `bound` is its worst case, None if there is none."""

    p50: float
    p99: float
    bound: float | None = None


class MechanismMargin(msgspec.Struct, frozen=True):
    """`margin` is 1 - FHTI / FTTI, of the bound, or of the p99 if there is none; None without an FTTI."""

    fhti_ms: Fhti
    margin: float | None


class FttiRow(msgspec.Struct, frozen=True):
    """`ftti_ms`, `broken_by` and `worst_instant_s` are None if nothing breaks up to `FTTI_MAX_MS`."""

    scenario: str
    speed_kmh: float
    fault: FunctionFault
    ftti_ms: float | None
    closed_form_ms: float | None
    broken_by: str | None
    worst_instant_s: float | None
    mechanisms: dict[str, MechanismMargin] = {}


class FttiSearch(msgspec.Struct, frozen=True):
    """What is to be searched."""

    scenario: str
    fault: FunctionFault
    brakes: BrakePolicy
    seed: int


def searched(todo: Sequence[FttiSearch], jobs: int) -> Generator[FttiRow, None, None]:
    """The row of each, in order."""
    with closing(each(ftti, todo, jobs)) as found:
        for _, _, row in found:
            yield row


def ftti(todo: FttiSearch) -> FttiRow:
    """Search. Raises ConfigError if the row is broken without a fault."""
    road = _Road(todo)
    free, cycles = road.free()
    if because := road.broken(free):
        raise ConfigError(f"{todo.scenario}: is broken without a fault, so has no FTTI: {because}")
    first, last = span(cycles)
    shortest_ms, worst, why = FTTI_MAX_MS + 1, -1, ""

    def attempt(places: Sequence[int]) -> None:
        nonlocal shortest_ms, worst, why
        for at in places:
            if at not in tried and shortest_ms > 1:
                tried.add(at)
                found = road.break_by(cycles[at].t_ms, shortest_ms - 1)
                if found is not None:
                    (shortest_ms, why), worst = found, at

    tried: set[int] = set()
    attempt(coarse(cycles, first, last))
    for step in FINER_CYCLES:
        attempt([at for at in (worst - step, worst + step) if worst >= 0 and first <= at <= last])
    begun = next((at for at, cycle in enumerate(cycles) if cycle.stage >= STAGE_PARTIAL), len(cycles))
    return FttiRow(
        scenario=todo.scenario,
        speed_kmh=round(road.scenario.plant.speed_ms * KMH_PER_MS, 3),
        fault=todo.fault,
        ftti_ms=float(shortest_ms) if why else None,
        closed_form_ms=road.closed_form_ms(free, cycles) if worst <= begun else None,
        broken_by=why or None,
        worst_instant_s=cycles[worst].t_ms / 1000 if why else None,
    )


# -- one drive with a fault -------------------------------------------------------------------------


class _Road:
    """The drives of one search."""

    def __init__(self, todo: FttiSearch) -> None:
        self.scenario = load_scenario(todo.scenario)
        self._todo = todo
        self._rows = rows_of(todo.scenario)
        self._wrong_stage = STAGE_NONE
        if any(row.demand_ms2_max is not None for row in self._rows) or (
            not self._rows and self.scenario.expect.outcome == "no_braking"
        ):
            self._wrong_stage = STAGE_FULL

    def free(self) -> tuple[VehicleResult, list[DriveCycle]]:
        """Without a fault."""
        cycles: list[DriveCycle] = []
        return self._drive(0, 0, cycles.append), cycles

    def broken(self, result: VehicleResult) -> str:
        """The first row that `result` breaks, and how; "" if none."""
        for row in self._rows:
            if because := tables.broken(row, result):
                return f"{row.name}: {because[0]}"
        if self._rows:
            return ""
        return next(iter(broken_expectations(self.scenario, result)), "")

    def break_by(self, at_ms: int, most_ms: int) -> tuple[int, str] | None:
        """The shortest fault at that time that breaks a row, and how; None if `most_ms` do not."""
        why = self.broken(self._drive(at_ms, most_ms))
        if not why:
            return None
        held_ms = 0
        while most_ms - held_ms > 1:
            half_ms = (held_ms + most_ms) // 2
            if because := self.broken(self._drive(at_ms, half_ms)):
                most_ms, why = half_ms, because
            else:
                held_ms = half_ms
        return most_ms, why

    def closed_form_ms(self, free: VehicleResult, cycles: Sequence[DriveCycle]) -> float | None:
        """The least that a rule leaves, see the module; None where the form does not apply."""
        plant = self.scenario.plant
        closing_ms, lead = closing_speed_ms(self.scenario), plant.lead
        begun = next((cycle for cycle in cycles if cycle.stage >= STAGE_PARTIAL), None)
        if self._todo.fault is FunctionFault.WRONG_VALUE or plant.driver is not None:
            return None
        if closing_ms is None or lead is None or lead.cut_in is not None or begun is None:
            return None
        gap_m = (
            lead.gap_m - closing_ms * (begun.t_ms + plant.brakes.dead_time_ms + plant.brakes.lag_ms) / 1000
        )

        def late_s(limit_kmh: float, left_m: float) -> float:
            square = closing_ms**2 - (limit_kmh / KMH_PER_MS) ** 2
            return (gap_m - square / (2.0 * free.max_deceleration_ms2) - left_m) / closing_ms

        if not self._rows:
            expect = self.scenario.expect
            return _form_ms(late_s(expect.impact_speed_kmh_max, expect.stop_gap_m_min))
        return _form_ms(
            *(late_s(row.limit_kmh, 0.0) for row in self._rows),
            *(
                free.warning_s - row.warning_s_min
                for row in self._rows
                if free.warning_s is not None and row.warning_s_min is not None
            ),
        )

    def _drive(
        self, at_ms: int, length_ms: int, report: Callable[[DriveCycle], None] | None = None
    ) -> VehicleResult:
        """Drive, with the fault from `at_ms` on for `length_ms`."""
        todo = self._todo
        car = VirtualCar(self.scenario, brake_policy=todo.brakes, seed=todo.seed)
        function, wrong_stage = AebFunction(), self._wrong_stage
        begin_ns, end_ns = at_ms * NS_PER_MS, (at_ms + length_ms) * NS_PER_MS
        waiting: list[bytes] = []
        last: bytes | None = None
        number = 0
        while (due_ns := car.due_ns()) is not None:
            now_ns = min(due_ns, end_ns) if waiting else due_ns
            requests = car.advance(now_ns)
            struck = begin_ns <= now_ns < end_ns
            if struck and todo.fault is FunctionFault.HANG:
                waiting += requests
                continue
            for request in (*waiting, *requests):
                number += 1
                reply = function.execute(request)
                if report is not None:
                    report(_cycle(number, request, reply))
                sent: bytes | None = reply
                if not struck:
                    last = reply
                elif todo.fault is FunctionFault.WRONG_VALUE:
                    output = decode_reply(reply)
                    demand_ms2 = DEMAND_MS2[wrong_stage]
                    sent = encode_reply(replace(output, stage=wrong_stage, deceleration_ms2=demand_ms2))
                else:
                    sent = last if todo.fault is FunctionFault.STUCK else None
                if sent is not None:
                    car.deliver(sent, now_ns)
            waiting.clear()
        return car.result()


def _form_ms(*times_s: float) -> float:
    """The least of them, 0 or more, in ms."""
    return round(max(0.0, min(times_s)) * 1000, 1)


def _cycle(number: int, request: bytes, reply: bytes) -> DriveCycle:
    asked = decode_request(request)
    moving = asked.ego_speed_ms > 0.0
    return DriveCycle(number, asked.t_ms, decode_reply(reply).stage, bool(asked.targets), moving)


def rows_of(name: str) -> tuple[tables.Case, ...]:
    """The rows that a scenario is judged by: itself, or those of `JUDGES` whose drive is the same."""
    scenario = load_scenario(name)
    if name in _rows():
        return (_rows()[name],)
    alike = (row for row in _rows().values() if row.table in JUDGES)
    return tuple(row for row in alike if load_scenario(row.name).plant == scenario.plant)


def expanded(name: str) -> tuple[str, ...]:
    """The rows of a group (`ncap:ccrs`), or `name` itself. Raises ConfigError on an unknown name."""
    table, _, group = name.partition(tables.SEPARATOR)
    if table in tables.table_names() and group in tables.group_names(table):
        return tuple(row.name for row in tables.cases(table, group))
    load_scenario(name)
    return (name,)


@lru_cache(maxsize=1)
def _rows() -> Mapping[str, tables.Case]:
    return {row.name: row for table in tables.table_names() for row in tables.cases(table)}


# -- mechanisms --------------------------------------------------------------------------------------


def margins(row: FttiRow, figures: Mapping[str, Fhti]) -> FttiRow:
    """`row` with the margin of each mechanism."""

    def margin(fhti: Fhti) -> float | None:
        handled_ms = fhti.p99 if fhti.bound is None else fhti.bound
        return None if row.ftti_ms is None else round(1.0 - handled_ms / row.ftti_ms, 4)

    return replace(row, mechanisms={name: MechanismMargin(of, margin(of)) for name, of in figures.items()})


def read_fhti(path: Path) -> dict[str, Fhti]:
    """`{"MECHANISM": {"p50": ms, "p99": ms, "bound": ms or null}}`. Raises ConfigError."""
    try:
        found = read_yaml(path, dict[str, Fhti])  # JSON is YAML
    except ConfigError as error:
        form = '{"pbr": {"p50": 1.9, "p99": 3.6, "bound": 12.5}}'
        raise ConfigError(f"--fhti {error}; allowed is a JSON object such as {form}") from None
    for name, fhti in found.items():
        bound_ms = fhti.p99 if fhti.bound is None else fhti.bound
        if not 0.0 <= fhti.p50 <= fhti.p99 <= bound_ms:
            found_ms = f"p50 {fhti.p50:g}, p99 {fhti.p99:g}, bound {bound_ms:g}"
            raise ConfigError(f"--fhti {path}: {name}: found {found_ms}; allowed is 0 <= p50 <= p99 <= bound")
    return found
