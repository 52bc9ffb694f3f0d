"""`aftbed scenario`: the drives and the published tables whose rows are drives.

`scenario run` forks the supervisor, as `aftbed run` does: `table`, `ftti` and `import` are modules of
their own.
"""

from typing import Annotated, Final

import typer

from aftbed.cli.lazy import CommandTable, group_of
from aftbed.cli.options import VERIFIES, VERIFIES_HELP, Ftm, Json, Junit, Seed, print_json
from aftbed.cli.run import Pace, Placement, RunArguments, execute
from aftbed.vehicle.plant import KMH_PER_MS, LeadCar
from aftbed.vehicle.scenarios import tables
from aftbed.vehicle.scenarios.library import load_scenario, scenario_names
from aftbed.vehicle.scenarios.scenario import Scenario

SUBCOMMANDS: Final[CommandTable] = {
    "table": (
        "scenario_table:table",
        "Drive a whole table on the simulator, without a fault or with one at its worst.",
    ),
    "ftti": (
        "scenario_ftti:ftti",
        "Measure how long a fault of the function may last before the row is broken, at the worst instant.",
    ),
    "import": (
        "scenario_import:import_",
        "Make scenario files of OpenSCENARIO 1.0 to 1.3 files; all of a file or nothing.",
    ),
}

scenario = typer.Typer(cls=group_of(SUBCOMMANDS, "scenario"))

Name = Annotated[str, typer.Argument(help="A scenario, a row of a table (r152:m1-60), or a YAML file.")]


# -- list, show -----------------------------------------------------------------------------------


@scenario.command("list")
def list_(json: Json = False) -> None:
    """The scenarios that are shipped, and the tables with their groups."""
    scenarios = {name: load_scenario(name).description for name in scenario_names()}
    groups = {
        name: {group: len(tables.cases(name, group)) for group in tables.group_names(name)}
        for name in tables.table_names()
    }
    if json:
        listed = [{"table": name, "title": tables.title(name), "groups": groups[name]} for name in groups]
        print_json({"scenarios": scenarios, "tables": listed})
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


@scenario.command()
def show(name: Name, json: Json = False) -> None:
    """How a drive begins, and what its outcome must be."""
    drive, case = load_scenario(name), _case(name)
    if json:
        print_json({"scenario": drive, "row": case})
        return
    lines = [
        ("ego", f"{drive.plant.speed_ms * KMH_PER_MS:.1f} km/h"),
        ("ahead", _ahead(drive.plant.lead)),
        ("road", f"friction {drive.plant.friction:g}"),
        ("lasts", _lasts(drive)),
        ("expected", _expected(drive)),
    ]
    if case is not None:
        lines += [
            ("row of", f"{case.table}, {case.group}"),
            ("demands", _demands(case)),
            ("source", case.source),
        ]
    print(f"{drive.name}: {drive.description}")
    print("\n".join(f"  {head:<9}{text}" for head, text in lines))


def _case(name: str) -> tables.Case | None:
    table = name.partition(tables.SEPARATOR)[0]
    if table not in tables.table_names():
        return None
    return next((case for case in tables.cases(table) if case.name == name), None)


def _ahead(lead: LeadCar | None) -> str:
    if lead is None:
        return "an empty road"
    words = [f"a car {lead.gap_m:.1f} m ahead at {lead.speed_ms * KMH_PER_MS:.1f} km/h"]
    if lead.braking is not None:
        after_s = lead.braking.after_ms / 1000
        final_kmh = lead.braking.final_ms * KMH_PER_MS
        final = f" to {final_kmh:g} km/h" if final_kmh else ""
        words.append(f"brakes at {lead.braking.deceleration_ms2:g} m/s2{final} after {after_s:g} s")
    for one in lead.speeds:
        change = f"goes to {one.final_ms * KMH_PER_MS:.1f} km/h at {one.rate_ms2:g} m/s2"
        words.append(f"{change} after {one.after_ms / 1000:g} s")
    if lead.cut_in is not None:
        words.append(f"cuts in after {lead.cut_in.after_ms / 1000:g} s")
    elif lead.lateral_m:
        words.append(f"{abs(lead.lateral_m):g} m beside our lane's middle")
    return ", ".join(words)


def _lasts(scenario: Scenario) -> str:
    words, end = [f"{scenario.duration_ms / 1000:g} s at most"], scenario.slow_end
    if end is not None:
        if end.below_ms is not None:
            words.append(f"slower than {end.below_ms * KMH_PER_MS:g} km/h")
        if end.below_lead_ms is not None:
            by = f"{end.below_lead_ms * KMH_PER_MS:g} km/h " if end.below_lead_ms else ""
            words.append(f"{by}slower than the car ahead")
        words[1:] = [f"until {end.after_ms / 1000:g} s after the car is {' or '.join(words[1:])}"]
    return ", ".join(words)


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


# -- run ------------------------------------------------------------------------------------------


@scenario.command()
def run(
    name: Name,
    ftm: Ftm = "pbr",
    placement: Placement = "process",
    pace: Pace = None,
    seed: Seed = 0,
    faults: Annotated[
        list[str] | None, typer.Option("--inject", help='E.g. "crash primary at server.enter nth 100".')
    ] = None,
    verifies: Annotated[list[str] | None, typer.Option(VERIFIES, help=VERIFIES_HELP)] = None,
    junit: Junit = None,
    json: Json = False,
) -> None:
    """Drive it on real processes: `aftbed run --scenario NAME`, which has more options.

    Exit code: 0 pass, 1 a promise was broken, 2 usage, 3 inconclusive, 130 interrupted and cleaned.
    """
    raise typer.Exit(
        execute(
            RunArguments(
                ftm,
                name,
                placement=placement,
                pace=pace,
                seed=seed,
                faults=tuple(faults or ()),
                verifies=tuple(verifies or ()),
                junit=junit,
                json=json,
            )
        )
    )
