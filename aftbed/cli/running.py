"""`aftbed run`: checks everything the user asked for, starts the run, shows it, judges it."""

import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from aftbed.cli.view import View, open_view
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.fault import Fault, FlipMemory
from aftbed.core.graph import Graph
from aftbed.core.messages import Scheduled
from aftbed.core.script import RECIPES
from aftbed.ftm.compose import build
from aftbed.inject.parts import refuse_unsafe
from aftbed.inject.words import parse
from aftbed.runtime import targets
from aftbed.runtime.control import Report
from aftbed.runtime.unix.launch import Launched, launch, options_for
from aftbed.runtime.unix.options import CarRun, LoadRun, ReplayRun, Work

if TYPE_CHECKING:
    from aftbed.adapt.policy import Policy
    from aftbed.runtime.unix.closedloop import ClosedLoop

POLICIES: Final = ("hold", "release", "latch")
PACE_MIN, PACE_MAX = 0.01, 100.0
SEED_MAX: Final = 2**63 - 1
LOAD_MAX: Final = 10_000_000
RATE_HZ_MAX: Final = 100_000.0


class Asked(msgspec.Struct, frozen=True):
    """The options of `aftbed run` as they were typed."""

    ftm: str
    scenario: str
    placement: str
    pace: str
    seed: int
    faults: tuple[str, ...]
    adaptations: tuple[str, ...]
    recipe: str
    force: bool
    policy: str | None
    approve: str
    brake_policy: str
    record: str | None
    replay: str | None
    dbc: str | None
    map_file: str | None
    load: str | None
    bus_port: int
    pin: bool
    unsafe_memory: bool = False
    mcap: Path | None = None
    trace: Path | None = None


def run(asked: Asked, *, as_json: bool) -> int:
    """Run, show, judge; the exit code."""
    graph = build(asked.ftm, asked.placement)
    faults = tuple(_fault(text, graph, unsafe=asked.unsafe_memory) for text in asked.faults)
    adaptations = _adaptations(asked, graph)
    policy = _policy(asked, as_json=as_json)
    work = _work(asked)
    if not 0 <= asked.seed <= SEED_MAX:
        raise ConfigError(f"--seed {asked.seed}: 0 to {SEED_MAX} are allowed")
    if not 0 <= asked.bus_port <= 65535:
        raise ConfigError(f"--bus-port {asked.bus_port}: 0 to 65535 are allowed")
    _check_files(asked)
    options, listener = options_for(
        ftm=asked.ftm,
        placement=asked.placement,
        work=work,
        seed=asked.seed,
        record=asked.record,
        faults=faults,
        adaptations=adaptations,
        pin=asked.pin,
        bus_port=asked.bus_port,
    )
    launched = launch(options, listener)
    view = open_view(options, quiet=as_json)
    closed = _closed_loop(policy, asked, launched)
    interrupted = _follow(launched, view, closed)
    launched.wait()
    # Not before: the processes that start have better use for the cores.
    from aftbed.cli.show import show_verdict  # noqa: PLC0415
    from aftbed.judge.record import read_record  # noqa: PLC0415
    from aftbed.judge.verdict import EXIT_CODES, EXIT_INTERRUPTED, judge  # noqa: PLC0415

    try:
        verdict = judge(read_record(launched.record))
        show_verdict(verdict, as_json=as_json)
        if verdict.verdict == "inconclusive" and not as_json:
            _show_log(launched.record / "processes.log")
        unwritten = _write_files(asked, launched.record, as_json=as_json)
    finally:
        launched.remove()
    code = EXIT_CODES[verdict.verdict]
    return EXIT_INTERRUPTED if interrupted else code or (EXIT_CODES["inconclusive"] if unwritten else 0)


def _check_files(asked: Asked) -> None:
    if asked.mcap is not None or asked.trace is not None:
        from aftbed.campaign.runfiles.export import Wanted, check  # noqa: PLC0415 - only where there are any

        check(Wanted(asked.mcap, asked.trace))


def _write_files(asked: Asked, record: Path, *, as_json: bool) -> bool:
    """The files of `--mcap` and `--trace`; True if one could not be written: the verdict stands then, too."""
    if asked.mcap is None and asked.trace is None:
        return False
    from aftbed.campaign.runfiles.export import Wanted, export  # noqa: PLC0415
    from aftbed.judge.record import read_record  # noqa: PLC0415

    try:
        lines = export(read_record(record), Wanted(asked.mcap, asked.trace))
    except ConfigError as error:
        print(f"aftbed: trouble: {error}", file=sys.stderr)
        return True
    if not as_json:
        print("\n".join(lines))
    return False


def _fault(text: str, graph: Graph, *, unsafe: bool) -> Fault:
    fault = parse(text)
    if isinstance(fault.action, FlipMemory):
        refuse_unsafe(str(fault), unsafe=unsafe)
    targets.check(fault, graph)
    return fault


def _adaptations(asked: Asked, graph: Graph) -> tuple[Scheduled, ...]:
    if not asked.adaptations:
        if asked.recipe != RECIPES[0] or asked.force:
            raise ConfigError("--recipe and --force say how --adapt is carried out: give --adapt too")
        return ()
    from aftbed.cli.adaptation import scheduled  # noqa: PLC0415 - only where there are any

    return scheduled(asked.adaptations, graph, asked.recipe, force=asked.force)


