"""A protected function that is a program, in any language: JSON lines on its stdin and stdout.

A line is a request, a line is its answer, in turn. Bytes are in hex.

| request                                                        | answer                              |
|----------------------------------------------------------------|-------------------------------------|
| `{"id":0,"describe":null}`, once, first                        | `{"id":0,"describe":{...}}`         |
| `{"id":1,"execute":"0a2b"}`                                    | `{"id":1,"execute":"0c"}`           |
| `{"id":2,"capture":null}`                                      | `{"id":2,"capture":"00"}`           |
| `{"id":3,"restore":"00"}`                                      | `{"id":3,"restore":null}`           |
| `{"id":4,"acceptable":{"request":"0a2b","reply":"0c"}}`        | `{"id":4,"acceptable":true}`        |

`execute` and `restore` may be refused, with the state as it was: `{"id":1,"error":"text"}`.
`ProgramDescription` has what the program declares of itself. `acceptable` is asked only of a program that
says there that it answers it.

Anything else is a fault: an answer that is late, too long, of another id or no such line, and the end of the
program. Then the program is killed, the end of its stderr is quoted, and the node that hosts it ends.

The program is a child of the process that made the object, and lives as long as the object: it is killed when
that is closed or collected, and by the kernel when that process dies (prctl(2), PR_SET_PDEATHSIG). It has no
descriptor but its three pipes. There is no thread: stderr is read while an answer is waited for, so a program
that fills that pipe between two requests stands still until the next one.
"""

import ctypes
import os
import select
import shlex
import signal
import subprocess
import time
import weakref
from binascii import unhexlify
from collections.abc import Callable
from functools import partial
from typing import Final

import msgspec
from msgspec import UNSET, UnsetType

from aftbed.core.application import (
    REPLY_BYTES_MAX,
    STATE_BYTES_MAX,
    AccessKind,
    Application,
    Characteristics,
    WrittenAccess,
    access_of,
)
from aftbed.core.errors import ConfigError, FunctionFailedError, PeerError, shown

DESCRIBE_SECONDS_MAX: Final = (
    5.0  # an interpreter or a virtual machine starts first, on a machine that is busy
)
ANSWER_SECONDS_MAX: Final = (
    2.0  # as long as any step of the runtime may take; 30 MB of state take Python 0.5 s
)
END_SECONDS_MAX: Final = 1.0  # of a program that was killed, or has closed a pipe
STDERR_BYTES_MAX: Final = 4096  # of its end, which is kept
STDERR_READS_MAX: Final = 64  # at a fault: what the program has started may go on writing
ERROR_CHARACTERS_MAX: Final = 300
CHUNK_BYTES: Final = 1 << 16  # what a pipe holds
FRAME_BYTES_MAX: Final = 4096  # of an answer, beside the bytes in hex
PR_SET_PDEATHSIG: Final = 1
REFUSABLE: Final = ("execute", "restore")

_libc: Final = ctypes.CDLL(None)
_libc.prctl.argtypes = (ctypes.c_int, *(ctypes.c_ulong,) * 4)


class ProgramFailedError(FunctionFailedError):
    """The program broke the protocol, or ended: a fault of the replica that hosts it."""


class ProgramDescription(msgspec.Struct, forbid_unknown_fields=True):
    """What a program declares of itself (`Characteristics`), and whether it answers `acceptable`."""

    deterministic: bool = True
    state_access: WrittenAccess = "exact"
    acceptable: bool = False


class ProgramAnswer(msgspec.Struct, forbid_unknown_fields=True):
    """A line of the program: the id, and one of the others."""

    id: int
    describe: ProgramDescription | UnsetType = UNSET
    execute: str | UnsetType = UNSET
    capture: str | UnsetType = UNSET
    restore: UnsetType | None = UNSET
    acceptable: bool | UnsetType = UNSET
    error: str | UnsetType = UNSET


Value = ProgramDescription | bytes | bool | None
_decode: Final = msgspec.json.Decoder(ProgramAnswer).decode
_ANSWERS: Final = ProgramAnswer.__struct_fields__[1:]
_SIZES: Final = {"execute": REPLY_BYTES_MAX, "capture": STATE_BYTES_MAX}  # bytes at most, of an answer


def program_function(command: str) -> Callable[[], Application]:
    """The maker of instances of the program that `command` starts; no shell reads it.

    Raises ConfigError where it is no command line. The maker starts the program: it raises ConfigError where
    that is not possible, and ProgramFailedError where the program gives no description.
    """
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ConfigError(f"{command!r} is no command line: {str(error).lower()}") from None
    if not words:
        raise ConfigError("the command line of the program is empty")
    return partial(Program, words)


