"""`aftbed bench compare`: two installed versions, each bench in turn, in pairs. Is the new one slower?

A version is a venv with aftbed in it. `VENV/bin/python -m aftbed bench ... --json` prints its document. Of
that only the figures of `FIGURES` are read, so an old version need not know the documents of today.

A pair is a document of each, one right after the other; the new version is the first in every second pair.
What the machine does to both within a pair cancels out in their ratio. The pairs are independent of one
another, so the interval of their median ratio is that of the sign test: two of the ratios, by their ranks
(`campaign.statistics.quantile_interval`). It assumes no distribution; at 95 % it needs six pairs.

| the interval of new / old         | verdict               |
|-----------------------------------|-----------------------|
| is above 1                        | slower (or larger)    |
| is below 1                        | faster (or smaller)   |
| has 1 in it                       | no difference shown   |
| there is none: fewer than 6 pairs | not enough rounds     |

A rate is turned into the time that one takes. Limits: each figure has its own interval, so of 40 figures
without any difference, one is called slower at 95 %. "No difference shown" is no proof that there is none:
the interval says how large it can be.
"""

import math
import os
import shlex
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final, Literal

import msgspec

from aftbed.bench.numbers import COMMAND_SECONDS_MAX, Document
from aftbed.bench.rounds import ROUNDS, Meanwhile, in_turn, text
from aftbed.bench.runs import TRIES, CommandFailedError, Log, run_python
from aftbed.campaign.statistics import CONFIDENCE, Interval, quantile, quantile_interval
from aftbed.core.errors import ConfigError, HarnessError, unknown
from aftbed.core.progress import Show, unshown
from aftbed.runtime.unix.interrupts import scratch_directory

DEFAULT: Final = ("cycle --ftm pbr --count 1100",)
VERSION_SECONDS_MAX: Final = 60.0
QUANTILES: Final = ("p50", "p99", "")  # "": of a figure that is one number
EXIT_TROUBLE: Final = 3  # of a bench that the machine was too busy for, perhaps
DIGITS: Final = 4  # of a ratio

Change = Literal["slower", "faster", "larger", "smaller", "no difference shown", "not enough rounds"]
Measure = Callable[[Path, str], Document]


class ComparedFigure(msgspec.Struct, frozen=True):
    """Where a figure is in the document of a bench; `rate`: more of it is better, `size`: it is no time."""

    path: str
    rate: bool = False
    size: bool = False


FIGURES: Final = {  # by the first word of a bench
    "cycle": (ComparedFigure("cycle_us"),),
    "hops": (ComparedFigure("hop_ns"),),
    "recovery": (ComparedFigure("recovery_ms"),),
    "adapt": (ComparedFigure("blackout_ms"), ComparedFigure("back.blackout_ms")),
    "launch": (ComparedFigure("launch_ms"), ComparedFigure("graph_ms"), ComparedFigure("help.help_ms")),
    "memory": (
        ComparedFigure("pss_mb", size=True),
        ComparedFigure("rss_mb", size=True),
        ComparedFigure("idle_cpu_percent"),
    ),
    "campaign": (ComparedFigure("per_minute", rate=True), ComparedFigure("cpu_ms")),
    "state": (ComparedFigure("cycle_us"), ComparedFigure("blackout_ms")),
}


class InstalledVersion(msgspec.Struct, frozen=True, omit_defaults=True):
    """`version` is what `aftbed --version` prints; `options` each bench is given of this version only."""

    venv: str
    version: str
    options: str = ""


class VersionChange(msgspec.Struct, frozen=True):
    """A quantile of a figure: its medians over the rounds, and new / old in each of them.

    `ratio` is the median of `ratios`, `interval` that of the true median at 95 %. Of a rate, they are those
    of the time that one takes.
    """

    bench: str
    figure: str
    quantile: str
    old: float
    new: float
    ratio: float
    interval: Interval | None
    verdict: Change
    ratios: tuple[float, ...]


class VersionComparison(msgspec.Struct, frozen=True):
    """The document of `aftbed bench compare`; `left_out`: figures that not both versions have in each round.

    `machine` has what it did during each bench.
    """

    old: InstalledVersion
    new: InstalledVersion
    rounds: int
    confidence: float
    changes: tuple[VersionChange, ...]
    left_out: tuple[str, ...]
    machine: dict[str, Meanwhile]


