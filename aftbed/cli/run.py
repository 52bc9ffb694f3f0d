"""`aftbed run`: check all options, start the run, show it, judge it.

The supervisor has begun before this module is imported (`runtime.unix.head_start`), and waits for the
options: a module that is imported before the launch delays the first reply. What only some runs need is
imported where it is used, and what judges is imported after the run.
"""

import contextlib
import json
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
import typer

from aftbed.cli.interrupted import EXIT_INTERRUPTED
from aftbed.cli.options import (
    RATE_HZ_MAX,
    VERIFIES,
    VERIFIES_HELP,
    App,
    Expect,
    Ftm,
    Ftti,
    Html,
    Json,
    Junit,
    Quiet,
    Requests,
    Tolerance,
    check_file,
    check_range,
    check_seed,
    choices,
    requirements,
    takes,
)
from aftbed.cli.views import PlainView, RunView
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.graph import PLACEMENTS, Graph
from aftbed.core.messages import Scheduled
from aftbed.core.script import RECIPES
from aftbed.core.units import whole_milliseconds
from aftbed.ftm.compose import build, canonical
from aftbed.functions.source import located
from aftbed.inject.memory import refuse_unsafe
from aftbed.inject.model import Fault, parse
from aftbed.runtime import control
from aftbed.runtime.control import Report
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.launch import Launched, launch, listen_on_loopback, options_for
from aftbed.runtime.unix.options import (
    CarRun,
    LoadRun,
    PolicyOptions,
    ReplayRun,
    RunOptions,
    Work,
    ftti_ms_of,
)
from aftbed.vehicle.can.bus_load import BITRATE_BPS, BITRATE_BPS_MAX, BITRATE_BPS_MIN

if TYPE_CHECKING:
    from aftbed.cli.request_options import RequestSource
    from aftbed.functions.request_file import GivenRequests
    from aftbed.runtime.unix.closed_loop import ClosedLoop

POLICIES: Final = ("hold", "release", "latch")  # the last one if left out
SCENARIO: Final = "ccrs-50"  # if left out
PACE_MIN, PACE_MAX = 0.01, 100.0
LOAD_MAX: Final = 10_000_000
PROCESSES_LOG_SHOWN: Final = 4000  # characters


Placement = Annotated[
    str,
    typer.Option(metavar=choices(PLACEMENTS), help="Which bricks share a process: none, a replica's, all."),
]
Pace = Annotated[
    str | None, typer.Option(show_default="real", metavar="<real|max|FACTOR>", help="As 4; max is lockstep.")
]


