"""`aftbed bench all`: every figure of docs/numbers.md in one table, by one command on one day.

A line names the command that measures it. Each command is run once in a pass, in an interpreter of its own,
as a user would start it; several lines may read its document. A figure stands beside its limit. The speed of
a machine changes from minute to minute, so what can be compared is the ratio of the two, and nearly every
document has it: both were measured in turn (`rounds`).

Of a ratio that a document has, the table of one pass shows as the p50 the median of the rounds with its
quartiles, and the p99 over all rounds (`rounds.QuantileRatio`). Of several passes, one behind the other, it
shows the median of each value over the passes, and its quartiles over the passes: they say how far one pass
can be trusted. A command that fails in a pass leaves its lines without a value in that pass; the table says
how often that was, and why.
"""

import datetime
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from aftbed.bench.rounds import MachineWatch, Meanwhile, Ratio
from aftbed.bench.runs import Log, run_python, tried
from aftbed.campaign.ledger import Environment, here
from aftbed.campaign.statistics import quantile
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.progress import Show, unshown
from aftbed.runtime.unix import interrupts
from aftbed.runtime.unix.code_version import code_version

COMMAND_SECONDS_MAX: Final = 1200.0
BEGIN, END = "<!-- numbers: begin -->", "<!-- numbers: end -->"  # of the table in a page
QUICK: Final = {  # what makes a command short: too few samples to quote, but more than a few turns
    "cycle": "--count 1000 --rounds 2",
    "hops": "--count 1000 --rounds 2",
    "recovery": "--kills 2",
    "adapt": "--adaptations 2",
    "launch": "--runs 1",
    "campaign": "--experiments 4 --rounds 1",
    "state": "--rounds 1",
    "simulator": "--count 2000 --rounds 2",
}

Document = dict[str, object]


class FigureLimit(msgspec.Struct, frozen=True):
    """What a figure is compared with: the path in the document. Without a name, the one that stands there."""

    name: str
    path: str


class TableLine(msgspec.Struct, frozen=True):
    """A line of the table. `figure` is a path in the document of `aftbed bench COMMAND`.

    `goal`: the greatest value of each quantile's ratio to the limit; without a limit, of the figure itself;
    the least one where `more_is_better`. `ratio`: path of that to the limit, a `Ratio` or the number of the
    p50. `counted`: the values are numbers of events, which several passes add up.
    """

    what: str
    command: str
    figure: str
    unit: str = ""
    limit: FigureLimit | None = None
    ratio: str = ""
    goal: dict[str, float] = {}
    more_is_better: bool = False
    counted: bool = False


def _cycle(what: str, options: str, **goal: float) -> TableLine:
    return TableLine(what, f"cycle --ftm {options}", "cycle_us", "us", OWN, OWN_RATIO, goal)


def _recovery(what: str, options: str) -> TableLine:
    goal = {"p50": 1.5, "p99": 3.0}
    return TableLine(what, f"recovery {options}", "recovery_ms", "ms", OWN, OWN_RATIO, goal)


def _adaptation(what: str, options: str, **goal: float) -> tuple[TableLine, ...]:
    command = f"adapt {options}"
    kept = dict.fromkeys(("lost", "duplicated", "reordered", "wrong"), 0.0)
    return (
        TableLine(f"{what}: no request is served for", command, "blackout_ms", "ms", OWN, OWN_RATIO, goal),
        TableLine("its steps, p50", command, "steps_ms.*.p50", "ms"),
        TableLine("and back", command, "back.blackout_ms", "ms", OWN, f"back.{OWN_RATIO}", goal),
        TableLine("its steps, p50", command, "back.steps_ms.*.p50", "ms"),
        TableLine("the requests meanwhile", command, "requests", goal=kept, counted=True),
    )


def _rate(what: str, command: str, least: float) -> TableLine:
    return TableLine(what, command, "per_minute", goal={"": least}, more_is_better=True)


def _state(what: str, options: str, **goal: float) -> TableLine:
    return TableLine(what, f"state {options}", "cycle_us", "us", SMALL_STATE, "ratio_p50", goal)


