"""A simulated run that broke a promise: its last messages, a simpler one that breaks the same, the commands.

A command is only given if reading it back makes the very experiment.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

from msgspec.structs import replace

from aftbed.cli.simasked import DEFAULT, Asked, made_of
from aftbed.cli.simview import adaptation_words, command, described
from aftbed.core.errors import ConfigError
from aftbed.judge.verdict import Breach
from aftbed.report import sequence
from aftbed.runtime.sim.tracing import traced
from aftbed.runtime.sim.world import Setup
from aftbed.search.explore import attempt
from aftbed.search.shrink import shrink

NO_COMMAND: Final = "(no command line says it: repeat the original)"


class Picture(NamedTuple):
    """The last messages of a run, up to what broke it: for a terminal, and as Mermaid."""

    text: str
    mermaid: str

    def lines(self) -> list[str]:
        """For a terminal."""
        return self.text.rstrip().splitlines()


class Failure(NamedTuple):
    """A broken experiment. `command` repeats it, `shrunk_command` the simplest that breaks the same."""

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
        """The last messages, where it was looked at closely."""
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


def failure(setup: Setup, broken: tuple[Breach, ...], *, swarm: bool, shrinks: bool = True) -> Failure:
    """What there is to tell about it."""
    original = again(setup, swarm=swarm)
    if not shrinks:
        return Failure(setup, broken, original, None, "")
    smaller = shrink(setup, lambda simpler: attempt(simpler)[1])
    return Failure(setup, broken, original, smaller, repeating(smaller))


def again(setup: Setup, *, swarm: bool) -> str:
    """The command that repeats `setup`, of a swarm perhaps; "" if there is none."""
    return f"aftbed sim --swarm --seed {setup.seed}" if swarm else repeating(setup)


def repeating(setup: Setup) -> str:
    """The command that repeats `setup`, with all its options; "" if there is none."""
    if setup.dooms:
        return ""
    exact = replace(setup, count=DEFAULT.count, rate_hz=DEFAULT.rate_hz) if setup.scenario else setup
    for force in (False, True):
        try:
            if made_of(_options(exact, force=force and bool(setup.adaptations)))(setup.seed) == exact:
                return command(setup, force=force)
        except ConfigError:
            continue
    return ""


def _options(setup: Setup, *, force: bool) -> Asked:
    car = bool(setup.scenario)
    recipe = next((a.goal.recipe for a in setup.adaptations), None)
    return Asked(
        seed=setup.seed,
        seeds=None,
        ftm=setup.ftm,
        placement=setup.placement,
        count=None if car else setup.count,
        rate=None if car else setup.rate_hz or None,
        scenario=setup.scenario or None,
        faults=tuple(map(str, setup.faults)),
        adaptations=tuple(map(adaptation_words, setup.adaptations)),
        recipe=recipe,
        force=force,
        swarm=False,
        minutes=None,
        jobs=None,
        diagram=None,
    )


def picture(setup: Setup, broken: tuple[Breach, ...]) -> Picture:
    """Of the last messages before what broke it first; empty where the executive itself broke down."""
    if attempt(setup)[0] is None:
        return Picture("", "")
    trace = traced(setup)
    return Picture(sequence.text(trace, broken), sequence.mermaid(trace, broken))
