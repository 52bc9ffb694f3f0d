"""What another command asks of a live run, and the answer. One packet each way per question."""

import json
import socket
import struct
from collections.abc import Callable
from pathlib import Path

import msgspec

from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.fault import Fault
from aftbed.runtime.unix import control, rundir
from aftbed.runtime.unix.resources import Row


class Status(msgspec.Struct, frozen=True, tag=True):
    """How the run is."""


class Processes(msgspec.Struct, frozen=True, tag=True):
    """Names, roles and pids."""


class GraphNow(msgspec.Struct, frozen=True, tag=True):
    """The graph, as JSON."""


class Inject(msgspec.Struct, frozen=True, tag=True):
    """Arm or apply a fault."""

    fault: Fault


class Stop(msgspec.Struct, frozen=True, tag=True):
    """End the run."""


class Answer(msgspec.Struct, frozen=True, tag=True):
    """`data` is JSON; `error` is for the user."""

    data: bytes = b"{}"
    error: str = ""


Question = Status | Processes | GraphNow | Inject | Stop
decode_question: Callable[[bytes], Question] = msgspec.msgpack.Decoder(Question).decode
decode_answer: Callable[[bytes], Answer] = msgspec.msgpack.Decoder(Answer).decode


def same_user(sock: socket.socket, uid: int) -> bool:
    """Whether the peer's process belongs to `uid` (SO_PEERCRED, unix(7))."""
    raw = sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    return bool(struct.unpack("3i", raw)[1] == uid)


def processes(private: Path) -> list[Row]:
    """The processes of the run in `private`."""
    return msgspec.convert(ask(private, Processes())["processes"], list[Row])


def ask(private: Path, question: Question) -> dict[str, object]:
    """Ask the run in `private`. Raises ConfigError with its refusal, HarnessError without an answer."""
    try:
        line = control.Line(rundir.connect(private), decode_answer)
    except OSError as error:
        raise ConfigError(f"run {private.name} does not answer: {error.strerror}") from None
    try:
        line.send(question)
        got = line.recv()
    except OSError as error:
        raise HarnessError(f"run {private.name} did not answer within 2 s: {error}") from None
    finally:
        line.close()
    if got is None:
        raise HarnessError(f"run {private.name} closed the connection (another user's run?)")
    answer, _ = got
    if answer.error:
        raise ConfigError(answer.error)
    found = json.loads(answer.data)
    assert isinstance(found, dict)
    return found
