"""What `aftbed sim` and `aftbed explore` show: an experiment in words, as a command; what happened; a bar."""

import sys
import time
from collections.abc import Iterator
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

import msgspec

from aftbed.cli.adaptview import Outcome, history_lines
from aftbed.core.errors import ConfigError
from aftbed.core.fault import Fault
from aftbed.core.graph import Graph
from aftbed.core.messages import Scheduled
from aftbed.core.script import RECIPES
from aftbed.inject.words import parse
from aftbed.runtime import targets
from aftbed.runtime.sim.clock import START_NS
from aftbed.runtime.sim.world import Run, Setup

if TYPE_CHECKING:
    from rich.progress import Progress

REFRESH_S: Final = 0.1
AFTER: Final = "after"
DEFAULT: Final = Setup()


# -- words ----------------------------------------------------------------------------------------


def read_fault(text: str, graph: Graph) -> Fault:
    """The words of `aftbed run --inject`. Raises ConfigError."""
    fault = parse(text)
    targets.check(fault, graph)
    if fault.target in targets.OTHERS:
        raise ConfigError(f"{text!r}: the simulator has no {fault.target}: it simulates what is in the graph")
    return fault


def adaptation_words(adaptation: Scheduled) -> str:
    """As `--adapt` reads it."""
    goal = adaptation.goal
    words = [f"to {goal.expression}" if goal.expression else f"update {goal.part} to {goal.source}"]
    if adaptation.at_request:
        words.append(f"at request {adaptation.at_request}")
    elif adaptation.after_ms:
        words.append(f"after {_number(adaptation.after_ms)}ms")
    return " ".join(words)


def command(setup: Setup, *, force: bool = False) -> str:
    """That runs `setup`; with `force`, also what an Engine would refuse."""
    words = [f"aftbed sim --seed {setup.seed} --ftm {setup.ftm}"]
    if setup.placement != DEFAULT.placement:
        words.append(f"--placement {setup.placement}")
    if setup.scenario:
        words.append(f"--scenario {_quoted(setup.scenario)}")
    else:
        words.append(f"--count {setup.count}")
        words += [f"--rate {_number(setup.rate_hz)}"] if setup.rate_hz else []
    words += [f"--faults {_quoted(str(fault))}" for fault in setup.faults]
    words += [f"--adapt {_quoted(adaptation_words(a))}" for a in setup.adaptations]
    recipes = {a.goal.recipe for a in setup.adaptations} - {RECIPES[0]}
    words += [f"--recipe {recipe}" for recipe in recipes]
    return " ".join([*words, *(["--force"] if force else [])])


def described(setup: Setup) -> str:
    """For people."""
    load = f"a car in {setup.scenario}" if setup.scenario else _load(setup)
    parts = [f"{setup.ftm} ({setup.placement}), seed {setup.seed}, {load}"]
    parts += [f"{doom.brick} dies before its effect {doom.effect}" for doom in setup.dooms]
    parts += [str(fault) for fault in setup.faults]
    return "; ".join([*parts, *map(adaptation_words, setup.adaptations)])


def _load(setup: Setup) -> str:
    requests = f"{setup.count} request{'s' if setup.count > 1 else ''}"
    return f"{requests} at {_number(setup.rate_hz)}/s" if setup.rate_hz else requests


def spaced(number: float) -> str:
    """`8 867`."""
    return f"{number:,.0f}".replace(",", " ")


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else str(value)


def _quoted(text: str) -> str:
    return f'"{text}"' if " " in text or "'" in text else text


def event_lines(run: Run) -> Iterator[str]:
    """What the executive told, in virtual time, as `aftbed run` shows it."""
    for t_ns, event, text in run.told:
        yield f"[{(t_ns - START_NS) / 1e6:>10.3f} ms] {event}: {text}"


def adaptation_lines(run: Run) -> list[str]:
    """As `aftbed adapt history` shows them; none if there are none."""
    outcomes = msgspec.convert(msgspec.to_builtins(run.adaptations), list[Outcome])
    return list(history_lines(outcomes)) if outcomes else []


# -- a bar ----------------------------------------------------------------------------------------


class Bar:
    """How far it is, with the rate and the failures: on a terminal, and never in the way of the output."""

    def __init__(self, what: str, total: float, *, quiet: bool) -> None:
        self._what, self._total = what, total
        self._progress: Progress | None = None
        self._shown_s = self._began_s = time.monotonic()
        self._wanted = sys.stderr.isatty() and not quiet

    def __enter__(self) -> Self:
        if self._wanted:
            self._progress = self._open()
            self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._progress is not None:
            self._progress.stop()

    def _open(self) -> "Progress":
        from rich.console import Console  # noqa: PLC0415 - only where somebody looks
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: PLC0415

        said = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[count]}")
        progress = Progress(
            *said,
            TimeRemainingColumn(),
            console=Console(stderr=True),
            auto_refresh=False,  # a thread of its own would be forked with the processes that simulate
            transient=True,
            redirect_stdout=sys.stdout.isatty(),
        )
        progress.add_task(self._what, total=self._total, count="")
        return progress

    def show(self, done: float, runs: int, broken: int) -> None:
        """`done` of the total, after so many runs."""
        now_s = time.monotonic()
        if self._progress is None or now_s < self._shown_s + REFRESH_S:
            return
        self._shown_s = now_s
        rate = runs / max(now_s - self._began_s, 1e-9)
        count = f"{spaced(runs)} runs, {spaced(rate)}/s, {broken} broken"
        self._progress.update(self._progress.task_ids[0], completed=done, count=count, refresh=True)
