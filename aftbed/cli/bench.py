"""`aftbed bench`: measure the figures of docs/ and the README, each beside its bare limit.

The processes that are measured are forked from this one. So what only some figures need (campaigns, plots) is
imported where it is used.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
import typer

from aftbed.bench import ballast
from aftbed.bench.adaptation import bench_adapt
from aftbed.bench.cycle import CYCLE_ROUNDS, CYCLES, CycleRun, bench_cycle, bench_cycle_beside, bench_hops
from aftbed.bench.recovery import bench_recovery
from aftbed.bench.resources import START_RUNS, bench_launch, bench_memory
from aftbed.bench.rounds import ROUNDS, SHORT_ROUNDS, text
from aftbed.cli.interrupted import told_if_interrupted
from aftbed.cli.options import App, Ftm, Json, Recipe, check_range, choices, print_json
from aftbed.cli.parsing import PlainGroup
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.graph import PLACEMENTS
from aftbed.ftm.compose import DUPLEX, canonical, replication_of
from aftbed.functions.load import OWN_CODE
from aftbed.functions.request_file import located_requests, requests_from
from aftbed.functions.source import located
from aftbed.report.progress import ProgressLine

bench = typer.Typer(cls=PlainGroup)
SENT_FUNCTION: Final = 512  # requests of MODULE:FUNCTION, sent in turn
KILLS_MIN: Final = 1

Placement = Annotated[str, typer.Option(metavar=choices(PLACEMENTS), help="Which bricks share a process.")]
Rounds = Annotated[
    int, typer.Option(min=1, help=f"Of figure and limit in turn; below {ROUNDS} they are too few to quote.")
]
Count = Annotated[int, typer.Option(min=100, help="Requests after the warm-up.")]
Pin = Annotated[bool, typer.Option(help="Keep each replica's chain on one core.")]


@bench.command()
def cycle(
    ftm: Ftm = "pbr",
    placement: Placement = "process",
    count: Count = CYCLES,
    app: App = None,
    requests: Annotated[
        str | None, typer.Option(help="What --app is sent: FILE (CSV, JSON lines) or MODULE:FUNCTION.")
    ] = None,
    beside: Annotated[
        str | None, typer.Option(help="A mechanism whose cycle is the limit in the place of the bare ring.")
    ] = None,
    beside_placement: Annotated[
        str | None,
        typer.Option(metavar=choices(PLACEMENTS), help="The placement of --beside, if it is another one."),
    ] = None,
    pin: Pin = True,
    rounds: Rounds = CYCLE_ROUNDS,
    json: Json = False,
) -> None:
    """Cycle time at the client, alternating with a bare ring of the same number of hops, or with --beside."""
    application, given = located(app) if app is not None else "", None
    if requests is not None:
        given = requests_from(located_requests(requests), SENT_FUNCTION, 0, OWN_CODE)
    ours = CycleRun(ftm, placement, pin, application, given)
    with _measuring("cycle", as_json=json) as progress:
        if beside is None and beside_placement is None:
            measure: Callable[..., msgspec.Struct] = partial(bench_cycle, ours)
        else:
            other = ours._replace(ftm=beside or ftm, placement=beside_placement or placement)
            measure = partial(bench_cycle_beside, ours, other)
        result = measure(count, rounds=rounds, show=progress.show)
    _print(result, as_json=json)


@bench.command()
def recovery(
    ftm: Ftm = "pbr",
    placement: Placement = "process",
    kills: Annotated[int, typer.Option(min=KILLS_MIN, help="How often the primary is killed.")] = 110,
    pin: Pin = True,
    rounds: Rounds = ROUNDS,
    json: Json = False,
) -> None:
    """From SIGKILL of the primary to the next good reply, by its parts; beside what the kernel takes."""
    if not replication_of(ftm):
        raise ConfigError(
            f"--ftm {ftm}: one replica does not recover; {' and '.join(DUPLEX)} do, and X+Y of them"
        )
    if placement == "single":
        raise ConfigError(
            "--placement single: both replicas die with their node; process and replica are allowed"
        )
    with _measuring("recovery", as_json=json) as progress:
        found = bench_recovery(ftm, placement, kills, pin=pin, rounds=rounds, show=progress.show)
    _print(found, as_json=json)


@bench.command()
def adapt(
    old: Annotated[str, typer.Option("--from", help="The first mechanism.")] = "pbr",
    new: Annotated[
        str, typer.Option("--to", help="The mechanism it is adapted to.", show_default="pbr+tr")
    ] = "",
    update: Annotated[
        int,
        typer.Option(
            metavar="<bytes>",
            show_default=False,
            help="In place of --to: update a function whose state has so many bytes.",
        ),
    ] = 0,
    placement: Placement = "process",
    recipe: Recipe = "drained",
    adaptations: Annotated[int, typer.Option(min=1, help="There; as many lead back.")] = 110,
    pin: Pin = True,
    rounds: Rounds = ROUNDS,
    json: Json = False,
) -> None:
    """Adaptations there and back under load: the blackout at the client, and what is lost."""
    if update and new:
        raise ConfigError(f"--to {new} --update {update}: one of them is allowed; an update keeps --from")
    if update:
        check_range("--update", update, ballast.SIZE_BYTES_MIN, ballast.SIZE_BYTES_MAX)
    new = old if update else new or "pbr+tr"
    if not update and canonical(old) == canonical(new):
        raise ConfigError(f"--from {old} --to {new}: the same mechanism; two different ones are allowed")
    with _measuring("adapt", as_json=json) as progress:
        found = bench_adapt(
            old,
            new,
            placement,
            recipe,
            adaptations,
            update_bytes=update,
            pin=pin,
            rounds=rounds,
            show=progress.show,
        )
    _print(found, as_json=json)


@bench.command()
def launch(
    ftm: Ftm = "pbr",
    placement: Placement = "process",
    runs: Annotated[int, typer.Option(min=1, help="Each is a round with its limit.")] = START_RUNS,
    json: Json = False,
) -> None:
    """From the start of `aftbed run` to the first reply, the graph alone, and the page of --help."""
    with _measuring("launch", as_json=json) as progress:
        found = bench_launch(ftm, placement, runs, progress.show)
    _print(found, as_json=json)


@bench.command()
def page(
    ftm: Ftm = "pbr",
    placement: Placement = "process",
    seconds: Annotated[float, typer.Option(min=0.1, help="Of each round, with a page and without.")] = 1.0,
    pin: Pin = True,
    rounds: Rounds = ROUNDS,
    json: Json = False,
) -> None:
    """Cycle time at the client while a live page reads the run, alternating with runs without a page."""
    from aftbed.bench.page import bench_page  # noqa: PLC0415 - see above

    _print(bench_page(ftm, placement, seconds, pin=pin, rounds=rounds), as_json=json)


@bench.command()
def memory(ftm: Ftm = "pbr", placement: Placement = "process", json: Json = False) -> None:
    """PSS and RSS of the graph's processes, and of all others apart."""
    with _measuring("memory", as_json=json) as progress:
        found = bench_memory(ftm, placement, progress.show)
    _print(found, as_json=json)


