"""Commands for a live run, from a second terminal: `aftbed status`, `ps`, `graph`, `stop`."""

import os
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer

from aftbed.cli.options import Json, Run, choices, print_blocks, print_json
from aftbed.cli.views import car_line, event_line, requests_line, sight_line
from aftbed.core.errors import ConfigError, shown, unknown
from aftbed.core.graph import PLACEMENTS, Graph
from aftbed.ftm.compose import build
from aftbed.runtime.unix import control_client, run_directory
from aftbed.runtime.unix.control_client import measured
from aftbed.runtime.unix.run_directory import EVENT_LOG_NAME
from aftbed.vehicle.can.bus_model import CHANNEL, HOST

EVENTS_SHOWN: Final = 8
EVENTS_BYTES: Final = 8192  # of the end of the log, in which they are


def status(run: Run = None, json: Json = False) -> None:
    """Show the state of a live run."""
    found = control_client.ask(run_directory.find(run), control_client.StatusQuery())
    if json:
        print_json(found)
    else:
        print_blocks(**_blocks(msgspec.convert(found, control_client.Status)))


def _blocks(status: control_client.Status) -> dict[str, list[str]]:
    """The status in lines, by the word before them."""
    adapting = ", adapting" if status.adapting else ""
    counted = f"{status.adaptations} adaptation{'s' if status.adaptations != 1 else ''}"
    blocks = {
        "run": [f"{status.run}, for {status.seconds:.1f} s"],
        "mechanism": [f"{status.ftm} ({status.placement}){adapting}, {counted}"],
        "roles": [status.roles],
    }
    if status.requests is not None:
        blocks["requests"] = [requests_line(status)]
    if status.vehicle is not None:
        blocks["car"] = [car_line(status.vehicle).strip()]
    if status.sees is not None:
        blocks["sees"] = [sight_line(status.sees).strip()]
    if status.port:
        blocks["bus"] = [f"{CHANNEL} at {HOST}:{status.port}, for clients of socketcand"]
    if status.busy:
        blocks["busy"] = [", ".join(status.busy)]
    return blocks | {"record": [status.record], "events": _last_events(Path(status.record))}


def _last_events(record: Path) -> list[str]:
    """The last lines of the event log, as `aftbed run` prints them."""
    try:
        with (record / EVENT_LOG_NAME).open("rb") as file:
            begin = file.seek(max(0, os.fstat(file.fileno()).st_size - EVENTS_BYTES))
            *lines, _ = file.read().split(b"\n")
    except OSError:  # it has ended meanwhile
        return []
    whole = lines[1:] if begin else lines
    return [shown(event_line(msgspec.json.decode(line))) for line in whole[-EVENTS_SHOWN:]]


def ps(run: Run = None, json: Json = False) -> None:
    """The processes of a live run: name, role, pid, CPU, memory (PSS)."""
    rows = measured(control_client.processes(run_directory.find(run)))
    if json:
        print_json(rows)
        return
    print(f"{'NAME':14} {'ROLE':10} {'PID':>7} {'CPU%':>6} {'PSS MB':>7}")
    for row in rows:
        mark = "" if row.node else "  (beside)"
        print(f"{row.name:14} {row.role:10} {row.pid:>7} {row.cpu_percent:>6.1f} {row.pss_mb:>7.1f}{mark}")
    nodes_mb = [row.pss_mb for row in rows if row.node]
    print(f"{len(nodes_mb)} processes, {sum(nodes_mb):.1f} MB; {len(rows) - len(nodes_mb)} beside")


def stop(run: Run = None, json: Json = False) -> None:
    """End a live run; its command prints the verdict so far."""
    private = run_directory.find(run)
    control_client.ask(private, control_client.StopCommand())
    if json:
        print_json({"run": private.name, "stopping": True})
    else:
        print(f"run {private.name}: stopping")


# -- graph ----------------------------------------------------------------------------------------


def graph(
    ftm: Annotated[str | None, typer.Option(help="Show this FTM's graph; without it, a live run's.")] = None,
    placement: Annotated[
        str, typer.Option(metavar=choices(PLACEMENTS), help="With --ftm: which bricks share a process.")
    ] = "process",
    style: Annotated[
        str,
        typer.Option(
            "--format", metavar="<text|dot|mermaid>", help="Of Graphviz, or for a page in Markdown."
        ),
    ] = "text",
    run: Run = None,
    json: Json = False,
) -> None:
    """The bricks, their channels and their nodes."""
    if json and style != "text":
        raise ConfigError(f"--json and --format {style}: one of them is allowed")
    if style not in FORMATS:
        raise unknown("format", style, FORMATS)
    if ftm is not None:
        shown = build(ftm, placement)
    else:
        shown = msgspec.convert(
            control_client.ask(run_directory.find(run), control_client.GraphQuery()), Graph
        )
    if json:
        print_json(shown)
    else:
        print(FORMATS[style](shown))


def _text(graph: Graph) -> str:
    lines = [f"ftm {graph.ftm}, placement {graph.placement}: {len(graph.nodes)} nodes"]
    for node, bricks in graph.nodes.items():
        kinds = ", ".join(f"{b} ({graph.brick(b).kind})" for b in bricks)
        lines.append(f"node {node}: {kinds}")
    for link in graph.links:
        standby = "  (standby)" if link.standby else ""
        lines.append(f"{link.name:8} {link.source} -> {link.sink}{standby}")
    return "\n".join(lines)


def _dot(graph: Graph) -> str:
    lines = ["digraph aftbed {", "  rankdir=LR; node [shape=box];"]
    for index, (node, bricks) in enumerate(graph.nodes.items()):
        inside = " ".join(f'"{b}";' for b in bricks)
        lines.append(f'  subgraph cluster_{index} {{ label="{node}"; {inside} }}')
    for link in graph.links:
        style = ", style=dashed" if link.standby else ""
        lines.append(f'  "{link.source}" -> "{link.sink}" [label="{link.name}"{style}];')
    return "\n".join([*lines, "}"])


def _mermaid(graph: Graph) -> str:
    def name(brick: str) -> str:
        return brick.replace("/", "_")

    lines = ["flowchart LR"]
    for node, bricks in graph.nodes.items():
        lines.append(f"  subgraph node_{name(node)}[{node}]")
        lines += [f"    {name(b)}[{b}]" for b in bricks]
        lines.append("  end")
    for link in graph.links:
        arrow = "-.->" if link.standby else "-->"
        lines.append(f"  {name(link.source)} {arrow}|{link.name}| {name(link.sink)}")
    return "\n".join(lines)


FORMATS: Final = {"text": _text, "dot": _dot, "mermaid": _mermaid}