SMALL_STATE: Final = FigureLimit("the same with 10 kB", "beside_cycle_us")
OWN: Final = FigureLimit("", "limit")
OWN_RATIO: Final = "ratio"
LAUNCH: Final = "launch --ftm pbr"
RECIPE: Final = "adapt --from pbr --to pbr+tr --recipe paper"
SIM_CAMPAIGN: Final = "campaign --sim --experiments 4000 --rounds 44"  # 11 go with the load of the machine
SIMULATOR: Final = "simulator --ftm pbr"
LINES: Final = (
    _cycle("cycle under `pbr`, a process per brick", "pbr", p50=1.35),
    _cycle("cycle under `pbr`, a process per replica", "pbr --placement replica", p50=2.0),
    _cycle(
        "the same beside a process per brick", "pbr --placement replica --beside-placement process", p50=0.5
    ),
    _cycle("cycle of the bare server", "none"),
    _cycle("cycle under `lfr`", "lfr --beside pbr", p50=0.9),
    _cycle("cycle under `pbr+tr`", "pbr+tr --beside pbr", p50=1.8),
    _cycle("cycle under `lfr+tr`", "lfr+tr --beside lfr", p50=1.8),
    TableLine("delay of one hop under `pbr`", "hops --ftm pbr", "hop_ns", "ns", OWN, OWN_RATIO),
    _recovery("SIGKILL of the primary to the next good reply, `pbr`", "--ftm pbr"),
    TableLine("its parts, p50", "recovery --ftm pbr", "parts_ms.*.p50", "ms"),
    _recovery("the same, a process per replica", "--ftm pbr --placement replica"),
    _recovery("the same under `lfr`", "--ftm lfr"),
    *_adaptation("composition `pbr` to `pbr+tr`", "--from pbr --to pbr+tr", p50=1.2, p99=3.0),
    *_adaptation("switch `pbr` to `lfr`", "--from pbr --to lfr", p50=1.5, p99=4.0),
    *_adaptation("update of a function with 1 kB of state", "--from pbr --update 1000", p50=1.5)[:2],
    TableLine(
        "composition by the paper's recipe (the paper: 300 ms)", RECIPE, "blackout_ms", "ms", OWN, OWN_RATIO
    ),
    TableLine("of these, never served again", RECIPE, "stuck", counted=True),
    _state("cycle under `pbr`, 1 MB of state, a page changed", "--bytes 1000000", p50=2.0),
    TableLine(
        "the same beside what the machine allows", "state --bytes 1000000", "cycle_us", "us", OWN, OWN_RATIO
    ),
    TableLine(
        "update of a function with 1 MB of state: no request is served for",
        "state --bytes 1000000 --beside 1000",
        "blackout_ms",
        "ms",
        FigureLimit("the same with 1 kB", "beside_blackout_ms"),
        "blackout_ratio_p50",
        {"p50": 3.0},
    ),
    _state("cycle under `pbr`, 10 MB of state, a page changed", "--bytes 10000000", p50=4.0),
    _state("the same, of a function that tells its changes", "--bytes 10000000 --tells-changes", p50=4.0),
    TableLine("start of a run to a reply", LAUNCH, "launch_ms", "ms", OWN, OWN_RATIO, {"p50": 2}),
    TableLine(
        "the page of `aftbed --help`",
        LAUNCH,
        "help.help_ms",
        "ms",
        FigureLimit("", "help.limit"),
        "help.ratio",
    ),
    TableLine("the graph from a warm zygote", LAUNCH, "graph_ms", "ms", goal={"p50": 40}),
    TableLine("memory of the 17 processes (PSS)", "memory --ftm pbr", "pss_mb", "MB", goal={"": 70}),
    TableLine("CPU of the same, idle", "memory --ftm pbr", "idle_cpu_percent", "% of a core", goal={"": 2}),
    TableLine("beside them (PSS)", "memory --ftm pbr", "others.*.pss_mb", "MB"),
    _rate("experiments a minute on real processes, each a crash in 100 requests", "campaign", 600),
    TableLine("time of one of them, two at a time", "campaign", "experiment_ms", "ms", OWN, OWN_RATIO),
    TableLine("CPU time of one of them", "campaign", "cpu_ms", "ms"),
    _rate("experiments a minute in the simulator", SIM_CAMPAIGN, 3000),
    TableLine("time of one of them, two at a time", SIM_CAMPAIGN, "experiment_ms", "ms", OWN, OWN_RATIO),
    TableLine(
        "requests a second of one core in the simulator",
        SIMULATOR,
        "requests_per_s",
        goal={"": 10_000},
        more_is_better=True,
    ),
    TableLine("CPU time of one of them", SIMULATOR, "request_us", "us", OWN, OWN_RATIO),
)


