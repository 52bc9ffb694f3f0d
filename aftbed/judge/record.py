"""The record of a run: one type, of real processes (what `--record DIR` leaves) and of the simulator.

The directory of a real run can be read after a `kill -9`, too.
"""

import itertools
import json
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError, PeerError
from aftbed.core.events import Event
from aftbed.core.history import History
from aftbed.core.journal import dropped, entries, records
from aftbed.core.script import ScriptKind
from aftbed.ftm.compose import replication_of
from aftbed.inject.model import FaultReport
from aftbed.inject.receipts import ReceiptState
from aftbed.runtime.deployment import replica_of
from aftbed.runtime.hosting import Hosted
from aftbed.runtime.sim.world import Run
from aftbed.runtime.unix.journal_files import contents
from aftbed.runtime.unix.options import CarRun, LoadRun, RunOptions, Work
from aftbed.runtime.unix.support import HISTORY_NAME
from aftbed.vehicle.plant import VehicleResult


class RunEnd(msgspec.Struct, frozen=True):
    """How a run ended, as `end.json` says it. `hosted` is None where it was not looked at.

    `left`: processes that outlived it. `unfinished`: scripts that were under way. `lost`: no replica lived.
    `starved_ms`: how long the node that waited longest was ready to run and had no CPU.
    """

    reason: str = ""
    left: tuple[str, ...] = ()
    unfinished: tuple[str, ...] = ()
    lost: bool = False
    leader: str = ""
    backup: str = ""
    epoch: int = 0
    hosted: Hosted | None = None
    states: dict[str, str] = {}
    faults: tuple[FaultReport, ...] = ()
    result: dict[str, object] | None = None
    seconds: float | None = None
    starved_ms: float = 0.0


class Excuses(msgspec.Struct, frozen=True):
    """What the faults of a run allow, although a promise is broken by it; only the simulator knows this.

    `service_lost`: a fault struck each replica, the second before redundancy was back from the first.
    `values`: a bit was flipped that no mechanism outvotes (of a checkpoint, or of a reply that is kept).
    """

    service_lost: bool = False
    values: bool = False
    struck: tuple[str, ...] = ()  # the nodes that faults killed or stopped


class RunRecord(msgspec.Struct, frozen=True):
    """What a run left behind: of real processes, read from its directory, or of the simulator.

    `end` is None where the supervisor did not live to write it. `failures`: asserts that failed in nodes, as
    far as they are known. `excuses` is None of a real run, of which nothing is excused.
    """

    options: RunOptions
    history: History
    end: RunEnd | None
    faults: tuple[FaultReport, ...] = ()  # each with its receipt
    adaptations: tuple[dict[str, object], ...] = ()  # how each one ended, in order
    vehicle: VehicleResult | None = None
    path: Path = Path()
    started_ns: int = 0
    failures: tuple[str, ...] = ()
    excuses: Excuses | None = None

    @property
    def simulated(self) -> bool:
        """Whether the simulator made it."""
        return self.excuses is not None

    @property
    def ftm(self) -> str:
        """The FTM that the adaptations, as they ended, have come to."""
        done = [str(a["ftm"]) for a in self.adaptations if a["outcome"] == "done"]
        return done[-1] if done else self.options.ftm

    @property
    def lost(self) -> bool:
        """Whether no replica lived at the end, as far as it is known."""
        if self.end is None or self.end.lost:
            return True
        return not (self.end.hosted.leader if self.end.hosted is not None else self.end.leader)


def read_record(path: Path) -> RunRecord:
    """The record in `path`. Raises ConfigError naming the file that is missing or malformed."""
    about = _json(path / "run.json")
    try:
        options = msgspec.convert(about | {"private": "", "listener": -1}, RunOptions)
        started = msgspec.convert(about.get("started_ns"), int)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path / 'run.json'}: not the options of a run: {error}") from None
    folder = path / "journal"
    files = sorted(folder.glob("*.journal"))
    dialogues = sorted(folder.glob("client.*.dialogue"), key=lambda p: int(p.name.split(".")[1]))
    try:
        journals = {p.name.removesuffix(".journal"): list(records(contents(p))) for p in files}
        dialogue = [e for p in dialogues for e in entries(contents(p))]
        lost = sum(dropped(contents(p)) for p in (*files, *dialogues))
    except PeerError as error:
        raise ConfigError(f"{folder}: {error}") from None
    history = History(journals, dialogue, lost)
    end = _end(path / "end.json") if (path / "end.json").exists() else None
    faults = (
        end.faults
        if end is not None
        else tuple(FaultReport(str(fault), ReceiptState.UNKNOWN) for fault in options.faults)
    )
    vehicle = _vehicle(options, end)
    return RunRecord(options, history, end, faults, _adaptations(path), vehicle, path, started)


