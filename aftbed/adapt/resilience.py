"""How resilient a set of mechanisms is: which changes of FT, A and R it answers, and how.

A system is resilient if its mechanisms stay consistent when something changes, or if what has become
inconsistent is soon put right (W. Excoffon, J.-C. Fabre, M. Lauer, "Analysis of Adaptive Fault Tolerance for
Resilient Computing", EDCC 2017; W. Excoffon's thesis, INP Toulouse, 2018INPT0049). They judge a *set* of
mechanisms and its compositions. The counting here is ours; each single change is enumerated:

    state     an expression of the set, in a situation with which it is consistent (`suitability`)
    change    one axis of the situation takes another value
    answer    the expression stays: it is consistent with the new situation too
              an adaptation: another expression of the set is
              nothing: none is

Every state can be reached: where nothing is asked and everything is there, each expression is consistent, and
on the way from there, one change after the other, it stays so. All changes have the same weight: how often
each happens is not known here. A change for the better needs no answer, so the share of the changes that
break what runs is given too.

A change of A comes with a new version of the function, so the adaptation is done before it. One of FT or R is
noticed, so the adaptation comes after it. An adaptation that has to hand over the state of the function is no
answer where the function gives no access to its state, neither before the change nor after it.

What would have to be added is tried one mechanism at a time: those that are shipped and not in the set; then
each shipped one with one assumption less.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import Enum
from functools import cache, reduce
from itertools import product
from operator import and_
from typing import Final, NamedTuple

import msgspec

from aftbed.adapt.planner import plan, target
from aftbed.adapt.suitability import (
    AMPLE,
    FAULTS,
    LEVELS,
    PART_OF,
    TABLE,
    FaultModel,
    Limits,
    Resources,
    Row,
    SuitabilityTable,
    cost,
    problems,
)
from aftbed.core.application import EXACT, NONE, Characteristics, StateAccess, approximate
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.graph import PLACEMENTS
from aftbed.core.script import Align, Transfer
from aftbed.ftm.compose import NONE as NO_MECHANISM
from aftbed.ftm.compose import build, known_expressions, parse
from aftbed.ftm.declaration import FaultClass
from aftbed.ftm.registry import MECHANISMS, SHIPPED, find
from aftbed.ftm.registry import names as known_names

NOTHING_ASKED: Final = FaultModel(crash=False)
ACCESSES: Final[dict[str, StateAccess]] = {"exact": EXACT, "approximate": approximate(1e-3), "no": NONE}


class AssumptionKind(Enum):
    """Which part of the assumptions a change is of."""

    FT = "FT"
    A = "A"
    R = "R"


class ChangeAnswer(Enum):
    """What a set of mechanisms does about a change."""

    STAYS = "stays"
    ADAPTS = "adapts"
    NOTHING = "nothing"


class AxisValue(msgspec.Struct, frozen=True):
    """One value of an axis, with all other axes at their best."""

    label: str
    faults: FaultModel = NOTHING_ASKED
    characteristics: Characteristics = Characteristics()
    resources: Resources = AMPLE


class Axis(msgspec.Struct, frozen=True):
    """What can change by itself, and the values that the table tells apart, the best first."""

    kind: AssumptionKind
    name: str
    values: tuple[AxisValue, ...]


Situation = tuple[int, ...]  # the number of the value on each axis


class Addition(Enum):
    """What is added to a set: a mechanism as it is shipped, or one like it with an assumption less."""

    AS_SHIPPED = "as_shipped"
    TOLERATES = "tolerates"
    DETERMINISM = "no_determinism"
    STATE_ACCESS = "no_state_access"
    EXACT_STATE = "no_exact_state"
    CPUS = "one_cpu"
    CPU_LOAD = "less_cpu_load"
    BANDWIDTH = "less_bandwidth"


WORDS: Final[dict[Addition, str]] = {
    Addition.TOLERATES: "also tolerates",
    Addition.DETERMINISM: "needs no determinism",
    Addition.STATE_ACCESS: "needs no state access",
    Addition.EXACT_STATE: "needs no exact state access",
    Addition.CPUS: "needs 1 CPU",
    Addition.CPU_LOAD: "takes less CPU",
    Addition.BANDWIDTH: "takes less bandwidth",
}


class Candidate(msgspec.Struct, frozen=True):
    """A mechanism that may be added. `row`: what it tolerates and needs; `detail`: which fault more."""

    mechanism: str
    addition: Addition
    row: Row
    detail: str = ""

    def __str__(self) -> str:
        if self.addition is Addition.AS_SHIPPED:
            return self.mechanism
        return f"one like {self.mechanism} that {WORDS[self.addition]} {self.detail}".rstrip()


class Counts(msgspec.Struct, frozen=True):
    """Changes, by their answer. `answered`: the share that has one; `of_breaking`: of those that break what
    runs; None where there are none.
    """

    changes: int
    stays: int
    adapts: int
    nothing: int
    answered: float | None
    of_breaking: float | None


class KindCounts(msgspec.Struct, frozen=True):
    """Of all changes of FT, A or R."""

    kind: AssumptionKind
    counts: Counts


class ChangeCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Of one change, over all states in which it can happen."""

    kind: AssumptionKind
    axis: str
    old: str = msgspec.field(name="from")
    new: str = msgspec.field(name="to")
    counts: Counts


