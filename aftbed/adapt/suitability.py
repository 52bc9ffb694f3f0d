"""Whether a mechanism suits: FT, A and R against what it tolerates and needs (paper, II).

FT is the fault model asked for, A what the protected function declares, R the available resources. A
mechanism is *consistent* with the three if it tolerates every fault asked for and has all that it needs.
Each mechanism declares both. The declarations are **reconstructed**: the paper's Fig. 1 is an image, so
they were made from the text, from the related work of its authors, and from what our own bricks do. Rows of
a user's file replace them (`table_from`).

An expression follows from its parts, and has no row of its own:

    tolerates, detects, needs   the union
    CPUs, CPU load, bandwidth   the most that a part asks for
    detects                     becomes tolerates under a mechanism that replicates: where one replica
                                stops, the other one executes the request

There are two classes of value faults. `value` is any wrong reply or state of one execution; a mechanism
that compares executions covers it. `implausible` is the part of it that the function's own assertion
refuses; that is all that an assertion covers. `flow`: a step is skipped, done twice, or late.

State access where a backup executes every request: normal service needs none. A *new* backup needs it:
without, the survivor of a failover stays alone. That is no reason to refuse the mechanism; `remarks` says
it.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from aftbed.core.application import NONE, AccessKind, Characteristics
from aftbed.core.errors import FileKeyError, unknown
from aftbed.ftm.compose import expressions, parse, replicates
from aftbed.ftm.declaration import FaultClass, Level, Mechanism, Suitability
from aftbed.ftm.registry import MECHANISMS, SHIPPED, find, names

Part = Annotated[float, Meta(ge=0, le=1)]
Rate = Annotated[float, Meta(ge=0, le=1e9)]

FAULTS: Final[dict[FaultClass, str]] = {
    "crash": "crashes",
    "value": "value faults",
    "implausible": "implausible value faults",
    "flow": "flow faults",
}
PART_OF: Final[dict[FaultClass, FaultClass]] = {"implausible": "value"}  # a class of faults within another
LEVELS: Final[tuple[Level, ...]] = ("none", "low", "high")
TAKES: Final[dict[Level, str]] = {"none": "no", "low": "little", "high": "much"}


class FaultModel(msgspec.Struct, frozen=True):
    """FT: the faults that must be tolerated."""

    crash: bool = True
    value: bool = False
    implausible: bool = False
    flow: bool = False

    def asked(self) -> tuple[FaultClass, ...]:
        return tuple(fault for fault in FAULTS if getattr(self, fault))


class Resources(msgspec.Struct, frozen=True):
    """R: CPUs that may be used, how busy they are (0 to 1), kbit/s between the replicas.

    `bandwidth_kbit_s` None: nothing limits it, as between replicas on one host.
    """

    cpus: int
    cpu_load: float = 0.0
    bandwidth_kbit_s: float | None = None


AMPLE: Final = Resources(cpus=1024)  # where R is not at stake


class Row(Suitability, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What one mechanism tolerates and needs."""

    mechanism: str  # whose row it is


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the classes of CPU load and bandwidth mean in numbers.

    A mechanism of high CPU load at least doubles the work, so half of the CPUs must be free for it. The
    bandwidths carry 50 requests a second of the brake function: as requests (low), as states (high).
    """

    low_cpu_load_max: Part = 0.9  # of a mechanism of low CPU load
    high_cpu_load_max: Part = 0.5  # of one of high CPU load
    low_bandwidth_kbit_s_min: Rate = 64.0  # of a mechanism of low bandwidth
    high_bandwidth_kbit_s_min: Rate = 256.0  # of one of high bandwidth


class SuitabilityTable(msgspec.Struct, frozen=True):
    """The rows, by mechanism, and the limits."""

    rows: dict[str, Row]
    limits: Limits = Limits()

    def row(self, name: str) -> Row:
        """That of a mechanism that is known. An installed one has the row that it declares, if no other."""
        return self.rows.get(name) or _declared(MECHANISMS[name])


class TableFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A user's file: each row takes the place of the shipped one for the same mechanism."""

    rows: tuple[Row, ...] = ()  # each takes the place of that of the same mechanism
    limits: Limits = Limits()  # what the classes mean in numbers


