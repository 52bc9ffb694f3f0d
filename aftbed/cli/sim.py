"""`aftbed sim`: runs in virtual time, each determined by its seed.

A verdict is that of a real run, with one difference: a service that is lost because a fault struck each
replica is no failure here (`unavailable`), since a swarm draws such faults too and no promise covers them. A
fault or an adaptation that was asked for and never happened makes the verdict inconclusive (G8).
"""

import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from json import dumps
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import msgspec
import typer
from msgspec.structs import replace
from rich.console import Console
from rich.table import Table

from aftbed.adapt import commands
from aftbed.cli.adapt import scheduled
from aftbed.cli.options import RATE_HZ_MAX, SEED_MAX, Json, check_seed, jobs_of, takes
from aftbed.cli.views import Bar, EndedAdaptation, history_lines, show_verdict, spaced
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.graph import Graph
from aftbed.core.messages import Goal, Scheduled
from aftbed.core.script import RECIPES
from aftbed.ftm.compose import build
from aftbed.inject.model import Fault, parse
from aftbed.inject.targets import OTHERS
from aftbed.judge.outcome import outcome_of
from aftbed.judge.simulated import record_of
from aftbed.judge.verdict import (
    EXIT_CODES,
    EXIT_INTERRUPTED,
    Breach,
    Verdict,
    Word,
    evidence_of,
    judge,
)
from aftbed.report import sequence
from aftbed.runtime.sim.clock import START_NS
from aftbed.runtime.sim.givens import check as check_fault
from aftbed.runtime.sim.trace import traced
from aftbed.runtime.sim.world import Run, Setup
from aftbed.runtime.unix.worker_pool import each
from aftbed.search.agreement import SEEDS, Agreement, RecoveryRange, against
from aftbed.search.explore import Found, attempt, missed, tried
from aftbed.search.shrink import shrink
from aftbed.search.swarm import drawn
from aftbed.vehicle.aeb.function import default_application
from aftbed.vehicle.scenarios.library import load_scenario

COUNT_MAX: Final = 100_000
LOAD_S_MAX: Final = 3600.0  # of virtual time
MINUTES_MAX: Final = 100_000.0
SHRUNK_MAX: Final = 3  # broken runs: shrinking one takes up to 400 runs
MISSED_MAX: Final = 3  # reasons shown
LISTED_MAX: Final = 20  # broken runs, while the others go on
NO_COMMAND: Final = "(no command line says it: repeat the original)"
DEFAULT: Final = Setup()
_RANGE: Final = re.compile(r"([0-9]{1,19})\.\.([0-9]{1,19})")

MakeSetup = Callable[[int], Setup]


class SimArguments(msgspec.Struct, frozen=True):
    """The options of `aftbed sim`; None is one that was left out."""

    seed: Annotated[
        int | None, typer.Option(help="Seed of all random numbers of one run; 0 if left out.")
    ] = None
    seeds: Annotated[str | None, typer.Option(help="A..B: a run for each, both ends included.")] = None
    ftm: Annotated[str | None, typer.Option(help="none, pbr, lfr, tr, pbr+tr, ...; pbr if left out.")] = None
    placement: Annotated[str | None, typer.Option(help="process (default), replica or single.")] = None
    count: Annotated[int | None, typer.Option(help="Requests of a run; 100 if left out.")] = None
    rate: Annotated[
        float | None,
        typer.Option(help="Requests per second; if left out, each follows the reply before it."),
    ] = None
    scenario: Annotated[
        str | None, typer.Option(help="A car makes the requests: a scenario, or a YAML file.")
    ] = None
    faults: Annotated[
        tuple[str, ...], typer.Option("--faults", help='E.g. "crash primary at server.exit nth 3".')
    ] = ()
    adaptations: Annotated[
        tuple[str, ...], typer.Option("--adapt", help='E.g. "to lfr+tr at request 20".')
    ] = ()
    recipe: Annotated[
        str | None, typer.Option(help="How each --adapt is carried out: drained (default) or paper.")
    ] = None
    force: Annotated[
        bool, typer.Option("--force", help="Begin each --adapt even if it would be refused.")
    ] = False
    swarm: Annotated[bool, typer.Option("--swarm", help="Draw everything from the seed.")] = False
    minutes: Annotated[float | None, typer.Option(help="Simulate the seeds from --seed on, for so long.")] = (
        None
    )
    jobs: Annotated[int | None, typer.Option(help="Processes, for many runs; one per CPU if left out.")] = (
        None
    )
    diagram: Annotated[
        str | None, typer.Option(help="Write the last messages to this file, as a Mermaid diagram.")
    ] = None
    against: Annotated[
        tuple[Path, ...],
        typer.Option(help="The record of a real run: simulate the same, under --seeds, and compare."),
    ] = ()
    json: Json = False