class RunArguments(msgspec.Struct, frozen=True):
    """The options of `aftbed run`."""

    ftm: Ftm = "pbr"
    scenario: Annotated[
        str | None, typer.Option(show_default=SCENARIO, help="Name of a scenario, or a YAML file.")
    ] = None
    app: App = None
    placement: Placement = "process"
    pace: Pace = None
    seed: Annotated[int, typer.Option(help="Seed of all random numbers of the run.")] = 0
    faults: Annotated[
        tuple[str, ...], typer.Option("--inject", help='E.g. "crash primary at checkpoint.sent nth 100".')
    ] = ()
    adaptations: Annotated[
        tuple[str, ...], typer.Option("--adapt", help='E.g. "compose lfr+tr at request 120".')
    ] = ()
    recipe: Annotated[
        str, typer.Option(metavar=choices(RECIPES), help="How each --adapt is carried out.")
    ] = "drained"
    force: Annotated[
        bool, typer.Option("--force", help="Run, and --adapt, even where it does not suit the function.")
    ] = False
    may_fail: Annotated[
        bool, typer.Option("--may-fail", help="The run may pass even if an adaptation was not done.")
    ] = False
    policy: Annotated[
        str | None, typer.Option(help="When the run adapts by itself: name of a policy, or a YAML file.")
    ] = None
    approve: Annotated[
        str, typer.Option(metavar="<auto|ask>", help="What --policy proposes: do it, or ask.")
    ] = "auto"
    brake_policy: Annotated[
        str | None,
        typer.Option(
            show_default=POLICIES[-1],
            metavar=choices(POLICIES),
            help="What the brake ECU does on lost requests.",
        ),
    ] = None
    record: Annotated[str | None, typer.Option(help="Keep the record of the run in this new directory.")] = (
        None
    )
    replay: Annotated[
        str | None, typer.Option(help="A log to replay instead of a drive: candump, ASC, BLF, TRC, MF4, CSV.")
    ] = None
    skip_bad: Annotated[
        bool, typer.Option("--skip-bad", help="Leave out what cannot be read of --replay, and count it.")
    ] = False
    dbc: Annotated[str | None, typer.Option(help="The DBC of the replayed log.")] = None
    map_file: Annotated[str | None, typer.Option("--map", help="What the log's signals mean.")] = None
    loop: Annotated[bool, typer.Option("--loop", help="Begin the log of --replay again behind its end.")] = (
        False
    )
    duration: Annotated[
        str | None,
        typer.Option(help="End after so long, of bus time, e.g. 90s; else as scenario or log say."),
    ] = None
    load: Annotated[
        str | None, typer.Option(help="COUNT[@RATE]: synthetic requests (per second) instead of a drive.")
    ] = None
    requests: Requests = None
    count: Annotated[
        int | None,
        typer.Option(help="With --requests: how many are sent; behind the last of a file, the first again."),
    ] = None
    rate: Annotated[
        float | None,
        typer.Option(help="With --requests: per second; 0 or left out, each follows the reply before it."),
    ] = None
    expect: Expect = None
    tolerance: Tolerance = None
    ftti: Ftti = None
    verifies: Annotated[tuple[str, ...], typer.Option(VERIFIES, help=VERIFIES_HELP)] = ()
    bus_port: Annotated[int, typer.Option(help="TCP port of the bus on 127.0.0.1; 0 is any free one.")] = 0
    bus_open: Annotated[
        bool,
        typer.Option(
            "--bus-open", help="Let other users onto the bus; what strangers send is part of the run."
        ),
    ] = False
    bitrate: Annotated[
        int, typer.Option(help="Bits per second by which the load of the bus is measured.")
    ] = BITRATE_BPS
    pin: Annotated[bool, typer.Option(help="Keep each replica's chain on one core.")] = True
    unsafe_memory: Annotated[
        bool, typer.Option("--unsafe-memory", help='Allow --inject "bitflip memory ...".')
    ] = False
    web: Annotated[
        bool, typer.Option("--web", help="Serve a page of the run on 127.0.0.1, to watch and to steer it.")
    ] = False
    port: Annotated[int, typer.Option(help="With --web: its TCP port; 0 is any free one.")] = 0
    open_page: Annotated[bool, typer.Option("--open", help="With --web: open it in the browser.")] = False
    mcap: Annotated[Path | None, typer.Option(help="Write the run to this file, for Foxglove.")] = None
    trace: Annotated[Path | None, typer.Option(help="Write its nodes to this file, for Perfetto.")] = None
    junit: Junit = None
    html: Html = None
    quiet: Quiet = False
    json: Json = False

    @property
    def silent(self) -> bool:
        """Standard output is for the verdict alone."""
        return self.json or self.quiet


DEFAULTS: Final = RunArguments()
OF_A_REPLAY: Final = ("dbc", "map_file", "skip_bad", "loop")
OTHER_SOURCES: Final = ("load", "replay", *OF_A_REPLAY, "scenario", "pace", "brake_policy")
OF_THE_BUS: Final = ("bus_port", "bus_open", "bitrate", "duration")


@takes(RunArguments)
def run(given: RunArguments) -> int:
    """Drive a car at an obstacle, under a fault tolerance mechanism; end with a verdict.

    Exit code: 0 pass, 1 a promise was broken, 2 usage, 3 inconclusive, 130 interrupted and cleaned.
    """
    return execute(given)


