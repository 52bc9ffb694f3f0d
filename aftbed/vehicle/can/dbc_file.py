"""The DBC is the only truth about frames; this is the one place that reads it.

`Codec` is a thin typed layer over cantools: raw numbers in physical units, no names for values, and
aftbed's own errors. A frame that does not decode is a `PeerError`; a DBC that does not parse, or
lacks a message or a signal that is asked for, is the user's error: `ConfigError`, with the file, cantools'
reason, the line, and the nearest name that exists.

A DBC whose signals overlap or lie outside their message contradicts itself, so it is refused. Files of real
cars do that, most often in messages that are not needed here. With `strict` False such a file is read: a
message with overlapping signals is decoded signal by signal, each as the file has it, and a signal outside
its message does not exist (`misfits`).

cantools is imported when a DBC is loaded and not before: the mechanism's processes never need it,
and `aftbed --help` must not wait for it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from importlib import import_module
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from aftbed.core.errors import ConfigError, PeerError, unknown
from aftbed.vehicle.can.frame import DATA_LENGTH_MAX

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

DBC_BYTES_MAX: Final = 16_000_000  # the largest real ones known to us have two; a log given by mistake more
SIZE_MAX: Final = 0xFFFF  # of a message's bytes, a signal's bits and place, a range of multiplexer values
DIGITS_MAX: Final = 18
_SIZES: Final = re.compile(
    r"\bBO_\s+\d+\s+\w+\s*:\s*(\d+)|\bSG_\s+\w+(?:\s+\w+)?\s*:\s*(-?\d+)\s*\|\s*(\d+)", re.ASCII
)
_MULTIPLEXED: Final = re.compile(r"\bSG_MUL_VAL_\s[^;]*")
_RANGE: Final = re.compile(r"(\d+)\s*-\s*(\d+)", re.ASCII)
_PACKAGE: Final = Path(__file__).resolve().parents[2]
_CANDIDATES: Final = (
    _PACKAGE / "dbc" / "aftbed.dbc",  # in a wheel
    _PACKAGE.parent / "dbc" / "aftbed.dbc",  # in a checkout
)


class Codec:
    """One DBC, loaded: encodes and decodes by message name, in the physical units of the file."""

    def __init__(self, database: Database, path: Path, misfits: Mapping[str, frozenset[str]]) -> None:
        self.path = path
        self._messages: dict[str, Message] = {message.name: message for message in database.messages}
        self._misfits = misfits
        self._pieces = {
            name: [_alone(message, signal) for signal in message.signals if signal.name not in misfits[name]]
            for name, message in self._messages.items()
            if name in misfits and not message.is_multiplexed()
        }
        self._ranges: dict[str, dict[str, tuple[float, float]]] = {}  # of the messages encoded so far

    def names(self) -> list[str]:
        return sorted(self._messages)

    def signal_names(self, name: str) -> list[str]:
        return [signal.name for signal in self._message(name).signals]

    def misfits(self, name: str) -> frozenset[str]:
        """The signals of message `name` that lie outside of it; none in a DBC that was read strictly."""
        return self._misfits.get(name, frozenset())

    def can_id(self, name: str) -> int:
        return self._message(name).frame_id

    def length(self, name: str) -> int:
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
        """In small letters."""
        return sorted({node.lower() for message in self._messages.values() for node in message.senders})

    def sent_by(self, node: str) -> list[str]:
        messages = self._messages.values()
        return [m.name for m in messages if node in (sender.lower() for sender in m.senders)]

    def patch(self, name: str, signal: str, value: float) -> tuple[bytes, bytes]:
        """The bits of a signal in its message as a mask, and those of `value`.

        A value outside the range that the file gives is allowed. ConfigError if the bits cannot hold it.
        """
        found, message = self._signal(name, signal), self._message(name)
        if message.is_multiplexed():
            raise ConfigError(f"{self.path}: {name} is multiplexed: which signals it has is in its data")
        half, whole = 2 ** (found.length - 1), 2**found.length
        least, most = (-half, half - 1) if found.is_signed else (0, whole - 1)
        scale, offset = float(found.scale), float(found.offset)
        if signal in self.misfits(name) or scale == 0.0:
            raise ConfigError(f"{self.path}: {name}.{signal} has no bits that stand for a value")
        raw = round((value - offset) / scale)
        if found.is_float or not least <= raw <= most:
            low, high = sorted((offset + scale * least, offset + scale * most))
            raise ConfigError(f"{name}.{signal}={value:g}: its bits hold {low:g} to {high:g}")
        ones = -1 if found.is_signed else most
        alone = _alone(message, found)
        encoded = [alone.encode({signal: r}, scaling=False, strict=False) for r in (ones, raw)]
        return encoded[0], encoded[1]

    def unit(self, name: str, signal: str) -> str:
        """The unit of a signal as the file has it, "" where it has none."""
        return self._signal(name, signal).unit or ""

    def whole(self, name: str, signal: str) -> bool:
        """True if the signal is a plain whole number, as a counter must be."""
        found = self._signal(name, signal)
        return not found.is_float and found.scale == 1 and found.offset == 0

    def multiplexed(self, name: str) -> bool:
        """True if the signals of the message depend on the value of one of them."""
        return self._message(name).is_multiplexed()

    def encode(self, name: str, signals: Mapping[str, float]) -> bytes:
        """The data bytes of message `name`. Values outside the file's ranges are our own mistake.

        cantools takes longer to check a message than to encode it, so it checks only what is not plainly
        all signals within their ranges.
        """
        message = self._message(name)
        if name not in self._ranges:
            self._ranges[name] = _ranges(message)
        ranges = self._ranges[name]
        plain = signals.keys() == ranges.keys() and all(
            low <= signals[signal] <= high for signal, (low, high) in ranges.items()
        )
        return message.encode(dict(signals), strict=not plain)

    def decode(self, name: str, data: bytes) -> dict[str, float]:
        """All signals of message `name`, as numbers. Raises PeerError on a wrong length.

        A multiplexed message is not for this: which signals it has is in the data.
        """
        message = self._message(name)
        if len(data) != message.length:
            raise PeerError(f"{name} of {len(data)} bytes, expected {message.length}")
        # Numbers only: no names for values were asked for, and CAN messages hold no containers.
        if name not in self._pieces:
            return cast("dict[str, float]", message.decode(data, decode_choices=False))
        found: dict[str, float] = {}
        for piece in self._pieces[name]:
            found |= cast("dict[str, float]", piece.decode(data, decode_choices=False))
        return found

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


def _ranges(message: Message) -> dict[str, tuple[float, float]]:
    """Least and greatest value of each signal; empty where the data decide which signals there are."""
    if message.is_multiplexed():
        return {}
    return {
        signal.name: (
            -inf if signal.minimum is None else float(signal.minimum),
            inf if signal.maximum is None else float(signal.maximum),
        )
        for signal in message.signals
    }


@lru_cache(maxsize=1)
def own_dbc() -> Codec:
    """aftbed's own DBC, loaded once for this process and its forks: that takes 7 ms. Raises ConfigError."""
    return load_dbc()


