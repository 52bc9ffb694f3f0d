"""`aftbed sim`: runs in virtual time, each determined by its seed.

A verdict is that of a real run, with one difference: a service that is lost because a fault struck each
replica is no failure here (`unavailable`), since a swarm draws such faults too and no promise covers them. A
fault or an adaptation that was asked for and never happened makes the verdict inconclusive (G8).
"""

import io
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Annotated, Final, NamedTuple, TypeVar

import msgspec
import typer
from msgspec.structs import asdict, replace

from aftbed.adapt import commands
from aftbed.cli.adapt import refuse_unsuitable, scheduled
from aftbed.cli.interrupted import interrupted
from aftbed.cli.options import (
    RATE_HZ_MAX,
    SEED_MAX,
    App,
    Expect,
    Ftti,
    Json,
    Requests,
    Tolerance,
    check_file,
    check_seed,
    choices,
    jobs_of,
    print_json,
    takes,
)
from aftbed.cli.request_options import RequestSource, first_requests
from aftbed.cli.views import show_verdict
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.graph import PLACEMENTS, Graph
from aftbed.core.messages import Goal, Scheduled
from aftbed.core.script import RECIPES
from aftbed.core.units import duration
from aftbed.ftm.compose import build
from aftbed.functions.load import OWN_CODE
from aftbed.functions.source import located
from aftbed.inject.model import Fault, parse
from aftbed.inject.targets import OTHERS
from aftbed.judge.asked import not_happened
from aftbed.judge.outcome import outcome_of
from aftbed.judge.simulated import evidence_of_run, verdict_of
from aftbed.judge.verdict import EXIT_CODES, Breach, Verdict, Word
from aftbed.report import sequence
from aftbed.report.progress import ProgressLine, spaced
from aftbed.runtime.sim.clock import START_NS
from aftbed.runtime.sim.trace import traced
from aftbed.runtime.sim.world import Run, Setup
from aftbed.runtime.sim.world import check as check_fault
from aftbed.runtime.unix.options import CarRun, LoadRun, ftti_ms_of
from aftbed.runtime.unix.trust import trusting
from aftbed.runtime.unix.worker_pool import SECONDS_MAX, Alone, each, once, own_seconds_max
from aftbed.search.agreement import SEEDS, RecoveryRange, against
from aftbed.search.explore import Attempt, Found, attempt_own, tried
from aftbed.search.shrink import shrink
from aftbed.search.swarm import attempt_drawn, drawn, intended
from aftbed.search.tally import Tally, happened_in
from aftbed.vehicle.scenarios.library import load_scenario

S = TypeVar("S")
T = TypeVar("T")
COUNT_MAX: Final = 100_000
PAGE_BYTES: Final = (16, 65536)
LOAD_S_MAX: Final = 3600.0  # of virtual time
MINUTES_MAX: Final = 100_000.0
SHRUNK_MAX: Final = 3  # broken runs: shrinking one takes up to 400 runs
MISSED_MAX: Final = 3  # reasons shown
LISTED_MAX: Final = 20  # broken runs, while the others go on
NO_COMMAND: Final = "(no command expresses it: repeat the original)"
DEFAULT: Final = Setup()
_RANGE: Final = re.compile(r"([0-9]{1,19})\.\.([0-9]{1,19})")

MakeSetup = Callable[[int], Setup]  # the setup of a seed


