"""A figure and its limit, measured in turn in short rounds; their ratio; and what the machine did meanwhile.

A virtual machine can be twice as slow in the next minute. So a figure alone says little, and so does a limit
that was measured a minute before. What holds is the ratio of the two where both were measured within some
seconds. `in_turn` alternates them: limit and figure, figure and limit, and so on. Neither is always the later
one, so a drift of the machine within a round cancels out over two of them. Some machines are slower for a
tenth of a second: there the two have to alternate within a round, by whatever measures both (`together`).

`beside_limit` makes the ratio of each quantile in each round: that of the figure to the *median* of the limit
in the same round, so the p99 of a figure is not excused by the tail of its limit. Over the rounds this gives
a median and its quartiles, by nearest rank: a round with a disturbance is one value of eleven. The p99 of a
round with fewer than 100 values is its greatest one. So there is also `all`: the quantile over the values of
all rounds, each divided by the limit of its round.

A limit of what nodes do runs as the nodes do (`as_node`): under SCHED_BATCH, and on the core of the leader's
chain where runs are pinned.

Limits: of 11 rounds, the 95 % interval of the median is from the 2nd to the 10th value. Whether a change has
made something slower is a question for `aftbed bench compare`, which measures both versions in turn.
"""

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, Generic, NamedTuple, TypeVar

import msgspec

from aftbed.bench.runs import Percentiles, percentiles
from aftbed.campaign.statistics import quantile
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.progress import Show, unshown
from aftbed.runtime.unix import interrupts, linux

ROUNDS: Final = 11  # fewer are too few to quote
SHORT_ROUNDS: Final = 20 * ROUNDS  # of a tenth of a second each, in which a machine may change its speed
DIGITS: Final = 3  # of a ratio
FAILURES_MAX: Final = 3  # of a bench, that are measured again

Figure = TypeVar("Figure")
Limit = TypeVar("Limit")
Value = TypeVar("Value")


# -- in turn --------------------------------------------------------------------------------------


class Rounds(NamedTuple, Generic[Figure, Limit]):
    """What each round measured, and what the machine did meanwhile."""

    figures: list[Figure]
    limits: list[Limit]
    machine: "Meanwhile"


def in_turn(
    rounds: int,
    figure: Callable[[int], Figure],
    limit: Callable[[int], Limit],
    failures_max: int = FAILURES_MAX,
    show: Show = unshown,
) -> Rounds[Figure, Limit]:
    """Measure both `rounds` times, the limit first in round 0, the figure first in round 1, and so on.

    Both get the number of the round. `show` is called between two measurements, with their number. One that
    fails is measured again, in all at most `failures_max` times: a busy machine may fail it (`runs.tried`).
    Raises the HarnessError or ConfigError of the next failure.
    """
    figures: list[Figure] = []
    limits: list[Limit] = []
    measured = _Measured(2 * rounds, failures_max, show)
    for number in range(rounds):
        if number % 2 == 0:
            limits.append(measured.by(limit, number))
            figures.append(measured.by(figure, number))
        else:
            figures.append(measured.by(figure, number))
            limits.append(measured.by(limit, number))
    return Rounds(figures, limits, measured.machine())


def together(
    rounds: int, both: Callable[[int], tuple[Figure, Limit]], show: Show = unshown
) -> Rounds[Figure, Limit]:
    """As `in_turn`, where one call measures the figure and its limit, in turns that are shorter."""
    measured = _Measured(rounds, FAILURES_MAX, show)
    found = [measured.by(both, number) for number in range(rounds)]
    return Rounds([figure for figure, _ in found], [limit for _, limit in found], measured.machine())


class _Measured:
    """How many measurements were made, of so many, and how many failed; `show` is called between two."""

    def __init__(self, total: int, failures_max: int, show: Show) -> None:
        self._watch = MachineWatch()
        self._total, self._failures_max, self._show = total, failures_max, show
        self._done = self._failures = 0
        show(0, total)

    def by(self, what: Callable[[int], Value], number: int) -> Value:
        """What `what` gives for that round, again if it fails."""
        while True:
            try:
                found = what(number)
                break
            except (HarnessError, ConfigError):
                self._failures += 1
                if self._failures > self._failures_max or interrupts.came():
                    raise
        self._done += 1
        self._watch.look()
        self._show(self._done, self._total)
        return found

    def machine(self) -> "Meanwhile":
        return self._watch.found(self._failures)


