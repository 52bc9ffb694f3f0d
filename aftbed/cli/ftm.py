"""`aftbed ftm`: what each mechanism tolerates and needs, and which one suits.

`check` compares the mechanism with the faults (`--faults`), with what the protected function declares
(`--app`) and with the resources: CPUs and their load are measured unless they are given. The bandwidth
between two replicas on one host is that of its memory, so it is unlimited unless it is given.
"""

from pathlib import Path
from typing import Annotated, Final

import psutil
import typer

from aftbed.adapt.suitability import (
    FAULTS,
    TABLE,
    Demand,
    Resources,
    SuitabilityTable,
    TableFile,
    consistent,
    demand,
    fault_model,
    problems,
    remarks,
    table_from,
)
from aftbed.cli.lazy import CommandTable, group_of
from aftbed.cli.options import Json, check_range, note_unusable, print_blocks, print_json
from aftbed.core.application import NONE
from aftbed.core.errors import ConfigError
from aftbed.core.graph import Graph
from aftbed.core.yaml_file import in_file, read_yaml
from aftbed.ftm.compose import build, expressions
from aftbed.functions.source import located
from aftbed.judge.isolated import declared_by
from aftbed.runtime.unix.trust import OWN_RUN
from aftbed.vehicle.aeb.function import default_application

SUBCOMMANDS: Final[CommandTable] = {
    "resilience": (
        "ftm_resilience:resilience_",
        "Which changes of FT, A and R a set of mechanisms answers: by staying, by an adaptation, by nothing.",
    ),
}
ftm = typer.Typer(cls=group_of(SUBCOMMANDS, "ftm"))
EXIT_INCONSISTENT: Final = 1
CPUS_MAX: Final = 1024
BANDWIDTH_KBIT_S_MAX: Final = 1e9
SAMPLE_SECONDS: Final = 0.2  # of the CPU load
COLUMNS: Final = ("DETERMINISTIC", "STATE ACCESS", "CPUS", "CPU LOAD", "BANDWIDTH", "PROCESSES")
NO_FTM: Final = "no consistent FTM"

TableOption = Annotated[
    str | None, typer.Option("--table", help="YAML file whose rows replace the shipped ones.")
]


def table_of(path: str | None) -> SuitabilityTable:
    """What `--table` means. Raises ConfigError."""
    if path is None:
        return TABLE
    file = read_yaml(Path(path), TableFile)
    with in_file(Path(path)):
        return table_from(file)


@ftm.command("list")
def list_(table: TableOption = None, json: Json = False) -> None:
    """Every FTM expression: what it tolerates and needs, and how many processes it takes."""
    rules = table_of(table)
    found = [(demand(name, rules), build(name, "process")) for name in expressions()]
    note_unusable()
    if json:
        print_json([_summary(*one) for one in found])
        return
    width = max(12, *(len(wanted.ftm) + 2 for wanted, _ in found))
    line = f"{{:<{width}}}{{:<28}}{{:<15}}{{:<14}}{{:>4}}  {{:<10}}{{:<11}}{{:>9}}".format
    print(line("FTM", "TOLERATES", *COLUMNS))
    for wanted, graph in found:
        needs = ("needed" if sentences else "-" for sentences in (wanted.deterministic, wanted.state_access))
        faults = ", ".join(wanted.tolerates) or "-"
        resources = (wanted.cpus, wanted.cpu_load, wanted.bandwidth)
        print(line(wanted.ftm, faults, *needs, *resources, _processes(graph)))


@ftm.command()
def show(
    expr: Annotated[str, typer.Argument(help="As lfr+tr: the outermost mechanism first.")],
    table: TableOption = None,
    json: Json = False,
) -> None:
    """One FTM expression: what it tolerates and needs, its bricks and its channels."""
    wanted, graph = demand(expr, table_of(table)), build(expr, "process")
    if json:
        bricks = [{"name": brick.name, "kind": brick.kind} for brick in graph.bricks]
        channels = [{"name": k.name, "source": k.source, "sink": k.sink} for k in graph.links]
        print_json({**_summary(wanted, graph), "bricks": bricks, "channels": channels})
        return
    bandwidth = "no" if wanted.bandwidth == "none" else wanted.bandwidth
    print_blocks(
        tolerates=[", ".join(wanted.tolerates) or "nothing"],
        detects=[", ".join(wanted.detects)] if set(wanted.detects) - set(wanted.tolerates) else [],
        needs=[*wanted.deterministic, *wanted.state_access, *wanted.exact_state]
        or ["nothing of the function"],
        takes=[f"{_cpus(wanted.cpus)}, {wanted.cpu_load} CPU load, {bandwidth} bandwidth"],
        processes=[f"{_processes(graph)}, one per brick and the supervisor"],
        bricks=_bricks(graph),
        channels=_channels(graph),
    )