class SimArguments(msgspec.Struct, frozen=True):
    """The options of `aftbed sim`; None is one that was left out."""

    seed: Annotated[
        int | None, typer.Option(help="Seed of all random numbers of one run; 0 if left out.")
    ] = None
    seeds: Annotated[str | None, typer.Option(help="A..B: a run for each, both ends included.")] = None
    ftm: Annotated[str | None, typer.Option(help="none, pbr, lfr, tr, pbr+tr, ...; pbr if left out.")] = None
    app: App = None
    placement: Annotated[
        str | None, typer.Option(metavar=choices(PLACEMENTS), help="process if left out.")
    ] = None
    count: Annotated[
        int | None, typer.Option(help="Requests of a run; if left out 100, or all of a file.")
    ] = None
    rate: Annotated[
        float | None,
        typer.Option(help="Requests per second; if left out, each follows the reply before it."),
    ] = None
    requests: Requests = None
    expect: Expect = None
    tolerance: Tolerance = None
    scenario: Annotated[
        str | None, typer.Option(help="A car makes the requests: a scenario, or a YAML file.")
    ] = None
    faults: Annotated[
        tuple[str, ...],
        typer.Option("--inject", help='E.g. "crash primary at server.exit nth 3".'),
    ] = ()
    adaptations: Annotated[
        tuple[str, ...], typer.Option("--adapt", help='E.g. "to lfr+tr at request 20".')
    ] = ()
    recipe: Annotated[
        str | None,
        typer.Option(metavar=choices(RECIPES), help="How each --adapt is carried out; drained if left out."),
    ] = None
    force: Annotated[
        bool, typer.Option("--force", help="Begin each --adapt even if it would be refused.")
    ] = False
    may_fail: Annotated[
        bool, typer.Option("--may-fail", help="A run may pass even if an --adapt was not done.")
    ] = False
    ftti: Ftti = None
    page_bytes: Annotated[
        int | None,
        typer.Option(
            help="Of a page of a checkpoint; 4096 if left out. Of 4 pages or more only changes travel."
        ),
    ] = None
    swarm: Annotated[bool, typer.Option("--swarm", help="Draw everything from the seed.")] = False
    minutes: Annotated[float | None, typer.Option(help="Simulate the seeds from --seed on, for so long.")] = (
        None
    )
    jobs: Annotated[int | None, typer.Option(help="Processes, for many runs; one per CPU if left out.")] = (
        None
    )
    diagram: Annotated[
        str | None,
        typer.Option(help="Draw faults and what is around them: .svg is a space-time diagram, else Mermaid."),
    ] = None
    against: Annotated[
        tuple[Path, ...],
        typer.Option(help="The record of a real run: simulate the same, under --seeds, and compare."),
    ] = ()
    trust: Annotated[
        tuple[Path, ...], typer.Option(help="With --against: directory whose functions may be executed.")
    ] = ()
    json: Json = False


@takes(SimArguments)
def sim(given: SimArguments) -> int:
    """Simulate runs in virtual time; the same seed gives the same run.

    The bricks, scripts and faults are those of real runs.

    Exit code: 0 pass, 1 a promise was broken, 2 usage, 3 what was asked for did not happen or a swarm proves
    too little, 130 interrupted.
    """
    if given.against:
        return _compare(given)
    if given.trust:
        raise ConfigError("--trust says which functions of records are executed: give --against RECORD too")
    first, last = _seeds(given)
    jobs, make = jobs_of(given.jobs), _setup_maker(given)
    if given.app is not None:
        setup = make(first)
        requests = first_requests(setup.application, setup.given)
        refuse_unsuitable(setup.application, setup.ftm, force=given.force, requests=requests)
    check_file("--diagram", None if given.diagram is None else Path(given.diagram))
    if given.seeds is None and given.minutes is None:
        show, apart = partial(_simulate_one, given), given.app is not None
        setup = make(first)
        return shown_apart(show, setup, setup.count, lambda _, s: repeating(s)) if apart else show(setup)
    return _ManyRuns(given).simulate(make, first, last, jobs)


# -- what the options mean ------------------------------------------------------------------------


def _used(given: SimArguments, *but: str) -> list[str]:
    """The options that were given, except those of the fields `but`."""
    names = {"adaptations": "adapt", "may_fail": "may-fail", "page_bytes": "page-bytes"}
    values = asdict(given).items()
    used = [name for name, value in values if value is not None and value is not False and value != ()]
    return [f"--{names.get(name, name)}" for name in used if name not in but]


def _seeds(given: SimArguments) -> tuple[int, int]:
    """The first and the last seed. Raises ConfigError."""
    options = {"--seeds": given.seeds, "--seed": given.seed, "--minutes": given.minutes}
    used = [name for name, value in options.items() if value is not None]
    if given.seeds is not None and len(used) > 1:
        raise ConfigError(f"{' and '.join(used)}: --seeds stands alone")
    if given.minutes is not None and not 0 < given.minutes <= MINUTES_MAX:
        raise ConfigError(f"--minutes {given.minutes}: more than 0, up to {MINUTES_MAX:.0f} are allowed")
    if given.seeds is None:
        seed = given.seed or 0
        check_seed(seed)
        return seed, SEED_MAX
    found = _RANGE.fullmatch(given.seeds)
    if found is None:
        raise ConfigError(f"--seeds {given.seeds[:60]!r}: A..B is allowed, as 0..99, both ends included")
    first, last = int(found[1]), int(found[2])
    if first > last:
        raise ConfigError(
            f"--seeds {given.seeds}: no seed is in it; A..B with A up to B is allowed, as {last}..{first}"
        )
    if last > SEED_MAX:
        raise ConfigError(f"--seeds {given.seeds}: 0 to {SEED_MAX} are allowed")
    return first, last