class Demand(msgspec.Struct, frozen=True):
    """What an expression tolerates and needs.

    `deterministic`, `state_access`, `exact_state`: a sentence for each part that needs it.
    """

    ftm: str
    tolerates: tuple[FaultClass, ...]
    detects: tuple[FaultClass, ...]
    deterministic: tuple[str, ...]
    state_access: tuple[str, ...]
    exact_state: tuple[str, ...]
    cpus: int
    cpu_load: Level
    bandwidth: Level


def _declared(one: Mechanism) -> Row:
    return Row(mechanism=one.name, **msgspec.structs.asdict(one.suitability))


ROWS: Final = tuple(_declared(MECHANISMS[name]) for name in SHIPPED)
TABLE: Final = SuitabilityTable({row.mechanism: row for row in ROWS})


def table_from(file: TableFile) -> SuitabilityTable:
    """The shipped table with the rows of `file` in it. Raises FileKeyError."""
    for index, row in enumerate(file.rows):
        if find(row.mechanism) is None:
            raise FileKeyError(f"rows[{index}].mechanism", unknown("FTM", row.mechanism, names()))
    for name, times in Counter(row.mechanism for row in file.rows).items():
        if times > 1:
            raise FileKeyError("rows", f"found {times} for {name}, allowed is one")
    return SuitabilityTable(TABLE.rows | {row.mechanism: row for row in file.rows}, file.limits)


def fault_model(text: str) -> FaultModel:
    """`crash,value` as a FaultModel; `none` asks for no tolerance. Raises ConfigError."""
    names = [] if text == "none" else text.split(",")
    for name in names:
        if name not in FAULTS:
            raise unknown("fault", name, ("none", *FAULTS))
    return FaultModel(**{fault: fault in names for fault in FAULTS})


def demand(expression: str, table: SuitabilityTable = TABLE) -> Demand:
    """What `expression` tolerates and needs. Raises ConfigError if it is none."""
    parts = parse(expression)
    rows = [table.row(name) for name in parts]
    detects = _united(row.detects for row in rows)
    tolerates = _united(row.tolerates for row in rows)
    return Demand(
        expression,
        tolerates=_united((tolerates, detects)) if _replicates(parts) else tolerates,
        detects=detects,
        deterministic=tuple(
            f"{row.mechanism} needs a deterministic function: {row.deterministic}"
            for row in rows
            if row.deterministic
        ),
        state_access=tuple(
            f"{row.mechanism} needs state access: {row.state_access}" for row in rows if row.state_access
        ),
        exact_state=tuple(
            f"{row.mechanism} needs exact state access: {row.exact_state}" for row in rows if row.exact_state
        ),
        cpus=max([row.cpus for row in rows], default=1),
        cpu_load=max([row.cpu_load for row in rows], default="low", key=LEVELS.index),
        bandwidth=max([row.bandwidth for row in rows], default="none", key=LEVELS.index),
    )


def problems(
    expression: str,
    faults: FaultModel,
    characteristics: Characteristics,
    resources: Resources,
    table: SuitabilityTable = TABLE,
) -> list[str]:
    """Every assumption of `expression` that does not hold, a sentence each; [] if it is consistent.

    Raises ConfigError if it is no expression.
    """
    wanted = demand(expression, table)
    known = ", ".join(wanted.tolerates) or "nothing"
    found = [
        f"{expression} detects {FAULTS[fault]} and can only stop:"
        " there is no second replica to execute instead"
        if fault in wanted.detects
        else f"{expression} does not tolerate {FAULTS[fault]} (it tolerates {known})"
        for fault in faults.asked()
        if fault not in wanted.tolerates
    ]
    if not characteristics.deterministic:
        found += wanted.deterministic
    if characteristics.state_access == NONE:
        found += wanted.state_access
    if characteristics.state_access.kind is AccessKind.APPROXIMATE:
        found += wanted.exact_state
    return found + _short_of(wanted, resources, table.limits)