@takes(SimArguments)
def sim(given: SimArguments) -> None:
    """Simulate runs in virtual time; the same seed gives the same run.

    The bricks, scripts and faults are those of real runs.

    Exit code: 0 pass, 1 a promise was broken, 2 usage, 3 a fault did not fire, 130 interrupted.
    """
    raise typer.Exit(_simulate(given))


def _simulate(given: SimArguments) -> int:
    if given.against:
        return _compare(given.against, _seeds_against(given), as_json=given.json)
    first, last = _seeds(given)
    jobs, make = jobs_of(given.jobs), _setup_maker(given)
    _check_diagram(given.diagram)
    if given.seeds is None and given.minutes is None:
        return _simulate_one(given, make(first))
    return _ManyRuns(given, make, first, last).run(jobs)


# -- what the options mean ------------------------------------------------------------------------


def _seeds(given: SimArguments) -> tuple[int, int]:
    """The first and the last seed. Raises ConfigError."""
    options = {"--seeds": given.seeds, "--seed": given.seed, "--minutes": given.minutes}
    used = [name for name, value in options.items() if value is not None]
    if given.seeds is not None and len(used) > 1:
        raise ConfigError(f"{' and '.join(used)}: --seeds stands alone")
    if given.minutes is not None and not 0 < given.minutes <= MINUTES_MAX:
        raise ConfigError(f"--minutes {given.minutes}: more than 0, up to {MINUTES_MAX:.0f} are allowed")
    if given.seeds is not None:
        return _range(given.seeds)
    seed = given.seed or 0
    check_seed(seed)
    return seed, SEED_MAX


def _range(text: str) -> tuple[int, int]:
    found = _RANGE.fullmatch(text)
    if found is None:
        raise ConfigError(f"--seeds {text[:60]!r}: A..B is allowed, as 0..99, both ends included")
    first, last = int(found[1]), int(found[2])
    if first > last:
        raise ConfigError(
            f"--seeds {text}: no seed is in it; A..B with A up to B is allowed, as {last}..{first}"
        )
    if last > SEED_MAX:
        raise ConfigError(f"--seeds {text}: 0 to {SEED_MAX} are allowed")
    return first, last


def _setup_maker(given: SimArguments) -> MakeSetup:
    """What makes the setup of a seed. Raises ConfigError."""
    if given.swarm:
        _check_swarm(given)
        return drawn
    graph = build(given.ftm or DEFAULT.ftm, given.placement or DEFAULT.placement)
    faults = tuple(read_fault(text, graph) for text in given.faults)
    adaptations = _adaptations(given, graph)
    setup = replace(
        _load(given), ftm=graph.ftm, placement=graph.placement, faults=faults, adaptations=adaptations
    )
    for fault in faults:
        check_fault(fault, setup.scenario)
    for adaptation in adaptations:
        if not setup.scenario and adaptation.at_request > setup.count:
            raise ConfigError(
                f"--adapt: at request {adaptation.at_request}: there are {setup.count} requests (--count)"
            )
    return lambda seed: replace(setup, seed=seed)


def _check_swarm(given: SimArguments) -> None:
    drawn_too = {
        "--ftm": given.ftm,
        "--placement": given.placement,
        "--count": given.count,
        "--rate": given.rate,
        "--scenario": given.scenario,
        "--faults": given.faults or None,
        "--adapt": given.adaptations or None,
        "--recipe": given.recipe,
        "--force": given.force or None,
    }
    used = [name for name, value in drawn_too.items() if value is not None]
    if used:
        raise ConfigError(f"--swarm draws everything from the seed: leave out {', '.join(used)}")