def _setup_maker(given: SimArguments) -> MakeSetup:
    """What makes the setup of a seed. Raises ConfigError."""
    if given.swarm:
        kept = ("seed", "seeds", "swarm", "minutes", "jobs", "diagram", "json")
        if used := _used(given, *kept):
            raise ConfigError(f"--swarm draws everything from the seed: leave out {', '.join(used)}")
        return drawn
    application = located(given.app) if given.app is not None else ""
    graph = build(given.ftm or DEFAULT.ftm, given.placement or DEFAULT.placement, application=application)
    faults = tuple(read_fault(text, graph) for text in given.faults)
    adaptations = _adaptations(given, graph)
    source = _source(given)
    setup = replace(
        _load(given if source is None else replace(given, count=source.count)),
        ftm=graph.ftm,
        placement=graph.placement,
        faults=faults,
        adaptations=adaptations,
        page_bytes=_page_bytes(given),
        application=application,
    )
    if given.ftti is not None:
        work = CarRun(setup.scenario, None, "") if setup.scenario else LoadRun(setup.count, setup.rate_hz)
        setup = replace(setup, ftti_ms=ftti_ms_of("--ftti", given.ftti, work))
    check_setup(setup)
    return lambda seed: replace(setup, seed=seed, given=source.of(seed) if source is not None else None)


def check_setup(setup: Setup) -> None:
    """Raise ConfigError if its faults have nothing to strike, or an adaptation would not begin."""
    for fault in setup.faults:
        check_fault(fault, setup.scenario)
    for adaptation in setup.adaptations:
        if not setup.scenario and adaptation.at_request > setup.count:
            raise ConfigError(
                f"--adapt: at request {adaptation.at_request}: there are {setup.count} requests (--count)"
            )


def _source(given: SimArguments) -> RequestSource | None:
    """Of `--requests`, or None without it."""
    if given.requests is None:
        if given.expect is not None or given.tolerance is not None:
            raise ConfigError("--expect and --tolerance are about --requests: give it too")
        return None
    if given.scenario is not None:
        raise ConfigError("--scenario: the car makes the requests; leave out --requests")
    return RequestSource(
        given.requests,
        count=given.count,
        count_max=COUNT_MAX,
        expect=given.expect,
        tolerance=given.tolerance,
    )


def _load(given: SimArguments) -> Setup:
    """The source of the requests, their number and their rate."""
    if given.scenario is not None:
        if given.count is not None or given.rate is not None:
            raise ConfigError("--scenario: the car makes the requests; leave out --count and --rate")
        load_scenario(given.scenario)
        return Setup(scenario=given.scenario)
    return load_of(DEFAULT.count if given.count is None else given.count, given.rate)


def load_of(count: int, rate_hz: float | None) -> Setup:
    """`count` requests; without a rate, each follows the reply before it. Raises ConfigError."""
    if not 1 <= count <= COUNT_MAX:
        raise ConfigError(f"--count {count}: 1 to {COUNT_MAX} requests are allowed")
    if rate_hz is None:
        return Setup(count=count)
    if not 0 < rate_hz <= RATE_HZ_MAX:
        raise ConfigError(
            f"--rate {rate_hz}: more than 0, up to {RATE_HZ_MAX:.0f} a second are allowed"
            " (without it, each follows the reply before)"
        )
    if count / rate_hz > LOAD_S_MAX:
        raise ConfigError(f"--count {count} --rate {rate_hz}: {LOAD_S_MAX:.0f} s of virtual time are allowed")
    return Setup(count=count, rate_hz=rate_hz)


def _page_bytes(given: SimArguments) -> int:
    least, most = PAGE_BYTES
    if given.page_bytes is not None and not least <= given.page_bytes <= most:
        raise ConfigError(f"--page-bytes {given.page_bytes}: {least} to {most} are allowed")
    return given.page_bytes or DEFAULT.page_bytes