# -- the document ---------------------------------------------------------------------------------


class Number(msgspec.Struct, frozen=True):
    """A line, measured. A figure without quantiles has the name "". `met`: None where there is no goal.

    `quartiles`: of one pass, those of the p50 of a ratio over its `rounds`; None where the ratio is not one
    of rounds. Of several passes, over them: of the p50 of the ratio, or of a figure without a limit (its p50,
    if it has one); None of what is counted. `failed`: in how many passes the command failed, so that they are
    not in it; `reason`: what it said last. One that failed in all of them has no values, and misses its goal.
    """

    what: str
    command: str
    unit: str
    measured: dict[str, float]
    limit: str
    limit_p50: float | None
    ratios: dict[str, float]
    goal: dict[str, float]
    more_is_better: bool
    met: bool | None
    quartiles: tuple[float, float] | None = None
    rounds: int | None = None
    failed: int = 0
    reason: str = ""


class Numbers(msgspec.Struct, frozen=True):
    """The document of `aftbed bench all --json`."""

    date: str
    code: str
    quick: bool
    seconds: float
    environment: Environment
    numbers: tuple[Number, ...]
    passes: int
    machine: Meanwhile


def not_measured(found: Numbers) -> list[str]:
    """The commands that failed in every pass."""
    return list(dict.fromkeys(one.command for one in found.numbers if not one.measured))


def bench_all(
    log: Log,
    *,
    quick: bool = False,
    passes: int = 1,
    measure: Callable[[str], Document] | None = None,
    show: Show = unshown,
) -> Iterator[Numbers]:
    """Measure every line `passes` times; yields after each pass what all up to now have found.

    `log` gets each command. One that fails `TRIES` times in a pass is left out of it.
    """
    watch = MachineWatch()
    run = measure or _measured
    commands = dict.fromkeys(line.command for line in LINES)
    words = {one: f"{one} {QUICK.get(one.split()[0], '')}".strip() if quick else one for one in commands}
    by_pass: list[list[Number]] = []
    for number in range(passes):
        found: dict[str, Document | HarnessError] = {}
        for one, command in words.items():
            show(number * len(words) + len(found), passes * len(words))
            found[one] = _tried(command, run, log)
        by_pass.append([_number(line, found[line.command]) for line in LINES])
        watch.look()
        machine = watch.found()
        yield Numbers(
            datetime.datetime.now(datetime.UTC).date().isoformat(),
            code_version(),
            quick,
            machine.seconds,
            here(),
            tuple(map(_over_passes, LINES, zip(*by_pass, strict=True))),
            len(by_pass),
            machine,
        )


def _measured(command: str) -> Document:
    """What `aftbed bench COMMAND --json` prints."""
    arguments = ["-m", "aftbed", "bench", *command.split(), "--json"]
    return msgspec.json.decode(run_python(arguments, COMMAND_SECONDS_MAX), type=Document)


def _tried(command: str, run: Callable[[str], Document], log: Log) -> Document | HarnessError:
    """What `run` gives, or why it failed."""
    try:
        return tried(f"aftbed bench {command}", partial(run, command), log)
    except HarnessError as error:
        if interrupts.came():
            raise
        log(f"not measured: {error}")
        return error


