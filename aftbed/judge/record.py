"""The record of a run: one type, of real processes (what `--record DIR` leaves) and of the simulator.

The directory of a real run can be read after a `kill -9`, too.
"""

import contextlib
import itertools
import json
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import BinaryIO, Final, TypeVar

import msgspec

from aftbed.adapt.engine import DONE
from aftbed.core.errors import ConfigError, PeerError
from aftbed.core.input_file import open_input, read_input
from aftbed.core.journal import Entry, EntryKind, History, Stored
from aftbed.core.requirements import check_requirements
from aftbed.ftm.compose import parse
from aftbed.functions.request_file import ExpectedReplies
from aftbed.inject.model import FaultReport
from aftbed.inject.receipts import ReceiptState
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.deployment import Hosted
from aftbed.runtime.unix.closed_loop import PolicyReport, Proposed, read_policy_report, read_proposals
from aftbed.runtime.unix.journal_files import entries_dropped, stored_entries, stored_records
from aftbed.runtime.unix.options import CarRun, LoadRun, RunOptions, Work
from aftbed.runtime.unix.request_store import stored_replies, stored_requests
from aftbed.runtime.unix.run_directory import BUS_NAME, HISTORY_NAME
from aftbed.vehicle.can.bus_load import BusLoad, bus_load
from aftbed.vehicle.can.hub import LOG_BYTES_MAX, HubCounts
from aftbed.vehicle.ecus import End
from aftbed.vehicle.plant import VehicleResult

DOCUMENT_BYTES_MAX: Final = 64_000_000  # of a file that is no journal
IN_MEMORY_MAX: Final = 200_000  # records and entries that are kept, at some 200 bytes each
LINE_BYTES_MAX: Final = 256  # of the log of the bus; a longer line is read in parts
END_KEYS: Final = (
    *("reason", "ended_ns", "seconds", "left", "unfinished", "lost", "leader", "backup", "hosted", "states"),
    *("epoch", "faults", "bus"),
)


BESIDE_OPTIONS: Final = ("version", "started_ns", "load", "kept")  # keys of `run.json`

T = TypeVar("T")


class ClientEnd(msgspec.Struct, frozen=True):
    """What the last client of a load said of itself."""

    sent: int | None = None


class RunEnd(msgspec.Struct, frozen=True):
    """How a run ended, by `end.json`. `hosted` is None where no snapshot of the graph was taken.

    `left`: processes that outlived it. `unfinished`: why it was not at rest. `lost`: no replica lived.
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
    ended_ns: int = 0  # monotonic
    client: ClientEnd | None = None
    bus: HubCounts | None = None  # of a load, or where the hub did not live to report
    absent: tuple[str, ...] = ()  # keys that every end has, and this one does not


class _OfSource(msgspec.Struct, frozen=True):
    """What the source of the requests has left in `end.json`."""

    result: dict[str, object] | None
    client: ClientEnd | None


class DriveEnd(msgspec.Struct, frozen=True):
    """How a drive ended, after so many microseconds of bus time. `end` is None where it did not."""

    end: End | None
    t_us: int
    result: VehicleResult


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
    far as they are known. `excuses` is None of a real run, of which nothing is excused. `given`, `expected`:
    the requests and the replies that the user gave, None if there are none, or they are missing.
    """

    options: RunOptions
    history: History
    end: RunEnd | None
    faults: tuple[FaultReport, ...] = ()  # each with its receipt
    adaptations: tuple[Outcome, ...] = ()  # how each one ended, in order
    drive: DriveEnd | None = None
    policy: PolicyReport | None = None
    proposals: tuple[Proposed, ...] = ()  # of the policy
    path: Path = Path()
    started_ns: int = 0
    failures: tuple[str, ...] = ()
    excuses: Excuses | None = None
    kept: bool = False  # after the run, so it was sealed at its end
    frames: int = 0  # in the log of the bus
    bus_load: BusLoad | None = None
    function_failures: tuple[str, ...] = ()  # of a simulated run: nodes that stopped for their function
    given: tuple[bytes, ...] | None = None
    expected: ExpectedReplies | None = None

    @property
    def simulated(self) -> bool:
        """Whether the simulator made it."""
        return self.excuses is not None

    @property
    def vehicle(self) -> VehicleResult | None:
        """What the car did, if there was one and it reported."""
        return self.drive.result if self.drive is not None else None

    @property
    def ftm(self) -> str:
        """The FTM that the adaptations, as they ended, have come to."""
        done = [one.ftm for one in self.adaptations if one.outcome == DONE]
        return done[-1] if done else self.options.ftm

    @property
    def lost(self) -> bool:
        """Whether no replica lived at the end, as far as it is known."""
        if self.end is None or self.end.lost:
            return True
        return not (self.end.hosted.leader if self.end.hosted is not None else self.end.leader)