def read_fault(text: str, graph: Graph) -> Fault:
    """A fault in the words of `aftbed run --inject`. Raises ConfigError."""
    fault = parse(text)
    fault.check(graph)
    if fault.target in OTHERS:
        raise ConfigError(f"{text!r}: the simulator has no {fault.target}: it simulates what is in the graph")
    return fault


def _adaptations(given: SimArguments, graph: Graph) -> tuple[Scheduled, ...]:
    recipe = given.recipe or RECIPES[0]
    if recipe not in RECIPES:
        raise unknown("recipe", recipe, RECIPES)
    if not given.adaptations and (given.recipe is not None or given.may_fail):
        raise ConfigError("--recipe and --may-fail are about --adapt: give --adapt too")
    if given.force and not given.adaptations and given.app is None:
        raise ConfigError("--force is about --adapt and --app: give one of them too")
    if given.force and given.app is None:
        found = tuple(_forced(text, recipe, may_fail=given.may_fail) for text in given.adaptations)
    else:
        found = scheduled(given.adaptations, graph, recipe, force=given.force, may_fail=given.may_fail)
    return found


def _forced(text: str, recipe: str, *, may_fail: bool) -> Scheduled:
    """An adaptation that is not checked here: the Engine may refuse it when it begins."""
    timed = commands.read(text)
    if timed.wish.verb == "decompose":
        raise ConfigError(f"--adapt {text!r}: with --force, the whole of what will run is named: to EXPR")
    build(timed.wish.name, DEFAULT.placement)
    goal = Goal(expression=timed.wish.name, recipe=recipe, may_fail=may_fail)
    return Scheduled(goal, timed.at_request, timed.after_ms)


# -- a setup in words, and as a command -----------------------------------------------------------


def described(setup: Setup) -> str:
    """For people."""
    if setup.scenario:
        load = f"a car in {setup.scenario}"
    else:
        load = f"{setup.count} request{'s' if setup.count > 1 else ''}"
        load += f" of {setup.given.source}" if setup.given is not None else ""
        load += f" at {_number(setup.rate_hz)}/s" if setup.rate_hz else ""
    parts = [f"{setup.ftm} ({setup.placement}), seed {setup.seed}, {load}"]
    parts += [setup.application] if setup.application else []
    parts += [f"{doom.brick} dies before its effect {doom.effect}" for doom in setup.dooms]
    parts += [*map(str, setup.faults), *map(_adaptation_words, setup.adaptations)]
    parts += [f"FTTI {duration(setup.ftti_ms)}"] if setup.ftti_ms else []
    parts += [f"pages of {setup.page_bytes} bytes"] if setup.page_bytes != DEFAULT.page_bytes else []
    return "; ".join(parts)


def _adaptation_words(adaptation: Scheduled) -> str:
    """As `--adapt` reads them."""
    goal = adaptation.goal
    words = f"to {goal.expression}" if goal.expression else f"update {goal.part} to {goal.source}"
    if adaptation.at_request:
        return f"{words} at request {adaptation.at_request}"
    return f"{words} after {_number(adaptation.after_ms)}ms" if adaptation.after_ms else words


def repeating(setup: Setup, *, swarm: bool = False) -> str:
    """The command that repeats `setup`, "" if none does; if a swarm drew it, its seed is enough.

    Checked: reading the command back gives `setup`.
    """
    if swarm:
        return f"aftbed sim --swarm --seed {setup.seed}"
    if setup.dooms:
        return ""
    exact = replace(setup, count=DEFAULT.count, rate_hz=DEFAULT.rate_hz) if setup.scenario else setup
    requests = setup.given
    given = SimArguments(
        seed=setup.seed,
        ftm=setup.ftm,
        app=setup.application or None,
        placement=setup.placement if setup.placement != DEFAULT.placement else None,
        count=None if setup.scenario else setup.count,
        rate=None if setup.scenario else setup.rate_hz or None,
        requests=requests.source if requests is not None else None,
        expect=requests.expect or None if requests is not None else None,
        tolerance=requests.tolerance if requests is not None else None,
        scenario=setup.scenario or None,
        ftti=duration(setup.ftti_ms) if setup.ftti_ms else None,
        page_bytes=setup.page_bytes if setup.page_bytes != DEFAULT.page_bytes else None,
        faults=tuple(map(str, setup.faults)),
        adaptations=tuple(map(_adaptation_words, setup.adaptations)),
        recipe=next((a.goal.recipe for a in setup.adaptations if a.goal.recipe != RECIPES[0]), None),
        may_fail=any(a.goal.may_fail for a in setup.adaptations),
    )
    for force in (False, True)[: 1 + bool(setup.adaptations)]:
        given = replace(given, force=force)
        try:
            if _as_sent(_setup_maker(given)(setup.seed)) == _as_sent(exact):
                return _command(given)
        except ConfigError:
            continue
    return ""


