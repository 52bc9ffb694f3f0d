"""What `aftbed scenario` shows: what there is to drive, one drive, a table that was driven row by row."""

import json
import sys
from collections.abc import Sequence
from itertools import groupby
from typing import Final

import msgspec

from aftbed.search.road_table import Line, Row
from aftbed.search.worst_instant import STEP_CYCLES
from aftbed.vehicle.plant import KMH_PER_MS, Lead
from aftbed.vehicle.scenarios import tables
from aftbed.vehicle.scenarios.library import load_scenario, scenario_names
from aftbed.vehicle.scenarios.scenario import Scenario

WIDTH: Final = 150  # characters, where there is no terminal to ask
CYCLE_S: Final = 0.02
HEADS: Final = ("row", "km/h", "allowed", "impact", "gap", "warned")
FAULT_HEADS: Final = ("struck at", "worst of", "lost")
OUTAGE_HEADS: Final = ("at most",)


# -- what there is --------------------------------------------------------------------------------


def show_list(*, as_json: bool) -> None:
    """Scenarios by name; tables by group."""
    scenarios = {name: load_scenario(name).description for name in scenario_names()}
    groups = {
        name: {group: len(tables.cases(name, group)) for group in tables.group_names(name)}
        for name in tables.table_names()
    }
    if as_json:
        listed = [{"table": name, "title": tables.title(name), "groups": groups[name]} for name in groups]
        print(json.dumps({"scenarios": scenarios, "tables": listed}))
        return
    width = max(map(len, (*scenarios, *(group for counted in groups.values() for group in counted))))
    print("scenarios")
    for name, description in scenarios.items():
        print(f"  {name:<{width}}  {description}")
    for name, counted in groups.items():
        print(f"table {name}: {tables.title(name)}")
        for group, count in counted.items():
            rows = [case.name for case in tables.cases(name, group)]
            ends = rows[0] if count == 1 else f"{rows[0]} to {rows[-1]}"
            print(f"  {group:<{width}}  {count:>2} row{'s' if count > 1 else ' '}  {ends}")


def show_scenario(name: str, *, as_json: bool) -> None:
    """One drive, and the row of a table that it is. Raises ConfigError."""
    scenario, case = load_scenario(name), _case(name)
    if as_json:
        row = None if case is None else msgspec.to_builtins(case)
        print(json.dumps({"scenario": msgspec.to_builtins(scenario), "row": row}))
        return
    lines = [
        ("ego", f"{scenario.plant.speed_ms * KMH_PER_MS:.1f} km/h"),
        ("ahead", _ahead(scenario.plant.lead)),
    ]
    lines += [("road", f"friction {scenario.plant.friction:g}"), ("lasts", _lasts(scenario))]
    lines += [("expected", _expected(scenario))]
    if case is not None:
        lines += [
            ("row of", f"{case.table}, {case.group}"),
            ("demands", _demands(case)),
            ("source", case.source),
        ]
    print(f"{scenario.name}: {scenario.description}")
    print("\n".join(f"  {head:<9}{text}" for head, text in lines))


def _case(name: str) -> tables.Case | None:
    table = name.partition(tables.SEPARATOR)[0]
    if table not in tables.table_names():
        return None
    return next((case for case in tables.cases(table) if case.name == name), None)


def _ahead(lead: Lead | None) -> str:
    if lead is None:
        return "an empty road"
    words = [f"a car {lead.gap_m:.1f} m ahead at {lead.speed_ms * KMH_PER_MS:.1f} km/h"]
    if lead.braking is not None:
        after_s = lead.braking.after_ms / 1000
        words.append(f"brakes at {lead.braking.deceleration_ms2:g} m/s2 after {after_s:g} s")
    if lead.cut_in is not None:
        words.append(f"cuts in after {lead.cut_in.after_ms / 1000:g} s")
    elif lead.lateral_m:
        words.append(f"{abs(lead.lateral_m):g} m beside our lane's middle")
    return ", ".join(words)


def _lasts(scenario: Scenario) -> str:
    return f"{scenario.duration_ms / 1000:g} s at most"


def _expected(scenario: Scenario) -> str:
    expect = scenario.expect
    words = [expect.outcome.replace("_", " ")]
    words += [f"at {expect.impact_speed_kmh_max:g} km/h at most"] if expect.impact_speed_kmh_max else []
    words += [f"{expect.stop_gap_m_min:g} m short at least"] if expect.stop_gap_m_min else []
    return ", ".join(words)


