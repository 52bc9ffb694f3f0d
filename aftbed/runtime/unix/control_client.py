"""What another command asks of a live run, and the answer. One packet each way per question."""

import json
import socket
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from aftbed.adapt.planner import Plan
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.messages import Goal
from aftbed.inject.model import Fault
from aftbed.runtime.unix import run_directory
from aftbed.runtime.unix.resources import ProcessRow
from aftbed.runtime.unix.transport import Line

ANSWER_SECONDS_MAX: Final = 2.0
ADAPT_SECONDS_MAX: Final = 15.0  # to prepare, commit, observe and finish, on a busy machine


class StatusQuery(msgspec.Struct, frozen=True, tag=True):
    """How the run is."""


class ProcessesQuery(msgspec.Struct, frozen=True, tag=True):
    """Names, roles and pids."""


class GraphQuery(msgspec.Struct, frozen=True, tag=True):
    """The graph, as JSON."""


class InjectCommand(msgspec.Struct, frozen=True, tag=True):
    """Arm or apply a fault."""

    fault: Fault


class AdaptCommand(msgspec.Struct, frozen=True, tag=True):
    """Adapt; answered when it has ended."""

    goal: Goal


class PlanQuery(msgspec.Struct, frozen=True, tag=True):
    """The plan of an adaptation to `goal`, and that of the way back; nothing is changed. See `Planned`."""

    goal: Goal


class PlanAnswer(msgspec.Struct, frozen=True):
    """The answer to PlanFor."""

    there: Plan
    back: Plan


class AdaptationsQuery(msgspec.Struct, frozen=True, tag=True):
    """Those that have ended."""


class StopCommand(msgspec.Struct, frozen=True, tag=True):
    """End the run."""


class Answer(msgspec.Struct, frozen=True, tag=True):
    """`data` is JSON; `error` is for the user."""

    data: bytes = b"{}"
    error: str = ""


Question = (
    StatusQuery
    | ProcessesQuery
    | GraphQuery
    | InjectCommand
    | AdaptCommand
    | PlanQuery
    | AdaptationsQuery
    | StopCommand
)
decode_question: Callable[[bytes], Question] = msgspec.msgpack.Decoder(Question).decode
decode_answer: Callable[[bytes], Answer] = msgspec.msgpack.Decoder(Answer).decode


def same_user(sock: socket.socket, uid: int) -> bool:
    """Whether the peer's process belongs to `uid` (SO_PEERCRED, unix(7))."""
    raw = sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    return bool(struct.unpack("3i", raw)[1] == uid)


def processes(private: Path) -> list[ProcessRow]:
    """The processes of the run in `private`."""
    return msgspec.convert(ask(private, ProcessesQuery())["processes"], list[ProcessRow])


Waiting = Line[Answer]


def ask(private: Path, question: Question, seconds: float = ANSWER_SECONDS_MAX) -> dict[str, object]:
    """Ask the run in `private`. Raises ConfigError with its refusal, HarnessError without an answer."""
    return receive(send(private, question), seconds)


def send(private: Path, question: Question) -> Waiting:
    """Ask; the answer is for `receive`. Raises ConfigError where nobody listens."""
    try:
        line = Line(run_directory.connect(private), decode_answer)
    except OSError as error:
        raise ConfigError(f"run {private.name} does not answer: {error.strerror}") from None
    try:
        line.send(question)
    except OSError as error:
        line.close()
        raise HarnessError(f"run {private.name} does not hear: {error.strerror}") from None
    return line


def receive(line: Waiting, seconds: float = ANSWER_SECONDS_MAX) -> dict[str, object]:
    """The answer. Raises ConfigError with a refusal, HarnessError without an answer."""
    try:
        line.sock.settimeout(seconds)
        got = line.recv()
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