def _as_sent(setup: Setup) -> Setup:
    """Without the given requests that are never sent: a function is asked for no more."""
    given = setup.given
    if given is None:
        return setup
    return replace(setup, given=replace(given, requests=given.requests[: setup.count]))


def _command(given: SimArguments) -> str:
    """The command whose options are `given`."""
    options: list[tuple[str, str | None]] = [
        ("--ftm", given.ftm),
        ("--app", given.app),
        ("--placement", given.placement),
        ("--scenario", given.scenario),
        ("--count", None if given.count is None else str(given.count)),
        ("--rate", None if given.rate is None else _number(given.rate)),
        ("--ftti", given.ftti),
        ("--page-bytes", None if given.page_bytes is None else str(given.page_bytes)),
        ("--requests", given.requests),
        ("--expect", given.expect),
        ("--tolerance", None if given.tolerance is None else repr(given.tolerance)),
        *(("--inject", text) for text in given.faults),
        *(("--adapt", text) for text in given.adaptations),
        ("--recipe", given.recipe),
    ]
    words = [f"{name} {_quoted(value)}" for name, value in options if value is not None]
    flags = [flag for flag, on in (("--force", given.force), ("--may-fail", given.may_fail)) if on]
    return " ".join([f"aftbed sim --seed {given.seed}", *words, *flags])


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else str(value)


def _quoted(text: str) -> str:
    return f'"{text}"' if " " in text or "'" in text else text


# -- a run that broke a promise -------------------------------------------------------------------


class Picture(NamedTuple):
    """A run drawn: the last messages before its first breach as lines of text, and a diagram."""

    lines: list[str]
    diagram: str = ""


def _attempt(*, swarm: bool) -> Attempt:
    """How a run is made and judged: what a swarm drew not to happen must not have happened."""
    return attempt_drawn if swarm else attempt_own


def picture(setup: Setup, broken: tuple[Breach, ...], path: str | None = None) -> Picture:
    """Simulates `setup` again, traced. Empty if the executive itself failed. `path`: of the diagram."""
    if attempt_own(setup)[0] is None:
        return Picture([])
    trace = traced(setup, code=OWN_CODE)
    lines = sequence.listing(trace, broken).rstrip().splitlines()
    if path is None:
        return Picture(lines)
    if not path.endswith(".svg"):
        return Picture(lines, sequence.mermaid(trace, broken))
    from aftbed.report.html import space_time_svg  # noqa: PLC0415 - Jinja2, only for --diagram

    return Picture(lines, space_time_svg(sequence.space_time(trace)))


class BrokenRun(NamedTuple):
    """A run that broke a promise, and the simplest run that breaks the same; None if it was not shrunk."""

    setup: Setup
    breaches: tuple[Breach, ...]
    command: str
    shrunk: Setup | None
    shrunk_command: str

    def document(self) -> dict[str, object]:
        """For `--json`."""
        return {
            "seed": self.setup.seed,
            "breaches": [str(breach) for breach in self.breaches],
            "command": self.command,
            "shrunk": self.shrunk_command or None,
        }

    def lines(self) -> Iterator[str]:
        """For people."""
        yield f"found: {described(self.setup)}"
        yield from (f"  because    {breach}" for breach in self.breaches)
        yield f"  repeat     {self.command or NO_COMMAND}"
        if self.shrunk is not None and self.shrunk != self.setup:
            yield f"shrunk: {described(self.shrunk)}"
            yield f"  repeat     {self.shrunk_command or NO_COMMAND}"


