"""`aftbed bench`: every number that the README quotes, with the command that makes it."""

from typing import Annotated, Final

import typer

from aftbed.cli.benchpaper import paper

bench = typer.Typer(
    help="Measure, each time beside the bare limit.", no_args_is_help=True, rich_markup_mode=None
)
REQUESTS_MIN: Final = 5000
KILLS_MIN: Final = 1

Ftm = Annotated[str, typer.Option(help="none, pbr, lfr, tr, pbr+tr, ...: aftbed ftm list.")]
Placement = Annotated[str, typer.Option(help="process, replica or single.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document.")]
Pin = Annotated[bool, typer.Option(help="Keep each replica's chain on one core.")]


@bench.command()
def cycle(
    ftm: Ftm = "pbr",
    placement: Placement = "process",
    requests: Annotated[int, typer.Option(min=100, help="After the warm-up.")] = REQUESTS_MIN,
    pin: Pin = True,
    json: Json = False,
) -> None:
    """Cycle time seen by the client, in turn with a bare ring of as many hops."""
    from aftbed.bench.cycle import bench_cycle  # noqa: PLC0415

    _print(bench_cycle(ftm, placement, requests, pin=pin), as_json=json)


@bench.command()
def recovery(
    ftm: Ftm = "pbr",
    placement: Placement = "process",
    kills: Annotated[int, typer.Option(min=KILLS_MIN, help="Of the primary.")] = 50,
    pin: Pin = True,
    json: Json = False,
) -> None:
    """From SIGKILL of the primary to the next good reply, by its parts."""
    from aftbed.bench.recovery import bench_recovery  # noqa: PLC0415
    from aftbed.core.errors import ConfigError  # noqa: PLC0415
    from aftbed.ftm.compose import DUPLEX, replication_of  # noqa: PLC0415

    if not replication_of(ftm):
        raise ConfigError(
            f"--ftm {ftm}: one replica does not recover; {' and '.join(DUPLEX)} do, and X+Y of them"
        )
    if placement == "single":
        raise ConfigError(
            "--placement single: both replicas die with their node; process and replica are allowed"
        )
    _print(bench_recovery(ftm, placement, kills, pin=pin), as_json=json)


@bench.command()
def adapt(
    old: Annotated[str, typer.Option("--from", help="What runs first.")] = "pbr",
    new: Annotated[str, typer.Option("--to", help="What it becomes.")] = "pbr+tr",
    placement: Placement = "process",
    recipe: Annotated[
        str, typer.Option(help="drained, or paper: SIGSTOP, kill, launch, link, SIGCONT.")
    ] = "drained",
    adaptations: Annotated[int, typer.Option(min=1, help="There; as many lead back.")] = 50,
    pin: Pin = True,
    json: Json = False,
) -> None:
    """Adaptations there and back under load: what the client feels, and what is lost."""
    from aftbed.bench.adapt import bench_adapt  # noqa: PLC0415

    _print(bench_adapt(old, new, placement, recipe, adaptations, pin=pin), as_json=json)


@bench.command()
def launch(
    ftm: Ftm = "pbr",
    placement: Placement = "process",
    runs: Annotated[int, typer.Option(min=1)] = 10,
    json: Json = False,
) -> None:
    """From the start of `aftbed run` to the first reply; and the graph alone, from a warm zygote."""
    from aftbed.bench.launch import bench_launch  # noqa: PLC0415

    _print(bench_launch(ftm, placement, runs), as_json=json)


@bench.command()
def memory(ftm: Ftm = "pbr", placement: Placement = "process", json: Json = False) -> None:
    """PSS and RSS of the graph's processes, and of all others apart."""
    from aftbed.bench.memory import bench_memory  # noqa: PLC0415

    _print(bench_memory(ftm, placement), as_json=json)


@bench.command()
def campaign(
    ftm: Ftm = "pbr",
    placement: Placement = "process",
    sim: Annotated[bool, typer.Option("--sim", help="In the simulator.")] = False,
    experiments: Annotated[int, typer.Option(min=1, help="Each with a crash of the primary.")] = 400,
    jobs: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = 2,
    json: Json = False,
) -> None:
    """Experiments per minute: 100 requests and one crash each, verdict included."""
    from aftbed.bench.campaign import bench_campaign  # noqa: PLC0415

    _print(bench_campaign(ftm, placement, "sim" if sim else "unix", experiments, jobs), as_json=json)


@bench.command()
def hops(
    ftm: Ftm = "pbr",
    requests: Annotated[int, typer.Option(min=100, help="After the warm-up.")] = REQUESTS_MIN,
    pin: Pin = True,
    json: Json = False,
) -> None:
    """The delay of one hop between two bricks in processes of their own, as a distribution."""
    import msgspec  # noqa: PLC0415

    from aftbed.bench.hops import bench_hops  # noqa: PLC0415

    found = bench_hops(ftm, requests, pin=pin)
    if json:
        _print(msgspec.to_builtins(found), as_json=True)
        return
    _print({"ftm": found.ftm, "requests": found.requests, "samples": found.samples}, as_json=False)
    for name, delay_ns in found.hop_ns.items():
        print(f"{name:14} {delay_ns / 1e3:9.2f} us")
    for pair in (*found.pairs, *found.beside):
        apart = "  (not used: sends more)" if pair in found.beside else ""
        print(f"p50 {pair.p50_ns / 1e3:9.2f} us  {pair.source} -> {pair.sink}{apart}")


bench.command()(paper)


def _print(found: dict[str, object], *, as_json: bool) -> None:
    import json  # noqa: PLC0415

    if as_json:
        print(json.dumps(found))
        return
    for key, value in found.items():
        parts = value.items() if isinstance(value, dict) else [("", value)]
        print(f"{key:14} " + "  ".join(f"{name} {part}".strip() for name, part in parts))