def _load(given: SimArguments) -> Setup:
    """The source of the requests, their number and their rate."""
    if given.scenario is not None:
        if given.count is not None or given.rate is not None:
            raise ConfigError("--scenario: the car makes the requests; leave out --count and --rate")
        load_scenario(given.scenario)
        return Setup(scenario=given.scenario)
    count = DEFAULT.count if given.count is None else given.count
    rate_hz = DEFAULT.rate_hz if given.rate is None else given.rate
    if not 1 <= count <= COUNT_MAX:
        raise ConfigError(f"--count {count}: 1 to {COUNT_MAX} requests are allowed")
    if given.rate is not None and not 0 < rate_hz <= RATE_HZ_MAX:
        raise ConfigError(
            f"--rate {rate_hz}: more than 0, up to {RATE_HZ_MAX:.0f} a second are allowed"
            " (without it, each follows the reply before)"
        )
    if rate_hz and count / rate_hz > LOAD_S_MAX:
        raise ConfigError(f"--count {count} --rate {rate_hz}: {LOAD_S_MAX:.0f} s of virtual time are allowed")
    return Setup(count=count, rate_hz=rate_hz)


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
    if not given.adaptations and (given.recipe is not None or given.force):
        raise ConfigError("--recipe and --force say how --adapt is carried out: give --adapt too")
    if given.force:
        found = tuple(_forced(text, recipe) for text in given.adaptations)
    else:
        found = scheduled(given.adaptations, graph, recipe, force=False)
    for text, adaptation in zip(given.adaptations, found, strict=True):
        if adaptation.goal.source:
            raise ConfigError(f"--adapt {text!r}: the simulator loads no brick that was written off line")
    return found


def _forced(text: str, recipe: str) -> Scheduled:
    """An adaptation that is not checked here: the Engine may refuse it when it begins."""
    timed = commands.read(text)
    if timed.wish.verb == "decompose":
        raise ConfigError(f"--adapt {text!r}: with --force, the whole of what will run is named: to EXPR")
    build(timed.wish.name, DEFAULT.placement)
    return Scheduled(Goal(expression=timed.wish.name, recipe=recipe), timed.at_request, timed.after_ms)


def _check_diagram(path: str | None) -> None:
    """Raise ConfigError if `--diagram` cannot be written, before anything is simulated."""
    if path is None:
        return
    file = Path(path)
    if file.is_dir() or not file.absolute().parent.is_dir():
        raise ConfigError(f"--diagram {path}: a file in a directory that exists is allowed")


# -- a setup in words, and as a command -----------------------------------------------------------


def described(setup: Setup) -> str:
    """For people."""
    load = f"a car in {setup.scenario}" if setup.scenario else _load_words(setup)
    parts = [f"{setup.ftm} ({setup.placement}), seed {setup.seed}, {load}"]
    parts += [f"{doom.brick} dies before its effect {doom.effect}" for doom in setup.dooms]
    parts += [str(fault) for fault in setup.faults]
    return "; ".join([*parts, *map(_adaptation_words, setup.adaptations)])


def _load_words(setup: Setup) -> str:
    requests = f"{setup.count} request{'s' if setup.count > 1 else ''}"
    return f"{requests} at {_number(setup.rate_hz)}/s" if setup.rate_hz else requests


def _adaptation_words(adaptation: Scheduled) -> str:
    """As `--adapt` reads them."""
    goal = adaptation.goal
    found = [f"to {goal.expression}" if goal.expression else f"update {goal.part} to {goal.source}"]
    if adaptation.at_request:
        found.append(f"at request {adaptation.at_request}")
    elif adaptation.after_ms:
        found.append(f"after {_number(adaptation.after_ms)}ms")
    return " ".join(found)


def repeating(setup: Setup) -> str:
    """The command that repeats `setup`; "" if none does. Checked: reading it back gives `setup`."""
    if setup.dooms:
        return ""
    exact = replace(setup, count=DEFAULT.count, rate_hz=DEFAULT.rate_hz) if setup.scenario else setup
    for force in (False, True):
        try:
            if _setup_maker(_arguments(exact, force=force and bool(setup.adaptations)))(setup.seed) == exact:
                return _command(setup, force=force)
        except ConfigError:
            continue
    return ""


def repeating_drawn(setup: Setup, *, swarm: bool) -> str:
    """The same; if `setup` was drawn by a swarm, its seed is enough."""
    return f"aftbed sim --swarm --seed {setup.seed}" if swarm else repeating(setup)