def broken_run(setup: Setup, broken: tuple[Breach, ...], *, swarm: bool, shrinks: bool = True) -> BrokenRun:
    """Shrink it if `shrinks`, and find the commands that repeat it."""
    original = repeating(setup, swarm=swarm)
    if not shrinks:
        return BrokenRun(setup, broken, original, None, "")
    smaller = shrink(setup, lambda simpler: _attempt(swarm=swarm)(simpler)[1])
    return BrokenRun(setup, broken, original, smaller, repeating(smaller))


# -- one run --------------------------------------------------------------------------------------


class _DoneRun(NamedTuple):
    """A run that came to its end, as it is shown."""

    run: Run
    verdict: Verdict
    outcome: str
    virtual_ms: float

    def lines(self, wall_ms: float, tally: Tally | None) -> Iterator[str]:
        """The events, what became of what a swarm drew, and the outcome of the faults."""
        yield from event_lines(self.run)
        yield from tally.lines() if tally is not None else ()
        outcome = f"; outcome: {self.outcome}" if self.run.setup.faults else ""
        yield f"{self.virtual_ms:.1f} ms of virtual time in {wall_ms:.1f} ms{outcome}"

    def document(self) -> dict[str, object]:
        """For `--json`."""
        return {
            "outcome": self.outcome,
            "requests": self.verdict.requests,
            "failovers": self.verdict.failovers,
            "intervals": self.verdict.intervals,
            "adaptations": self.verdict.adaptations,
            "ftm_at_end": self.verdict.ftm_at_end,
            "faults": self.run.faults,
            "vehicle": self.run.vehicle,
            "virtual_ms": round(self.virtual_ms, 3),
        }


def shown_apart(show: Callable[[S], int], setup: S, requests: int, alone: Alone[S]) -> int:
    """`show`, which executes a function of the user, in a process of its own. Raises HarnessError."""
    code, text = once(partial(_printed, show), setup, own_seconds_max(requests), apart=True, alone=alone)
    print(text, end="")
    return code


def _printed(show: Callable[[S], int], setup: S) -> tuple[int, str]:
    """The exit code, and what it prints, in the encoding of the output."""
    data, encoding = io.BytesIO(), sys.stdout.encoding or "utf-8"
    out = io.TextIOWrapper(data, encoding, sys.stdout.errors, write_through=True)
    with redirect_stdout(out):
        code = show(setup)
        return code, data.getvalue().decode(encoding)


def _simulate_one(given: SimArguments, setup: Setup) -> int:
    began_s = time.perf_counter()
    run, broken = _attempt(swarm=given.swarm)(setup)
    wall_ms = round((time.perf_counter() - began_s) * 1e3, 3)
    done, tally, lacking = None, None, tuple[str, ...]()
    word: Word = "fail" if broken else "pass"
    reasons = list(map(str, broken))
    if run is not None:
        evidence = evidence_of_run(run, OWN_CODE)
        verdict = verdict_of(run, evidence)
        if given.swarm:  # what a swarm draws may well not happen: `attempt_drawn` has judged that
            tally = Tally()
            tally.add(happened_in(run), intended(setup))
            verdict = replace(verdict, verdict=word, reasons=reasons)
        else:
            lacking = tuple(not_happened(evidence.record))
            word, reasons = verdict.verdict, verdict.reasons
        done = _DoneRun(run, verdict, outcome_of(evidence)[0], (run.rest.ended_ns - START_NS) / 1e6)
    if not given.json:
        print(f"seed {setup.seed}\n{described(setup)}")
        if done is None:
            print("\n".join((*(f"  because    {reason}" for reason in reasons), f"verdict: {word}")))
        else:
            print("\n".join(done.lines(wall_ms, tally)))
            show_verdict(done.verdict, as_json=False)
    found = broken_run(setup, broken, swarm=given.swarm) if broken else None
    drawing = picture(setup, broken, given.diagram) if broken or given.diagram is not None else Picture([])
    if given.diagram is not None:
        Path(given.diagram).write_text(drawing.diagram)
    if given.json:
        about = {"seed": setup.seed, "verdict": word, "setup": described(setup), "missed": lacking}
        breach = found.document() if found is not None else {"breaches": [], "command": None, "shrunk": None}
        happened = done.document() if done is not None else {}
        by_intent = {"happened": tally.document()} if tally is not None else {}
        print_json({**about, **breach, **happened, **by_intent, "wall_ms": wall_ms})
    else:
        for line in (*drawing.lines, *found.lines()) if found is not None else ():
            print(line)
        print(f"seed {setup.seed}")
    return EXIT_CODES[word]