def _number(line: TableLine, document: Document | HarnessError) -> Number:
    if isinstance(document, HarnessError):
        return _not_measured(line, str(document))
    measured = figure_at(document, line.figure)
    ratios: dict[str, float] = {}
    limit_p50, limit_name, rounds = None, "", None
    if line.limit is not None:
        if list(measured) == [""]:
            measured = {"p50": measured[""]}  # one value for each round: this is their median
        limit = _at(document, line.limit.path)
        limit_p50, limit_name = figure_at(limit, "p50")[""], line.limit.name or str(_at(limit, "name"))
        ratios, rounds = _ratios(line, document, measured, limit_p50)
    return Number(
        line.what,
        f"aftbed bench {line.command}",
        line.unit,
        measured,
        limit_name,
        limit_p50,
        ratios,
        line.goal,
        line.more_is_better,
        _met(line, ratios or measured),
        (round(rounds.p50.q1, 2), round(rounds.p50.q3, 2)) if rounds is not None else None,
        rounds.rounds if rounds is not None else None,
    )


def _not_measured(line: TableLine, reason: str) -> Number:
    return Number(
        line.what,
        f"aftbed bench {line.command}",
        line.unit,
        {},
        "",
        None,
        {},
        line.goal,
        line.more_is_better,
        False if line.goal else None,
        failed=1,
        reason=reason,
    )


def _met(line: TableLine, values: dict[str, float]) -> bool | None:
    kept = [values[name] >= g if line.more_is_better else values[name] <= g for name, g in line.goal.items()]
    return all(kept) if kept else None


def _over_passes(line: TableLine, numbers: tuple[Number, ...]) -> Number:
    """The line over all passes: the median of each value, and the quartiles of what is compared."""
    failed = [one for one in numbers if one.failed]
    if len(failed) == len(numbers):
        return msgspec.structs.replace(numbers[-1], failed=len(failed))
    found = _over_measured(line, [one for one in numbers if not one.failed])
    return msgspec.structs.replace(found, failed=len(failed), reason=failed[-1].reason if failed else "")


def _over_measured(line: TableLine, numbers: list[Number]) -> Number:
    if len(numbers) == 1:
        return numbers[0]
    measured = _summary([one.measured for one in numbers], sum if line.counted else _median)
    ratios = _summary([one.ratios for one in numbers], _median)
    limits = [one.limit_p50 for one in numbers if one.limit_p50 is not None]
    compared = [one.ratios or one.measured for one in numbers]
    name = next((name for name in ("p50", "") if name in compared[0]), None)
    quartiles = None
    if name is not None and not line.counted:
        values = [one[name] for one in compared]
        quartiles = quantile(values, 0.25), quantile(values, 0.75)
    return msgspec.structs.replace(
        numbers[0],
        measured=measured,
        limit_p50=_median(limits) if limits else None,
        ratios=ratios,
        met=_met(line, ratios or measured),
        quartiles=quartiles,
    )


def _summary(values: list[dict[str, float]], of: Callable[[list[float]], float]) -> dict[str, float]:
    """`of` the values of each name, in those dictionaries that have it."""
    names = dict.fromkeys(name for one in values for name in one)
    return {name: of([one[name] for one in values if name in one]) for name in names}


def _median(values: list[float]) -> float:
    return quantile(values, 0.5)


def _ratios(
    line: TableLine, document: Document, measured: dict[str, float], limit_p50: float
) -> tuple[dict[str, float], Ratio | None]:
    """Of the p50 and of what the goal names; and the ratio of rounds, if the document has one."""
    names = dict.fromkeys(("p50", *line.goal))
    own = _at(document, line.ratio)
    if not isinstance(own, dict):
        quotients = {name: round(measured[name] / limit_p50, 2) for name in names}
        return quotients | {"p50": round(msgspec.convert(own, float), 2)}, None
    rounds = msgspec.convert(own, Ratio)
    in_rounds = {"p50": rounds.p50.median, "p99": rounds.p99.all}
    return {name: round(in_rounds[name], 2) for name in names}, rounds