def _arguments(setup: Setup, *, force: bool) -> SimArguments:
    car = bool(setup.scenario)
    return SimArguments(
        seed=setup.seed,
        ftm=setup.ftm,
        placement=setup.placement,
        count=None if car else setup.count,
        rate=None if car else setup.rate_hz or None,
        scenario=setup.scenario or None,
        faults=tuple(map(str, setup.faults)),
        adaptations=tuple(map(_adaptation_words, setup.adaptations)),
        recipe=next((a.goal.recipe for a in setup.adaptations), None),
        force=force,
    )


def _command(setup: Setup, *, force: bool) -> str:
    found = [f"aftbed sim --seed {setup.seed} --ftm {setup.ftm}"]
    if setup.placement != DEFAULT.placement:
        found.append(f"--placement {setup.placement}")
    if setup.scenario:
        found.append(f"--scenario {_quoted(setup.scenario)}")
    else:
        found.append(f"--count {setup.count}")
        found += [f"--rate {_number(setup.rate_hz)}"] if setup.rate_hz else []
    found += [f"--faults {_quoted(str(fault))}" for fault in setup.faults]
    found += [f"--adapt {_quoted(_adaptation_words(a))}" for a in setup.adaptations]
    recipes = {a.goal.recipe for a in setup.adaptations} - {RECIPES[0]}
    found += [f"--recipe {recipe}" for recipe in recipes]
    return " ".join([*found, *(["--force"] if force else [])])


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else str(value)


def _quoted(text: str) -> str:
    return f'"{text}"' if " " in text or "'" in text else text


# -- a run that broke a promise -------------------------------------------------------------------


class Picture(NamedTuple):
    """The last messages of a run before its first breach, as text and as Mermaid."""

    text: str
    mermaid: str

    def lines(self) -> list[str]:
        """For a terminal."""
        return self.text.rstrip().splitlines()


def picture(setup: Setup, broken: tuple[Breach, ...]) -> Picture:
    """Simulates `setup` again, traced. Empty if the executive itself failed."""
    if attempt(setup)[0] is None:
        return Picture("", "")
    trace = traced(setup)
    return Picture(sequence.listing(trace, broken), sequence.mermaid(trace, broken))


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

    def drawn_lines(self) -> list[str]:
        """The last messages; none if it was not shrunk."""
        return picture(self.setup, self.breaches).lines() if self.shrunk is not None else []

    def lines(self) -> Iterator[str]:
        """For people."""
        yield f"found: {described(self.setup)}"
        yield from (f"  because    {breach}" for breach in self.breaches)
        yield f"  repeat     {self.command or NO_COMMAND}"
        if self.shrunk not in (None, self.setup):
            assert self.shrunk is not None
            yield f"shrunk: {described(self.shrunk)}"
            yield f"  repeat     {self.shrunk_command or NO_COMMAND}"


def broken_run(setup: Setup, broken: tuple[Breach, ...], *, swarm: bool, shrinks: bool = True) -> BrokenRun:
    """Shrink it if `shrinks`, and find the commands that repeat it."""
    original = repeating_drawn(setup, swarm=swarm)
    if not shrinks:
        return BrokenRun(setup, broken, original, None, "")
    smaller = shrink(setup, lambda simpler: attempt(simpler)[1])
    return BrokenRun(setup, broken, original, smaller, repeating(smaller))


# -- one run --------------------------------------------------------------------------------------


def _simulate_one(given: SimArguments, setup: Setup) -> int:
    began_s = time.perf_counter()
    done, broken = attempt(setup)
    wall_ms = round((time.perf_counter() - began_s) * 1e3, 3)
    lacking = missed(done) if done is not None and not given.swarm else ()
    verdict: Word = "fail" if broken else "inconclusive" if lacking else "pass"
    if not given.json:
        print(f"seed {setup.seed}")
        _show(setup, done, verdict, (*map(str, broken), *lacking), wall_ms)
    found = broken_run(setup, broken, swarm=given.swarm) if broken else None
    drawing = picture(setup, broken) if found is not None or given.diagram is not None else None
    if given.diagram is not None and drawing is not None:
        Path(given.diagram).write_text(drawing.mermaid)
    if given.json:
        print(dumps(_document(setup, done, verdict, found, lacking, wall_ms)))
        return EXIT_CODES[verdict]
    if found is not None and drawing is not None:
        print("\n".join((*drawing.lines(), *found.lines())))
    print(f"seed {setup.seed}")
    return EXIT_CODES[verdict]


