"""Executes a function that is measured (`measured`): what it answers, captures, and does behind a restore.

This is executed in a process of its own, once for each task. There is one instance of the function at a
time, as some libraries can have no more. The process notes each call before it makes it, so that one that
does not return has a name.
"""

import os
import sys
import time
from collections.abc import Callable, Sequence
from hashlib import blake2b
from typing import Final

import msgspec

from aftbed.core.application import (
    BITS,
    Application,
    Characteristics,
    Field,
    close,
    difference,
    fields_of,
    reply_fields_of,
    value_of,
)
from aftbed.core.errors import ConfigError, FunctionFailedError, PeerError
from aftbed.functions.load import Code, load_application
from aftbed.runtime.unix.confined import note, serve
from aftbed.runtime.unix.trust import VettedCode, VettedFiles

PAGE_BYTES: Final = 4096
WHOLE_STATES_BYTES_MAX: Final = 8 << 20  # of states that are handed over; of any further ones, digests
DIGEST_BYTES: Final = 16
WORDS_MAX: Final = 300  # characters of what went wrong
LINES_MAX: Final = 8000  # the same, with what a program wrote on stderr

Note = Callable[[str], None]
Make = Callable[[], Application]


# -- tasks and answers ----------------------------------------------------------------------------


class Surroundings(msgspec.Struct, frozen=True):
    """What a function must not depend on. `ballast`: objects that are allocated before it is loaded."""

    variables: dict[str, str]
    folder: str
    ballast: int


class ExecuteAll(msgspec.Struct, frozen=True, tag=True):
    """Execute `requests`, take the time, and capture at the end only."""

    requests: tuple[bytes, ...]


class WatchStates(msgspec.Struct, frozen=True, tag=True):
    """Execute `requests` and capture after each; then go on from the states at `points`, in other instances.

    `points`: how many requests came before. `expected`: of a process that captured at the end only.
    """

    requests: tuple[bytes, ...]
    points: tuple[int, ...] = ()
    expected: "Executed | None" = None


class ResumeStates(msgspec.Struct, frozen=True, tag=True):
    """Go on from the states of another process, in a new instance each."""

    requests: tuple[bytes, ...]
    states: tuple[tuple[int, bytes], ...]
    expected: "Executed"


Task = ExecuteAll | WatchStates | ResumeStates


class FunctionDescription(msgspec.Struct, frozen=True):
    """What a function declares."""

    characteristics: Characteristics
    fields: tuple[Field, ...]
    reply_fields: tuple[Field, ...]


class Executed(msgspec.Struct, frozen=True, tag=True):
    """`state`: the last one; `execute_ns`: the time of each request; `capture_ns`: of that state."""

    described: FunctionDescription
    replies: tuple[bytes, ...]
    refused: int
    state: bytes
    execute_ns: tuple[int, ...]
    capture_ns: int


class Resumed(msgspec.Struct, frozen=True):
    """What became of the requests behind a restored state; each text is "" where nothing is wrong.

    `reply`: the first difference; `size`: the greatest one of a number, infinite where it is not one of
    numbers. `restored_state`, `last_state`: what differs when these are captured.
    """

    at: int
    used: bool = False  # an instance that had executed other requests
    failed: str = ""
    reply: str = ""
    size: float = 0.0
    restored_state: str = ""
    last_state: str = ""


class Watched(msgspec.Struct, frozen=True, tag=True):
    """`states`: behind each request, the initial one first; from the `whole`th on, their digests.

    `unstable`: what differs between two captures in a row, and where. `changed_bytes`, `changed_pages`: of
    the state, by each request. `begun_anew`: what differs in a second instance that nothing is restored
    into.
    """

    replies: tuple[bytes, ...]
    states: tuple[bytes, ...]
    whole: int
    state_bytes: int
    changed_bytes: tuple[int, ...]
    changed_pages: tuple[int, ...]
    last_state: bytes
    unstable: str = ""
    begun_anew: str = ""
    resumed: tuple[Resumed, ...] = ()
    points: tuple[tuple[int, bytes], ...] = ()


class ResumedElsewhere(msgspec.Struct, frozen=True, tag=True):
    resumed: tuple[Resumed, ...]


class NoFunction(msgspec.Struct, frozen=True, tag=True):
    """The source names none that can be loaded: an error of the user."""

    reason: str


class Unanswered(msgspec.Struct, frozen=True, tag=True):
    """What the function did instead of an answer, and in which call ("" if that is unknown)."""

    reason: str
    call: str = ""


Answer = Executed | Watched | ResumedElsewhere | NoFunction | Unanswered


# -- differences ----------------------------------------------------------------------------------


