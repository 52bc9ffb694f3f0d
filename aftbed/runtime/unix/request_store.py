"""The requests and expected replies that a user gave a run, in its record.

The command writes them before anything is started. Each Client of the run, a successor too, reads the
requests, and the judge reads both. Nodes import this module, so what only the judge needs is imported there.
"""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.core.input_file import read_input

if TYPE_CHECKING:
    from aftbed.functions.request_file import ExpectedReplies, GivenRequests

REQUESTS_NAME: Final = "requests.msgpack"  # a list of bytes
EXPECTED_NAME: Final = "expected.msgpack"  # an `ExpectedReplies`
STORED_BYTES_MAX: Final = 66 << 20  # 64 MiB, and some bytes around each of 100 000 requests

T = TypeVar("T")


def write_given(record: Path, given: "GivenRequests") -> None:
    """Raises OSError, also where they are there."""
    _write(record / REQUESTS_NAME, given.requests)
    if given.expected is not None:
        _write(record / EXPECTED_NAME, given.expected)


def _write(path: Path, content: object) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with open(descriptor, "wb") as file:
        file.write(msgspec.msgpack.encode(content))


def stored_requests(record: Path) -> tuple[bytes, ...] | None:
    """None where there is no such file. Raises ConfigError."""
    found = _read(record / REQUESTS_NAME, tuple[bytes, ...])
    if found == ():
        raise ConfigError(f"{record / REQUESTS_NAME}: no request in it")
    return found


def stored_replies(record: Path) -> "ExpectedReplies | None":
    """None where there is no such file. Raises ConfigError."""
    from aftbed.functions.request_file import (  # noqa: PLC0415 - not in nodes
        ExpectedReplies,
        FieldCodec,
        check_tolerance,
    )

    path = record / EXPECTED_NAME
    found = _read(path, ExpectedReplies)
    if found is not None:
        try:
            check_tolerance("tolerance", found.tolerance)
            _ = FieldCodec.parse(found.codec) if found.codec else None
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None
    return found


def _read(path: Path, kind: type[T]) -> T | None:
    try:
        return msgspec.msgpack.decode(read_input(path, STORED_BYTES_MAX), type=kind)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: {error}") from None