def _show(setup: Setup, done: Run | None, verdict: Word, reasons: tuple[str, ...], wall_ms: float) -> None:
    """The events and the verdict, as `aftbed run` shows them."""
    print(described(setup))
    if done is None:
        print("\n".join((*(f"  because    {reason}" for reason in reasons), f"verdict: {verdict}")))
        return
    print("\n".join((*event_lines(done), *_adaptation_lines(done))))
    virtual_ms = (done.rest.ended_ns - START_NS) / 1e6
    found = f"; outcome: {_outcome(done)}" if setup.faults else ""
    print(f"{virtual_ms:.1f} ms of virtual time in {wall_ms:.1f} ms{found}")
    show_verdict(_verdict(done, verdict, reasons), as_json=False)


def event_lines(run: Run) -> Iterator[str]:
    """The events of the executive, in virtual time, as `aftbed run` shows them."""
    for t_ns, event, text in run.told:
        yield f"[{(t_ns - START_NS) / 1e6:>10.3f} ms] {event}: {text}"


def _adaptation_lines(run: Run) -> list[str]:
    """As `aftbed adapt history` shows them; none if there are none."""
    ended = msgspec.convert(msgspec.to_builtins(run.adaptations), list[EndedAdaptation])
    return list(history_lines(ended)) if ended else []


def _verdict(done: Run, verdict: Word, reasons: tuple[str, ...]) -> Verdict:
    return msgspec.structs.replace(judge(record_of(done)), verdict=verdict, reasons=list(reasons))


def _outcome(done: Run) -> str:
    return outcome_of(evidence_of(record_of(done), default_application))[0]


def _document(
    setup: Setup,
    done: Run | None,
    verdict: Word,
    found: BrokenRun | None,
    lacking: tuple[str, ...],
    wall_ms: float,
) -> dict[str, object]:
    ran: dict[str, object] = {}
    if done is not None:
        judged = _verdict(done, verdict, ())
        ran = {
            "outcome": _outcome(done),
            "requests": judged.requests,
            "failovers": judged.failovers,
            "adaptations": done.adaptations,
            "faults": done.faults,
            "vehicle": done.vehicle,
            "virtual_ms": round((done.rest.ended_ns - START_NS) / 1e6, 3),
        }
    broken = found.document() if found is not None else {"breaches": [], "command": None, "shrunk": None}
    about = {"seed": setup.seed, "verdict": verdict, "setup": described(setup), "missed": lacking}
    document = msgspec.to_builtins({**about, **broken, **ran, "wall_ms": wall_ms})
    assert isinstance(document, dict)
    return document


# -- many runs ------------------------------------------------------------------------------------