def event_lines(run: Run) -> Iterator[str]:
    """The events of the executive, in virtual time, as `aftbed run` shows them."""
    for t_ns, event, text in run.logged:
        yield f"[{(t_ns - START_NS) / 1e6:>10.3f} ms] {event}: {text}"


# -- many runs ------------------------------------------------------------------------------------


class _ManyRuns:
    """The runs of a range of seeds; with --minutes, as many as there is time for."""

    def __init__(self, given: SimArguments) -> None:
        self._given, self._apart = given, given.app is not None
        self._runs = self._unavailable = self._requests = self._inconclusive = 0
        self._broken: list[tuple[Setup, tuple[Breach, ...]]] = []
        self._missed: list[str] = []
        self._tally = Tally()
        self._progress = ProgressLine("sim")

    def simulate(self, make: MakeSetup, first: int, last: int, jobs: int) -> int:
        """Simulate the seeds from `first` to `last` in `jobs` processes, show the result; the exit code."""
        given, began_s, took_s = self._given, time.monotonic(), 0.0
        seconds = (given.minutes or 0.0) * 60
        if not given.json:
            print(f"seeds {first}..{'' if seconds else last}", flush=True)
        total, unit = (seconds, "s") if seconds else (last - first + 1, "runs")
        self._progress = ProgressLine("sim", total, unit, plain=not given.json)
        setups = map(make, range(first, last + 1))
        try_ = partial(tried, attempt=_attempt(swarm=given.swarm))
        count = make(first).count if self._apart else 0
        seconds_max = own_seconds_max(count) if self._apart else SECONDS_MAX
        results = each(
            try_,
            setups,
            jobs,
            alone=lambda _, setup: repeating(setup, swarm=given.swarm),
            seconds_max=seconds_max,
            apart=self._apart,
        )
        stopped = False
        try:
            with self._progress, closing(results):
                for number, setup, found in results:
                    self._count(setup, found)
                    took_s = time.monotonic() - began_s
                    counts = [f"{spaced(self._runs)} runs"] if seconds else []
                    counts += [f"{spaced(len(self._broken))} broken"] if self._broken else []
                    self._progress.show(
                        min(took_s, seconds) if seconds else number + 1, note=", ".join(counts)
                    )
                    if seconds and took_s >= seconds:
                        break
        except KeyboardInterrupt:
            stopped = True
        broken = self._looked_at(shrunk_max=0 if stopped else SHRUNK_MAX)
        if given.diagram is not None and self._broken:
            broken_setup, breaches = self._broken[0]
            draw = partial(picture, broken=breaches, path=given.diagram)
            Path(given.diagram).write_text(self._simulated_again(draw, broken_setup).diagram)
        elif given.diagram is not None:
            print(f"aftbed: note: nothing broke: {given.diagram} is not written", file=sys.stderr)
        self._show(broken, (first, first + self._runs - 1), max(took_s, 1e-9))
        proves_little = bool(self._inconclusive or self._vacuous())
        word: Word = "fail" if self._broken else "inconclusive" if proves_little else "pass"
        if stopped:
            rest = f"--seed {first + self._runs}" if seconds else f"--seeds {first + self._runs}..{last}"
            return interrupted(f"{spaced(self._runs)} runs were done; {rest} goes on")
        return EXIT_CODES[word]

    def _looked_at(self, shrunk_max: int) -> list[BrokenRun]:
        """The broken runs, the first few of them shrunk."""
        if not self._broken:
            return []
        found = list[BrokenRun]()
        total = len(self._broken)
        with ProgressLine("sim: shrinking", total, "runs", plain=not self._given.json) as progress:
            for number, (setup, broken) in enumerate(self._broken):
                shrinks = number < shrunk_max
                again = partial(broken_run, broken=broken, swarm=self._given.swarm, shrinks=shrinks)
                found.append(self._simulated_again(again, setup))
                progress.show(number + 1)
        return found

    def _simulated_again(self, look: Callable[[Setup], T], setup: Setup) -> T:
        return once(look, setup, SECONDS_MAX, apart=self._apart)

    def _count(self, setup: Setup, found: Found) -> None:
        self._runs += 1
        self._requests += found.requests
        self._unavailable += found.lost and not found.breaches
        if found.happened is not None:
            self._tally.add(found.happened, intended(setup) if self._given.swarm else None)
        if found.missed and not self._given.swarm:
            self._inconclusive += 1
            self._missed.append(f"seed {setup.seed}: {found.missed[0]}")
        if found.breaches:
            self._broken.append((setup, found.breaches))
            if not self._given.json and len(self._broken) <= LISTED_MAX:
                self._progress.print(f"seed {setup.seed}: {found.breaches[0]}")

    def _vacuous(self) -> list[str]:
        """Why a swarm proves too little; other runs were asked for one by one, see `missed`."""
        return self._tally.vacuous() if self._given.swarm else []

    def _show(self, broken: list[BrokenRun], seeds: tuple[int, int], took_s: float) -> None:
        survived = self._runs - len(broken)
        if self._given.json:
            document = {
                "seeds": seeds,
                "runs": self._runs,
                "survived": survived,
                "unavailable": self._unavailable,
                "inconclusive": self._inconclusive,
                **self._tally.document(),
                "vacuous": self._vacuous(),
                "broken": [found.document() for found in broken],
                "runs_per_second": round(self._runs / took_s, 1),
                "requests_per_second": round(self._requests / took_s, 1),
                "seconds": round(took_s, 3),
            }
            print_json(document)
            return
        for found in broken[:SHRUNK_MAX]:
            show = partial(picture, broken=found.breaches)
            messages = self._simulated_again(show, found.setup).lines if found.shrunk is not None else []
            print("\n".join((*messages, *found.lines())))
        if len(broken) > SHRUNK_MAX:
            print(f"{spaced(len(broken))} broke in all; --json lists them, each with its command")
        for reason in self._missed[:MISSED_MAX]:
            print(reason)
        if self._inconclusive:
            print(f"inconclusive: in {spaced(self._inconclusive)} runs, what was asked for never came about")
        for line in (*self._tally.lines(), *self._vacuous()):
            print(line)
        print(
            f"{spaced(survived)} of {spaced(self._runs)} survived ({spaced(self._unavailable)} unavailable)"
            f" in {took_s:.1f} s: {spaced(self._runs / took_s)} runs/s,"
            f" {spaced(self._requests / took_s)} requests/s"
        )
        print(f"seeds {seeds[0]}..{seeds[1]}")


