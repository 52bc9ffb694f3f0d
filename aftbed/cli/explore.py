"""`aftbed explore`: simulate every experiment of one kind, and count them exactly."""

import time
from contextlib import closing
from typing import Annotated, Final

import msgspec
import typer

from aftbed.cli.options import Json, jobs_of, separated, takes
from aftbed.cli.sim import described, event_lines, picture
from aftbed.cli.views import Bar, spaced
from aftbed.core.errors import ConfigError
from aftbed.judge.verdict import EXIT_CODES, EXIT_INTERRUPTED, Breach
from aftbed.runtime.sim.world import Setup
from aftbed.search.explore import (
    PLACEMENTS,
    Broken,
    Explored,
    OrderedRuns,
    Selection,
    attempt,
    experiments,
    explore_orders,
    selected,
)
from aftbed.search.explore import explore as explore_all

REQUESTS: Final = 3
ORDER_REQUESTS: Final = 2
REQUESTS_MAX: Final = 1000
BOUND: Final = 2_000
BOUND_MAX: Final = 10_000_000
LISTED_MAX: Final = 20  # broken experiments that are printed; --json has all of them

explore = typer.Typer()


class ExploreArguments(msgspec.Struct, frozen=True, kw_only=True):
    """The options of all explorers."""

    ftm: Annotated[
        tuple[str, ...],
        typer.Option(help="Mechanisms, separated by commas or given one by one; all if left out."),
    ] = ()
    placement: Annotated[
        tuple[str, ...], typer.Option(help="process or replica, likewise; both if left out.")
    ] = ()
    jobs: Annotated[int | None, typer.Option(help="Processes; one per CPU if left out.")] = None
    json: Json = False


class NumberedArguments(ExploreArguments, frozen=True, kw_only=True):
    """The options of `aftbed explore adapt` and `pairs`."""

    only: Annotated[int | None, typer.Option(help="One experiment of this selection, by its number.")] = None


class ExploreCrashArguments(NumberedArguments, frozen=True, kw_only=True):
    """The options of `aftbed explore crash`."""

    requests: Annotated[int, typer.Option(help="Requests of each run.")] = REQUESTS


class ExploreOrderArguments(ExploreArguments, frozen=True, kw_only=True):
    """The options of `aftbed explore order`."""

    requests: Annotated[
        int, typer.Option(help="Requests of an undisturbed run, at most; one with a crash.")
    ] = ORDER_REQUESTS
    bound: Annotated[int, typer.Option(help="Runs of one experiment, at most.")] = BOUND


# -- crash, adapt, pairs: each experiment is one run ----------------------------------------------


@explore.command()
@takes(ExploreCrashArguments)
def crash(given: ExploreCrashArguments) -> None:
    """A crash before each effect of each brick, and after its last.

    Exit code of all explorers: 0 all survived, 1 a promise was broken, 2 usage, 130 interrupted.
    """
    _check("--requests", given.requests, REQUESTS_MAX)
    _explore("crash", given, given.requests)


@explore.command()
@takes(NumberedArguments)
def adapt(given: NumberedArguments) -> None:
    """A crash before, during and after each step of each adaptation, of each node that takes part."""
    _explore("adapt", given)


@explore.command()
@takes(NumberedArguments)
def pairs(given: NumberedArguments) -> None:
    """Each first fault of a few, then the crash of each node, after each delay of a grid."""
    _explore("pairs", given)


def _explore(explorer: str, given: NumberedArguments, requests: int = 0) -> None:
    jobs = jobs_of(given.jobs)
    selection = selected(explorer, separated(given.ftm), separated(given.placement), requests)
    setups = list(selection.setups())
    if given.only is not None:
        raise typer.Exit(_explore_one(selection, setups, given.only, as_json=given.json))
    raise typer.Exit(_Exploration(selection, setups, as_json=given.json).run(jobs))


def _explore_one(selection: Selection, setups: list[Setup], number: int, *, as_json: bool) -> int:
    if not 0 <= number < len(setups):
        raise ConfigError(f"--only {number}: this selection has the experiments 0 to {len(setups) - 1}")
    setup, began_s = setups[number], time.monotonic()
    done, broken = attempt(setup)
    lost = done is not None and done.rest.lost
    found = (_broken(selection, number, setup, broken),) if broken else ()
    result = Explored(1, 1 - len(found), int(lost and not broken), _since(began_s), found)
    if as_json:
        print(msgspec.json.encode(result).decode())
    else:
        print(f"{number}: {described(setup)}")
        print("\n".join(event_lines(done) if done is not None else ()))
        print("\n".join(picture(setup, broken).lines()))
        print("\n".join((*_breach_lines(found), _count(result))))
    return EXIT_CODES["fail" if broken else "pass"]