class NeededAdaptation(msgspec.Struct, frozen=True):
    """One that answers so many changes: it leads to the cheapest expression that is consistent."""

    old: str = msgspec.field(name="from")
    new: str = msgspec.field(name="to")
    changes: int


class AnsweredMore(msgspec.Struct, frozen=True):
    """A mechanism in addition, and how many of the changes without an answer it would answer."""

    words: str
    mechanism: str
    addition: Addition
    detail: str
    answers: int
    answered: float


class Resilience(msgspec.Struct, frozen=True):
    """Of a set of mechanisms. `ftms`: its expressions; `states`: each in each situation that it suits."""

    mechanisms: tuple[str, ...]
    ftms: tuple[str, ...]
    situations: int
    states: int
    total: Counts
    kinds: tuple[KindCounts, ...]
    changes: tuple[ChangeCounts, ...]
    adaptations: tuple[NeededAdaptation, ...]
    additions: tuple[AnsweredMore, ...]


# -- the set and the situations -------------------------------------------------------------------


def mechanisms_of(text: str) -> tuple[str, ...]:
    """`pbr,lfr,tr` in the order of the registry. Raises ConfigError."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    known = ", ".join(SHIPPED)
    if not names:
        raise ConfigError(f"a set without a mechanism answers nothing; {known} are allowed, with commas")
    for name in names:
        if name == NO_MECHANISM:
            raise ConfigError("none has no engine, so no adaptation leads to it or away from it")
        if "+" in name:
            raise ConfigError(
                f"{name} is a composition: a set has what its mechanisms compose;"
                f" {','.join(name.split('+'))} is allowed"
            )
        if find(name) is None:
            raise unknown("mechanism", name, known_names())
    return tuple(name for name in known_names() if name in names)


def expressions_of(mechanisms: Sequence[str]) -> tuple[str, ...]:
    """All that can run of a set: each mechanism, and each composition."""
    return tuple(e for e in known_expressions() if e != NO_MECHANISM and set(parse(e)) <= set(mechanisms))


def axes(table: SuitabilityTable = TABLE) -> tuple[Axis, ...]:
    """All that can change, with the values that `table` tells apart."""
    limits, counts = table.limits, sorted({1, *(table.row(name).cpus for name in MECHANISMS)}, reverse=True)
    return (
        *(Axis(AssumptionKind.FT, name, _faults(name)) for name in FAULTS if name not in PART_OF),
        Axis(
            AssumptionKind.A,
            "determinism",
            (
                AxisValue("deterministic"),
                AxisValue("not deterministic", characteristics=Characteristics(deterministic=False)),
            ),
        ),
        Axis(AssumptionKind.A, "state access", tuple(map(_access, ACCESSES))),
        Axis(AssumptionKind.R, "CPUs", tuple(_resources(str(count), cpus=count) for count in counts)),
        Axis(AssumptionKind.R, "CPU load", tuple(_loads(limits))),
        Axis(AssumptionKind.R, "bandwidth", tuple(_bandwidths(limits))),
    )


def _faults(name: FaultClass) -> tuple[AxisValue, ...]:
    """None of it, each part of it alone, all of it."""
    parts = [part for part, whole in PART_OF.items() if whole == name]
    asked: dict[str, tuple[str, ...]] = {"no": (), **{part: (part,) for part in parts}, name: (name, *parts)}
    return tuple(
        AxisValue(label, FaultModel(**{fault: fault in some for fault in FAULTS}))
        for label, some in asked.items()
    )


def _access(label: str) -> AxisValue:
    return AxisValue(label, characteristics=Characteristics(state_access=ACCESSES[label]))


def _resources(label: str, **given: float) -> AxisValue:
    return AxisValue(label, resources=msgspec.structs.replace(AMPLE, **given))


def _loads(limits: Limits) -> Iterator[AxisValue]:
    loads = sorted({limits.high_cpu_load_max, limits.low_cpu_load_max})
    for load in loads:
        yield _resources(f"up to {load:.0%}", cpu_load=load)
    if loads[-1] < 1.0:
        yield _resources(f"above {loads[-1]:.0%}", cpu_load=1.0)


def _bandwidths(limits: Limits) -> Iterator[AxisValue]:
    for rate in sorted({limits.high_bandwidth_kbit_s_min, limits.low_bandwidth_kbit_s_min} - {0.0})[::-1]:
        yield _resources(f"{rate:g} kbit/s", bandwidth_kbit_s=rate)
    yield _resources("less", bandwidth_kbit_s=0.0)


# -- what suits -----------------------------------------------------------------------------------


class _Option(NamedTuple):
    """What may run: an expression, with the table that says what it needs."""

    expression: str
    table: SuitabilityTable


class _Suits:
    """For each value of each axis, a bit for each option: whether it is consistent with that value.

    An option suits a situation if it suits each value by itself, since each assumption is about one axis.
    """

    def __init__(self, options: Sequence[_Option], along: Sequence[Axis]) -> None:
        self._masks = [
            [sum(_suits(o, value) << at for at, o in enumerate(options)) for value in axis.values]
            for axis in along
        ]

    def __call__(self, situation: Situation) -> int:
        return reduce(and_, (masks[value] for masks, value in zip(self._masks, situation, strict=True)))


def _suits(option: _Option, value: AxisValue) -> bool:
    return not problems(option.expression, value.faults, value.characteristics, value.resources, option.table)


@cache
def hands_over(old: str, new: str) -> bool:
    """Whether the adaptation gives a replica the state of the function that another one has."""
    if old == new:
        return False
    graph = build(old, PLACEMENTS[0])
    steps = plan(graph, target(graph, new)).script.commit
    return any(isinstance(step, Transfer | Align) for step in steps)


def candidates(mechanisms: Sequence[str], table: SuitabilityTable = TABLE) -> Iterator[Candidate]:
    """What may be added to a set, one mechanism each."""
    for name in MECHANISMS:
        if name not in mechanisms:
            yield Candidate(name, Addition.AS_SHIPPED, table.row(name))
    for name in MECHANISMS:
        yield from _with_less(table.row(name))


def _with_less(row: Row) -> Iterator[Candidate]:
    """`row` with one assumption less."""

    def less(addition: Addition, detail: str = "", **fields: object) -> Candidate:
        return Candidate(row.mechanism, addition, msgspec.structs.replace(row, **fields), detail)

    for fault in FAULTS:
        whole = {fault, *(part for part, of in PART_OF.items() if of == fault)}
        if not whole <= set(row.tolerates):
            tolerates = tuple(f for f in FAULTS if f in whole or f in row.tolerates)
            yield less(Addition.TOLERATES, fault, tolerates=tolerates)
    if row.deterministic:
        yield less(Addition.DETERMINISM, deterministic="")
    if row.state_access:
        yield less(Addition.STATE_ACCESS, state_access="", exact_state="")
    if row.exact_state:
        yield less(Addition.EXACT_STATE, exact_state="")
    if row.cpus > 1:
        yield less(Addition.CPUS, cpus=1)
    if row.cpu_load != LEVELS[0]:
        yield less(Addition.CPU_LOAD, cpu_load=LEVELS[LEVELS.index(row.cpu_load) - 1])
    if row.bandwidth != LEVELS[0]:
        yield less(Addition.BANDWIDTH, bandwidth=LEVELS[LEVELS.index(row.bandwidth) - 1])


# -- the measure ----------------------------------------------------------------------------------


class _Change(NamedTuple):
    """The value of one axis becomes another one."""

    axis: int
    old: int
    new: int

    def of(self, situation: Situation) -> Situation:
        return (*situation[: self.axis], self.new, *situation[self.axis + 1 :])


class _Tally:
    """Counts all changes from all states of a set that has `ftms`, the first ones of `options`."""

    def __init__(self, ftms: Sequence[str], options: Sequence[_Option], along: Sequence[Axis]) -> None:
        self.states = 0
        self.answers: Counter[tuple[_Change, ChangeAnswer]] = Counter()
        self.needed: Counter[tuple[str, str]] = Counter()  # adaptations
        self.unanswered: Counter[int] = Counter()  # by the options, as bits, that would be an answer
        self._ftms = ftms
        self._own = (1 << len(ftms)) - 1
        self._stateless = [  # by what runs: the options to which no state has to be handed over
            sum((not hands_over(old, option.expression)) << at for at, option in enumerate(options))
            for old in ftms
        ]
        suits = _Suits(options, along)
        self.situations = list(product(*(range(len(axis.values)) for axis in along)))
        self._suited = {situation: suits(situation) for situation in self.situations}
        self._gives_state = {situation: _gives_state(situation, along) for situation in self.situations}
        for before in self.situations:
            running = [at for at in range(len(ftms)) if self._suited[before] >> at & 1]
            self.states += len(running)
            for change in _changes(before, along) if running else ():
                for at in running:
                    self._count(at, before, change)

    def _count(self, at: int, before: Situation, change: _Change) -> None:
        """`at`: the number of what runs."""
        then = change.of(before)
        open_to = self._suited[then]
        if not (self._gives_state[before] or self._gives_state[then]):
            open_to &= self._stateless[at]
        if self._suited[then] >> at & 1:
            self.answers[change, ChangeAnswer.STAYS] += 1
        elif open_to & self._own:
            self.answers[change, ChangeAnswer.ADAPTS] += 1
            cheapest = (open_to & -open_to).bit_length() - 1
            self.needed[self._ftms[at], self._ftms[cheapest]] += 1
        else:
            self.answers[change, ChangeAnswer.NOTHING] += 1
            self.unanswered[open_to] += 1


def resilience(mechanisms: Sequence[str], table: SuitabilityTable = TABLE) -> Resilience:
    """Of a set of mechanisms: all changes from all its states."""
    along = axes(table)
    ftms = sorted(expressions_of(mechanisms), key=lambda expression: cost(expression, table))
    options = [_Option(name, table) for name in ftms]
    of_candidate: list[tuple[Candidate, int]] = []  # with the bits of its options
    for candidate in candidates(mechanisms, table):
        added = _with(candidate, mechanisms, table)
        of_candidate.append((candidate, ((1 << len(added)) - 1) << len(options)))
        options += added
    tally = _Tally(ftms, options, along)
    answers = tally.answers
    return Resilience(
        tuple(mechanisms),
        tuple(ftms),
        len(tally.situations),
        tally.states,
        _counts((answer, count) for (_, answer), count in answers.items()),
        tuple(_of_kind(kind, answers, along) for kind in AssumptionKind),
        tuple(_rows(answers, along)),
        tuple(NeededAdaptation(*pair, count) for pair, count in tally.needed.most_common()),
        tuple(_more(of_candidate, tally.unanswered, answers.total())),
    )


def _with(candidate: Candidate, mechanisms: Sequence[str], table: SuitabilityTable) -> list[_Option]:
    """What a set can run with the candidate that it cannot without."""
    changed = SuitabilityTable(table.rows | {candidate.mechanism: candidate.row}, table.limits)
    both = expressions_of((*mechanisms, candidate.mechanism))
    return [_Option(e, changed) for e in both if candidate.mechanism in parse(e)]


def _gives_state(situation: Situation, along: Sequence[Axis]) -> bool:
    """Whether the function gives access to its state."""
    values = (axis.values[at] for axis, at in zip(along, situation, strict=True))
    return all(value.characteristics.state_access != NONE for value in values)


def _changes(situation: Situation, along: Sequence[Axis]) -> Iterator[_Change]:
    for axis, old in enumerate(situation):
        for new in range(len(along[axis].values)):
            if new != old:
                yield _Change(axis, old, new)


_Answers = Mapping[tuple[_Change, ChangeAnswer], int]


def _counts(answers: Iterable[tuple[ChangeAnswer, int]]) -> Counts:
    by_answer = dict.fromkeys(ChangeAnswer, 0)
    for answer, count in answers:
        by_answer[answer] += count
    stays, adapts, nothing = by_answer.values()
    changes = stays + adapts + nothing
    return Counts(
        changes,
        stays,
        adapts,
        nothing,
        answered=_share(stays + adapts, changes),
        of_breaking=_share(adapts, adapts + nothing),
    )


def _share(part: int, whole: int) -> float | None:
    return round(part / whole, 4) if whole else None


def _of_kind(kind: AssumptionKind, answers: _Answers, along: Sequence[Axis]) -> KindCounts:
    of_it = [
        (answer, count) for (change, answer), count in answers.items() if along[change.axis].kind is kind
    ]
    return KindCounts(kind, _counts(of_it))


def _rows(answers: _Answers, along: Sequence[Axis]) -> Iterator[ChangeCounts]:
    for change in sorted({change for change, _ in answers}):
        axis = along[change.axis]
        yield ChangeCounts(
            kind=axis.kind,
            axis=axis.name,
            old=axis.values[change.old].label,
            new=axis.values[change.new].label,
            counts=_counts((answer, answers.get((change, answer), 0)) for answer in ChangeAnswer),
        )


def _more(
    of_candidate: Sequence[tuple[Candidate, int]], unanswered: Mapping[int, int], changes: int
) -> list[AnsweredMore]:
    """Those that would answer something, the most first."""
    answered = changes - sum(unanswered.values())
    found = []
    for candidate, bits in of_candidate:
        answers = sum(count for open_to, count in unanswered.items() if open_to & bits)
        if answers:
            share = round((answered + answers) / changes, 4)
            found.append(
                AnsweredMore(
                    str(candidate),
                    candidate.mechanism,
                    candidate.addition,
                    candidate.detail,
                    answers,
                    share,
                )
            )
    return sorted(found, key=lambda one: -one.answers)