def shares(count: int, rounds: int) -> list[int]:
    """`count` events in at most `rounds` rounds, as equal as can be; no round is empty."""
    assert count >= 1 and rounds >= 1, (count, rounds)
    rounds = min(rounds, count)
    return [count // rounds + (number < count % rounds) for number in range(rounds)]


# -- the ratio ------------------------------------------------------------------------------------


class MeasuredLimit(Percentiles, frozen=True, kw_only=True):
    """What a figure is compared with, over all rounds, in the unit of the figure."""

    name: str


class QuantileRatio(msgspec.Struct, frozen=True):
    """Of a quantile of the figure to the median of the limit, over the rounds.

    `all`: the same quantile over the values of all rounds, each divided by the limit of its round.
    """

    median: float
    q1: float
    q3: float
    all: float


class Ratio(msgspec.Struct, frozen=True):
    """Of a figure to its limit."""

    p50: QuantileRatio
    p99: QuantileRatio
    rounds: int


class BesideLimit(msgspec.Struct, frozen=True, kw_only=True):
    """What stands in a document beside a figure."""

    limit: MeasuredLimit
    ratio: Ratio


class InRounds(BesideLimit, frozen=True, kw_only=True):
    """What stands in the document of a bench that measures in rounds."""

    machine: "Meanwhile"


def beside_limit(
    name: str, figures: Sequence[Sequence[float]], limits: Sequence[Sequence[float]], digits: int = 3
) -> BesideLimit:
    """The limit called `name`, and the ratio to it; both sequences have the values of each round.

    `digits` are those of the limit. Raises HarnessError where a round measured nothing.
    """
    assert len(figures) == len(limits), (len(figures), len(limits))
    for number, values in enumerate(zip(figures, limits, strict=True)):
        if not all(values):
            raise HarnessError(f"{name}: nothing was measured in round {number + 1} of {len(figures)}")
    limit_p50 = [quantile(values, 0.5) for values in limits]
    in_limits = [[value / p50 for value in values] for values, p50 in zip(figures, limit_p50, strict=True)]
    everything = [value for values in limits for value in values]
    return BesideLimit(
        limit=MeasuredLimit(**msgspec.structs.asdict(percentiles(everything, digits)), name=name),
        ratio=Ratio(_over_rounds(in_limits, 0.5), _over_rounds(in_limits, 0.99), len(in_limits)),
    )


def _over_rounds(in_limits: Sequence[Sequence[float]], share: float) -> QuantileRatio:
    by_round = [quantile(values, share) for values in in_limits]
    median, q1, q3 = (round(quantile(by_round, part), DIGITS) for part in (0.5, 0.25, 0.75))
    whole = quantile([value for values in in_limits for value in values], share)
    return QuantileRatio(median, q1, q3, round(whole, DIGITS))


# -- as a node ------------------------------------------------------------------------------------


def cores(*, pin: bool) -> tuple[int | None, int | None]:
    """The cores of the leader's chain and of the backup's, as runs pin them; None: the kernel chooses."""
    cpus = sorted(os.sched_getaffinity(0))
    return (cpus[0], cpus[1]) if pin and len(cpus) > 1 else (None, None)


def become_node(cpu: int | None) -> None:
    """Run this process as the nodes on the way of a request run: their policy, on `cpu` if there is one."""
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    linux.use_batch_scheduling()


@contextlib.contextmanager
def as_node(cpu: int | None) -> Iterator[None]:
    """Run this process as a node within the block, and as before after it."""
    cpus, policy, priority = os.sched_getaffinity(0), os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        become_node(cpu)
        yield
    finally:
        os.sched_setscheduler(0, policy, priority)
        os.sched_setaffinity(0, cpus)


# -- the machine ----------------------------------------------------------------------------------

_STAT: Final = Path("/proc/stat")
_CPU_FILES: Final = "/sys/devices/system/cpu"
_IDLE, _IO_WAIT, _STEAL = 3, 4, 7  # the fields of a line `cpu` in /proc/stat (proc(5))
_CPU_FIELDS: Final = 8  # those behind them, of guests, are counted in the first two as well


class Meanwhile(msgspec.Struct, frozen=True):
    """What the machine did while a bench measured.

    `steal_percent`: of the time of all cores, what the hypervisor gave to others; `busy_percent`: what was
    used, by whatever. `load`: the mean of the last minute before the bench began, so of other work.
    `mhz_min` and `mhz_max`: of any core at the looks between two measurements. None where the machine does
    not show it. `failures`: measurements that failed and were repeated.
    """

    seconds: float
    steal_percent: float | None
    busy_percent: float | None
    switches_per_s: float | None
    load: float
    mhz_min: float | None
    mhz_max: float | None
    failures: int = 0


class MachineWatch:
    """Watches the machine from its making on."""

    def __init__(self) -> None:
        self._began_s, self._load = time.monotonic(), os.getloadavg()[0]
        self._before = _Counters.now()
        self._mhz: list[float] = []
        self.look()

    def look(self) -> None:
        """Note the frequency of the cores."""
        self._mhz += frequencies_mhz()

    def found(self, failures: int = 0) -> Meanwhile:
        """What the machine did up to now."""
        now = _Counters.now()
        seconds = time.monotonic() - self._began_s
        ticks = [after - before for after, before in zip(now.ticks, self._before.ticks, strict=True)]
        total = sum(ticks)
        known = total > 0
        switches = now.switches - self._before.switches
        return Meanwhile(
            round(seconds, 1),
            round(100 * ticks[_STEAL] / total, 2) if known else None,
            round(100 * (1 - (ticks[_IDLE] + ticks[_IO_WAIT]) / total), 1) if known else None,
            round(switches / seconds) if switches > 0 and seconds > 0 else None,
            round(self._load, 2),
            min(self._mhz, default=None),
            max(self._mhz, default=None),
            failures,
        )


class _Counters(NamedTuple):
    """Of /proc/stat, since the boot; zeros where it does not say."""

    ticks: list[int]
    switches: int

    @classmethod
    def now(cls) -> "_Counters":
        lines = {words[0]: words[1:] for words in map(str.split, _lines(_STAT)) if words}
        ticks = list(map(int, lines.get("cpu", [])[:_CPU_FIELDS]))
        return cls(ticks + [0] * (_CPU_FIELDS - len(ticks)), int(lines.get("ctxt", ["0"])[0]))


def frequencies_mhz() -> list[float]:
    """Of each core that shows one: what its driver says now, or else /proc/cpuinfo."""
    files = sorted(Path(_CPU_FILES).glob("cpu[0-9]*/cpufreq/scaling_cur_freq"))
    if files:
        return [round(int(line) / 1e3) for file in files for line in _lines(file)[:1]]
    shown = (line.partition(":") for line in _lines(Path("/proc/cpuinfo")))
    return [round(float(value)) for name, _, value in shown if name.strip() == "cpu MHz"]


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []


# -- for people -----------------------------------------------------------------------------------


def text(document: msgspec.Struct | Mapping[str, object], above: str = "") -> Iterator[str]:
    """A line for each key of a document, `a.b` for one inside of another."""
    values = document if isinstance(document, Mapping) else msgspec.structs.asdict(document)
    for key, value in values.items():
        name = f"{above}{key}"
        match value:
            case MeasuredLimit():
                yield f"{name:14} {value.name}: {_words(_numbers(value))}"
            case Ratio():
                yield (
                    f"{name:14} p50 {_spread(value.p50)}  p99 {_spread(value.p99)}  of all rounds: p50"
                    f" {value.p50.all:g}  p99 {value.p99.all:g}  rounds {value.rounds}"
                )
            case Meanwhile():
                yield f"{name:14} {_words(_numbers(value))}"
            case msgspec.Struct() if _holds_structs(msgspec.structs.asdict(value)):
                yield from text(value, f"{name}.")
            case msgspec.Struct():
                yield f"{name:14} {_words(_numbers(value))}"
            case dict() if _holds_structs(value):
                yield from text(value, f"{name}.")
            case dict():
                yield f"{name:14} {_words(value)}"
            case msgspec.UnsetType():
                pass
            case _:
                yield f"{name:14} {value}"


def _holds_structs(values: Mapping[str, object]) -> bool:
    return any(isinstance(one, msgspec.Struct) for one in values.values())


def _numbers(value: msgspec.Struct) -> dict[str, object]:
    fields = msgspec.structs.asdict(value)
    return {name: found for name, found in fields.items() if found is not None and name != "name"}


def _words(values: Mapping[str, object]) -> str:
    return "  ".join(f"{name} {value}" for name, value in values.items())


def _spread(found: QuantileRatio) -> str:
    return f"{found.median:g} ({found.q1:g} to {found.q3:g})"