def execute(given: RunArguments) -> int:
    """Run, show, judge; the exit code. Raises ConfigError before anything is started."""
    application = located(given.app) if given.app is not None else ""
    graph = build(given.ftm, given.placement, application=application)
    faults = tuple(_fault(text, graph, unsafe=given.unsafe_memory) for text in given.faults)
    adaptations = _adaptations(given, graph)
    policy = None
    if given.policy is not None:
        policy = PolicyOptions(given.policy, given.approve, given.may_fail)
    make_loop = _closed_loop(given)
    check_seed(given.seed)
    source = _requests(given)
    work = _work(given) if source is None else _sent(source, given)
    ftti_ms = ftti_ms_of("--ftti", given.ftti, work) if given.ftti is not None else 0.0
    requests = source.of(given.seed) if source is not None else None
    log = _log(given)
    if application:
        _refuse_unsuitable(application, graph.ftm, requests, force=given.force)
    check_range("--bus-port", given.bus_port, 0, 65535)
    check_range("--bitrate", given.bitrate, BITRATE_BPS_MIN, BITRATE_BPS_MAX)
    verifies = requirements(given.verifies)
    check_file("--junit", given.junit)
    check_file("--html", given.html)
    write_files = _files(given)
    _check_page(given)
    options, listener = options_for(
        ftm=graph.ftm,
        placement=given.placement,
        work=work,
        seed=given.seed,
        record=given.record,
        faults=faults,
        adaptations=adaptations,
        policy=policy,
        pin=given.pin,
        bus_port=given.bus_port,
        bus_open=given.bus_open,
        application=application,
        ftti_ms=ftti_ms,
        verifies=verifies,
        command=shlex.join(("aftbed", *sys.argv[1:])),
        evidence=given.junit is not None,
    )
    with contextlib.ExitStack() as page:
        if given.web:  # before the launch, whose processes would inherit its socket
            page.enter_context(_page(given, Path(options.private)))
        launched = launch(options, listener, requests, log)
        del log  # it may be large, and the run has it
        try:
            closed = make_loop(launched) if make_loop is not None else None
            interrupted = _follow(launched, _open_view(options, quiet=given.silent), closed)
            page.close()
            launched.wait()
            from aftbed.cli.check import (  # noqa: PLC0415 - after the launch
                judge_and_show,
                keep_verdict,
                write_html,
                write_junit,
            )
            from aftbed.judge.verdict import EXIT_CODES  # noqa: PLC0415 - after the launch
            from aftbed.runtime.unix.trust import OWN_RUN, remember  # noqa: PLC0415 - after the launch

            if why_not := remember(launched.record):
                text = f"aftbed check will ask for --trust: what was run cannot be remembered: {why_not}"
                print(f"aftbed: note: {text}", file=sys.stderr)
            verdict = judge_and_show(launched.record, OWN_RUN, as_json=given.json, quiet=given.quiet)
            if given.record is not None:
                keep_verdict(launched.record, verdict)
            if launched.trouble:
                print(f"aftbed: trouble: {launched.trouble}", file=sys.stderr)
            elif verdict.verdict == "inconclusive" and not given.silent:
                _show_log(launched.record / "processes.log")
            writers = list[Callable[[], list[str]]]()
            if write_files is not None:
                writers.append(partial(write_files, launched.record))
            if given.junit is not None:
                writers.append(partial(write_junit, given.junit, verdict))
            if given.html is not None:
                writers.append(partial(write_html, given.html, launched.record, verdict))
            unwritten = [write for write in writers if not _written(write, silent=given.silent)]
        finally:
            launched.remove()
    code = EXIT_CODES[verdict.verdict]
    return EXIT_INTERRUPTED if interrupted else code or (EXIT_CODES["inconclusive"] if unwritten else 0)