def _end(path: Path) -> RunEnd:
    try:
        return msgspec.convert(_json(path), RunEnd)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: not the end of a run: {error}") from None


def _vehicle(options: RunOptions, end: RunEnd | None) -> VehicleResult | None:
    if end is None or end.result is None or not isinstance(options.work, CarRun):
        return None
    return msgspec.convert(end.result["result"], VehicleResult)


# Events of faults that no mechanism outvotes: bits of a checkpoint, or of a reply that is kept.
UNPROMISED_VALUES: Final = frozenset(
    event.label
    for event in (Event.STATE_CAPTURED, Event.STATE_RESTORED, Event.CHECKPOINT_SENT)
    + (Event.CHECKPOINT_APPLIED, Event.REPLY_STORED, Event.DEDUPE_HIT)
)
SINGLE: Final = "single"  # the node of that placement hosts both replicas


def record_of(run: Run) -> RunRecord:
    """The record of a simulated run."""
    setup, rest = run.setup, run.rest
    work: Work = CarRun(setup.scenario, None, "") if setup.scenario else LoadRun(setup.count, setup.rate_hz)
    options = RunOptions("", "", "", setup.ftm, setup.placement, setup.seed, work, setup.faults)
    end = RunEnd(
        unfinished=rest.why_not,
        lost=rest.lost,
        leader=rest.leader,
        hosted=rest.hosted,
        states=rest.states,
        faults=run.faults,
    )
    flips = [f for f in setup.faults if f.action.alters_value]
    # A switch of the mechanism brings the Servers in line, so with adaptations the values are promised again.
    values = not setup.adaptations and any(f.event in UNPROMISED_VALUES for f in flips)
    return RunRecord(
        options,
        run.history,
        end,
        run.faults,
        tuple(msgspec.to_builtins(outcome) for outcome in run.adaptations),
        run.vehicle,
        failures=run.failures,
        excuses=Excuses(service_struck_down(run), values, tuple(name for _, name in run.struck)),
    )


def service_struck_down(run: Run) -> bool:
    """Whether faults struck each replica, the second before redundancy was back from the first."""
    replicas = {b.replica for b in run.rest.graph.bricks if b.replica and b.part == "server"}
    renewed = [
        (s.began_ns, s.ended_ns)
        for s in run.scripts
        if s.kind is ScriptKind.NEW_BACKUP and s.ended_ns and not s.failure
    ]
    strikes = sorted((t_ns, replica_of(name)) for t_ns, name in run.struck if replica_of(name))
    if any(name == SINGLE for _, name in run.struck):
        return True
    simplex = any(a.goal.expression and not replication_of(a.goal.expression) for a in run.setup.adaptations)
    if len(replicas) < 2 or simplex:  # for a time there may have been one replica only
        return bool(strikes)
    return any(
        other != replica and not any(first_ns < began and done < second_ns for began, done in renewed)
        for (first_ns, replica), (second_ns, other) in itertools.combinations(strikes, 2)
    )


def _adaptations(path: Path) -> tuple[dict[str, object], ...]:
    try:
        lines = (path / HISTORY_NAME).read_bytes().splitlines()
    except FileNotFoundError:
        return ()
    found = []
    for line in lines:
        try:
            found.append(json.loads(line))
        except ValueError:  # the last line, cut off with the run
            break
    return tuple(found)


def _json(path: Path) -> dict[str, object]:
    try:
        found = json.loads(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; is this the record of a run?") from None
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON: {error}") from None
    if not isinstance(found, dict):
        raise ConfigError(f"{path}: not a JSON object")
    return found
