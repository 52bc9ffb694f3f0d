"""Between a log's frames and python-can's messages, which its readers make and its writers take.

A reader of python-can goes on where it can: a line it cannot parse, or an object it does not know, is
skipped, and logged at best. Here whatever it warns of is an error. Nor does it compare the length that a
frame announces with the bytes that are there; that is done here too, or a line that was cut off would be a
shorter frame.
"""

import io
import logging
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from aftbed.core.errors import ConfigError, PeerError
from aftbed.vehicle.logs.candumpfile import FD
from aftbed.vehicle.logs.frames import Kind, Log, LoggedFrame, interface

if TYPE_CHECKING:
    from can import Message

# What the readers let through when a file is not what they expect.
READ_ERRORS: Final = (
    ValueError, LookupError, TypeError, ArithmeticError, AttributeError, AssertionError, RuntimeError,
    EOFError, struct.error, zlib.error,
)  # fmt: skip


class Memory(io.BytesIO):
    """What a writer of python-can writes; kept when it closes it. On a full disk its own file stays open."""

    name = ""  # the writer of TRC asks for it
    written = b""

    def close(self) -> None:
        if not self.closed:
            self.written = self.getvalue()
        super().close()


@contextmanager
def complaints() -> Iterator[list[str]]:
    """What python-can's readers and writers log as a warning, or worse, meanwhile."""
    found: list[str] = []
    logger = logging.getLogger("can.io")

    class Keeper(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            found.append(record.getMessage())

    keeper = Keeper(logging.WARNING)
    propagates = logger.propagate
    logger.addHandler(keeper)
    logger.propagate = False
    try:
        yield found
    finally:
        logger.propagate = propagates
        logger.removeHandler(keeper)


def taken(
    path: Path, messages: Iterable["Message"], where: Callable[[], str], channel_offset: int = 0
) -> Log:
    """The frames of a reader; `where` says how far it is. Raises ConfigError naming file and place."""
    frames: list[LoggedFrame] = []
    fd = 0
    with complaints() as warned:
        try:
            for message in messages:
                if warned:
                    break
                if message.is_fd and not message.is_error_frame:
                    fd += 1
                else:
                    frames.append(frame_of(message, channel_offset))
        except PeerError as error:
            raise ConfigError(f"{path}: {where()}: {error}") from None
        except READ_ERRORS as error:
            raise ConfigError(f"{path}: {where()}: cannot be read: {error or type(error).__name__}") from None
    if warned:
        raise ConfigError(f"{path}: {where()}: cannot be read: {warned[0]}")
    return Log(tuple(frames), {FD: fd} if fd else {})


def frame_of(message: "Message", channel_offset: int = 0) -> LoggedFrame:
    """A message as a frame; `channel_offset` is what the reader adds to a channel. Raises PeerError."""
    is_error, is_remote = bool(message.is_error_frame), bool(message.is_remote_frame)
    kind = Kind.ERROR if is_error else Kind.REMOTE if is_remote else Kind.DATA
    data = bytes(message.data) if kind is not Kind.REMOTE else b""
    if kind is Kind.DATA and len(data) != message.dlc:
        raise PeerError(f"a frame of {message.dlc} bytes with {len(data)}")
    channel = message.channel if isinstance(message.channel, int) else channel_offset
    return LoggedFrame(
        t_us=round(message.timestamp * 1e6),
        interface=interface(channel - channel_offset),
        can_id=message.arbitration_id,
        data=data,
        extended=bool(message.is_extended_id) or is_error,
        kind=kind,
        length=message.dlc if kind is Kind.REMOTE else 0,
        sent=not message.is_rx and not is_error,
    )


def message_of(frame: LoggedFrame, channel: int) -> "Message":
    """A frame as a message."""
    from can import Message  # noqa: PLC0415 - slow to import

    is_remote = frame.kind is Kind.REMOTE
    return Message(
        timestamp=frame.t_us / 1e6,
        arbitration_id=frame.can_id,
        is_extended_id=frame.extended,
        is_remote_frame=is_remote,
        is_error_frame=frame.kind is Kind.ERROR,
        channel=channel,
        dlc=frame.length if is_remote else len(frame.data),
        data=None if is_remote else frame.data,
        is_rx=not frame.sent,
    )
