"""`aftbed explore`: simulate every experiment of one kind, and count them exactly."""

import shlex
import time
from contextlib import closing
from functools import partial
from typing import Annotated, Final

import msgspec
import typer
from msgspec.structs import replace

from aftbed.cli.adapt import refuse_unsuitable
from aftbed.cli.interrupted import interrupted
from aftbed.cli.options import (
    App,
    Json,
    check_range,
    choices,
    jobs_of,
    note_unusable,
    print_json,
    separated,
    takes,
)
from aftbed.cli.parsing import PlainGroup
from aftbed.cli.request_options import RequestSource, first_requests
from aftbed.cli.sim import described, event_lines, picture, shown_apart
from aftbed.core.errors import ConfigError
from aftbed.functions.request_file import names_function
from aftbed.functions.source import located
from aftbed.judge.verdict import EXIT_CODES, Breach
from aftbed.report.progress import ProgressLine, spaced
from aftbed.runtime.sim.world import Setup
from aftbed.runtime.unix.worker_pool import once, own_seconds_max
from aftbed.search.explore import (
    PLACEMENTS,
    Broken,
    Explored,
    OrderedRuns,
    Selection,
    attempt_own,
    experiments,
    explore_orders,
    selected,
)
from aftbed.search.explore import explore as explore_all

REQUESTS: Final = 3
ORDER_REQUESTS: Final = 2
REQUESTS_MAX: Final = 1000
FUNCTION_REQUESTS: Final = 40  # of MODULE:FUNCTION
BOUND: Final = 2_000
BOUND_MAX: Final = 10_000_000
LISTED_MAX: Final = 20  # broken experiments that are printed; --json has all of them

explore = typer.Typer(cls=PlainGroup)


class ExploreArguments(msgspec.Struct, frozen=True, kw_only=True):
    """The options of all explorers."""

    ftm: Annotated[
        tuple[str, ...],
        typer.Option(help="Mechanisms, separated by commas or given one by one; all if left out."),
    ] = ()
    placement: Annotated[
        tuple[str, ...], typer.Option(metavar=choices(PLACEMENTS), help="Likewise; both if left out.")
    ] = ()
    jobs: Annotated[int | None, typer.Option(help="Processes; one per CPU if left out.")] = None
    json: Json = False


class NumberedArguments(ExploreArguments, frozen=True, kw_only=True):
    """The options of `aftbed explore adapt` and `pairs`."""

    only: Annotated[int | None, typer.Option(help="One experiment of this selection, by its number.")] = None
    app: App = None
    requests: Annotated[
        str | None, typer.Option(help="What --app is sent: FILE (CSV, JSON lines) or MODULE:FUNCTION.")
    ] = None
    count: Annotated[
        int | None, typer.Option(help="crash: requests of a run; 3, or all of a file, if left out.")
    ] = None
    force: Annotated[
        bool, typer.Option("--force", help="Explore --app even where a mechanism does not suit it.")
    ] = False


class ExploreOrderArguments(ExploreArguments, frozen=True, kw_only=True):
    """The options of `aftbed explore order`."""

    count: Annotated[int, typer.Option(help="Requests of an undisturbed run, at most; one with a crash.")] = (
        ORDER_REQUESTS
    )
    bound: Annotated[int, typer.Option(help="Runs of one experiment, at most.")] = BOUND


# -- crash, adapt, pairs: each experiment is one run ----------------------------------------------


@explore.command()
@takes(NumberedArguments)
def crash(given: NumberedArguments) -> int:
    """A crash before each effect of each brick, and after its last.

    Exit code of all explorers: 0 all survived, 1 a promise was broken, 2 usage, 130 interrupted.
    """
    return _explore("crash", given)


@explore.command()
@takes(NumberedArguments)
def adapt(given: NumberedArguments) -> int:
    """A crash before, during and after each step of each adaptation, of each node that takes part."""
    return _explore("adapt", given)


