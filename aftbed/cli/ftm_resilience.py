"""`aftbed ftm resilience`: what a set of mechanisms does about each change of FT, A and R.

The times of adaptations are measured here, on real processes, or read from files of `aftbed bench adapt`.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer

from aftbed.adapt.resilience import Addition, Counts, NeededAdaptation, Resilience, mechanisms_of, resilience
from aftbed.bench.adaptation import AdaptationTime, Pair, bench_pairs, read_times
from aftbed.cli.ftm import TableOption, table_of
from aftbed.cli.options import Json, check_range, print_json, takes
from aftbed.core.errors import ConfigError
from aftbed.ftm.registry import SHIPPED
from aftbed.report.progress import ProgressLine

ADAPTATIONS: Final = 3  # of each kind
ADAPTATIONS_MAX: Final = 1000
SHOWN: Final = 5  # additions that do not exist


class TimedAdaptation(NeededAdaptation, frozen=True, kw_only=True):
    """With its medians; `source` is "measured", the file with them, or null as they are."""

    blackout_ms: float | None = None
    total_ms: float | None = None
    of: int = 0
    source: str | None = None


class AdaptationMean(msgspec.Struct, frozen=True):
    """Over all changes that an adaptation of known time answers: the mean of its medians."""

    blackout_ms: float
    total_ms: float
    changes: int


class ResilienceArguments(msgspec.Struct, frozen=True):
    """The options of `aftbed ftm resilience`."""

    mechanisms: Annotated[
        str, typer.Option("--set", help="The mechanisms there are, with commas; what they compose is added.")
    ] = ",".join(SHIPPED)
    adaptations: Annotated[
        int, typer.Option(help="Of each kind, measured on real processes; 0: measure nothing.")
    ] = ADAPTATIONS
    times: Annotated[
        tuple[Path, ...],
        typer.Option(
            help="File of `aftbed bench adapt --json`: not measured here; may be given several times."
        ),
    ] = ()
    table: TableOption = None
    json: Json = False


@takes(ResilienceArguments)
def resilience_(given: ResilienceArguments) -> None:
    """Which changes of FT, A and R a set of mechanisms answers: by staying, by an adaptation, by nothing.

    Exit code: 0, 2 usage, 3 an adaptation that was measured failed.
    """
    check_range("--adaptations", given.adaptations, 0, ADAPTATIONS_MAX)
    found = resilience(_set(given.mechanisms), table_of(given.table))
    needed = [(one.old, one.new) for one in found.adaptations]
    times: dict[Pair, tuple[AdaptationTime, str]] = {}
    for path in given.times:
        times |= {pair: (time, str(path)) for pair, time in _read(path, needed).items()}
    missing = [pair for pair in needed if pair not in times]
    if given.adaptations:
        with ProgressLine("ftm resilience", unit="adaptations", plain=not given.json) as progress:
            measured = bench_pairs(missing, given.adaptations, progress.step, progress.show)
        times |= {pair: (time, "measured") for pair, time in measured.items()}
    timed = [_timed(one, times) for one in found.adaptations]
    mean = _mean(timed)
    if given.json:
        document = msgspec.structs.asdict(found) | {"adaptations": timed, "adaptation_mean": mean}
        print_json(document)
    else:
        _print(found, timed, mean)


def _set(text: str) -> tuple[str, ...]:
    try:
        return mechanisms_of(text)
    except ConfigError as error:
        raise ConfigError(f"--set {text!r}: {error}") from None


def _read(path: Path, needed: Collection[Pair]) -> dict[Pair, AdaptationTime]:
    """The times in a file. Raises ConfigError, also where none of them is of an adaptation that is needed."""
    try:
        found = read_times(path)
    except ConfigError as error:
        raise ConfigError(f"--times {error}") from None
    if not any(pair in found for pair in needed):
        ways = " and ".join(f"{old} to {new}" for old, new in found)
        allowed = ", ".join(f"{old} to {new}" for old, new in needed) or "nothing"
        raise ConfigError(f"--times {path}: found {ways}; this set adapts {allowed}")
    return found


def _timed(one: NeededAdaptation, times: Mapping[Pair, tuple[AdaptationTime, str]]) -> TimedAdaptation:
    if (one.old, one.new) not in times:
        return TimedAdaptation(one.old, one.new, one.changes)
    time, source = times[one.old, one.new]
    return TimedAdaptation(
        one.old,
        one.new,
        one.changes,
        blackout_ms=time.blackout_ms,
        total_ms=time.total_ms,
        of=time.adaptations,
        source=source,
    )


def _mean(timed: list[TimedAdaptation]) -> AdaptationMean | None:
    known = [
        (one.changes, one.blackout_ms, one.total_ms)
        for one in timed
        if one.blackout_ms is not None and one.total_ms is not None
    ]
    changes = sum(count for count, _, _ in known)
    if not changes:
        return None
    blackout_ms = sum(count * ms for count, ms, _ in known) / changes
    total_ms = sum(count * ms for count, _, ms in known) / changes
    return AdaptationMean(round(blackout_ms, 3), round(total_ms, 3), changes)


# -- as text --------------------------------------------------------------------------------------

CHANGE: Final = "{:<6}{:<14}{:<20}{:<20}{:>8}{:>8}{:>8}{:>9}{:>10}".format
ADAPTATION: Final = "{:<12}{:<12}{:>8}{:>13}{:>11}{:>5}".format
ADDITION: Final = "{:<48}{:>8}{:>10}".format


def _print(found: Resilience, timed: list[TimedAdaptation], mean: AdaptationMean | None) -> None:
    print(f"set         {', '.join(found.mechanisms)}")
    print(f"can run     {', '.join(found.ftms)}")
    print(f"states      {found.states}: one of these in a situation that it suits, of {found.situations}")
    print()
    print(CHANGE("KIND", "OF", "FROM", "TO", "CHANGES", "STAYS", "ADAPTS", "NOTHING", "ANSWERED"))
    for change in found.changes:
        print(CHANGE(change.kind.value, change.axis, change.old, change.new, *_cells(change.counts)))
    for of in found.kinds:
        print(CHANGE(of.kind.value, "all", "", "", *_cells(of.counts)))
    print(CHANGE("all", "", "", "", *_cells(found.total)))
    print()
    if timed:
        print(ADAPTATION("ADAPT FROM", "TO", "CHANGES", "BLACKOUT ms", "TOTAL ms", "OF"))
        for one in timed:
            times = ("-" if ms is None else f"{ms:.2f}" for ms in (one.blackout_ms, one.total_ms))
            print(ADAPTATION(one.old, one.new, one.changes, *times, one.of or "-"))
        print()
    if found.additions:
        print(ADDITION("ONE MECHANISM MORE", "ANSWERS", "ANSWERED"))
        shipped = [one for one in found.additions if one.addition is Addition.AS_SHIPPED]
        less = [one for one in found.additions if one.addition is not Addition.AS_SHIPPED]
        for more in (*shipped, *less[:SHOWN]):
            print(ADDITION(more.words, more.answers, _percent(more.answered)))
        print()
    print(_verdict(found.total))
    if mean is not None:
        print(
            f"an adaptation takes {mean.total_ms:.1f} ms, {mean.blackout_ms:.2f} ms of it without service:"
            f" the mean over {mean.changes} changes"
        )


def _cells(counts: Counts) -> tuple[object, ...]:
    return counts.changes, counts.stays, counts.adapts, counts.nothing, _percent(counts.answered)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


def _verdict(total: Counts) -> str:
    breaking = total.adapts + total.nothing
    answered = total.stays + total.adapts
    return (
        f"answered    {answered} of {total.changes} changes ({_percent(total.answered)});"
        f" of {breaking} that break what runs {total.adapts} ({_percent(total.of_breaking)})"
    )