# -- real records beside their simulation ---------------------------------------------------------


def _compare(given: SimArguments) -> int:
    """Compare each record with its simulations; the exit code is 1 if one does not agree."""
    if _used(given, "seeds", "against", "trust", "json"):
        raise ConfigError(
            "--against: the experiments are the records'; only --seeds, --trust and --json go with it"
        )
    first, last = _seeds(given) if given.seeds is not None else (0, SEEDS - 1)
    with ProgressLine("sim --against", unit="runs", plain=not given.json) as progress:
        found = against(given.against, last - first + 1, trusting(given.trust), progress.show)
    disagreeing = sum(bool(one.why_not) for one in found)
    if given.json:
        print_json({"agree": not disagreeing, "experiments": found})
        return EXIT_CODES["fail" if disagreeing else "pass"]
    from rich.console import Console  # noqa: PLC0415 - only for this table
    from rich.table import Table  # noqa: PLC0415 - the same

    table = Table("", "classes", "recovery: low, median, high (ms)", box=None, pad_edge=False)
    for one in found:
        table.add_row(one.experiment, "", "")
        table.add_row("  real", _classes(one.real), _times(one.real_recovery))
        table.add_row("  simulated", _classes(one.simulated), _times(one.simulated_recovery))
        for reason in one.why_not:
            table.add_row(f"  [red]not alike[/red]: {reason}", "", "")
    Console().print(table)
    print(f"{len(found) - disagreeing} of {len(found)} experiments agree")
    return EXIT_CODES["fail" if disagreeing else "pass"]


def _classes(found: dict[str, int]) -> str:
    return ", ".join(f"{word} {count}" for word, count in found.items())


def _times(found: RecoveryRange | None) -> str:
    if found is None:
        return "-"
    return f"{found.low_ms:.2f}  {found.median_ms:.2f}  {found.high_ms:.2f}  (of {found.count})"