def load_dbc(path: Path | None = None, *, strict: bool = True) -> Codec:
    """Load aftbed's own DBC, or the user's. ConfigError names the file, the reason and the line.

    With `strict` False also one whose signals overlap, or lie outside their message: see above.
    """
    chosen = path or next((candidate for candidate in _CANDIDATES if candidate.is_file()), None)
    if chosen is None:
        raise ConfigError(f"aftbed.dbc is missing, looked at: {', '.join(map(str, _CANDIDATES))}")
    try:
        if chosen.stat().st_size > DBC_BYTES_MAX:
            raise ConfigError(f"{chosen}: more than {DBC_BYTES_MAX} bytes, not a DBC")
        with chosen.open("rb") as file:
            text = file.read(DBC_BYTES_MAX).decode("cp1252")  # what DBC files are written in
    except OSError as error:
        raise ConfigError(f"{chosen}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{chosen}: not text, at byte {error.start}") from error
    _check_sizes(text, chosen)
    database, failure = _parse(text, strict=strict)
    if database is None:
        assert failure is not None
        way_out = strict and _parse(text, strict=False)[0] is not None
        offer = " (a map with `strict: false` takes it as it is)" if way_out else ""
        raise ConfigError(f"{chosen}: {_explain(failure, text)}{offer}") from failure
    _check_messages(database, chosen, text)
    return Codec(database, chosen, {} if strict else _contradictions(database))


def _check_sizes(text: str, path: Path) -> None:
    """Refuse what cantools allocates by before it compares it with the frame, or counts from the end."""
    for at, size in _sizes(text):
        if not 0 <= size <= SIZE_MAX:
            line = text.count("\n", 0, at) + 1
            what = "a length, a start bit or a range of multiplexer values"
            raise ConfigError(f"{path}: line {line}: {what} is {size}, allowed is 0 to {SIZE_MAX}")


