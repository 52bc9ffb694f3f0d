"""What `aftbed explore` does: runs every experiment of a selection, counts, and tells what broke."""

import time
from contextlib import closing
from typing import Final

import msgspec

from aftbed.cli.simasked import jobs_of
from aftbed.cli.simfailure import picture
from aftbed.cli.simview import Bar, described, event_lines, spaced
from aftbed.core.errors import ConfigError
from aftbed.judge.verdict import EXIT_CODES, EXIT_INTERRUPTED, Breach
from aftbed.runtime.sim.world import Setup
from aftbed.search.explore import PLACEMENTS, Broken, Explored, Selection, attempt, explore, selected

REQUESTS_MAX: Final = 1000
LISTED_MAX: Final = 20  # of those that broke; --json lists all


class Asked(msgspec.Struct, frozen=True):
    """The options of `aftbed explore` as they were typed; None is what was left out."""

    explorer: str
    ftms: tuple[str, ...]
    placements: tuple[str, ...]
    requests: int | None
    jobs: int | None
    only: int | None


def run(asked: Asked, *, as_json: bool) -> int:
    """Explore, show, count; the exit code."""
    jobs = jobs_of(asked.jobs)
    if asked.requests is not None and not 1 <= asked.requests <= REQUESTS_MAX:
        raise ConfigError(f"--requests {asked.requests}: 1 to {REQUESTS_MAX} are allowed")
    selection = selected(asked.explorer, asked.ftms, asked.placements, asked.requests or 0)
    setups = list(selection.setups())
    if asked.only is not None:
        return _only(selection, setups, asked.only, as_json=as_json)
    return _Exploration(selection, setups, as_json=as_json).run(jobs)


def command(selection: Selection, only: int) -> str:
    """That runs one experiment of `selection` again."""
    requests = f" --requests {selection.requests}" if selection.requests else ""
    ftms, placements = ",".join(selection.ftms), ",".join(selection.placements)
    where = "" if selection.placements == PLACEMENTS else f" --placement {placements}"
    return f"aftbed explore {selection.explorer} --ftm {ftms}{where}{requests} --only {only}"


# -- one ------------------------------------------------------------------------------------------


def _only(selection: Selection, setups: list[Setup], number: int, *, as_json: bool) -> int:
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


# -- all ------------------------------------------------------------------------------------------


class _Exploration:
    """All experiments of a selection."""

    def __init__(self, selection: Selection, setups: list[Setup], *, as_json: bool) -> None:
        self._selection, self._setups, self._as_json = selection, setups, as_json
        self._began_s = time.monotonic()
        self._runs = self._unavailable = 0
        self._broken: list[Broken] = []

    def run(self, jobs: int) -> int:
        """Run them, and tell; the exit code."""
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
            self._tell(result)
        if interrupted:
            return EXIT_INTERRUPTED
        return EXIT_CODES["fail" if self._broken else "pass"]

    def _explore(self, jobs: int) -> None:
        what = f"explore {self._selection.explorer}"
        found = closing(explore(self._setups, jobs, lambda number, _: command(self._selection, number)))
        with Bar(what, len(self._setups), quiet=self._as_json) as bar, found as results:
            for number, setup, lost, broken in results:
                self._runs += 1
                self._unavailable += lost and not broken
                if broken:
                    self._breaks(_broken(self._selection, number, setup, broken))
                bar.show(self._runs, self._runs, len(self._broken))

    def _breaks(self, broken: Broken) -> None:
        self._broken.append(broken)
        if not self._as_json and len(self._broken) <= LISTED_MAX:
            print("\n".join(_breach_lines((broken,))), flush=True)

    def _tell(self, result: Explored) -> None:
        more = len(result.broken) - LISTED_MAX
        if more > 0:
            print(f"and {spaced(more)} more; --json lists them all")
        if self._runs < len(self._setups):
            print(f"interrupted: {spaced(self._runs)} of {spaced(len(self._setups))} were run")
        print(_count(result))


def _since(began_s: float) -> float:
    return round(time.monotonic() - began_s, 3)


def _broken(selection: Selection, number: int, setup: Setup, breaches: tuple[Breach, ...]) -> Broken:
    return Broken(number, described(setup), tuple(map(str, breaches)), command(selection, number))


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
