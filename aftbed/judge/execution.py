"""Executes a function that a user or a record names, in a process of its own, which `isolated` starts for it.

The process lives for one job: it imports nothing of the runtime but `confined` and `trust`, since what it
imports takes most of its time.
"""

import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, TypeVar

import msgspec

from aftbed.core.application import (
    AccessKind,
    Application,
    Characteristics,
    close,
    difference,
    fields_of,
    reply_fields_of,
)
from aftbed.core.errors import ConfigError, FunctionFailedError, PeerError
from aftbed.functions.load import characteristics_of, declared_in, load_application
from aftbed.judge.bare_server import NamedChange, ReferenceRun, Succession, executed, loaded, maker
from aftbed.judge.exercise import behind, differs, reason_of
from aftbed.runtime.unix.confined import note, serve
from aftbed.runtime.unix.trust import VettedCode, VettedFiles

WORDS_MAX: Final = 300  # characters of what went wrong

T = TypeVar("T")


class Execute(msgspec.Struct, frozen=True, tag=True):
    """Execute `requests` by the function `first`, and then by the versions in `changes`."""

    first: str
    changes: tuple[NamedChange, ...]
    requests: tuple[tuple[int, bytes], ...]


class Describe(msgspec.Struct, frozen=True, tag=True):
    """What the function `source` declares."""

    source: str


class TryOut(msgspec.Struct, frozen=True, tag=True):
    """The same, and have it execute `requests` twice, from one state."""

    source: str
    requests: tuple[bytes, ...]


Task = Execute | Describe | TryOut


class Job(msgspec.Struct, frozen=True):
    """`path`: where the code looks for modules that it imports."""

    task: Task
    codes: tuple[VettedFiles, ...]
    path: tuple[str, ...]


class Replies(msgspec.Struct, frozen=True, tag=True):
    run: ReferenceRun


class Declared(msgspec.Struct, frozen=True, tag=True):
    """`otherwise`: what it did that differs from this when it was tried out, "" for nothing."""

    characteristics: Characteristics
    otherwise: str = ""


class Failed(msgspec.Struct, frozen=True, tag=True):
    reason: str


Answer = Replies | Declared | Failed


def work(data: bytes) -> bytes:
    """Do a job; its answer. Whatever a function does here is an answer too."""
    job = msgspec.msgpack.decode(data, type=Job)
    sys.path[:] = job.path
    sys.dont_write_bytecode = True
    try:
        return msgspec.msgpack.encode(_done(job))
    except BaseException as error:  # noqa: BLE001 - the failure is the answer
        return msgspec.msgpack.encode(Failed(reason_of(error)))


def _done(job: Job) -> Answer:
    code = VettedCode(job.codes)
    match job.task:
        case Execute(first, changes, requests):
            return Replies(executed(requests, Succession(maker(first, code), loaded(changes, code))))
        case Describe(source):
            return Declared(characteristics_of(source, code))
        case TryOut(source, requests):
            function = load_application(source, code)()
            try:
                return Declared(declared_in(source, function), _tried(function, requests))
            except FunctionFailedError as error:
                raise ConfigError(f"{source}: {str(error).replace(f'{source}: ', '')}") from error
            finally:
                close(function)


def _tried(function: Application, requests: Sequence[bytes]) -> str:
    """Have it execute `requests` twice, from one state; how that differs from what it declares, or "".

    Raises FunctionFailedError, also where a capture changes what it captures: no mechanism can use that.
    """
    declared = function.characteristics
    begun = _captured(function, 0)
    replies, refused = _replies(function, requests)
    if requests and refused == len(requests):
        return f"it refused each of the first {refused} requests"
    for number, (request, reply) in enumerate(zip(requests, replies, strict=True), 1):
        if not _did(f"request {number}: acceptable", partial(function.acceptable, request, reply)):
            return f"its assertion does not accept its own reply to request {number}"
    if declared.state_access.kind is AccessKind.NONE:
        return ""
    ended = _captured(function, len(requests))
    _did("restore of what capture gave", lambda: function.restore(begun))
    restored = _did("capture", function.capture)
    replies_again, _ = _replies(function, requests)
    ended_again = _did("capture", function.capture)
    exact = declared.state_access.kind is AccessKind.EXACT
    if exact and restored != begun:
        return "restore does not give the state back that capture gave"
    if not declared.deterministic:
        return ""
    fields, tolerance = reply_fields_of(function), declared.state_access.tolerance
    for number, (one, other) in enumerate(zip(replies, replies_again, strict=True), 1):
        if difference(fields, one, other) > tolerance:
            return f"behind a restored state, the reply to request {number} is another"
    if exact and ended != ended_again:
        return f"behind a restored state, {len(requests)} requests lead to another state"
    return ""


def _captured(function: Application, number: int) -> bytes:
    """The state behind so many requests. Raises FunctionFailedError."""
    state = _did("capture", function.capture)
    if text := differs(_did("capture", function.capture), state, fields_of(function)):
        raise FunctionFailedError(f"capture changes the state: the second one of {behind(number)}: {text}")
    return state


def _replies(function: Application, requests: Sequence[bytes]) -> tuple[list[bytes], int]:
    """Empty for a request that is refused; and how many were."""
    refused = 0

    def reply(request: bytes) -> bytes:
        nonlocal refused
        try:
            return function.execute(request)
        except PeerError:
            refused += 1
            return b""

    replies = [_did(f"request {n}: execute", partial(reply, one)) for n, one in enumerate(requests, 1)]
    return replies, refused


def _did(what: str, act: Callable[[], T]) -> T:
    """Raises FunctionFailedError where `act` raises whatever it does."""
    note(what)
    try:
        return act()
    except FunctionFailedError as error:
        raise FunctionFailedError(f"{what}: {error}") from error
    except Exception as error:
        raise FunctionFailedError(f"{what}: {type(error).__name__}: {error}") from error


if __name__ == "__main__":
    serve(work)