def differs(found: bytes, expected: bytes, fields: Sequence[Field]) -> str:
    """The first one, as `ttc_s is 2.5 instead of 2.6`; "" if there is none."""
    if found == expected:
        return ""
    if len(found) != len(expected):
        return f"{_size(found)} instead of {_size(expected)}"
    for field in fields:
        if field.offset_bytes + field.size_bits // 8 <= len(found):
            one, other = value_of(field, found), value_of(field, expected)
            if one != other and not (one != one and other != other):  # noqa: PLR0124 - NaN
                return f"{field.name} is {one} instead of {other}"
    at = next(at for at, (one, other) in enumerate(zip(found, expected, strict=True)) if one != other)
    return f"byte {at} is 0x{found[at]:02x} instead of 0x{expected[at]:02x}"


def changes(before: bytes, after: bytes) -> tuple[int, int]:
    """How many bytes differ, and how many pages; a byte that is in one of them only counts."""
    count = pages = 0
    for at in range(0, max(len(before), len(after)), PAGE_BYTES):
        one, other = before[at : at + PAGE_BYTES], after[at : at + PAGE_BYTES]
        if one != other:
            both = min(len(one), len(other))
            bits = int.from_bytes(one[:both], "little") ^ int.from_bytes(other[:both], "little")
            count += abs(len(one) - len(other)) + both - bits.to_bytes(both, "little").count(0)
            pages += 1
    return count, pages


def of_reply(number: int, text: str) -> str:
    return f"the reply to request {number}: {text}"


def behind(number: int) -> str:
    return f"the state behind request {number}" if number else "the initial state"


def _size(data: bytes) -> str:
    return "no byte" if not data else f"{len(data)} byte{'s' if len(data) > 1 else ''}"


# -- the tasks ------------------------------------------------------------------------------------


def perform(task: Task, source: str, code: Code, tell: Note) -> Answer:
    """The answer of the function `source`; whatever it does by exceptions is an answer too."""
    last = ""

    def call(what: str) -> None:
        nonlocal last
        last = what
        tell(what)

    try:
        call("loading")
        try:
            make = load_application(source, code)
            first = make()
            described = _described(source, first)
        except (ConfigError, FunctionFailedError) as error:
            return NoFunction(reason_of(error))
        match task:
            case ExecuteAll(requests):
                return _execute(first, requests, described, call)
            case WatchStates(requests, points, expected):
                found = _watch(first, requests, points, described, call)
                close(first)
                del first
                return found if expected is None else _compared(found, make, requests, expected, call)
            case ResumeStates(requests, states, expected):
                close(first)
                del first
                call("initialisation")
                return ResumedElsewhere(
                    tuple(_resume(make(), at, state, requests, expected, call) for at, state in states)
                )
    except BaseException as error:  # noqa: BLE001
        return Unanswered(reason_of(error), last)


def _described(source: str, function: Application) -> FunctionDescription:
    """Raises ConfigError."""
    declared: object = function.characteristics
    if not isinstance(declared, Characteristics):
        raise ConfigError(f"{source}: characteristics: found {declared!r}, allowed is Characteristics(...)")
    for name in ("fields", "reply_fields"):
        found: object = getattr(function, name, ())
        if not isinstance(found, tuple) or not all(
            isinstance(one, Field) and one.kind in BITS for one in found
        ):
            raise ConfigError(f"{source}: {name}: found {found!r}, allowed is a tuple of Field(...)")
    return FunctionDescription(declared, fields_of(function), reply_fields_of(function))


def _execute(
    function: Application,
    requests: tuple[bytes, ...],
    described: FunctionDescription,
    call: Note,
) -> Executed:
    replies, took_ns, refused = [], [], 0
    clock = time.perf_counter_ns
    for number, request in enumerate(requests, 1):
        call(f"execute of request {number}")
        begin_ns = clock()
        try:
            reply = function.execute(request)
        except PeerError:
            reply = b""
            refused += 1
        took_ns.append(clock() - begin_ns)
        replies.append(reply)
    call("capture of the last state")
    begin_ns = clock()
    state = function.capture()
    return Executed(described, tuple(replies), refused, state, tuple(took_ns), clock() - begin_ns)