# -- what the options mean ------------------------------------------------------------------------


def _fault(text: str, graph: Graph, *, unsafe: bool) -> Fault:
    fault = parse(text)
    if fault.action.unsafe:
        refuse_unsafe(str(fault), agreed=unsafe)
    fault.check(graph)
    return fault


def _refuse_unsuitable(application: str, ftm: str, requests: "GivenRequests | None", *, force: bool) -> None:
    from aftbed.cli.adapt import refuse_unsuitable  # noqa: PLC0415 - only with --app
    from aftbed.cli.request_options import first_requests  # noqa: PLC0415 - the same

    refuse_unsuitable(application, ftm, force=force, requests=first_requests(application, requests))


def _adaptations(given: RunArguments, graph: Graph) -> tuple[Scheduled, ...]:
    if not given.adaptations:
        if given.recipe != RECIPES[0]:
            raise ConfigError("--recipe says how --adapt is carried out: give --adapt too")
        if given.force and given.app is None:
            raise ConfigError("--force is about --adapt and --app: give one of them too")
        if given.may_fail and given.policy is None:
            raise ConfigError("--may-fail is about --adapt and --policy: give one of them too")
        return ()
    from aftbed.cli.adapt import scheduled  # noqa: PLC0415 - only with --adapt

    return scheduled(given.adaptations, graph, given.recipe, force=given.force, may_fail=given.may_fail)


def _closed_loop(given: RunArguments) -> "Callable[[Launched], ClosedLoop] | None":
    """What makes the closed loop of a launched run; None without `--policy`."""
    if given.policy is None and given.approve == "auto":
        return None
    from aftbed.runtime.unix.closed_loop import ClosedLoop, asked_for  # noqa: PLC0415 - only with --policy

    if given.approve == "ask" and given.quiet:
        raise ConfigError("--approve ask: --quiet prints no question; leave one of them out")
    policy = asked_for(given.policy, given.approve, canonical(given.ftm), as_json=given.json)
    if policy is None:
        return None
    from aftbed.cli.adapt import declared_in_time  # noqa: PLC0415 - the same

    return lambda run: ClosedLoop(policy, run.options, given.approve, declared_in_time)


def _work(given: RunArguments) -> Work:
    if given.replay is not None and given.load is not None:
        raise ConfigError("--replay and --load: one of them is allowed")
    if given.load is not None:
        _refuse(
            given, ("scenario", "pace", "brake_policy", *OF_A_REPLAY), "--load: there is no car: leave out"
        )
        _refuse(given, ("bus_open", "bitrate"), "--load: there is no bus: leave out")
        if given.duration is not None:
            raise ConfigError("--duration: a run of --load ends with its last request; COUNT says how many")
        return _load(given.load)
    pace = _pace(given.pace)
    duration_ms = whole_milliseconds("--duration", given.duration) if given.duration is not None else None
    if given.replay is not None:
        _refuse(given, ("scenario", "brake_policy"), "--replay: there is no car: leave out")
        if given.loop and pace is None and duration_ms is None:
            raise ConfigError("--loop with --pace max would fill the disk: give --duration too")
        files = _replay_files(given.replay, given.dbc, given.map_file)
        return ReplayRun(*files, pace, given.loop, duration_ms, given.bitrate)
    _refuse(given, OF_A_REPLAY, "only with --replay LOG: leave out")
    brake_policy = POLICIES[-1] if given.brake_policy is None else given.brake_policy
    if brake_policy not in POLICIES:
        raise unknown("brake policy", brake_policy, POLICIES)
    scenario = SCENARIO if given.scenario is None else given.scenario
    if scenario.endswith((".yaml", ".yml")):
        scenario = str(Path(scenario).resolve())
    return CarRun(scenario, pace, brake_policy, duration_ms, given.bitrate)