def read_answer(line: bytes, number: int, asked: str) -> Value:
    """What `line` answers to the request `asked` with the id `number`.

    Raises PeerError where the request is refused, and ValueError where this is no answer to it.
    """
    try:
        answer = _decode(line)
    except (msgspec.MsgspecError, ValueError) as error:  # ValueError: no UTF-8, before msgspec 0.23
        raise ValueError(f"{_excerpt(line)}: {error}") from None
    if answer.id != number:
        raise ValueError(f"{_excerpt(line)}: the id is {answer.id}, not {number}")
    given = [name for name in _ANSWERS if getattr(answer, name) is not UNSET]
    if given == ["error"] and asked in REFUSABLE:
        raise PeerError(shown(str(answer.error))[:ERROR_CHARACTERS_MAX])
    if given != [asked]:
        allowed = f"{asked!r} or 'error'" if asked in REFUSABLE else repr(asked)
        raise ValueError(
            f"{_excerpt(line)}: it has {', '.join(map(repr, given)) or 'neither'}, not {allowed}"
        )
    value: ProgramDescription | str | bool | None = getattr(answer, asked)
    if not isinstance(value, str):
        return value
    try:
        found = unhexlify(value)
    except ValueError as error:
        raise ValueError(f"{_excerpt(line)}: {asked}: no hex: {error}") from None
    if len(found) > _SIZES[asked]:
        raise ValueError(f"{len(found)} bytes, at most {_SIZES[asked]} are allowed")
    return found


def _excerpt(line: bytes, most: int = 100) -> str:
    return repr(line[:most]) + ("..." if len(line) > most else "")