def bench_compare(
    old: Path,
    new: Path,
    benches: tuple[str, ...],
    log: Log,
    *,
    rounds: int = ROUNDS,
    old_options: str = "",
    new_options: str = "",
    measure: Measure | None = None,
    show: Show = unshown,
) -> VersionComparison:
    """Measure `benches` (words behind `aftbed bench`) of both, `rounds` times. Raises ConfigError.

    `old_options` and `new_options` are added to each bench of that version: where one knows an option that
    the other does not, or has another default.
    """
    sides = ((old, old_options), (new, new_options))
    for bench in benches:
        check(bench)
        for _, options in sides:
            check(_with(bench, options))
    versions = [InstalledVersion(str(venv), version_of(venv), options) for venv, options in sides]
    for bench in benches if measure is None else ():
        for venv, options in sides:
            check_options(venv, _with(bench, options))
    changes: list[VersionChange] = []
    left_out: list[str] = []
    machine = {}

    def document(side: tuple[Path, str], bench: str, number: int) -> Document:
        venv, words = side[0], _with(bench, side[1])
        log(f"{venv}: aftbed bench {words}, round {number + 1} of {rounds}")
        return (measure or measured)(venv, words)

    different = list(dict.fromkeys(benches))
    for number, bench in enumerate(different):

        def shown_of_all(done: float, of: float, before: int = number) -> None:
            show(before * of + done, len(different) * of)

        of_old, of_new = (partial(document, side, bench) for side in sides)
        found = in_turn(rounds, of_new, of_old, 0, show=shown_of_all)
        machine[bench] = found.machine
        for figure in FIGURES[shlex.split(bench)[0]]:
            of_figure = _changes(bench, figure, found.limits, found.figures)
            changes += of_figure
            left_out += [] if of_figure else [f"{bench}: {figure.path}"]
    return VersionComparison(
        versions[0], versions[1], rounds, CONFIDENCE, tuple(changes), tuple(left_out), machine
    )


def _with(bench: str, options: str) -> str:
    return f"{bench} {options}" if options else bench


def check(bench: str) -> None:
    """Raise ConfigError unless `bench` begins with a bench whose figures are known."""
    try:
        words = shlex.split(bench)
    except ValueError as error:
        raise ConfigError(f"--bench {bench!r}: {error}") from None
    if not words:
        raise ConfigError(
            f"--bench {bench!r}: no bench; {', '.join(FIGURES)} are allowed, with their options"
        )
    if words[0] not in FIGURES:
        raise unknown("bench", words[0], tuple(FIGURES))


# -- what a version measures ----------------------------------------------------------------------


def version_of(venv: Path) -> str:
    """What `aftbed --version` prints there. Raises ConfigError if there is none."""
    if not venv.is_dir():
        raise ConfigError(f"{venv}: no such directory; that of a venv with aftbed in it is allowed")
    if not (venv / "bin" / "python").exists():
        raise ConfigError(
            f"{venv}: no bin/python in it; the directory of a venv with aftbed in it is allowed"
        )
    try:
        return _python_of(venv, ["--version"], VERSION_SECONDS_MAX).decode(errors="replace").strip()
    except CommandFailedError as error:
        raise ConfigError(f"{venv}: no aftbed that works: {_last_line(error)}") from None
    except (HarnessError, OSError) as error:
        raise ConfigError(f"{venv}: no aftbed that works: {error}") from None


def check_options(venv: Path, bench: str) -> None:
    """Raise ConfigError if that version does not know an option of `bench`: before hours are measured."""
    try:
        _python_of(venv, ["bench", *shlex.split(bench), "--help"], VERSION_SECONDS_MAX)
    except CommandFailedError as error:
        raise ConfigError(
            f"aftbed bench {bench} of {venv}: exit code {error.code}: {_last_line(error)}"
        ) from None
    except (HarnessError, OSError) as error:
        raise ConfigError(f"aftbed bench {bench} of {venv}: {error}") from None


