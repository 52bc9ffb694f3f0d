"""The DBC is the only truth about frames; this is the one place that reads it.

`Codec` is a thin typed face over cantools: raw numbers in physical units, no names for values, and
aftbed's own errors. A frame that does not decode is a `PeerError`; a DBC that does not parse, or
lacks a message or a signal that somebody asked for, is the user's: `ConfigError`, with the file,
the line that cantools found, and the nearest name that exists.

cantools is imported when a DBC is loaded and not before: the mechanism's processes never need it,
and `aftbed --help` must not wait for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from aftbed.core.errors import ConfigError, PeerError, unknown
from aftbed.vehicle.frame import DATA_LENGTH_MAX

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

DBC_BYTES_MAX: Final = 16_000_000  # the largest real ones known to us have two; a log given by mistake more
_PACKAGE: Final = Path(__file__).resolve().parents[1]
_CANDIDATES: Final = (
    _PACKAGE / "dbc" / "aftbed.dbc",  # in a wheel
    _PACKAGE.parent / "dbc" / "aftbed.dbc",  # in a checkout
)


class Codec:
    """One DBC, loaded: encodes and decodes by message name, in the physical units of the file."""

    def __init__(self, database: Database, path: Path) -> None:
        self.path = path
        self._messages: dict[str, Message] = {message.name: message for message in database.messages}

    def names(self) -> list[str]:
        """All messages of the file."""
        return sorted(self._messages)

    def signal_names(self, name: str) -> list[str]:
        """All signals of message `name`."""
        return [signal.name for signal in self._message(name).signals]

    def can_id(self, name: str) -> int:
        """The 11-bit identifier of message `name`."""
        return self._message(name).frame_id

    def length(self, name: str) -> int:
        """The number of data bytes of message `name`."""
        return self._message(name).length

    def cycle_us(self, name: str) -> int:
        """GenMsgCycleTime of message `name`, in microseconds. ConfigError if the file has none."""
        cycle_ms = self._message(name).cycle_time
        if not cycle_ms:
            raise ConfigError(f"{self.path}: message {name} has no GenMsgCycleTime")
        return cycle_ms * 1000

    def data_id(self, name: str) -> int:
        """E2EDataID of the E2E protected message `name`. ConfigError if it is not protected."""
        attributes = self._message(name).dbc.attributes  # type: ignore[union-attr]
        if "E2EDataID" not in attributes:
            raise ConfigError(f"{self.path}: message {name} has no E2EDataID")
        return int(attributes["E2EDataID"].value)

    def senders(self) -> list[str]:
        """The nodes that send something, in small letters."""
        return sorted({node.lower() for message in self._messages.values() for node in message.senders})

    def sent_by(self, node: str) -> list[str]:
        """The messages that `node` sends."""
        messages = self._messages.values()
        return [m.name for m in messages if node in (sender.lower() for sender in m.senders)]

    def patch(self, name: str, signal: str, value: float) -> tuple[bytes, bytes]:
        """Where the bits of a signal are in its message, as a mask, and what they are for `value`.

        Any value that has bits will do, also one outside the range that the file gives. ConfigError else.
        """
        found, message = self._signal(name, signal), self._message(name)
        if message.is_multiplexed():
            raise ConfigError(f"{self.path}: {name} is multiplexed: which signals it has is in its data")
        half, whole = 2 ** (found.length - 1), 2**found.length
        least, most = (-half, half - 1) if found.is_signed else (0, whole - 1)
        scale, offset = float(found.scale), float(found.offset)
        raw = round((value - offset) / scale)
        if found.is_float or not least <= raw <= most:
            low, high = sorted((offset + scale * least, offset + scale * most))
            raise ConfigError(f"{name}.{signal}={value:g}: its bits hold {low:g} to {high:g}")
        ones = -1 if found.is_signed else most
        zero = dict.fromkeys(self.signal_names(name), 0)
        encoded = [message.encode(zero | {signal: r}, scaling=False, strict=False) for r in (ones, raw)]
        return encoded[0], encoded[1]

    def unit(self, name: str, signal: str) -> str:
        """The unit of a signal as the file has it, "" where it has none."""
        return self._signal(name, signal).unit or ""

    def whole(self, name: str, signal: str) -> bool:
        """True if the signal is a plain whole number, as a counter must be."""
        found = self._signal(name, signal)
        return not found.is_float and found.scale == 1 and found.offset == 0

    def multiplexed(self, name: str) -> bool:
        """True if what the message holds depends on a signal in it."""
        return self._message(name).is_multiplexed()

    def encode(self, name: str, signals: Mapping[str, float]) -> bytes:
        """The data bytes of message `name`. What does not fit the file's ranges is our own mistake."""
        return self._message(name).encode(dict(signals))

    def decode(self, name: str, data: bytes) -> dict[str, float]:
        """All signals of message `name`, as numbers. Raises PeerError on a wrong length.

        A multiplexed message is not for this: which signals it has is in the data.
        """
        message = self._message(name)
        if len(data) != message.length:
            raise PeerError(f"{name} of {len(data)} bytes, expected {message.length}")
        # Numbers only: no names for values were asked for, and CAN messages hold no containers.
        return cast("dict[str, float]", message.decode(data, decode_choices=False))

    def _message(self, name: str) -> Message:
        message = self._messages.get(name)
        if message is None:
            raise ConfigError(f"{self.path}: {unknown('message', name, self._messages)}")
        return message

    def _signal(self, name: str, signal: str) -> Signal:
        for candidate in self._message(name).signals:
            if candidate.name == signal:
                return candidate
        raise ConfigError(f"{self.path}: {unknown(f'signal of {name}', signal, self.signal_names(name))}")


def load_dbc(path: Path | None = None) -> Codec:
    """Load aftbed's own DBC, or the user's. ConfigError names the file, the reason and the line."""
    chosen = path or _own_dbc()
    text = _read(chosen)
    from cantools.database.can import Database  # noqa: PLC0415  # lazily, see above
    from cantools.errors import Error  # noqa: PLC0415
    from textparser import ParseError  # noqa: PLC0415  # what cantools' parser raises: has line and column

    database = Database()
    try:
        database.add_dbc_string(text)
    except (Error, ParseError, ValueError, KeyError, OverflowError) as error:
        raise ConfigError(f"{chosen}: not a DBC that can be read: {error}") from error
    _check_classic(database, chosen)
    return Codec(database, chosen)


def _own_dbc() -> Path:
    for candidate in _CANDIDATES:
        if candidate.is_file():
            return candidate
    raise ConfigError(f"aftbed.dbc is missing, looked at: {', '.join(map(str, _CANDIDATES))}")


def _read(path: Path) -> str:
    try:
        if path.stat().st_size > DBC_BYTES_MAX:
            raise ConfigError(f"{path}: more than {DBC_BYTES_MAX} bytes, not a DBC")
        return path.read_text(encoding="cp1252")  # what DBC files are written in
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not text, at byte {error.start}") from error


def _check_classic(database: Database, path: Path) -> None:
    """An empty file parses too, and long frames belong to CAN FD: refuse both by name."""
    if not database.messages:
        raise ConfigError(f"{path}: holds no message")
    for message in database.messages:
        if message.length > DATA_LENGTH_MAX:
            raise ConfigError(f"{path}: message {message.name} has {message.length} bytes, allowed is 0 to 8")
