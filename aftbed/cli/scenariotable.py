"""`aftbed scenario table`: drive a table, show it, draw it; the exit code."""

import sys
import time
from collections.abc import Sequence
from contextlib import closing
from itertools import groupby
from pathlib import Path

from aftbed.cli import scenarioview
from aftbed.cli.scenarioasked import Asked, Chosen, chosen
from aftbed.cli.simview import Bar
from aftbed.core.errors import ConfigError
from aftbed.judge.verdict import EXIT_INTERRUPTED
from aftbed.report.roadplot import Curve, Point, road_plot
from aftbed.search.road_table import Row, driven, drives
from aftbed.vehicle.scenarios import tables

EXIT_PASS, EXIT_FAIL, EXIT_NO_FAULT = 0, 1, 3


def run(asked: Asked, *, as_json: bool) -> int:
    """Drive what is asked for. Raises ConfigError before anything is driven, HarnessError."""
    found = chosen(asked)
    began_s = time.monotonic()
    try:
        rows = _drive(found, quiet=as_json)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    seconds = round(time.monotonic() - began_s, 2)
    if asked.plot is not None:
        _plot(asked.plot, asked.table, found, rows)
    if as_json:
        about: dict[str, object] = {"table": asked.table, "group": asked.group, "seed": asked.seed}
        print(scenarioview.document(about | {"seconds": seconds}, rows))
    else:
        where = f", {asked.group}" if asked.group else ""
        title = f"{asked.table}{where}: {tables.title(asked.table)}; seed {asked.seed}"
        scenarioview.show_table(title, found.lines, rows)
        print(f"\n{_counted(rows)} in {seconds:.1f} s")
    return _code(rows)


def _drive(found: Chosen, *, quiet: bool) -> list[Row]:
    """All rows, in the order of the lines and of the table."""
    todo = drives(found.cases, found.lines, found.seed)
    rows: dict[tuple[str, str], Row] = {}
    with closing(driven(todo, found.jobs)) as coming, Bar("driving", len(todo), quiet=quiet) as bar:
        for done, these in enumerate(coming, 1):
            rows |= {(row.line, row.case): row for row in these}
            bar.show(done, len(rows), sum(not row.passed for row in rows.values()))
    return [rows[line.name, case.name] for line in found.lines for case in found.cases]


def _counted(rows: Sequence[Row]) -> str:
    passed, struck = sum(row.passed for row in rows), all(row.struck for row in rows)
    tail = "" if struck else f"; the fault never struck in {sum(not row.struck for row in rows)}"
    return f"{passed} of {len(rows)} rows pass{tail}"


def _code(rows: Sequence[Row]) -> int:
    if any(row.struck and not row.passed for row in rows):
        return EXIT_FAIL
    return EXIT_PASS if all(row.struck for row in rows) else EXIT_NO_FAULT


def _plot(path: Path, table: str, found: Chosen, rows: Sequence[Row]) -> None:
    """A picture for each group."""
    groups = {case.name: case.group for case in found.cases}
    curves = [
        Curve(group, line, tuple(_point(row) for row in sorted(of, key=lambda row: row.speed_kmh)))
        for (line, group), of in groupby(rows, key=lambda row: (row.line, groups[row.case]))
    ]
    try:
        path.write_text(road_plot(f"{table}: speed left at impact", curves), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--plot {path}: {error.strerror}") from None


def _point(row: Row) -> Point:
    return Point(row.speed_kmh, row.impact_kmh, row.limit_kmh, row.closed_form_kmh)