def read_record(path: Path, *, in_memory: bool = False) -> RunRecord:
    """The record in `path`. Raises ConfigError naming the file that is missing or malformed.

    What is long stays in its files, and each check reads it again. With `in_memory` it is kept all the same,
    so that the directory may be removed.
    """
    about = _json(path / "run.json")
    given = {key: value for key, value in about.items() if key not in BESIDE_OPTIONS}
    what = f"{path / 'run.json'}: not the options of a run"
    options = _exactly(given | {"private": "", "listener": -1, "log": -1}, RunOptions, what)
    check_requirements(f"{path / 'run.json'}: verifies", options.verifies)
    try:
        started = msgspec.convert(about.get("started_ns"), int)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{what}: started_ns: {error}") from None
    adaptations = _adaptations(path)
    for ftm, one in ((options.ftm, "run.json"), *((a.ftm, HISTORY_NAME) for a in adaptations)):
        _check_mechanism(path / one, ftm, options.packages)
    history = _history(path / "journal", in_memory=in_memory)
    end = _end(path / "end.json") if (path / "end.json").exists() else None
    faults = (
        end.faults
        if end is not None
        else tuple(
            FaultReport(str(fault), ReceiptState.UNKNOWN, number=number)
            for number, fault in enumerate(options.faults)
        )
    )
    work = options.work
    frames, load = _bus_log(path / BUS_NAME, work)
    return RunRecord(
        options,
        history,
        end,
        faults,
        adaptations,
        _drive(options, end),
        read_policy_report(path),
        tuple(read_proposals(path)),
        path,
        started,
        kept=about.get("kept") is True,
        frames=frames,
        bus_load=load,
        given=stored_requests(path) if isinstance(work, LoadRun) and work.requests else None,
        expected=stored_replies(path) if isinstance(work, LoadRun) and work.expect else None,
    )


def _check_mechanism(file: Path, ftm: str, packages: tuple[str, ...]) -> None:
    """Raise ConfigError if this installation cannot build the graph that ran, and say what it lacks."""
    try:
        parse(ftm)
    except ConfigError as error:
        theirs = " and ".join(packages)
        needed = f"; the run had it of {theirs}: install that to judge it" if theirs else ""
        raise ConfigError(f"{file}: ftm: {error}{needed}") from None


def _bus_log(log: Path, work: Work) -> tuple[int, BusLoad | None]:
    """How many lines it has, and the load of the bus; 0 and None where there is none."""
    counted = 0

    def lines(file: BinaryIO) -> Iterator[bytes]:
        nonlocal counted
        for line in iter(partial(file.readline, LINE_BYTES_MAX), b""):
            counted += line.endswith(b"\n")
            yield line

    if isinstance(work, LoadRun):
        return 0, None
    try:
        with open_input(log) as file:
            if (size := os.fstat(file.fileno()).st_size) > LOG_BYTES_MAX:
                raise ConfigError(f"{log}: {size} bytes, allowed are {LOG_BYTES_MAX}")
            found = bus_load(lines(file), work.bitrate_bps)
            return counted, found
    except FileNotFoundError:
        return 0, None
    except OSError as error:
        raise ConfigError(f"{log}: {error.strerror}") from None


