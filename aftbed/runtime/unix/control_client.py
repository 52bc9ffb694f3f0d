"""The control protocol of a live run, and its client: one packet each way per request.

A *query* reads, a *command* changes something. `control_server` answers them.
"""

import json
import socket
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from aftbed.adapt.planner import Plan
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.messages import Goal
from aftbed.inject.model import Fault
from aftbed.runtime.control import ServiceState
from aftbed.runtime.unix import run_directory
from aftbed.runtime.unix.transport import Line
from aftbed.vehicle.aeb.messages import Sight
from aftbed.vehicle.plant import Telemetry

ANSWER_SECONDS_MAX: Final = 2.0
ADAPT_SECONDS_MAX: Final = 15.0  # to prepare, commit, observe and finish, on a busy machine
CPU_SAMPLE_SECONDS: Final = 0.2


class StatusQuery(msgspec.Struct, frozen=True, tag=True):
    """Ask for the state of the run."""


class ProcessesQuery(msgspec.Struct, frozen=True, tag=True):
    """Ask for all processes, as `ProcessRow`."""


class GraphQuery(msgspec.Struct, frozen=True, tag=True):
    """Ask for the graph that runs."""


class AdaptationsQuery(msgspec.Struct, frozen=True, tag=True):
    """Ask for the adaptations that have ended."""


class PlanQuery(msgspec.Struct, frozen=True, tag=True):
    """The plan of an adaptation to `goal`, and that of the way back, as `PlanAnswer`."""

    goal: Goal


class InjectCommand(msgspec.Struct, frozen=True, tag=True):
    """Arm or apply a fault."""

    fault: Fault


class AdaptCommand(msgspec.Struct, frozen=True, tag=True):
    """Adapt; answered when the adaptation has ended."""

    goal: Goal


class StopCommand(msgspec.Struct, frozen=True, tag=True):
    pass


class Status(ServiceState, frozen=True, kw_only=True):
    """The answer to a StatusQuery.

    `slowest_us` is the longest cycle of the last 2 s. `vehicle` is the latest of a drive, `sees` that of a
    replay; `busy` names tasks of the executive.
    """

    run: str
    adaptations: int
    placement: str
    seconds: float
    busy: list[str]
    record: str
    slowest_us: float | None
    port: int
    bitrate_bps: int | None
    vehicle: Telemetry | None
    sees: Sight | None


class PlanAnswer(msgspec.Struct, frozen=True):
    """The answer to a PlanQuery."""

    there: Plan
    back: Plan


class Answer(msgspec.Struct, frozen=True, tag=True):
    """`data` is JSON; `error` is for the user."""

    data: bytes = b"{}"
    error: str = ""


ControlRequest = (
    StatusQuery
    | ProcessesQuery
    | GraphQuery
    | AdaptationsQuery
    | PlanQuery
    | InjectCommand
    | AdaptCommand
    | StopCommand
)
decode_request: Callable[[bytes], ControlRequest] = msgspec.msgpack.Decoder(ControlRequest).decode
decode_answer: Callable[[bytes], Answer] = msgspec.msgpack.Decoder(Answer).decode


class ProcessRow(msgspec.Struct, frozen=True):
    """A process of a run; `node`: one of the graph, or the supervisor."""

    name: str
    role: str
    pid: int
    node: bool
    cpu_percent: float = 0.0
    pss_mb: float = 0.0
    rss_mb: float = 0.0


def same_user(sock: socket.socket, uid: int) -> bool:
    """Whether the peer's process belongs to `uid` (SO_PEERCRED, unix(7))."""
    raw = sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    return bool(struct.unpack("3i", raw)[1] == uid)


def ask(private: Path, request: ControlRequest, seconds: float = ANSWER_SECONDS_MAX) -> dict[str, object]:
    """The answer of the run in `private`.

    Raises ConfigError with its refusal, HarnessError without an answer.
    """
    return receive(send(private, request, seconds), seconds)


def send(private: Path, request: ControlRequest, seconds: float = ANSWER_SECONDS_MAX) -> Line[Answer]:
    """Send a request, whose answer `receive` takes. Raises ConfigError if no supervisor listens."""
    try:
        line = Line(run_directory.connect(private, min(seconds, ANSWER_SECONDS_MAX)), decode_answer)
    except OSError as error:
        raise ConfigError(f"run {private.name} does not answer: {error.strerror}") from None
    try:
        line.send(request)
    except OSError as error:
        line.close()
        raise HarnessError(f"run {private.name} does not hear: {error.strerror}") from None
    return line


def receive(line: Line[Answer], seconds: float = ANSWER_SECONDS_MAX) -> dict[str, object]:
    """The answer. Raises ConfigError with a refusal, HarnessError without an answer."""
    try:
        line.sock.settimeout(seconds)
        got = line.recv()
    except ConnectionError:  # it ended with our request unread
        got = None
    except OSError as error:
        raise HarnessError(f"the run did not answer within {seconds:.0f} s: {error}") from None
    finally:
        line.close()
    if got is None:
        raise HarnessError("the run closed the connection: it has ended, or is another user's")
    answer, _ = got
    if answer.error:
        raise ConfigError(answer.error)
    found = json.loads(answer.data)
    assert isinstance(found, dict)
    return found


def processes(private: Path) -> list[ProcessRow]:
    """The processes of the run in `private`."""
    return process_rows(ask(private, ProcessesQuery()))


def process_rows(answer: dict[str, object]) -> list[ProcessRow]:
    """Those in the answer to a ProcessesQuery."""
    return msgspec.convert(answer["processes"], list[ProcessRow])


def measured(rows: list[ProcessRow]) -> list[ProcessRow]:
    """`rows` with CPU over `CPU_SAMPLE_SECONDS`, PSS and RSS; without processes that have ended meanwhile."""
    import psutil  # noqa: PLC0415 - it costs 15 ms

    alive, found = [], []
    for row in rows:
        try:
            process = psutil.Process(row.pid)
            process.cpu_percent()
            alive.append((row, process))
        except psutil.Error:
            continue
    time.sleep(CPU_SAMPLE_SECONDS)  # what is sampled, not what is waited for
    for row, process in alive:
        try:
            memory, cpu = process.memory_full_info(), process.cpu_percent()
        except psutil.Error:
            continue
        pss_mb, rss_mb = round(memory.pss / 1e6, 2), round(memory.rss / 1e6, 2)
        found.append(msgspec.structs.replace(row, cpu_percent=cpu, pss_mb=pss_mb, rss_mb=rss_mb))
    return found
