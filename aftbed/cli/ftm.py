"""`aftbed ftm`: what each mechanism tolerates and needs, and which one suits (FT, A and R; design 4).

`check` compares with what is asked for (`--faults`), what the protected function declares (`--app`) and what
there is: CPUs and their load are measured where they are not given. The bandwidth between two replicas on
one host is that of its memory, so nothing limits it unless it is given.
"""

from typing import TYPE_CHECKING, Annotated, Final

import typer

if TYPE_CHECKING:
    from aftbed.adapt.suitability import Demand, Resources, Table
    from aftbed.core.application import Characteristics
    from aftbed.core.graph import Graph

ftm = typer.Typer(
    help="What each mechanism tolerates and needs, and which one suits.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
EXIT_INCONSISTENT: Final = 1
CPUS_MAX: Final = 1024
BANDWIDTH_KBIT_S_MAX: Final = 1e9
SAMPLE_SECONDS: Final = 0.2  # of the CPU load
COLUMNS: Final = ("DETERMINISTIC", "STATE ACCESS", "CPUS", "CPU LOAD", "BANDWIDTH", "PROCESSES")
NO_FTM: Final = "no consistent FTM"

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
TableOption = Annotated[
    str | None, typer.Option("--table", help="YAML file whose rows take the place of the shipped ones.")
]


@ftm.command("list")
def list_(table: TableOption = None, json: Json = False) -> None:
    """Every FTM expression: what it tolerates and needs, and how many processes it takes."""
    from aftbed.adapt.suitability import demand  # noqa: PLC0415
    from aftbed.ftm.compose import EXPRESSIONS, build  # noqa: PLC0415

    rules = _table(table)
    found = [(demand(name, rules), build(name, "process")) for name in EXPRESSIONS]
    if json:
        _print_json([_summary(*one) for one in found])
        return
    line = "{:<12}{:<28}{:<15}{:<14}{:>4}  {:<10}{:<11}{:>9}".format
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
    from aftbed.adapt.suitability import demand  # noqa: PLC0415
    from aftbed.ftm.compose import build  # noqa: PLC0415

    wanted, graph = demand(expr, _table(table)), build(expr, "process")
    if json:
        bricks = [{"name": brick.name, "kind": brick.kind} for brick in graph.bricks]
        channels = [{"name": k.name, "source": k.source, "sink": k.sink} for k in graph.links]
        _print_json({**_summary(wanted, graph), "bricks": bricks, "channels": channels})
        return
    _print_block("tolerates", [", ".join(wanted.tolerates) or "nothing"])
    if set(wanted.detects) - set(wanted.tolerates):
        _print_block("detects", [", ".join(wanted.detects)])
    _print_block("needs", [*wanted.deterministic, *wanted.state_access] or ["nothing of the function"])
    bandwidth = "no" if wanted.bandwidth == "none" else wanted.bandwidth
    _print_block("takes", [f"{_cpus(wanted.cpus)}, {wanted.cpu_load} CPU load, {bandwidth} bandwidth"])
    _print_block("processes", [f"{_processes(graph)}, one per brick and the supervisor"])
    _print_block("bricks", _bricks(graph))
    _print_block("channels", _channels(graph))


@ftm.command()
def check(
    expression: Annotated[str | None, typer.Option("--ftm", help="The one to judge; else all.")] = None,
    faults: Annotated[
        str, typer.Option(help="To be tolerated: crash, value, implausible, separated by commas; or none.")
    ] = "crash",
    app: Annotated[
        str | None, typer.Option(help="The protected function, as MODULE:CLASS or FILE.py:CLASS.")
    ] = None,
    cpus: Annotated[int | None, typer.Option(help="Else those that this process may use.")] = None,
    cpu_load: Annotated[float | None, typer.Option(help="0 to 1; else as measured.")] = None,
    bandwidth: Annotated[
        float | None, typer.Option(help="kbit/s between the replicas; else not limited.")
    ] = None,
    table: TableOption = None,
    json: Json = False,
) -> None:
    """Whether an FTM suits the faults, the function and the resources; and which ones would.

    Exit code: 0 consistent, 1 not consistent, 2 usage.
    """
    from aftbed.adapt.suitability import consistent, fault_model, problems, remarks  # noqa: PLC0415

    model, rules = fault_model(faults), _table(table)
    declared, resources = _declared(app), _resources(cpus, cpu_load, bandwidth)
    others = consistent(model, declared, resources, rules)
    found = [] if expression is None else problems(expression, model, declared, resources, rules)
    notes = [] if expression is None or found else remarks(expression, declared)
    suits = bool(others) if expression is None else not found
    if json:
        judged = {"problems": found, "remarks": notes, "consistent_ftms": others}
        given = {"faults": model.asked(), "app": app, "characteristics": declared, "resources": resources}
        _print_json({"ftm": expression, "consistent": suits, **judged, **given})
    else:
        _print_block("faults", [", ".join(model.asked()) or "none"])
        _print_block("function", [_function(declared, app)])
        _print_block("resources", [_machine(resources)])
        _print_verdict(expression, found, notes, others)
    if not suits:
        raise typer.Exit(EXIT_INCONSISTENT)


def _print_verdict(expression: str | None, found: list[str], notes: list[str], others: list[str]) -> None:
    """The reasons, and in the last line the answer."""
    _print_block("because", found)
    _print_block("remark", notes)
    would_do = f"consistent: {', '.join(others)}" if others else NO_FTM
    if expression is None:
        print(would_do)
    else:
        print(f"{expression} is not consistent; {would_do}" if found else f"{expression} is consistent")


def _table(path: str | None) -> "Table":
    from pathlib import Path  # noqa: PLC0415

    from aftbed.adapt.suitability import TABLE, TableFile, table_from  # noqa: PLC0415

    if path is None:
        return TABLE
    from aftbed.vehicle.yamlfile import read_yaml  # noqa: PLC0415 - PyYAML costs 15 ms

    return table_from(read_yaml(Path(path), TableFile), path)


def _declared(app: str | None) -> "Characteristics":
    """What the function says of itself."""
    from aftbed.adapt.bricks import load_application  # noqa: PLC0415
    from aftbed.core.application import Characteristics  # noqa: PLC0415
    from aftbed.core.errors import ConfigError  # noqa: PLC0415
    from aftbed.runtime.unix.part import load_module  # noqa: PLC0415
    from aftbed.vehicle.aeb.function import default_application  # noqa: PLC0415

    if app is None:
        return default_application().characteristics
    found: object = getattr(load_application(app, load_module), "characteristics", None)
    if not isinstance(found, Characteristics):
        kind = type(found).__name__
        raise ConfigError(f"--app {app}: its characteristics are a {kind}, allowed is a Characteristics")
    return found


def _resources(cpus: int | None, cpu_load: float | None, bandwidth: float | None) -> "Resources":
    """What was given, and what is measured for the rest."""
    from aftbed.adapt.suitability import Resources  # noqa: PLC0415
    from aftbed.core.errors import ConfigError  # noqa: PLC0415

    if cpus is not None and not 1 <= cpus <= CPUS_MAX:
        raise ConfigError(f"--cpus {cpus}: 1 to {CPUS_MAX} are allowed")
    if cpu_load is not None and not 0.0 <= cpu_load <= 1.0:
        raise ConfigError(f"--cpu-load {cpu_load:g}: 0 to 1 is allowed")
    if bandwidth is not None and not 0.0 <= bandwidth <= BANDWIDTH_KBIT_S_MAX:
        raise ConfigError(f"--bandwidth {bandwidth:g}: 0 to {BANDWIDTH_KBIT_S_MAX:g} kbit/s are allowed")
    if cpus is not None and cpu_load is not None:
        return Resources(cpus, cpu_load, bandwidth)
    import psutil  # noqa: PLC0415 - 15 ms that nobody else needs

    measured = len(psutil.Process().cpu_affinity()) if cpus is None else cpus
    load = psutil.cpu_percent(SAMPLE_SECONDS) / 100 if cpu_load is None else cpu_load
    return Resources(measured, load, bandwidth)


def _summary(wanted: "Demand", graph: "Graph") -> dict[str, object]:
    """An expression as it stands in a JSON document."""
    return {
        "ftm": wanted.ftm,
        "tolerates": wanted.tolerates,
        "detects": wanted.detects,
        "needs": {"deterministic": wanted.deterministic, "state_access": wanted.state_access},
        "cpus": wanted.cpus,
        "cpu_load": wanted.cpu_load,
        "bandwidth": wanted.bandwidth,
        "processes": _processes(graph),
    }


def _processes(graph: "Graph") -> int:
    """As the paper counts them: the nodes, and the supervisor in the place of the ROS master."""
    return len(graph.nodes) + 1


def _bricks(graph: "Graph") -> list[str]:
    """By place: those beside the replicas, and those of each replica."""
    places: dict[str, list[str]] = {}
    for brick in graph.bricks:
        places.setdefault(brick.replica or "beside", []).append(brick.part)
    return [f"{place}: {', '.join(parts)}" for place, parts in places.items()]


def _channels(graph: "Graph") -> list[str]:
    """All but those inside of the second replica, which are as those of the first."""
    second = max((brick.replica for brick in graph.bricks if brick.replica), default="")
    first = min((brick.replica for brick in graph.bricks if brick.replica), default="")
    hidden = f"{second}/" if first != second else "/"
    return [
        f"{k.name:<8} {k.source} -> {k.sink}"
        for k in graph.links
        if not (k.source.startswith(hidden) and k.sink.startswith(hidden)) and not k.standby
    ]


def _function(declared: "Characteristics", app: str | None) -> str:
    determinism = "deterministic" if declared.deterministic else "not deterministic"
    access = "state access" if declared.state_access else "no state access"
    return f"{determinism}, {access} ({app or 'the brake function'})"


def _machine(resources: "Resources") -> str:
    bandwidth = resources.bandwidth_kbit_s
    limit = "bandwidth not limited" if bandwidth is None else f"{bandwidth:g} kbit/s"
    return f"{_cpus(resources.cpus)}, load {resources.cpu_load:.0%}, {limit}"


def _cpus(count: int) -> str:
    return "1 CPU" if count == 1 else f"{count} CPUs"


def _print_block(head: str, lines: list[str]) -> None:
    for index, line in enumerate(lines):
        print(f"{'' if index else head:<10} {line}")


def _print_json(found: object) -> None:
    import msgspec  # noqa: PLC0415

    print(msgspec.json.encode(found).decode())