def _history(folder: Path, *, in_memory: bool) -> History:
    dialogues = sorted(folder.glob("client.*.dialogue"), key=lambda p: int(p.name.split(".")[1]))
    try:
        journals = sorted(folder.glob("*.journal"))
        found = {p.name.removesuffix(".journal"): _head_of(p, stored_records) for p in journals}
        lost = [_head_of(p, entries_dropped) for p in dialogues]

        def read() -> Iterator[Entry]:
            return itertools.chain.from_iterable(map(stored_entries, dialogues))

        if any(lost):  # what was answered behind the end of a dialogue is not known
            answered = {e.request_id for e in read() if e.kind is EntryKind.ANSWERED}
            entries = Stored(lambda: (e for e in read() if e.request_id in answered))
        else:
            entries = Stored(read)
        history = History(
            {name: records for name, (records, _) in found.items()},
            entries,
            sum(dropped for _, dropped in found.values()) + sum(lost),
        )
        size = len(entries) + sum(map(len, history.journals.values()))
        return history.in_memory() if in_memory or size <= IN_MEMORY_MAX else history
    except PeerError as error:
        raise ConfigError(f"{folder}: {error}") from None
    except OSError as error:
        raise ConfigError(f"{error.filename}: {error.strerror}") from None


def _head_of(path: Path, read: Callable[[Path], T]) -> T:
    """What `read` finds. Raises ConfigError, which names the file, if it is no journal."""
    try:
        return read(path)
    except PeerError as error:
        raise ConfigError(f"{path}: {error}") from None


def _end(path: Path) -> RunEnd:
    found, what = _json(path), f"{path}: not the end of a run"
    absent = tuple(key for key in END_KEYS if key not in found)
    of_source = {key: found.pop(key, None) for key in ("result", "client")}  # the judge reads parts of these
    found.pop("graph_ms", None)
    end = _exactly(found | {"absent": absent}, RunEnd, what)
    try:
        rest = msgspec.convert(of_source, _OfSource)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{what}: {error}") from None
    return msgspec.structs.replace(end, result=rest.result, client=rest.client)


def _drive(options: RunOptions, end: RunEnd | None) -> DriveEnd | None:
    if end is None or end.result is None or not isinstance(options.work, CarRun):
        return None
    what = "end.json: not the result of a drive"
    try:
        drive = msgspec.convert(end.result, DriveEnd)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{what}: {error}") from None
    _exactly(end.result["result"], VehicleResult, what)
    return drive


def _adaptations(path: Path) -> tuple[Outcome, ...]:
    try:
        lines = read_input(path / HISTORY_NAME, DOCUMENT_BYTES_MAX).split(b"\n")
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise ConfigError(f"{path / HISTORY_NAME}: {error.strerror}") from None
    *whole, cut = lines
    with contextlib.suppress(ConfigError):  # cut off with the run, if there is something
        whole += [cut] if _parsed(cut, "") else []
    what = f"{path / HISTORY_NAME}: line"
    return tuple(
        _exactly(_parsed(line, f"{what} {number}"), Outcome, f"{what} {number}")
        for number, line in enumerate(whole, 1)
    )


def _json(path: Path) -> dict[str, object]:
    try:
        return _parsed(read_input(path, DOCUMENT_BYTES_MAX), str(path))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; is this the record of a run?") from None


def _parsed(data: bytes, where: str) -> dict[str, object]:
    try:
        found = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{where}: not JSON: {error}") from None
    if not isinstance(found, dict):
        raise ConfigError(f"{where}: not a JSON object")
    return found


def _exactly(found: object, kind: type[T], what: str) -> T:
    """`found` as a `kind`. Raises ConfigError, also for a key that it does not have: it was misspelt."""
    try:
        converted = msgspec.convert(found, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{what}: {error}") from None
    if key := _unknown_key(found, msgspec.to_builtins(converted)):
        raise ConfigError(f"{what}: unknown key {key!r}")
    return converted


def _unknown_key(found: object, known: object) -> str:
    """The first key of `found`, at any depth, that `known` does not have; "" if there is none."""
    if isinstance(found, dict) and isinstance(known, dict):
        keys = (key if key not in known else _unknown_key(value, known[key]) for key, value in found.items())
        return next(filter(None, keys), "")
    if isinstance(found, list) and isinstance(known, list | tuple):
        return next(filter(None, map(_unknown_key, found, known)), "")
    return ""