@explore.command()
@takes(NumberedArguments)
def pairs(given: NumberedArguments) -> int:
    """Each first fault of a few, then the crash of each node, after each delay of a grid."""
    return _explore("pairs", given)


def _selection(explorer: str, given: NumberedArguments) -> Selection:
    """What of all there is was asked for. Raises ConfigError."""
    text, sent, counted = given.requests, None, explorer == "crash"
    if given.count is not None:
        if not counted:
            raise ConfigError(f"--count {given.count}: {explorer} itself decides how many requests a run has")
        check_range("--count", given.count, 1, REQUESTS_MAX)
    count = (REQUESTS if given.count is None else given.count) if counted else 0
    if text is not None:
        asked = FUNCTION_REQUESTS if given.count is None and names_function(text) else given.count
        source = RequestSource(text, count=asked, count_max=REQUESTS_MAX, expect=None, tolerance=None)
        sent, count = source.of(0), source.count if counted else 0
    chosen = selected(explorer, separated(given.ftm), separated(given.placement), count)
    application = located(given.app) if given.app is not None else ""
    if application:
        refuse_unsuitable(
            application, *chosen.ftms, force=given.force, requests=first_requests(application, sent)
        )
    return replace(chosen, application=application, given=sent)


def _explore(explorer: str, given: NumberedArguments) -> int:
    jobs, began_s = jobs_of(given.jobs), time.monotonic()
    selection = _selection(explorer, given)
    if not given.ftm:
        note_unusable()
    apart = bool(selection.application)
    # How many points a run has is found by simulating it.
    with ProgressLine(f"explore {explorer}: finding what can be struck", plain=False):
        setups = once(_setups, selection, own_seconds_max(REQUESTS_MAX), apart=apart)
    if given.only is not None:
        if not 0 <= given.only < len(setups):
            raise ConfigError(
                f"--only {given.only}: this selection has the experiments 0 to {len(setups) - 1}"
            )
        one = partial(_explore_one, selection, setups, as_json=given.json)
        if not apart:
            return one(given.only)
        return shown_apart(one, given.only, REQUESTS_MAX, lambda number, _: _command(selection, number))
    runs, unavailable, broken, stopped = 0, 0, list[Broken](), False
    results = explore_all(setups, jobs, lambda number, _: _command(selection, number), apart=apart)
    try:
        with (
            ProgressLine(f"explore {explorer}", len(setups), "runs", plain=not given.json) as progress,
            closing(results),
        ):
            for number, setup, lost, breaches in results:
                runs += 1
                unavailable += lost and not breaches
                if breaches:
                    broken.append(broken_one(selection, number, setup, breaches))
                    if not given.json and len(broken) <= LISTED_MAX:
                        progress.print(_breach_text(broken[-1]))
                progress.show(runs, note=_broken(len(broken)))
    except KeyboardInterrupt:
        stopped = True
    result = Explored(runs, runs - len(broken), unavailable, _since(began_s), tuple(broken))
    if given.json:
        print_json(result)
    else:
        if len(broken) > LISTED_MAX:
            print(f"and {spaced(len(broken) - LISTED_MAX)} more; --json lists them all")
        print(_count(result))
    if stopped:
        return interrupted(_done(runs, len(setups)))
    return EXIT_CODES["fail" if broken else "pass"]


def _setups(selection: Selection) -> list[Setup]:
    return list(selection.setups())


def _explore_one(selection: Selection, setups: list[Setup], number: int, *, as_json: bool) -> int:
    setup, began_s = setups[number], time.monotonic()
    run, breaches = attempt_own(setup)
    lost = run is not None and run.rest.lost
    found = tuple(broken_one(selection, number, setup, breaches) for _ in breaches[:1])
    result = Explored(1, 1 - len(found), int(lost and not found), _since(began_s), found)
    if as_json:
        print_json(result)
    else:
        events = event_lines(run) if run is not None else ()
        print("\n".join((f"{number}: {described(setup)}", *events, *picture(setup, breaches).lines)))
        print("\n".join((*map(_breach_text, found), _count(result))))
    return EXIT_CODES["fail" if found else "pass"]