def measured(venv: Path, bench: str) -> Document:
    """The document of `bench` there. One that ran into trouble is tried again. Raises ConfigError."""
    arguments = ["bench", *shlex.split(bench), "--json"]
    for left in reversed(range(TRIES)):
        try:
            output = _python_of(venv, arguments, COMMAND_SECONDS_MAX)
            return msgspec.json.decode(output, type=Document)
        except CommandFailedError as error:
            if error.code != EXIT_TROUBLE or not left:
                what = f"exit code {error.code}: {_last_line(error)}"
                raise ConfigError(f"aftbed bench {bench} of {venv}: {what}") from None
        except (HarnessError, OSError, msgspec.DecodeError) as error:
            raise ConfigError(f"aftbed bench {bench} of {venv}: {error}") from None
    raise AssertionError("the last try returns or raises")


def _python_of(venv: Path, arguments: list[str], seconds_max: float) -> bytes:
    """The output of `aftbed arguments` of that version, and no other: whatever this process imports from."""
    python = str((venv / "bin" / "python").absolute())
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    with scratch_directory("aftbed-bench-") as folder:
        words = ["-P", "-m", "aftbed", *arguments]
        return run_python(words, seconds_max, python=python, folder=str(folder), environment=environment)


def _last_line(error: CommandFailedError) -> str:
    return error.last_words.rpartition("\n")[2]


# -- the comparison -------------------------------------------------------------------------------


def _changes(
    bench: str, figure: ComparedFigure, old: list[Document], new: list[Document]
) -> list[VersionChange]:
    """Of each quantile that all documents have, and that is not 0."""
    before, after = ([_quantiles(one, figure.path) for one in documents] for documents in (old, new))
    names = [name for name in QUANTILES if all(one.get(name) for one in (*before, *after))]
    return [
        change(bench, figure, name, [one[name] for one in before], [one[name] for one in after])
        for name in names
    ]


def change(
    bench: str, figure: ComparedFigure, name: str, old: list[float], new: list[float]
) -> VersionChange:
    """Of the quantile called `name`, one value for each round of each version."""
    pairs = zip(new, old, strict=True)
    ratios = [b / a if figure.rate else a / b for a, b in pairs]
    interval = quantile_interval(ratios, 0.5)
    return VersionChange(
        bench,
        figure.path,
        name,
        quantile(old, 0.5),
        quantile(new, 0.5),
        round(quantile(ratios, 0.5), DIGITS),
        interval and Interval(round(interval.low, DIGITS), round(interval.high, DIGITS)),
        verdict_of(interval, figure),
        tuple(round(ratio, DIGITS) for ratio in ratios),
    )


def verdict_of(interval: Interval | None, figure: ComparedFigure) -> Change:
    """See the table of the module."""
    if interval is None:
        return "not enough rounds"
    if interval.low > 1:
        return "larger" if figure.size else "slower"
    if interval.high < 1:
        return "smaller" if figure.size else "faster"
    return "no difference shown"


def above(found: VersionComparison, max_ratio: float) -> list[VersionChange]:
    """Those that are certainly above: the whole interval is."""
    return [one for one in found.changes if one.interval is not None and one.interval.low > max_ratio]


def _quantiles(document: Document, path: str) -> dict[str, float]:
    """The numbers at `path`; a single one has the name "". None where the document has no such path."""
    found: object = document
    for key in path.split("."):
        found = found.get(key) if isinstance(found, dict) else None
    values = found if isinstance(found, dict) else {"": found}
    return {
        name: value
        for name, value in values.items()
        if isinstance(value, int | float) and math.isfinite(value)
    }


# -- for people -----------------------------------------------------------------------------------


def lines(found: VersionComparison) -> Iterator[str]:
    """A line for each version and each change, and what the machine did."""
    for which, side in (("old", found.old), ("new", found.new)):
        options = f" with {side.options}" if side.options else ""
        yield f"{which:14} {side.version} ({side.venv}){options}"
    for one in found.changes:
        interval = f" ({one.interval.low:g} to {one.interval.high:g})" if one.interval else ""
        figure = f"{one.figure} {one.quantile}".strip()
        yield (
            f"{one.bench}: {figure}: old {one.old:g}  new {one.new:g}  ratio {one.ratio:g}{interval}"
            f"  rounds {found.rounds}  {one.verdict}"
        )
    for name in found.left_out:
        yield f"{name}: not compared, not both versions have it"
    yield from text(found.machine, "machine: ")