def _replay_files(log: str, dbc_name: str | None, map_name: str | None) -> tuple[str, str, str]:
    """Log, DBC and map, as a ReplayRun has them. Raises ConfigError."""
    if dbc_name is None or map_name is None:
        raise ConfigError("--replay LOG needs --dbc FILE and --map FILE, which say what its frames mean")
    from aftbed.vehicle.replay.map_file import (  # noqa: PLC0415 - only with --replay
        bind,
        find_dbc,
        find_map,
    )

    dbc, map_path = find_dbc(dbc_name), find_map(map_name)
    bind(map_path, dbc)
    return str(Path(log).resolve()), str(dbc.resolve()), str(map_path)


def _log(given: RunArguments) -> bytes | None:
    """The log of `--replay`, as the player takes it; None without one."""
    if given.replay is None:
        return None
    from aftbed.interop.logs import read_for_replay  # noqa: PLC0415 - only with --replay

    return msgspec.msgpack.encode(read_for_replay(Path(given.replay), skip_bad=given.skip_bad))


def _pace(text: str | None) -> float | None:
    """The pace as a factor; None is lockstep."""
    if text == "max":
        return None
    if text is None or text == "real":
        return 1.0
    try:
        pace = float(text)
    except ValueError:
        pace = 0.0
    if not PACE_MIN <= pace <= PACE_MAX:
        raise ConfigError(f"--pace {text}: real, max, or a factor from {PACE_MIN} to {PACE_MAX} is allowed")
    return pace


def _load(text: str) -> LoadRun:
    count, at, rate = text.partition("@")
    try:
        load = LoadRun(int(count), float(rate) if at else 0.0)
    except ValueError:
        load = LoadRun(0, 0.0)
    if not (1 <= load.count <= LOAD_MAX and 0 <= load.rate_hz <= RATE_HZ_MAX):
        raise ConfigError(
            f"--load {text}: COUNT or COUNT@RATE is allowed, 1 to {LOAD_MAX} requests,"
            f" up to {RATE_HZ_MAX:.0f} a second (without a rate: each follows the reply before)"
        )
    return load


def _requests(given: RunArguments) -> "RequestSource | None":
    """Of `--requests`, or None without it."""
    if given.requests is None:
        _refuse(given, ("count", "rate", "expect", "tolerance"), "only with --requests: leave out")
        return None
    _refuse(
        given, OTHER_SOURCES + OF_THE_BUS, "--requests: there is no car, no bus and no other load: leave out"
    )
    from aftbed.cli.request_options import RequestSource  # noqa: PLC0415 - only with --requests

    return RequestSource(
        given.requests,
        count=given.count,
        count_max=LOAD_MAX,
        expect=given.expect,
        tolerance=given.tolerance,
    )


def _refuse(given: RunArguments, names: tuple[str, ...], why: str) -> None:
    """Raise ConfigError if one of these options has another value than by default."""
    used = [name for name in names if getattr(given, name) != getattr(DEFAULTS, name)]
    if used:
        options = (f"--{name.removesuffix('_file').removesuffix('_page').replace('_', '-')}" for name in used)
        raise ConfigError(f"{why} {', '.join(options)}")


def _sent(source: "RequestSource", given: RunArguments) -> LoadRun:
    rate_hz = given.rate or 0.0
    if not 0 <= rate_hz <= RATE_HZ_MAX:
        raise ConfigError(f"--rate {rate_hz}: 0 to {RATE_HZ_MAX:.0f} a second are allowed")
    expect = str(Path(given.expect).resolve()) if given.expect is not None else ""
    return LoadRun(source.count, rate_hz, source.name, expect)


def _check_page(given: RunArguments) -> None:
    if not given.web:
        _refuse(given, ("port", "open_page"), "only with --web: leave out")
    check_range("--port", given.port, 0, 65535)