def _watch(
    function: Application,
    requests: tuple[bytes, ...],
    points: tuple[int, ...],
    described: FunctionDescription,
    call: Note,
) -> Watched:
    replies: list[bytes] = []
    states: list[bytes] = []
    kept: list[tuple[int, bytes]] = []
    counts: list[tuple[int, int]] = []
    whole = whole_bytes = most_bytes = 0
    unstable, before = "", b""
    for number in range(len(requests) + 1):
        if number:
            call(f"execute of request {number}")
            replies.append(_reply(function, requests[number - 1]))
        call(f"capture of {behind(number)}")
        state = function.capture()
        text = differs(function.capture(), state, described.fields)
        unstable = unstable or (text and f"{behind(number)}: {text}")
        whole_bytes += len(state)
        most_bytes = max(most_bytes, len(state))
        if whole_bytes <= WHOLE_STATES_BYTES_MAX:
            whole += 1
            states.append(state)
        else:
            states.append(blake2b(state, digest_size=DIGEST_BYTES).digest())
        if number in points:
            kept.append((number, state))
        if number:
            counts.append(changes(before, state))
        before = state
    order = {number: place for place, number in enumerate(points)}
    return Watched(
        tuple(replies),
        tuple(states),
        whole,
        most_bytes,
        tuple(count for count, _ in counts),
        tuple(pages for _, pages in counts),
        before,
        unstable=unstable,
        points=tuple(sorted(kept, key=lambda one: order[one[0]])),
    )


def _compared(
    found: Watched, make: Make, requests: tuple[bytes, ...], expected: Executed, call: Note
) -> Watched:
    """With what other instances of this process do: a new one each, and one that is used already."""
    expected = msgspec.structs.replace(expected, state=found.last_state)
    call("initialisation of a second instance")
    used = make()
    begun_anew = ""
    for number, request in enumerate(requests, 1):
        call(f"execute of request {number} in a second instance")
        text = differs(_reply(used, request), expected.replies[number - 1], expected.described.reply_fields)
        begun_anew = begun_anew or (text and of_reply(number, text))
    resumed = []
    if found.state_bytes:
        for at, state in found.points:
            resumed.append(_resume(used, at, state, requests, expected, call, used=True))
    close(used)
    del used
    if found.state_bytes:
        for at, state in found.points:
            call("initialisation of another instance")
            resumed.append(_resume(make(), at, state, requests, expected, call))
    return msgspec.structs.replace(found, begun_anew=begun_anew, resumed=tuple(resumed))


def _resume(
    function: Application,
    at: int,
    state: bytes,
    requests: tuple[bytes, ...],
    expected: Executed,
    call: Note,
    *,
    used: bool = False,
) -> Resumed:
    """Restore `state`, which comes behind `at` requests, and execute the others."""
    found = Resumed(at, used=used)
    fields, reply_fields = expected.described.fields, expected.described.reply_fields
    where = f"behind the restore of {behind(at)}"

    try:
        call(f"restore of {behind(at)}")
        function.restore(state)
        call(f"capture {where}")
        same = differs(function.capture(), state, fields)
        found = msgspec.structs.replace(found, restored_state=same)
        for number, request in enumerate(requests[at:], at + 1):
            call(f"execute of request {number} {where}")
            reply, wanted = _reply(function, request), expected.replies[number - 1]
            if reply == wanted:
                continue
            text = differs(reply, wanted, reply_fields)
            found = msgspec.structs.replace(
                found,
                reply=found.reply or of_reply(number, text),
                size=max(found.size, difference(reply_fields, reply, wanted)),
            )
        call(f"capture {where} and of all further requests")
        last = differs(function.capture(), expected.state, fields)
        if not used:
            close(function)
        return msgspec.structs.replace(found, last_state=last)
    except PeerError as error:
        return msgspec.structs.replace(found, failed=f"refused: {error}"[:WORDS_MAX])
    except Exception as error:  # noqa: BLE001 - of a function of the user
        line, *_ = reason_of(error).split("\n")
        return msgspec.structs.replace(found, failed=f"failed: {line}")


def _reply(function: Application, request: bytes) -> bytes:
    try:
        return function.execute(request)
    except PeerError:
        return b""


def reason_of(error: BaseException) -> str:
    """What went wrong, for an answer. A text that is fit to be shown may have the end of a stderr."""
    if isinstance(error, ConfigError | FunctionFailedError):
        return str(error)[:LINES_MAX]
    return f"{type(error).__name__}: {error}"[:WORDS_MAX]


# -- the process ----------------------------------------------------------------------------------


class ExerciseJob(msgspec.Struct, frozen=True):
    """`path`: where the code looks for modules that it imports."""

    task: Task
    source: str
    files: VettedFiles
    path: tuple[str, ...]
    surroundings: Surroundings


def work(data: bytes) -> bytes:
    job = msgspec.msgpack.decode(data, type=ExerciseJob)
    sys.path[:] = job.path
    sys.dont_write_bytecode = True
    os.chdir(job.surroundings.folder)
    ballast = [object() for _ in range(job.surroundings.ballast)]
    answer = perform(job.task, job.source, VettedCode((job.files,)), note)
    del ballast
    return msgspec.msgpack.encode(answer)


if __name__ == "__main__":
    serve(work)