def _demands(case: tables.Case) -> str:
    """What the table asks for, apart from what is expected of the scenario."""
    words = ["no contact" if not case.limit_kmh else f"impact at {case.limit_kmh:g} km/h at most"]
    if case.warning_s_min is not None:
        words.append(f"a warning {case.warning_s_min:g} s before braking")
    if case.demand_ms2_min is not None:
        words.append(f"a demand of {case.demand_ms2_min:g} m/s2 at least")
    return ", ".join(words)


# -- a table that was driven ----------------------------------------------------------------------


def document(about: dict[str, object], rows: Sequence[Row]) -> str:
    """The one document of `--json`."""
    passed = all(row.passed for row in rows)
    return json.dumps({**about, "pass": passed, "rows": [msgspec.to_builtins(row) for row in rows]})


def show_table(title: str, lines: Sequence[Line], rows: Sequence[Row]) -> None:
    """A table for each line, then why rows fail, then what repeats the worst of them."""
    print(title)
    by_line = {name: list(of) for name, of in groupby(rows, key=lambda row: row.line)}
    for line in lines:
        found = by_line[line.name]
        print(f"\n{line.name}" + (f" (under {line.ftm})" if line.outage_ms is not None else ""))
        _print_rows(line, found)
        for text in (*_failures(line, found), *_search(line, found), *_repeat(line, found)):
            print(f"  {text}")


def _print_rows(line: Line, rows: Sequence[Row]) -> None:
    from rich.console import Console  # noqa: PLC0415 - only where somebody looks
    from rich.table import Table  # noqa: PLC0415

    heads = (*HEADS, *(FAULT_HEADS if line.fault else ()), *(OUTAGE_HEADS if line.outage_ms else ()), "")
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="")
    for at, head in enumerate(heads):
        table.add_column(head, no_wrap=True, justify="left" if at in (0, len(heads) - 1) else "right")
    for row in rows:
        style = "" if row.passed else "red"
        table.add_row(*_cells(line, row), style=style)
    console = Console(width=None if sys.stdout.isatty() else WIDTH, highlight=False)
    with console.capture() as captured:
        console.print(table)
    print("\n".join(line.rstrip() for line in captured.get().splitlines()))


def _cells(line: Line, row: Row) -> list[str]:
    cells = [
        row.case,
        f"{row.speed_kmh:g}",
        f"{row.limit_kmh:g}" if row.limit_kmh else "none",
        f"{row.impact_kmh:.1f} km/h" if row.impact_kmh else "-",
        "-" if row.min_gap_m is None else f"{row.min_gap_m:.2f} m",
        "-" if row.warning_s is None else f"{row.warning_s:.2f} s",
    ]
    if line.fault is not None:
        cells.append("-" if row.at_s is None else f"{row.at_s:.3f} s")
        cells.append("-" if row.instants is None else f"{row.instants}")
        cells.append(_lost(row))
    if line.outage_ms is not None:
        cells.append("-" if row.closed_form_kmh is None else f"{row.closed_form_kmh:.1f} km/h")
    verdict = "pass" if row.passed else "fail" if row.struck else "no fault"
    return [*cells, verdict + (f", {row.colour}" if row.colour else "")]


def _lost(row: Row) -> str:
    if row.loss_kmh:
        return f"{row.loss_kmh:.1f} km/h"
    return "-" if row.loss_m is None else f"{row.loss_m:.3f} m"


def _failures(line: Line, rows: Sequence[Row]) -> list[str]:
    """Each row that fails, with why; of an outage, also that it must."""
    failed = [row for row in rows if not row.passed]
    found = [f"{row.case}: {'; '.join(row.because)}" for row in failed]
    must = [f"{row.case}: {row.must_fail}" for row in failed if row.must_fail]
    if must:
        found += [f"{len(must)} of these must fail, since nothing stands in for the function:", *must]
    if line.outage_ms is not None and not failed:
        found.append(f"no row fails: {line.outage_ms} ms are less than what the function keeps in hand")
    return found


def _search(line: Line, rows: Sequence[Row]) -> list[str]:
    """How the worst instants were found."""
    if not line.searched:
        return []
    runs = sum(row.instants or 0 for row in rows)
    step = f"every {STEP_CYCLES * CYCLE_S:g} s and at each change of stage, then down to 1 ms"
    return [f"worst of {runs} instants: {step}"]


def _repeat(line: Line, rows: Sequence[Row]) -> list[str]:
    """The commands that repeat the row that lost most."""
    if line.fault is None:
        return []
    struck = [row for row in rows if row.struck]
    if not struck:
        return []
    worst = max(struck, key=lambda row: (not row.passed, row.loss_kmh or 0.0, row.loss_m or 0.0))
    return [f"{'repeat' if at == 0 else '      '}  {text}" for at, text in enumerate(worst.repeat)]