class _Exploration:
    """All experiments of a selection."""

    def __init__(self, selection: Selection, setups: list[Setup], *, as_json: bool) -> None:
        self._selection, self._setups, self._as_json = selection, setups, as_json
        self._began_s = time.monotonic()
        self._runs = self._unavailable = 0
        self._broken: list[Broken] = []

    def run(self, jobs: int) -> int:
        """Run them in `jobs` processes, show the result; the exit code."""
        interrupted = False
        try:
            self._explore(jobs)
        except KeyboardInterrupt:
            interrupted = True
        survived = self._runs - len(self._broken)
        result = Explored(self._runs, survived, self._unavailable, _since(self._began_s), tuple(self._broken))
        if self._as_json:
            print(msgspec.json.encode(result).decode())
        else:
            self._show(result)
        if interrupted:
            return EXIT_INTERRUPTED
        return EXIT_CODES["fail" if self._broken else "pass"]

    def _explore(self, jobs: int) -> None:
        what = f"explore {self._selection.explorer}"
        found = closing(explore_all(self._setups, jobs, lambda number, _: _command(self._selection, number)))
        with Bar(what, len(self._setups), quiet=self._as_json) as bar, found as results:
            for number, setup, lost, breaches in results:
                self._runs += 1
                self._unavailable += lost and not breaches
                if breaches:
                    self._add_broken(_broken(self._selection, number, setup, breaches))
                bar.show(self._runs, self._runs, len(self._broken))

    def _add_broken(self, broken: Broken) -> None:
        self._broken.append(broken)
        if not self._as_json and len(self._broken) <= LISTED_MAX:
            print("\n".join(_breach_lines((broken,))), flush=True)

    def _show(self, result: Explored) -> None:
        more = len(result.broken) - LISTED_MAX
        if more > 0:
            print(f"and {spaced(more)} more; --json lists them all")
        if self._runs < len(self._setups):
            print(f"interrupted: {spaced(self._runs)} of {spaced(len(self._setups))} were run")
        print(_count(result))


def _command(selection: Selection, only: int) -> str:
    """The command that runs one experiment of `selection` again."""
    requests = f" --requests {selection.requests}" if selection.requests else ""
    ftms, placements = ",".join(selection.ftms), ",".join(selection.placements)
    where = "" if selection.placements == PLACEMENTS else f" --placement {placements}"
    return f"aftbed explore {selection.explorer} --ftm {ftms}{where}{requests} --only {only}"


def _broken(selection: Selection, number: int, setup: Setup, breaches: tuple[Breach, ...]) -> Broken:
    return Broken(number, described(setup), tuple(map(str, breaches)), _command(selection, number))


def _breach_lines(found: tuple[Broken, ...]) -> list[str]:
    lines = []
    for broken in found:
        lines += [f"broken: {broken.number}: {broken.setup}"]
        lines += [f"  because    {breach}" for breach in broken.breaches]
        lines += [f"  repeat     {broken.command}"]
    return lines


def _count(result: Explored) -> str:
    return (
        f"{spaced(result.survived)} of {spaced(result.explored)} survived"
        f" ({spaced(result.unavailable)} unavailable) in {result.seconds:.1f} s"
    )


def _since(began_s: float) -> float:
    return round(time.monotonic() - began_s, 3)


def _check(name: str, value: int, most: int) -> None:
    if not 1 <= value <= most:
        raise ConfigError(f"{name} {value}: 1 to {most} are allowed")


# -- order: each experiment is many runs ----------------------------------------------------------


@explore.command()
@takes(ExploreOrderArguments)
def order(given: ExploreOrderArguments) -> None:
    """Every order in which messages can arrive, without those that make no difference."""
    jobs, bound = jobs_of(given.jobs), given.bound
    _check("--requests", given.requests, REQUESTS_MAX)
    _check("--bound", bound, BOUND_MAX)
    # The same mechanisms as those of `crash`.
    chosen = selected("crash", separated(given.ftm), separated(given.placement), given.requests)
    setups = list(experiments(chosen.ftms, chosen.placements, given.requests))
    began_s, found = time.monotonic(), list[OrderedRuns]()
    with Bar("explore order", len(setups), quiet=given.json) as bar:
        for one in explore_orders(setups, bound, jobs):
            found.append(one)
            bar.show(len(found), len(found), sum(bool(o.broken) for o in found))
            if not given.json:
                print(_order_lines(one), flush=True)
    _show_orders(found, bound, _since(began_s), as_json=given.json)
    raise typer.Exit(EXIT_CODES["fail" if any(one.broken for one in found) else "pass"])


def _order_lines(one: OrderedRuns) -> str:
    whole = "all" if one.complete else "at least"
    lines = [f"{whole} {spaced(one.orders)} orders ({spaced(one.cut)} cut): {described(one.setup)}"]
    lines += [f"  broken in {spaced(one.broken)}: {reason}" for reason in one.breaches]
    return "\n".join(lines)


def _show_orders(found: list[OrderedRuns], bound: int, seconds: float, *, as_json: bool) -> None:
    orders, broken = sum(o.orders for o in found), sum(o.broken for o in found)
    complete = sum(o.complete for o in found)
    if as_json:
        document = {
            "explored": orders,
            "survived": orders - broken,
            "experiments": len(found),
            "complete": complete,
            "bound": bound,
            "seconds": seconds,
            "broken": [
                {"setup": described(o.setup), "orders": o.broken, "breaches": o.breaches}
                for o in found
                if o.broken
            ],
        }
        print(msgspec.json.encode(document).decode())
        return
    print(
        f"{spaced(orders - broken)} of {spaced(orders)} orders survived; all orders of {complete} of"
        f" {len(found)} experiments, the others up to {spaced(bound)} runs each; {seconds:.1f} s"
    )