def consistent(
    faults: FaultModel,
    characteristics: Characteristics,
    resources: Resources,
    table: SuitabilityTable = TABLE,
) -> list[str]:
    """The consistent expressions, the cheapest first; [] is "no consistent FTM"."""
    found = [e for e in expressions() if not problems(e, faults, characteristics, resources, table)]
    return sorted(found, key=lambda expression: cost(expression, table))


def cost(expression: str, table: SuitabilityTable = TABLE) -> tuple[int, int, int]:
    """To sort by: CPUs, CPU load, bandwidth; the last two summed over the parts."""
    rows = [table.row(name) for name in parse(expression)]
    cpu_load = sum(LEVELS.index(row.cpu_load) for row in rows)
    return demand(expression, table).cpus, cpu_load, sum(LEVELS.index(row.bandwidth) for row in rows)


def remarks(expression: str, characteristics: Characteristics) -> list[str]:
    """Limits of an expression that is consistent."""
    if _replicates(parse(expression)) and characteristics.state_access == NONE:
        return [f"{expression} without state access: after a failover the survivor stays alone"]
    return []


def refusal(
    expression: str,
    faults: FaultModel,
    characteristics: Characteristics,
    resources: Resources,
    table: SuitabilityTable = TABLE,
) -> str:
    """Why `expression` must not run here, with the expressions that may; "" if it may."""
    found = problems(expression, faults, characteristics, resources, table)
    if not found:
        return ""
    others = consistent(faults, characteristics, resources, table)
    instead = f"consistent: {', '.join(others)}" if others else "no consistent FTM"
    return f"{expression} is not consistent: {'; '.join(found)} ({instead})"


def unsuitable(expression: str, characteristics: Characteristics) -> str:
    """Why `expression` does not suit a function, by its A alone; "" if it does.

    The faults asked for are those that the mechanism is chosen for: crashes, where it replicates. Resources
    are not judged.
    """
    return refusal(expression, _chosen_for(expression), characteristics, AMPLE)


def mismatches(expression: str, characteristics: Characteristics) -> list[str]:
    """The same as sentences, without the expressions that would suit; [] if it does."""
    return problems(expression, _chosen_for(expression), characteristics, AMPLE)


def _chosen_for(expression: str) -> FaultModel:
    return FaultModel(crash=_replicates(parse(expression)))


def _united(faults: Iterable[tuple[FaultClass, ...]]) -> tuple[FaultClass, ...]:
    """All of them once, in the order of FAULTS."""
    found = {fault for some in faults for fault in some}
    return tuple(fault for fault in FAULTS if fault in found)


def _replicates(names: tuple[str, ...]) -> bool:
    return bool(names) and replicates(names[0])


def _short_of(wanted: Demand, resources: Resources, limits: Limits) -> list[str]:
    found = []
    if resources.cpus < wanted.cpus:
        found.append(f"{wanted.ftm} needs {wanted.cpus} CPUs, found {resources.cpus}")
    load_max = limits.high_cpu_load_max if wanted.cpu_load == "high" else limits.low_cpu_load_max
    if wanted.cpu_load != "none" and resources.cpu_load > load_max:
        found.append(
            f"{wanted.ftm} takes {TAKES[wanted.cpu_load]} CPU:"
            f" found a load of {resources.cpu_load:.0%}, allowed are {load_max:.0%}"
        )
    rates: dict[Level, float] = {
        "none": 0.0,
        "low": limits.low_bandwidth_kbit_s_min,
        "high": limits.high_bandwidth_kbit_s_min,
    }
    bandwidth_kbit_s = resources.bandwidth_kbit_s
    if bandwidth_kbit_s is not None and bandwidth_kbit_s < rates[wanted.bandwidth]:
        found.append(
            f"{wanted.ftm} takes {TAKES[wanted.bandwidth]} bandwidth:"
            f" found {bandwidth_kbit_s:g} kbit/s, needed are {rates[wanted.bandwidth]:g}"
        )
    return found
