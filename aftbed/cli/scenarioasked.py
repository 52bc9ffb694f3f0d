"""The options of `aftbed scenario table`, checked: which rows, under what, with which fault."""

from pathlib import Path
from typing import Final

import msgspec

from aftbed.cli.running import SEED_MAX
from aftbed.cli.simasked import jobs_of
from aftbed.cli.simview import read_fault
from aftbed.core.errors import ConfigError
from aftbed.core.fault import Crash, Fault, Hang, Slow, Trigger
from aftbed.core.graph import Graph
from aftbed.core.words import milliseconds, whole_milliseconds
from aftbed.ftm.compose import build
from aftbed.inject.words import parse
from aftbed.runtime import targets
from aftbed.search.road_table import NONE, PRIMARY, Line, outage
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.tables import Case, cases

WORST: Final = "worst-instant"
PLOT: Final = ".svg"


class Asked(msgspec.Struct, frozen=True):
    """The options as they were typed."""

    table: str
    group: str | None = None
    ftms: tuple[str, ...] = ()
    fault: str | None = None
    outages: tuple[str, ...] = ()
    seed: int = 0
    jobs: int | None = None
    plot: Path | None = None


class Chosen(msgspec.Struct, frozen=True):
    """What is to be driven."""

    cases: tuple[Case, ...]
    lines: tuple[Line, ...]
    seed: int
    jobs: int


def chosen(asked: Asked) -> Chosen:
    """Raises ConfigError naming the argument, before anything is driven."""
    rows = cases(asked.table, asked.group)
    if not 0 <= asked.seed <= SEED_MAX:
        raise ConfigError(f"--seed {asked.seed}: 0 to {SEED_MAX} are allowed")
    check_plot(asked.plot)
    lines = (*_mechanisms(asked), *(_outage(text, rows) for text in dict.fromkeys(asked.outages)))
    return Chosen(rows, lines, asked.seed, jobs_of(asked.jobs))


def check_plot(plot: Path | None) -> None:
    """Raises ConfigError if that file cannot be written, before there is anything to write."""
    if plot is None:
        return
    if plot.suffix != PLOT or plot.is_dir() or not plot.absolute().parent.is_dir():
        raise ConfigError(f"--plot {plot}: a file {PLOT} in a directory that exists is allowed")


def _mechanisms(asked: Asked) -> tuple[Line, ...]:
    """A line for each; none is named, and outages are: they speak for themselves."""
    named = tuple(dict.fromkeys(asked.ftms))
    if not named:
        named = () if asked.outages and asked.fault is None else (NONE,)
    return tuple(_line(ftm, asked.fault) for ftm in named)


def _line(ftm: str, fault: str | None) -> Line:
    graph = build(ftm, "process")
    if fault is None:
        return Line(ftm, ftm)
    words = fault.split()
    if words[-1:] != [WORST]:
        return Line(f"{ftm}, {fault}", ftm, read_fault(fault, graph))
    found = _searched(fault, words, graph)
    return Line(f"{ftm}, {found} at the worst instant", ftm, found, searched=True)


def _searched(text: str, words: list[str], graph: Graph) -> Fault:
    """`worst-instant` alone, a crash of the primary; or `hang primary for 50ms at worst-instant`."""
    if len(words) == 1:
        return Fault(Crash(), PRIMARY, Trigger())
    if words[-2] != "at":
        raise ConfigError(f"--fault {text!r}: {WORST}, or FAULT WORDS at {WORST} is allowed")
    fault = parse(" ".join(words[:-2]))
    if not isinstance(fault.action, Crash | Hang | Slow) or fault.trigger != Trigger():
        raise ConfigError(f"--fault {text!r}: a crash, a hang or a slow without any other time is searched")
    targets.check(fault, graph)
    return fault


def _outage(text: str, rows: tuple[Case, ...]) -> Line:
    """Raises ConfigError if it is longer than one of the drives."""
    if milliseconds("--outage", text) < 1.0:
        raise ConfigError(f"--outage {text}: 1ms is the shortest that is allowed")
    length_ms = whole_milliseconds("--outage", text)
    for case in rows:
        lasts_ms = load_scenario(case.name).duration_ms
        if length_ms >= lasts_ms:
            raise ConfigError(
                f"--outage {text}: {case.name} lasts {lasts_ms / 1000:g} s; a shorter one is allowed"
            )
    return outage(length_ms)