def _page(given: RunArguments, private: Path) -> AbstractContextManager[None]:
    """What serves the page of the run in `private`; its address is printed. Raises ConfigError."""
    from aftbed.report import live_page  # noqa: PLC0415 - only with --web

    listener, token = listen_on_loopback(given.port, "--port"), live_page.new_token()
    shown = live_page.address(listener, token)
    print(f"page: {shown}", file=sys.stderr, flush=True)
    if given.open_page:
        import webbrowser  # noqa: PLC0415 - only with --open

        webbrowser.open(shown)
    return live_page.beside(listener, private, token)


# -- while it runs --------------------------------------------------------------------------------


@contextlib.contextmanager
def _open_view(options: RunOptions, *, quiet: bool) -> Iterator[RunView]:
    """The view that suits standard output; `quiet` shows nothing."""
    if quiet:
        yield RunView()
        return
    if not sys.stdout.isatty():
        yield PlainView(options)
        return
    from aftbed.cli.live_view import LiveView  # noqa: PLC0415 - only on a terminal
    from aftbed.cli.screen import opened  # noqa: PLC0415 - the same

    screen = opened()
    if screen is None:
        yield PlainView(options)
        return
    with screen, contextlib.closing(LiveView(options, screen)) as view:
        yield view


def _follow(launched: Launched, view: AbstractContextManager[RunView], closed: "ClosedLoop | None") -> bool:
    """Show the reports until the run ends; True if the user interrupted it. A second Ctrl-C kills the run."""
    interrupted = False

    def interrupt(signum: int, frame: object) -> None:
        nonlocal interrupted
        if interrupted:
            os.kill(launched.supervisor, signal.SIGKILL)
        interrupted = True
        launched.stop()

    before = {s: signal.signal(s, interrupt) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        with view as shown:
            if closed is not None:
                closed.show = shown.event
                shown.decide, closed.reads_input = closed.decide, not shown.takes_keys
            for report in _reports(launched, closed, shown):
                if report.kind != control.EVENT:
                    shown.report(report)
                    continue
                event = json.loads(report.data)
                shown.event(event)
                if closed is not None:
                    closed.on_event(event)
            if closed is not None:
                closed.close()
    finally:
        for sig, handler in before.items():
            signal.signal(sig, handler)
    return interrupted


def _reports(launched: Launched, closed: "ClosedLoop | None", shown: RunView) -> Iterator[Report]:
    """The reports of the run; between two of them a closed loop observes, and the view is attended to."""
    reports, line = launched.reports(), launched.line.fileno()
    while True:
        shown.attend()
        descriptors = (line, *shown.descriptors)
        wait = closed.wait if closed is not None else partial(linux.readable, seconds=shown.wait_s)
        if line not in wait(descriptors):
            continue
        report = next(reports, None)
        if report is None:
            return
        yield report


# -- when it has ended ----------------------------------------------------------------------------


def _files(given: RunArguments) -> Callable[[Path], list[str]] | None:
    """What writes `--mcap` and `--trace` from a record; None without them. Checked before the run."""
    if given.mcap is None and given.trace is None:
        return None
    from aftbed.interop.export import ExportFiles, check, export  # noqa: PLC0415 - the same
    from aftbed.judge.record import read_record  # noqa: PLC0415 - only with --mcap or --trace

    files = ExportFiles(given.mcap, given.trace)
    check(files)
    return lambda record: list(map(str, export(read_record(record), files)))


def _written(write: Callable[[], list[str]], *, silent: bool) -> bool:
    """False if a file could not be written. The verdict is printed all the same."""
    try:
        lines = write()
    except ConfigError as error:
        print(f"aftbed: trouble: {error}", file=sys.stderr)
        return False
    if not silent:
        print("\n".join(lines))
    return True


def _show_log(log: Path) -> None:
    """What the processes printed: the first place to look when the harness is in trouble."""
    text = log.read_text(errors="replace").strip() if log.exists() else ""
    if text:
        print("what the processes printed:\n" + text[-PROCESSES_LOG_SHOWN:], file=sys.stderr)