@bench.command()
def campaign(
    ftm: Ftm = "pbr",
    placement: Placement = "process",
    sim: Annotated[bool, typer.Option("--sim", help="In the simulator.")] = False,
    experiments: Annotated[int, typer.Option(min=1, help="Each with a crash of the primary.")] = 400,
    jobs: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = 2,
    rounds: Rounds = ROUNDS,
    json: Json = False,
) -> None:
    """Experiments per minute: 100 requests and one crash each, verdict included."""
    from aftbed.bench.campaign import bench_campaign  # noqa: PLC0415 - see above

    runtime: Literal["unix", "sim"] = "sim" if sim else "unix"
    with _measuring("campaign", as_json=json) as progress:
        found = bench_campaign(ftm, placement, runtime, experiments, jobs, rounds=rounds, show=progress.show)
    _print(found, as_json=json)


@bench.command()
def simulator(
    ftm: Ftm = "pbr",
    placement: Placement = "process",
    count: Annotated[int, typer.Option(min=100, help="Requests over all rounds.")] = 110_000,
    rounds: Rounds = SHORT_ROUNDS,
    json: Json = False,
) -> None:
    """Requests per second of one core in the simulator, beside a bare loop of as many calls."""
    from aftbed.bench.simulator import bench_simulator  # noqa: PLC0415 - see above

    with _measuring("simulator", as_json=json) as progress:
        found = bench_simulator(ftm, placement, count, rounds=rounds, show=progress.show)
    _print(found, as_json=json)