@ftm.command()
def check(
    expression: Annotated[
        str | None, typer.Option("--ftm", help="The FTM to judge; all of them if left out.")
    ] = None,
    faults: Annotated[
        str, typer.Option(help=f"To be tolerated: {', '.join(FAULTS)}, separated by commas; or none.")
    ] = "crash",
    app: Annotated[
        str | None, typer.Option(help="The protected function, as MODULE:CLASS or FILE.py:CLASS.")
    ] = None,
    cpus: Annotated[int | None, typer.Option(help="CPUs that this process may use, if left out.")] = None,
    cpu_load: Annotated[float | None, typer.Option(help="0 to 1; measured if left out.")] = None,
    bandwidth: Annotated[
        float | None, typer.Option(help="kbit/s between the replicas; unlimited if left out.")
    ] = None,
    table: TableOption = None,
    json: Json = False,
) -> None:
    """Whether an FTM suits the faults, the function and the resources; and which ones would.

    Exit code: 0 consistent, 1 not consistent, 2 usage.
    """
    model, rules = fault_model(faults), table_of(table)
    built_in = default_application().characteristics
    declared = built_in if app is None else declared_by(located(app), OWN_RUN)
    resources = _resources(cpus, cpu_load, bandwidth)
    note_unusable()
    others = consistent(model, declared, resources, rules)
    found = [] if expression is None else problems(expression, model, declared, resources, rules)
    notes = [] if expression is None or found else remarks(expression, declared)
    suits = bool(others) if expression is None else not found
    if json:
        judged = {"problems": found, "remarks": notes, "consistent_ftms": others}
        given = {"faults": model.asked(), "app": app, "characteristics": declared.told()}
        print_json({"ftm": expression, "consistent": suits, **judged, **given, "resources": resources})
    else:
        determinism = "deterministic" if declared.deterministic else "not deterministic"
        state_access = declared.state_access
        access = "no state access" if state_access == NONE else f"{state_access} state access"
        kbit_s = resources.bandwidth_kbit_s
        limit = "bandwidth not limited" if kbit_s is None else f"{kbit_s:g} kbit/s"
        print_blocks(
            faults=[", ".join(model.asked()) or "none"],
            function=[f"{determinism}, {access} ({app or 'the brake function'})"],
            resources=[f"{_cpus(resources.cpus)}, load {resources.cpu_load:.0%}, {limit}"],
            because=found,
            remark=notes,
        )
        would_do = f"consistent: {', '.join(others)}" if others else NO_FTM
        if expression is None:
            print(would_do)
        else:
            print(f"{expression} is not consistent; {would_do}" if found else f"{expression} is consistent")
    if not suits:
        raise typer.Exit(EXIT_INCONSISTENT)


def _resources(cpus: int | None, cpu_load: float | None, bandwidth: float | None) -> Resources:
    """The resources that are given; the others are measured."""
    if cpus is not None:
        check_range("--cpus", cpus, 1, CPUS_MAX)
    if cpu_load is not None and not 0.0 <= cpu_load <= 1.0:
        raise ConfigError(f"--cpu-load {cpu_load:g}: 0 to 1 is allowed")
    if bandwidth is not None and not 0.0 <= bandwidth <= BANDWIDTH_KBIT_S_MAX:
        raise ConfigError(f"--bandwidth {bandwidth:g}: 0 to {BANDWIDTH_KBIT_S_MAX:g} kbit/s are allowed")
    if cpus is not None and cpu_load is not None:
        return Resources(cpus, cpu_load, bandwidth)
    measured = len(psutil.Process().cpu_affinity()) if cpus is None else cpus
    load = psutil.cpu_percent(SAMPLE_SECONDS) / 100 if cpu_load is None else cpu_load
    return Resources(measured, load, bandwidth)


def _summary(wanted: Demand, graph: Graph) -> dict[str, object]:
    """One expression in the document of --json."""
    return {
        "ftm": wanted.ftm,
        "tolerates": wanted.tolerates,
        "detects": wanted.detects,
        "needs": {
            "deterministic": wanted.deterministic,
            "state_access": wanted.state_access,
            "exact_state": wanted.exact_state,
        },
        "cpus": wanted.cpus,
        "cpu_load": wanted.cpu_load,
        "bandwidth": wanted.bandwidth,
        "processes": _processes(graph),
    }


def _processes(graph: Graph) -> int:
    """The count of the paper: the nodes, and the supervisor instead of the ROS master."""
    return len(graph.nodes) + 1


def _bricks(graph: Graph) -> list[str]:
    """The bricks of each replica, and those beside the replicas."""
    places: dict[str, list[str]] = {}
    for brick in graph.bricks:
        places.setdefault(brick.replica or "beside", []).append(brick.part)
    return [f"{place}: {', '.join(parts)}" for place, parts in places.items()]


def _channels(graph: Graph) -> list[str]:
    """All channels except those inside the second replica, which equal those inside the first."""
    second = max((brick.replica for brick in graph.bricks if brick.replica), default="")
    first = min((brick.replica for brick in graph.bricks if brick.replica), default="")
    hidden = f"{second}/" if first != second else "/"
    return [
        f"{k.name:<8} {k.source} -> {k.sink}"
        for k in graph.links
        if not (k.source.startswith(hidden) and k.sink.startswith(hidden)) and not k.standby
    ]


def _cpus(count: int) -> str:
    return "1 CPU" if count == 1 else f"{count} CPUs"
