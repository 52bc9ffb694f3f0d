"""A protected function in a shared library with the C interface of `aft.h`.

The library is loaded into the process that hosts the function: a call costs microseconds, and a crash of the
library is a crash of that process. Of what it does wrong without a crash, this module finds: writing behind a
buffer (there is a guard), sizes and return codes that are not allowed. Each is a fault, which ends the node.
"""

import ctypes
import weakref
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from aftbed.core.application import (
    EXACT,
    NONE,
    REPLY_BYTES_MAX,
    STATE_BYTES_MAX,
    AccessKind,
    Application,
    Characteristics,
    approximate,
)
from aftbed.core.errors import ConfigError, FunctionFailedError, PeerError
from aftbed.core.input_file import open_input

HEADER: Final = Path(__file__).with_name("aft.h")
OK: Final = 0
REFUSED: Final = 1
GUARD: Final = bytes(range(1, 256))  # behind a buffer: a library that writes too far changes it
ELF: Final = b"\x7fELF"
_NOT_SET: Final = ctypes.c_size_t(-1).value
_ACCESS: Final = {0: EXACT, 1: None, 2: NONE}  # None: approximate, within the tolerance


class _Description(ctypes.Structure):
    """`aft_description`."""

    _fields_ = (
        ("deterministic", ctypes.c_int),
        ("state_access", ctypes.c_int),
        ("tolerance", ctypes.c_double),
    )


_IN: Final = (ctypes.c_char_p, ctypes.c_size_t)
_OUT: Final = (ctypes.c_void_p, ctypes.c_size_t)
_INSTANCE: Final = ctypes.c_void_p
_REQUIRED: Final[dict[str, tuple[Any, tuple[Any, ...]]]] = {  # name: type of the result, of the arguments
    "aft_init": (ctypes.c_int, (ctypes.POINTER(ctypes.c_void_p),)),
    "aft_execute": (ctypes.c_int, (_INSTANCE, *_IN, *_OUT, ctypes.POINTER(ctypes.c_size_t))),
    "aft_state_size": (ctypes.c_int64, (_INSTANCE,)),
    "aft_capture": (ctypes.c_int, (_INSTANCE, *_OUT)),
    "aft_restore": (ctypes.c_int, (_INSTANCE, *_IN)),
}
_OPTIONAL: Final[dict[str, tuple[Any, tuple[Any, ...]]]] = {
    "aft_end": (None, (_INSTANCE,)),
    "aft_describe": (None, (ctypes.POINTER(_Description),)),
    "aft_acceptable": (ctypes.c_int, (*_IN, *_IN)),
}
_MAY_REFUSE: Final = ("aft_execute", "aft_restore")
_LIVE: Final[dict[int, set[int]]] = {}  # the instances of each library that this process has loaded


class LibraryFailedError(FunctionFailedError):
    """The library broke the contract of `aft.h`: a fault of the replica that hosts it."""


def library_function(path: Path) -> Callable[[], Application]:
    """Load the library; the maker of its instances.

    Raises ConfigError: no such file, no shared library, functions or a declaration that are missing or wrong.
    The maker raises ConfigError if the library can have one instance only and that exists, and
    LibraryFailedError if `aft_init` fails.
    """
    library = _loaded(path)
    return partial(LibraryFunction, path, library, _described(path, library))


def _loaded(path: Path) -> ctypes.CDLL:
    try:
        with open_input(path) as file:
            start = file.read(len(ELF))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    if start != ELF:
        raise ConfigError(f"{path}: no shared library: it begins with {start!r}, an ELF file with {ELF!r}")
    try:
        library = ctypes.CDLL(str(path.absolute()))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be loaded: {error}") from None
    missing = [name for name in _REQUIRED if not hasattr(library, name)]
    if missing:
        raise ConfigError(f"{path}: lacks {', '.join(missing)} (required by {HEADER.name})")
    for name, (result, arguments) in (_REQUIRED | _OPTIONAL).items():
        if hasattr(library, name):
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    return library


def _described(path: Path, library: ctypes.CDLL) -> Characteristics:
    found = _Description(1, 0, 0.0)
    if hasattr(library, "aft_describe"):
        library.aft_describe(ctypes.byref(found))
    if found.deterministic not in (0, 1):
        raise ConfigError(
            f"{path}: aft_describe: deterministic: found {found.deterministic}, 0 or 1 is allowed"
        )
    if found.state_access not in _ACCESS:
        raise ConfigError(
            f"{path}: aft_describe: state_access: found {found.state_access},"
            f" AFT_EXACT (0), AFT_APPROXIMATE (1) or AFT_NONE (2) is allowed"
        )
    access = _ACCESS[found.state_access]
    if access is None:
        try:
            access = approximate(found.tolerance)
        except ConfigError as error:
            raise ConfigError(f"{path}: aft_describe: {error}") from None
    return Characteristics(bool(found.deterministic), access)