@bench.command()
def state(
    ftm: Ftm = "pbr",
    size: Annotated[int, typer.Option("--bytes", help="Of the state.")] = 1_000_000,
    beside: Annotated[int, typer.Option(help="Of the state that it is compared with.")] = 10_000,
    tells_changes: Annotated[
        bool, typer.Option("--tells-changes", help="The function knows what it has changed.")
    ] = False,
    rounds: Rounds = ROUNDS,
    json: Json = False,
) -> None:
    """The cycle under a large state beside a small one, a page of it changed; the blackout of an update."""
    from aftbed.bench.sweep import bench_state  # noqa: PLC0415 - see above

    check_range("--bytes", size, ballast.SIZE_BYTES_MIN, ballast.SIZE_BYTES_MAX)
    check_range("--beside", beside, ballast.SIZE_BYTES_MIN, ballast.SIZE_BYTES_MAX)
    with _measuring("state", as_json=json) as progress:
        found = bench_state(ftm, size, beside, tracked=tells_changes, rounds=rounds, show=progress.show)
    _print(found, as_json=json)


@bench.command()
def hops(
    ftm: Ftm = "pbr",
    count: Count = CYCLES,
    pin: Pin = True,
    rounds: Rounds = CYCLE_ROUNDS,
    json: Json = False,
) -> None:
    """The delay of one hop between two bricks in processes of their own, beside one of the bare ring."""
    with _measuring("hops", as_json=json) as progress:
        found = bench_hops(ftm, count, pin=pin, rounds=rounds, show=progress.show)
    if json:
        _print(found, as_json=True)
        return
    print(f"ftm            {found.ftm}\nrequests       {found.requests}\nsamples        {found.samples}")
    for name, delay_ns in found.hop_ns.items():
        print(f"{name:14} {delay_ns / 1e3:9.2f} us")
    for pair in (*found.pairs, *found.beside):
        apart = "  (not used: sends more)" if pair in found.beside else ""
        print(f"p50 {pair.p50_ns / 1e3:9.2f} us  {pair.source} -> {pair.sink}{apart}")
    print("\n".join(text({"limit": found.limit, "ratio": found.ratio, "machine": found.machine})))


@bench.command()
def soak(
    minutes: Annotated[float, typer.Option(help="How long the load lasts.")] = 30.0,
    rate: Annotated[float, typer.Option(help="Requests a second.")] = 500.0,
    crash_every: Annotated[float, typer.Option(help="Seconds between two crashes; 0: none.")] = 2.0,
    adapt_every: Annotated[float, typer.Option(help="Seconds between two adaptations; 0: none.")] = 5.0,
    placement: Placement = "process",
    record: Annotated[
        str | None, typer.Option(help="Keep the record of the run in this new directory.")
    ] = None,
    json: Json = False,
) -> None:
    """One long run with crashes and adaptations in turn: is all served right, and does anything grow?

    Exit code: 0 all was served right and each figure is flat, 1 not so, 3 the run was too short to tell.
    """
    from aftbed.bench import soak as endurance  # noqa: PLC0415 - the judge, see above
    from aftbed.judge.verdict import EXIT_CODES  # noqa: PLC0415 - the same

    plan = endurance.SoakPlan(minutes, rate, crash_every, adapt_every, placement, record)
    endurance.check(plan)
    kept = f"the record is kept in {record}" if record is not None else "nothing is kept"
    with told_if_interrupted(lambda: kept), _measuring("soak", "s", as_json=json) as progress:
        found = endurance.bench_soak(plan, progress.step, progress.show)
    if json:
        print_json(found)
    else:
        print("\n".join(endurance.text(found)))
    raise typer.Exit(EXIT_CODES[found.verdict])