class _ManyRuns:
    """The runs of the seeds from `first` to `last`; with --minutes, as many as there is time for."""

    def __init__(self, given: SimArguments, make: MakeSetup, first: int, last: int) -> None:
        self._given, self._make, self._first, self._last = given, make, first, last
        self._seconds = (given.minutes or 0.0) * 60
        self._began_s, self._took_s = time.monotonic(), 0.0
        self._runs = self._unavailable = self._requests = self._inconclusive = 0
        self._broken: list[tuple[Setup, tuple[Breach, ...]]] = []
        self._missed: list[str] = []

    def run(self, jobs: int) -> int:
        """Simulate them in `jobs` processes, show the result; the exit code."""
        if not self._given.json:
            print(f"seeds {self._first}..{'' if self._seconds else self._last}", flush=True)
        interrupted = False
        try:
            self._simulate(jobs)
        except KeyboardInterrupt:
            interrupted = True
        swarm = self._given.swarm
        found = [
            broken_run(setup, broken, swarm=swarm, shrinks=number < SHRUNK_MAX and not interrupted)
            for number, (setup, broken) in enumerate(self._broken)
        ]
        self._draw()
        self._show(found)
        word: Word = "fail" if self._broken else "inconclusive" if self._inconclusive else "pass"
        return EXIT_INTERRUPTED if interrupted else EXIT_CODES[word]

    def _simulate(self, jobs: int) -> None:
        total = self._seconds or self._last - self._first + 1
        setups = map(self._make, range(self._first, self._last + 1))
        swarm = self._given.swarm
        results = each(tried, setups, jobs, alone=lambda _, setup: repeating_drawn(setup, swarm=swarm))
        with Bar("sim", total, quiet=self._given.json) as bar, closing(results) as found:
            for number, setup, what in found:
                self._count(setup, what)
                self._took_s = time.monotonic() - self._began_s
                bar.show(self._took_s if self._seconds else number + 1, self._runs, len(self._broken))
                if self._seconds and self._took_s >= self._seconds:
                    break

    def _count(self, setup: Setup, found: Found) -> None:
        self._runs += 1
        self._requests += found.requests
        self._unavailable += found.lost and not found.breaches
        if found.missed and not self._given.swarm:
            self._inconclusive += 1
            self._missed += [f"seed {setup.seed}: {missed}" for missed in found.missed[:1]]
        if found.breaches:
            self._broken.append((setup, found.breaches))
            if not self._given.json and len(self._broken) <= LISTED_MAX:
                print(f"seed {setup.seed}: {found.breaches[0]}", flush=True)

    def _draw(self) -> None:
        """Write the diagram of the first run that broke a promise."""
        path = self._given.diagram
        if path is None:
            return
        if self._broken:
            Path(path).write_text(picture(*self._broken[0]).mermaid)
        else:
            print(f"aftbed: note: nothing broke: {path} is not written", file=sys.stderr)

    def _show(self, broken: list[BrokenRun]) -> None:
        took_s = max(self._took_s, 1e-9)
        last = self._first + self._runs - 1
        survived = self._runs - len(self._broken)
        if self._given.json:
            document = {
                "seeds": [self._first, last],
                "runs": self._runs,
                "survived": survived,
                "unavailable": self._unavailable,
                "inconclusive": self._inconclusive,
                "broken": [found.document() for found in broken],
                "runs_per_second": round(self._runs / took_s, 1),
                "requests_per_second": round(self._requests / took_s, 1),
                "seconds": round(took_s, 3),
            }
            print(dumps(document))
            return
        for found in broken[:SHRUNK_MAX]:
            print("\n".join((*found.drawn_lines(), *found.lines())))
        if len(broken) > SHRUNK_MAX:
            print(f"{spaced(len(broken))} broke in all; --json lists them, each with its command")
        for reason in self._missed[:MISSED_MAX]:
            print(reason)
        if self._inconclusive:
            print(f"inconclusive: in {spaced(self._inconclusive)} runs, what was asked for never came about")
        print(
            f"{spaced(survived)} of {spaced(self._runs)} survived ({spaced(self._unavailable)} unavailable)"
            f" in {took_s:.1f} s: {spaced(self._runs / took_s)} runs/s,"
            f" {spaced(self._requests / took_s)} requests/s"
        )
        print(f"seeds {self._first}..{last}")


# -- real records beside their simulation ---------------------------------------------------------


def _seeds_against(given: SimArguments) -> int:
    """The number of simulations of each record. Raises ConfigError if other options are given."""
    others = [name for name in given.__struct_fields__ if name not in ("seeds", "against", "json")]
    if any(getattr(given, name) not in (None, (), False) for name in others):
        raise ConfigError("--against: the experiments are the records'; only --seeds and --json go with it")
    first, last = _seeds(given) if given.seeds is not None else (0, SEEDS - 1)
    return last - first + 1


def _compare(records: tuple[Path, ...], seeds: int, *, as_json: bool) -> int:
    """Compare each record with its simulations; the exit code is 1 if one does not agree."""
    found = against(records, seeds)
    disagreeing = sum(bool(one.why_not) for one in found)
    if as_json:
        print(msgspec.json.encode({"agree": not disagreeing, "experiments": found}).decode())
    else:
        _show_agreement(found)
        print(f"{len(found) - disagreeing} of {len(found)} experiments agree")
    return EXIT_CODES["fail" if disagreeing else "pass"]


def _show_agreement(found: list[Agreement]) -> None:
    table = Table("", "classes", "recovery: low, median, high (ms)", box=None, pad_edge=False)
    for one in found:
        table.add_row(one.experiment, "", "")
        table.add_row("  real", _classes(one.real), _times(one.real_recovery))
        table.add_row("  simulated", _classes(one.simulated), _times(one.simulated_recovery))
        for reason in one.why_not:
            table.add_row(f"  [red]not alike[/red]: {reason}", "", "")
    Console().print(table)


def _classes(found: dict[str, int]) -> str:
    return ", ".join(f"{word} {count}" for word, count in found.items())


def _times(found: RecoveryRange | None) -> str:
    if found is None:
        return "-"
    return f"{found.low_ms:.2f}  {found.median_ms:.2f}  {found.high_ms:.2f}  (of {found.count})"