class LibraryFunction:
    """An instance, which is freed when this is collected, or closed."""

    def __init__(self, path: Path, library: ctypes.CDLL, characteristics: Characteristics) -> None:
        self.characteristics = characteristics
        self._path, self._library = path, library
        self._access = characteristics.state_access.kind is not AccessKind.NONE
        self._asserts = hasattr(library, "aft_acceptable")
        instance = ctypes.c_void_p()
        self._check("aft_init", library.aft_init(ctypes.byref(instance)))
        live = _LIVE.setdefault(library._handle, set())
        address = instance.value or 0
        if address in live:
            raise ConfigError(
                f"{path}: aft_init gave the instance at {address:#x}, which is in use: this library can have"
                f" one instance at a time, more are needed here; {HEADER.name} says how it can have several"
            )
        live.add(address)
        self._instance = address
        self._finalizer = weakref.finalize(self, _end, library, address, live)
        self._finalizer.atexit = False
        self._reply = _Buffer(REPLY_BYTES_MAX)

    def close(self) -> None:
        """Free the instance, which cannot be used from then on."""
        self._finalizer()

    def execute(self, request: bytes) -> bytes:
        self._check_open()
        size, reply = ctypes.c_size_t(_NOT_SET), self._reply
        reply.clear()
        code = self._library.aft_execute(
            self._instance, request, len(request), reply.address, REPLY_BYTES_MAX, ctypes.byref(size)
        )
        self._check_guard("aft_execute", reply)
        if code == REFUSED:
            raise PeerError(f"{self._path}: refuses the request of {len(request)} bytes")
        self._check("aft_execute", code)
        if size.value > REPLY_BYTES_MAX:
            found = "was not set" if size.value == _NOT_SET else f"is {size.value}"
            raise self._failed(f"aft_execute: *reply_size {found}, at most {REPLY_BYTES_MAX} is allowed")
        return reply.head(size.value)

    def capture(self) -> bytes:
        self._check_open()
        if not self._access:
            return b""
        size = self._library.aft_state_size(self._instance)
        if not 0 <= size <= STATE_BYTES_MAX:
            raise self._failed(f"aft_state_size returned {size}, 0 to {STATE_BYTES_MAX} is allowed")
        state = _Buffer(size)
        code = self._library.aft_capture(self._instance, state.address, size)
        self._check_guard("aft_capture", state)
        self._check("aft_capture", code)
        return state.head(size)

    def restore(self, state: bytes) -> None:
        self._check_open()
        if not self._access:
            if state:
                raise PeerError(f"{self._path}: a state of {len(state)} bytes, but there is no access to it")
            return
        code = self._library.aft_restore(self._instance, state, len(state))
        if code == REFUSED:
            raise PeerError(f"{self._path}: refuses the state of {len(state)} bytes")
        self._check("aft_restore", code)

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        self._check_open()
        if not self._asserts:
            return True
        answer = self._library.aft_acceptable(request, len(request), reply, len(reply))
        if answer not in (0, 1):
            raise self._failed(f"aft_acceptable returned {answer}, 0 or 1 is allowed")
        return bool(answer)

    def _check_open(self) -> None:
        if not self._finalizer.alive:
            raise RuntimeError(f"{self._path}: this instance is closed")

    def _check(self, function: str, code: int) -> None:
        if code != OK:
            allowed = "AFT_OK (0) or AFT_REFUSED (1)" if function in _MAY_REFUSE else "AFT_OK (0)"
            raise self._failed(f"{function} returned {code}, {allowed} is allowed")

    def _check_guard(self, function: str, buffer: "_Buffer") -> None:
        if not buffer.intact():
            raise self._failed(f"{function} wrote more than the {buffer.size} bytes that it was given")

    def _failed(self, what: str) -> LibraryFailedError:
        return LibraryFailedError(f"{self._path}: {what}")


def _end(library: ctypes.CDLL, instance: int, live: set[int]) -> None:
    live.discard(instance)
    if hasattr(library, "aft_end"):
        library.aft_end(instance)


class _Buffer:
    """`size` bytes for a library to write to, all 0, with the guard behind them."""

    def __init__(self, size: int) -> None:
        self.size = size
        data = bytearray(size + len(GUARD))
        data[size:] = GUARD
        self._view = memoryview(data)
        self._behind = self._view[size:]
        self.address = ctypes.addressof(ctypes.c_char.from_buffer(data))  # the views keep it where it is

    def clear(self) -> None:
        ctypes.memset(self.address, 0, self.size)

    def intact(self) -> bool:
        return self._behind == GUARD

    def head(self, size: int) -> bytes:
        return self._view[:size].tobytes()
