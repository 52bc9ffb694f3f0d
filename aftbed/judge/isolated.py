"""Executes a function that a user or a record names: only if it is trusted, and in a process of its own.

Code that is not trusted is not executed at all (`runtime.unix.trust`). The process of code that is trusted
has limits (`runtime.unix.confined`); a class writes no byte into a file. When it crashes, hangs or answers
anything but MessagePack of the declared type, the replies of the function are unknown, with the reason.
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
from aftbed.functions.load import OWN_CODE, characteristics_of, declared_in, load_application
from aftbed.functions.source import told_of
from aftbed.judge.exercise import behind, differs, reason_of
from aftbed.judge.record import RunRecord
from aftbed.judge.reference import (
    NamedChange,
    ReferenceRun,
    Succession,
    changes_of,
    executed,
    loaded,
    maker,
    reference_run,
    requests_of,
    succession,
)
from aftbed.runtime.unix.confined import JobFailedError, ProcessLimits, ask, note, serve
from aftbed.runtime.unix.trust import (
    NOBODY,
    Trust,
    VettedCode,
    VettedFiles,
    search_path,
    vetted,
)

WORDS_MAX: Final = 300  # characters of what went wrong
OPAQUE_FILE_BYTES: Final = 1 << 30  # a model is unpacked; a program may keep a log
LIMITS: Final = ProcessLimits(seconds=120.0, memory_bytes=4 << 30, file_bytes=0)
TRIAL_LIMITS: Final = ProcessLimits(seconds=10.0, memory_bytes=4 << 30, file_bytes=0)

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


# -- in the command -------------------------------------------------------------------------------


def reference_of(
    record: RunRecord,
    function: Callable[[], Application] | None = None,
    trust: Trust = NOBODY,
    limits: ProcessLimits = LIMITS,
) -> ReferenceRun:
    """Of `function` if it is given, else of the versions of the function that served the run.

    Those that the record names are executed in a process of their own: whatever they do ends that.
    """
    if function is not None:
        return reference_run(record.history, function())
    first = record.options.application
    changes = changes_of(record.history, record.adaptations, first)
    sources = tuple(dict.fromkeys(source for source in (first, *(one for _, one in changes)) if source))
    if not sources:
        return reference_run(record.history, succession(record, OWN_CODE))
    loaded_by = None if record.simulated else record.path
    try:
        codes = tuple(vetted(source, trust, loaded_by) for source in sources)
    except ConfigError as error:
        return ReferenceRun((), b"", unknown=str(error))
    match _answer(Execute(first, tuple(changes), tuple(requests_of(record.history))), codes, limits):
        case Replies(run):
            return run
        case Failed(reason):
            return _unknown(sources, reason)
        case Declared():
            return _unknown(sources, "it answered something else")


def _unknown(sources: tuple[str, ...], why: str) -> ReferenceRun:
    reason = f"{', '.join(sources)} cannot be executed again: {why}"
    return ReferenceRun((), b"", unknown=reason[: 2 * WORDS_MAX])


def declared_by(source: str, trust: Trust, limits: ProcessLimits = LIMITS) -> Characteristics:
    """What the function `source` declares. Raises ConfigError if that is unknown.

    One outside of this package is asked in a process of its own, too.
    """
    return _declared(source, Describe(source), trust, limits).characteristics


def tried_out(
    source: str, requests: Sequence[bytes], trust: Trust, limits: ProcessLimits = TRIAL_LIMITS
) -> Declared:
    """What the function `source` declares, and whether it is so for `requests`.

    Raises ConfigError where it is not known, or the function fails to execute them, to capture its state or
    to restore it; one that it refuses is none it fails to execute. One of this package is not tried out.
    """
    return _declared(source, TryOut(source, tuple(requests)), trust, limits)


def _declared(source: str, task: Describe | TryOut, trust: Trust, limits: ProcessLimits) -> Declared:
    code = vetted(source, trust)
    if not code.files:
        return Declared(characteristics_of(source, OWN_CODE))
    match _answer(task, (code,), limits):
        case Declared() as found:
            return found
        case Failed(reason):
            raise ConfigError(told_of(source, reason))
        case Replies():
            raise ConfigError(f"{source}: it answered something else")


def _answer(task: Task, codes: tuple[VettedFiles, ...], limits: ProcessLimits) -> Answer:
    """Of a new process, which has ended then."""
    job = msgspec.msgpack.encode(Job(task, codes, tuple(search_path())))
    if any(not file.module for code in codes for file in code.files):
        limits = msgspec.structs.replace(limits, file_bytes=OPAQUE_FILE_BYTES)
    try:
        found: Answer = msgspec.msgpack.decode(ask(__name__, job, limits), type=Answer)
    except JobFailedError as error:
        return Failed(f"its process {error}{f': {error.noted}' if error.noted else ''}")
    except (msgspec.DecodeError, RecursionError) as error:
        return Failed(f"its process answered what is no answer: {error}")
    return found


# -- in the process -------------------------------------------------------------------------------


def work(data: bytes) -> bytes:
    """Do a job; its answer. Whatever a function does here is an answer too."""
    job = msgspec.msgpack.decode(data, type=Job)
    sys.path[:] = job.path
    sys.dont_write_bytecode = True
    try:
        return msgspec.msgpack.encode(_done(job))
    except BaseException as error:  # noqa: BLE001
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