def _sizes(text: str) -> Iterator[tuple[int, int]]:
    """Where a size stands in a DBC, and the size; of a range of multiplexer values, how many they are."""
    for found in _SIZES.finditer(text):
        for number in filter(None, found.groups()):
            yield found.start(), int(number[:DIGITS_MAX])
    for found in _MULTIPLEXED.finditer(text):
        for low, high in _RANGE.findall(found[0]):
            yield found.start(), int(high[:DIGITS_MAX]) - int(low[:DIGITS_MAX])


def _parse(text: str, *, strict: bool) -> tuple[Database | None, Exception | None]:
    """The database, or what cantools raises; the general classes were found by feeding it damaged files."""
    import_module("aftbed.vehicle.can.python_can")  # before cantools, which imports python-can
    from cantools.database.can import Database  # noqa: PLC0415 - lazily, see above
    from cantools.errors import Error  # noqa: PLC0415
    from textparser import ParseError  # noqa: PLC0415 - what cantools' parser raises: has line and column

    database = Database(strict=strict)
    try:
        database.add_dbc_string(text)
    except (Error, ParseError, ValueError, LookupError, ArithmeticError, AttributeError, TypeError) as error:
        return None, error
    return database, None


def _explain(error: Exception, text: str) -> str:
    """cantools' reason in one line, with the line of the file where cantools does not give it."""
    reason = " ".join(str(error).split())
    if isinstance(error, KeyError):
        reason = f"{reason} is not defined"
    elif isinstance(error, LookupError | AttributeError | TypeError):
        reason = f"cantools gives up: {reason}"
    line = 0 if " at line " in reason else _line(error, text)
    return f"{f'line {line}: ' if line else ''}not a DBC that can be read: {reason}"


def _line(error: Exception, text: str) -> int:
    """The line of the signal, message, attribute or entry that the error names; 0 if there is none."""
    if message := re.search(r"message (\w+)", str(error)):
        signals = re.search(r"signals? (\w+)(?: and (\w+))?", str(error))
        return _line_of(text, message[1], signals.groups() if signals is not None else ())
    named = str(error.args[0]) if isinstance(error, KeyError) else str(error).rpartition("\n")[2].strip()
    return next((number for number, line in enumerate(text.splitlines(), 1) if named and named in line), 0)


def _line_of(text: str, message: str, signals: tuple[str | None, ...] = ()) -> int:
    """The line of the last of the signals in the message, or else of the message; 0 if it is not there."""
    found, inside = 0, False
    for number, line in enumerate(text.splitlines(), 1):
        if opens := re.match(r"\s*BO_\s+\d+\s+(\w+)", line):
            inside = opens[1] == message
            found = number if inside and not found else found
        elif inside and (named := re.match(r"\s*SG_\s+(\w+)", line)) and named[1] in signals:
            found = number
    return found


def _contradictions(database: Database) -> dict[str, frozenset[str]]:
    """The messages with signals that overlap or lie outside, each with those that lie outside."""
    from cantools.errors import Error  # noqa: PLC0415

    def fits(message: Message) -> bool:
        try:
            message.refresh(strict=True)
        except Error:
            return False
        return True

    return {
        message.name: frozenset(
            signal.name
            for signal in (() if message.is_multiplexed() else message.signals)
            if not fits(_alone(message, signal))
        )
        for message in database.messages
        if not fits(message)
    }


def _alone(message: Message, signal: Signal) -> Message:
    """The message with this signal only, so that no other overlaps it."""
    wide = message.is_extended_frame
    return type(message)(
        message.frame_id, message.name, message.length, [signal], is_extended_frame=wide, strict=False
    )


def _check_messages(database: Database, path: Path, text: str) -> None:
    """An empty file parses too, long frames belong to CAN FD, and of two of a name one would be lost."""
    if not database.messages:
        raise ConfigError(f"{path}: holds no message")
    seen: set[str] = set()
    for message in database.messages:
        where = f"{path}: line {_line_of(text, message.name)}: message {message.name}"
        if not 0 <= message.length <= DATA_LENGTH_MAX:
            raise ConfigError(f"{where} has {message.length} bytes, allowed is 0 to 8")
        if message.name in seen:
            raise ConfigError(f"{where} stands twice, allowed is once")
        seen.add(message.name)