def _policy(asked: Asked, *, as_json: bool) -> "Policy | None":
    if asked.policy is None and asked.approve == "auto":
        return None
    from aftbed.runtime.unix.closedloop import asked_for  # noqa: PLC0415 - only where there is one

    return asked_for(asked.policy, asked.approve, asked.ftm, as_json=as_json)


def _closed_loop(policy: "Policy | None", asked: Asked, launched: Launched) -> "ClosedLoop | None":
    if policy is None:
        return None
    from aftbed.runtime.unix.closedloop import ClosedLoop  # noqa: PLC0415

    return ClosedLoop(policy, asked.ftm, launched.private, launched.record, asked.approve)


def _reports(launched: Launched, closed: "ClosedLoop | None") -> Iterator[Report]:
    """What the run says; between two reports, a closed loop observes."""
    reports = launched.reports()
    while True:
        if closed is not None:
            closed.wait(launched.line.fileno())
        report = next(reports, None)
        if report is None:
            return
        yield report


def _follow(launched: Launched, view: View, closed: "ClosedLoop | None") -> bool:
    """Show what is reported until the end; True if the user broke it off. A second Ctrl-C kills."""
    interrupted = False

    def interrupt(signum: int, frame: object) -> None:
        nonlocal interrupted
        if interrupted:
            os.kill(launched.supervisor, signal.SIGKILL)
        interrupted = True
        launched.stop()

    before = {s: signal.signal(s, interrupt) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        with view:
            if closed is not None:
                closed.show(view.event)
            for report in _reports(launched, closed):
                if report.kind == "telemetry":
                    view.telemetry(report.data)
                elif report.kind == "cycle":
                    view.cycle(json.loads(report.data))
                elif report.kind == "event":
                    event = json.loads(report.data)
                    view.event(event)
                    if closed is not None:
                        closed.told(event)
            if closed is not None:
                closed.close()
    finally:
        for sig, handler in before.items():
            signal.signal(sig, handler)
    return interrupted


def _work(asked: Asked) -> Work:
    given = [n for n, v in (("--replay", asked.replay), ("--load", asked.load)) if v is not None]
    if len(given) > 1:
        raise ConfigError("--replay and --load: one of them is allowed")
    if asked.load is not None:
        return _load(asked.load)
    pace = _pace(asked.pace)
    if asked.replay is not None:
        return _replay(asked, pace)
    if asked.dbc is not None or asked.map_file is not None:
        raise ConfigError("--dbc and --map say what a replayed log means: give --replay LOG too")
    from aftbed.vehicle.scenarios.library import load_scenario  # noqa: PLC0415 - PyYAML costs 15 ms

    load_scenario(asked.scenario)
    if asked.brake_policy not in POLICIES:
        raise unknown("brake policy", asked.brake_policy, POLICIES)
    scenario = asked.scenario
    if scenario.endswith((".yaml", ".yml")):
        scenario = str(Path(scenario).resolve())
    return CarRun(scenario, pace, asked.brake_policy)


def _replay(asked: Asked, pace: float | None) -> ReplayRun:
    if asked.dbc is None or asked.map_file is None:
        raise ConfigError("--replay LOG needs --dbc FILE and --map FILE, which say what its frames mean")
    from aftbed.vehicle.can.candump import read_log  # noqa: PLC0415
    from aftbed.vehicle.replay.map_file import bind, find_dbc, find_map  # noqa: PLC0415

    assert asked.replay is not None
    dbc, map_path = find_dbc(asked.dbc), find_map(asked.map_file)
    bind(map_path, dbc)
    read_log(Path(asked.replay))
    return ReplayRun(str(Path(asked.replay).resolve()), str(dbc.resolve()), str(map_path), pace)


def _pace(text: str) -> float | None:
    if text == "max":
        return None
    if text == "real":
        return 1.0
    try:
        pace = float(text)
    except ValueError:
        pace = 0.0
    if not PACE_MIN <= pace <= PACE_MAX:
        raise ConfigError(f"--pace {text}: real, max, or a factor from {PACE_MIN} to {PACE_MAX} is allowed")
    return pace


def _load(text: str) -> LoadRun:
    count, _, rate = text.partition("@")
    try:
        load = LoadRun(int(count), float(rate or 0))
    except ValueError:
        load = LoadRun(0, 0.0)
    if not (1 <= load.count <= LOAD_MAX and 0 <= load.rate_hz <= RATE_HZ_MAX):
        raise ConfigError(
            f"--load {text}: COUNT or COUNT@RATE is allowed, 1 to {LOAD_MAX} requests,"
            f" up to {RATE_HZ_MAX:.0f} a second (without a rate: each follows the reply before)"
        )
    return load


def _show_log(log: Path) -> None:
    """What the processes printed: the first place to look when the harness is in trouble."""
    text = log.read_text(errors="replace").strip() if log.exists() else ""
    if text:
        print("what the processes printed:\n" + text[-4000:], file=sys.stderr)