@bench.command(name="all")
def every(
    quick: Annotated[bool, typer.Option("--quick", help="Two minutes: too few samples to quote.")] = False,
    passes: Annotated[
        int, typer.Option(min=1, help="Over all figures, one behind the other: their median and quartiles.")
    ] = 1,
    into: Annotated[
        Path | None,
        typer.Option(help="Write the table into this page, between its two markers, after each pass."),
    ] = None,
    json: Json = False,
) -> None:
    """Every figure of docs/numbers.md in one table, each beside its limit and its command."""
    from aftbed.bench import numbers  # noqa: PLC0415 - campaigns, see above

    if into is not None:
        numbers.check_page(into)
    with _measuring("all", as_json=json) as progress:
        for found in numbers.bench_all(progress.step, quick=quick, passes=passes, show=progress.show):
            if into is not None:
                numbers.write_into(into, found)
    print(msgspec.json.encode(found).decode() if json else "\n".join(numbers.markdown(found)))
    if missing := numbers.not_measured(found):
        raise HarnessError(f"not measured: {', '.join(missing)}; the table has the reasons")


@bench.command()
def compare(
    old: Annotated[Path, typer.Argument(metavar="OLD_VENV", help="A venv with the version of before.")],
    new: Annotated[Path, typer.Argument(metavar="NEW_VENV", help="A venv with the version of now.")],
    benches: Annotated[
        list[str] | None,
        typer.Option("--bench", help="What follows `aftbed bench`, in quotes; may be given several times."),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Of both in turn; at least 6 for an interval.")] = ROUNDS,
    old_options: Annotated[
        str, typer.Option(metavar="TEXT", help="Added to each bench of the old version only, in quotes.")
    ] = "",
    new_options: Annotated[
        str, typer.Option(metavar="TEXT", help="Added to each bench of the new version only, in quotes.")
    ] = "",
    max_ratio: Annotated[
        float | None, typer.Option(help="Exit code 1 if a ratio new / old is above it with 95 % confidence.")
    ] = None,
    json: Json = False,
) -> None:
    """Two installed versions in turn: is the new one slower? Each ratio with its interval."""
    from aftbed.bench import compare as versions  # noqa: PLC0415 - campaigns, see above

    if max_ratio is not None and not 0 < max_ratio < float("inf"):
        raise ConfigError(f"--max-ratio {max_ratio:g}: more than 0 is allowed, 1.05 for 5 % slower")
    given = tuple(benches) if benches else versions.DEFAULT
    with _measuring("compare", as_json=json) as progress:
        found = versions.bench_compare(
            old,
            new,
            given,
            progress.step,
            rounds=rounds,
            old_options=old_options,
            new_options=new_options,
            show=progress.show,
        )
    if json:
        print_json(found)
    else:
        print("\n".join(versions.lines(found)))
    if max_ratio is not None and versions.above(found, max_ratio):
        raise typer.Exit(1)


@bench.command()
def paper(
    quick: Annotated[bool, typer.Option("--quick", help="Half a minute: too few samples to quote.")] = False,
    html: Annotated[Path | None, typer.Option(help="Write a page with plots to this file.")] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print the tables as markdown.")] = False,
    json: Json = False,
) -> None:
    """Every figure of the paper's Section IV beside ours, measured now; placements; sweeps."""
    from aftbed.bench import paper as again  # noqa: PLC0415 - see above

    if json and markdown:
        raise ConfigError("--json and --markdown: one of them is allowed")
    if html is not None and not html.parent.is_dir():
        raise ConfigError(f"--html {html}: {html.parent} is no directory")
    if html is not None and html.is_dir():
        raise ConfigError(f"--html {html}: a directory; the name of a file is allowed")
    with _measuring("paper", as_json=json) as progress:
        found = again.bench_paper(again.QUICK if quick else again.FULL, progress.step, progress.show)
    if json:
        print_json(found)
    else:
        for line in again.markdown(found) if markdown else again.text(found):
            print(line)
    if html is not None:
        html.write_text(again.html_page(found), encoding="utf-8")


def _measuring(bench: str, unit: str = "measurements", *, as_json: bool) -> ProgressLine:
    return ProgressLine(f"bench {bench}", unit=unit, plain=not as_json)


def _print(document: msgspec.Struct, *, as_json: bool) -> None:
    if as_json:
        print_json(document)
    else:
        print("\n".join(text(document)))