def _command(selection: Selection, only: int) -> str:
    """The command that runs one experiment of `selection` again."""
    requests = f" --requests {shlex.quote(selection.given.source)}" if selection.given is not None else ""
    requests += f" --count {selection.requests}" if selection.requests else ""
    requests += f" --app {shlex.quote(selection.application)}" if selection.application else ""
    ftms, placements = ",".join(selection.ftms), ",".join(selection.placements)
    where = "" if selection.placements == PLACEMENTS else f" --placement {placements}"
    return f"aftbed explore {selection.explorer} --ftm {ftms}{where}{requests} --only {only}"


def broken_one(selection: Selection, number: int, setup: Setup, breaches: tuple[Breach, ...]) -> Broken:
    """With the command that repeats it."""
    return Broken(number, described(setup), tuple(map(str, breaches)), _command(selection, number))


def _breach_text(broken: Broken) -> str:
    because = [f"  because    {breach}" for breach in broken.breaches]
    return "\n".join([f"broken: {broken.number}: {broken.setup}", *because, f"  repeat     {broken.command}"])


def _count(result: Explored) -> str:
    return (
        f"{spaced(result.survived)} of {spaced(result.explored)} survived"
        f" ({spaced(result.unavailable)} unavailable) in {result.seconds:.1f} s"
    )


def _broken(count: int) -> str:
    return f"{spaced(count)} broken" if count else ""


def _done(runs: int, of: int) -> str:
    return f"{spaced(runs)} of {spaced(of)} were run; nothing is kept"


def _since(began_s: float) -> float:
    return round(time.monotonic() - began_s, 3)


# -- order: each experiment is many runs ----------------------------------------------------------


@explore.command()
@takes(ExploreOrderArguments)
def order(given: ExploreOrderArguments) -> int:
    """Every order in which messages can arrive, without those that make no difference."""
    jobs, began_s, found = jobs_of(given.jobs), time.monotonic(), list[OrderedRuns]()
    check_range("--count", given.count, 1, REQUESTS_MAX)
    check_range("--bound", given.bound, 1, BOUND_MAX)
    # The same mechanisms as those of `crash`.
    chosen = selected("crash", separated(given.ftm), separated(given.placement), given.count)
    setups = list(experiments(chosen.ftms, chosen.placements, given.count))
    stopped = False
    try:
        with (
            ProgressLine("explore order", len(setups), "experiments", plain=not given.json) as progress,
            closing(explore_orders(setups, given.bound, jobs)) as results,
        ):
            for one in results:
                found.append(one)
                if not given.json:
                    progress.print(_order_text(one))
                progress.show(len(found), note=_broken(sum(bool(o.broken) for o in found)))
    except KeyboardInterrupt:
        stopped = True
    orders, broken = sum(o.orders for o in found), sum(o.broken for o in found)
    complete, seconds = sum(o.complete for o in found), _since(began_s)
    if given.json:
        document = {
            "explored": orders,
            "survived": orders - broken,
            "experiments": len(found),
            "complete": complete,
            "bound": given.bound,
            "seconds": seconds,
            "broken": [
                {"setup": described(o.setup), "orders": o.broken, "breaches": o.breaches}
                for o in found
                if o.broken
            ],
        }
        print_json(document)
    else:
        print(
            f"{spaced(orders - broken)} of {spaced(orders)} orders survived; all orders of {complete} of"
            f" {len(found)} experiments, the others up to {spaced(given.bound)} runs each; {seconds:.1f} s"
        )
    if stopped:
        return interrupted(_done(len(found), len(setups)))
    return EXIT_CODES["fail" if broken else "pass"]


def _order_text(one: OrderedRuns) -> str:
    whole = "all" if one.complete else "at least"
    head = f"{whole} {spaced(one.orders)} orders ({spaced(one.cut)} cut): {described(one.setup)}"
    return "\n".join([head, *(f"  broken in {spaced(one.broken)}: {reason}" for reason in one.breaches)])