class Program:
    """A started program. Only the process that made it may use it, and only one of its threads.

    The kernel ties the program to the thread that made it: it is killed when that thread ends.
    """

    def __init__(self, words: list[str]) -> None:
        self._command, self._owner = shlex.join(words), os.getpid()
        self._number, self._failure = 0, ""
        self._stderr_end, self._stderr_closed = bytearray(), False
        process = self._process = self._started(words)
        self._finalizer = weakref.finalize(self, _end, process)
        assert process.stdin and process.stdout and process.stderr
        self._stdin, self._stdout, self._stderr = (
            pipe.fileno() for pipe in (process.stdin, process.stdout, process.stderr)
        )
        self._poll = select.poll()
        for pipe in (self._stdin, self._stdout, self._stderr):
            os.set_blocking(pipe, False)
        for pipe in (self._stdout, self._stderr):
            self._poll.register(pipe, select.POLLIN)
        self.characteristics = self._describe()

    def _started(self, words: list[str]) -> "subprocess.Popen[bytes]":
        """Raises ConfigError."""
        try:
            # In the child, `_die_with` makes two system calls and takes no lock. The alternative is another
            # program, which calls prctl and executes this one: 15 ms more, if it is an interpreter.
            return subprocess.Popen(
                words,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                preexec_fn=partial(_die_with, self._owner),  # noqa: PLW1509
            )
        except (OSError, ValueError) as error:  # ValueError: a null byte
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise ConfigError(f"{self._command}: cannot be started: {words[0]}: {reason}") from None

    def _describe(self) -> Characteristics:
        described = self._ask("describe", "null")
        assert isinstance(described, ProgramDescription)
        self._asserts = described.acceptable
        return Characteristics(described.deterministic, access_of(described.state_access))

    def close(self) -> None:
        """Kill the program, which cannot be asked from then on."""
        self._failure = self._failure or "is closed"
        self._finalizer()

    # -- the function -------------------------------------------------------------------------

    def execute(self, request: bytes) -> bytes:
        reply = self._ask("execute", f'"{request.hex()}"')
        assert isinstance(reply, bytes)
        return reply

    def capture(self) -> bytes:
        if self.characteristics.state_access.kind is AccessKind.NONE:
            return b""
        state = self._ask("capture", "null")
        assert isinstance(state, bytes)
        return state

    def restore(self, state: bytes) -> None:
        if self.characteristics.state_access.kind is not AccessKind.NONE:
            self._ask("restore", f'"{state.hex()}"')
        elif state:
            raise PeerError(f"{self._command}: a state of {len(state)} bytes, but there is no access to it")

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        if not self._asserts:
            return True
        answer = self._ask("acceptable", f'{{"request":"{request.hex()}","reply":"{reply.hex()}"}}')
        return answer is True

    # -- the protocol -------------------------------------------------------------------------

    def _ask(self, asked: str, argument: str) -> Value:
        """Raises PeerError where the program refuses, ProgramFailedError otherwise."""
        if self._failure:
            raise ProgramFailedError(f"{self._command}: {self._failure}")
        if os.getpid() != self._owner:
            raise RuntimeError(f"{self._command}: only process {self._owner}, which started it, may use it")
        number, self._number = self._number, self._number + 1
        line = self._exchange(f'{{"id":{number},"{asked}":{argument}}}\n'.encode(), asked)
        try:
            return read_answer(line, number, asked)
        except ValueError as error:
            raise self._failed(f"answered to {asked}: {error}") from None
        except PeerError as error:
            raise PeerError(f"{self._command}: {error}") from None

    def _exchange(self, request: bytes, asked: str) -> bytes:
        """Send a line and return the line that comes back, without its end. Raises ProgramFailedError."""
        seconds = DESCRIBE_SECONDS_MAX if asked == "describe" else ANSWER_SECONDS_MAX
        limit_s = time.monotonic() + seconds
        bytes_max = 2 * _SIZES.get(asked, 0) + FRAME_BYTES_MAX
        answer, whole, late = bytearray(), False, False
        left = self._send(memoryview(request))
        if left:
            self._poll.register(self._stdin, select.POLLOUT)
        while left or not whole:
            left_ms = (limit_s - time.monotonic()) * 1e3
            if late:
                hint = "; does it flush its stdout?" if asked == "describe" else ""
                raise self._failed(f"gave no answer to {asked} within {seconds:g} s{hint}")
            late = left_ms <= 0  # once more, for a process that was itself stopped meanwhile
            for pipe, _ in self._poll.poll(max(0.0, left_ms)):
                if pipe == self._stdout:
                    found = self._read_answer(asked, len(answer))
                    answer += found
                    whole = whole or b"\n" in found
                elif pipe == self._stderr:
                    self._read_stderr()
                else:
                    left = self._send(left)
                    if not left:
                        self._poll.unregister(self._stdin)
            if len(answer) > bytes_max:
                raise self._failed(f"answered to {asked}: more than {bytes_max} bytes in a line")
        line, _, rest = bytes(answer).partition(b"\n")
        if rest:
            raise self._failed(f"answered to {asked}: more than one line: {_excerpt(rest)}")
        return line

    def _send(self, data: memoryview) -> memoryview:
        """What is left of `data`."""
        try:
            return data[os.write(self._stdin, data) :]
        except BlockingIOError:
            return data
        except BrokenPipeError:
            raise self._failed(self._end_of("stdin")) from None

    def _read_answer(self, asked: str, before: int) -> bytes:
        found = os.read(self._stdout, CHUNK_BYTES)
        if not found:
            middle = f", {before} bytes into its answer to {asked}" if before else f", asked to {asked}"
            raise self._failed(self._end_of("stdout") + middle)
        return found

    def _read_stderr(self) -> bool:
        """Keep the end of it. Whether there may be more."""
        if self._stderr_closed:
            return False
        try:
            found = os.read(self._stderr, CHUNK_BYTES)
        except BlockingIOError:
            return False
        if not found:
            self._stderr_closed = True
            self._poll.unregister(self._stderr)  # else every poll would return at once
            return False
        self._stderr_end += found
        del self._stderr_end[:-STDERR_BYTES_MAX]
        return True

    # -- a fault ------------------------------------------------------------------------------

    def _end_of(self, pipe: str) -> str:
        """How the program ended, which has closed a pipe."""
        try:
            code = self._process.wait(END_SECONDS_MAX)
        except subprocess.TimeoutExpired:
            return f"closed its {pipe}"
        if code >= 0:
            return f"ended with exit code {code}"
        names = {one.value: one.name for one in signal.Signals}
        return f"was killed by {names.get(-code, f'signal {-code}')}"

    def _failed(self, what: str) -> ProgramFailedError:
        """The error that says so, with the end of stderr; the program is killed."""
        for _ in range(STDERR_READS_MAX):
            if not self._read_stderr():
                break
        text = shown(bytes(self._stderr_end).decode(errors="replace")).strip()
        self._failure = (
            f"{what}\nthe end of its stderr:\n{text}" if text else f"{what}; nothing is on its stderr"
        )
        self._finalizer()
        return ProgramFailedError(f"{self._command}: {self._failure}")


def _die_with(parent: int) -> None:
    """In the child, before the program is executed: have the kernel kill it when `parent` dies."""
    if _libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0 or os.getppid() != parent:
        os._exit(1)


def _end(process: "subprocess.Popen[bytes]") -> None:
    """In a fork of the process that started it, nothing is killed: Popen finds that it has no such child."""
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()
    process.kill()
    try:
        process.wait(END_SECONDS_MAX)
    except subprocess.TimeoutExpired:
        process.returncode = -signal.SIGKILL  # it waits for a disk; the kernel ends it