def _at(document: object, path: str) -> object:
    for key in path.split("."):
        assert isinstance(document, dict), path
        document = document[key]
    return document


def figure_at(document: object, path: str) -> dict[str, float]:
    """The numbers at `path` by name, where `*` is each of some names; a single number has the name ""."""
    here, _, rest = path.partition(".")
    if not here:
        return document if isinstance(document, dict) else {"": msgspec.convert(document, float)}
    assert isinstance(document, dict), path
    if here == "*":
        return {name: figure_at(value, rest)[""] for name, value in document.items()}
    return figure_at(document[here], rest)


# -- for people -----------------------------------------------------------------------------------


def markdown(found: Numbers) -> Iterator[str]:
    """The table, and the day and the machine above it."""
    about, several, steal = found.environment, found.passes > 1, found.machine.steal_percent
    options = f"{' --quick' if found.quick else ''}{f' --passes {found.passes}' if several else ''}"
    yield (
        f"Measured on {found.date} by `aftbed bench all{options}` in {found.seconds:.0f} s: {about.cpus};"
        f" {about.kernel.partition('-')[0]}; {about.python}; aftbed {found.code};"
        f" {f'{steal:g} %' if steal is not None else 'unknown'} steal meanwhile."
        + (f" Each value is the median of {found.passes} passes, with its quartiles." if several else "")
    )
    yield ""
    yield "| what | measured | limit beside it | ratio to its p50 | goal | command |"
    yield "|---|---|---|---|---|---|"
    for one in found.numbers:
        limit = f"{one.limit}: {one.limit_p50:g} {one.unit}" if one.limit_p50 is not None else ""
        goal = _words(one.goal)
        if goal:
            goal = (
                f"{'at least' if one.more_is_better else 'at most'} {goal}{'' if one.met else ': **missed**'}"
            )
        cells = (
            one.what,
            _measured_words(one),
            limit,
            _ratio_words(one),
            goal,
            f"`{one.command}`",
        )
        yield f"| {' | '.join(cells)} |"


def _measured_words(one: Number) -> str:
    """`p50 1.5, p99 3.1 ms`; with the quartiles of its first value where there is no ratio that has them."""
    if not one.measured:
        return f"**not measured**: {_in_cell(one.reason)}"
    words = f"{_words(one.measured, None if one.ratios else one.quartiles)} {one.unit}".strip()
    if not one.failed:
        return words
    return f"{words}; failed in {one.failed} pass{'es' * (one.failed > 1)}: {_in_cell(one.reason)}"


def _in_cell(reason: str) -> str:
    return " ".join(reason.replace("|", "/").split())


def _ratio_words(one: Number) -> str:
    """`p50 1.5 (1.4 to 1.7), p99 3.1`."""
    return _words(one.ratios, one.quartiles)


def _words(values: dict[str, float], quartiles: tuple[float, float] | None = None) -> str:
    words = [f"{name} {value:g}".strip() for name, value in values.items()]
    if quartiles is not None and words:
        words[0] += " ({:g} to {:g})".format(*quartiles)
    return ", ".join(words)


def check_page(page: Path) -> None:
    """Raise ConfigError unless `page` has the two lines between which the table stands."""
    try:
        lines = page.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise ConfigError(f"--into {page}: {error.strerror}") from None
    if lines.count(BEGIN) != 1 or lines.count(END) != 1 or lines.index(BEGIN) > lines.index(END):
        raise ConfigError(f"--into {page}: it needs the lines {BEGIN} and {END}, once each and in this order")


def write_into(page: Path, found: Numbers) -> None:
    """Put the table between the two lines of `page`, in the place of the one that is there."""
    before, _, rest = page.read_text(encoding="utf-8").partition(f"{BEGIN}\n")
    after = rest.partition(END)[2]
    table = "\n".join(markdown(found))
    page.write_text(f"{before}{BEGIN}\n{table}\n{END}{after}", encoding="utf-8")
