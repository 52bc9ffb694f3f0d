"""The DBC is the only truth about frames; this is the one place that reads it.

`Codec` is a thin typed layer over cantools: raw numbers in physical units, no names for values, and
aftbed's own errors. A frame that does not decode is a `PeerError`; a DBC that cannot be read, or
lacks a message or a signal that is asked for, is the user's error: `ConfigError`, with the file, the reason,
the line, and the nearest name that exists.

Only what is used has to be right. Files of real cars have messages of CAN FD, messages that stand twice,
and signals that overlap or lie outside their message, most often where nobody looks: each of them is an
error when the message is asked for, and not before. With `strict` False overlapping signals are decoded one
by one, each as the file has it, and a signal outside its message does not exist (`misfits`).

A file that cantools refuses is read by canmatrix, which goes line by line and leaves out what it cannot read;
`notes` has what it left out. Only messages and signals are taken from it.

Both are imported when a DBC is loaded and not before: the mechanism's processes never need them,
and `aftbed --help` must not wait for them.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from importlib import import_module
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

import msgspec

from aftbed.core.errors import ConfigError, PeerError, unknown
from aftbed.vehicle.can.frame import DATA_LENGTH_MAX

if TYPE_CHECKING:
    import canmatrix
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

DBC_BYTES_MAX: Final = 16_000_000  # the largest real ones known to us have two; a log given by mistake more
SIZE_MAX: Final = 0xFFFF  # of a message's bytes, a signal's bits and place, a range of multiplexer values
DIGITS_MAX: Final = 18
LINE_CHARACTERS_MAX: Final = 300  # of a signal up to its unit; receivers follow, which nobody asks for
_SIZES: Final = re.compile(
    r"\bBO_\s+\d+\s+\w+\s*:\s*(\d+)|\bSG_\s+\w+(?:\s+\w+)?\s*:\s*(-?\d+)\s*\|\s*(\d+)", re.ASCII
)
_MULTIPLEXED: Final = re.compile(r"\bSG_MUL_VAL_\s[^;]*")
_RANGE: Final = re.compile(r"(\d+)\s*-\s*(\d+)", re.ASCII)
_NAME: Final = re.compile(
    r"\w[\w .()/&-]*"
)  # of a message or a signal; canmatrix takes whatever stands there
_ESSENTIAL: Final = re.compile(
    r"(BO_|SG_|SG_MUL_VAL_|SIG_VALTYPE_) |BA_ +\"System(Message|Signal)LongSymbol\" "
)
_UNREAD: Final = re.compile(r"error with line no: (\d+)")  # what canmatrix prints
_PACKAGE: Final = Path(__file__).resolve().parents[2]
_CANDIDATES: Final = (
    _PACKAGE / "dbc" / "aftbed.dbc",  # in a wheel
    _PACKAGE.parent / "dbc" / "aftbed.dbc",  # in a checkout
)


class SignalPlace(msgspec.Struct, frozen=True):
    """A signal as the file has it. `choices`: the names of its values."""

    name: str
    start_bit: int
    length_bits: int
    little_endian: bool
    signed: bool
    scale: float
    offset: float
    high: float | None
    unit: str
    whole: bool
    choices: tuple[tuple[int, str], ...]


class Codec:
    """One DBC, loaded: encodes and decodes by message name, in the physical units of the file.

    All but `names`, `flaw`, `senders` and `sent_by` raise ConfigError if the message cannot be used, with the
    line and the reason. `notes`: what was left out of the file in reading it.
    """

    def __init__(
        self, messages: Iterable[Message], path: Path, text: str, *, strict: bool, notes: tuple[str, ...] = ()
    ) -> None:
        self.path = path
        self.notes = notes
        self._text = text
        self._strict = strict
        self._messages: dict[str, Message] = {}
        self._twice: set[str] = set()
        for message in messages:
            if message.name in self._messages:
                self._twice.add(message.name)
            self._messages[message.name] = message
        self._used: dict[str, Message] = {}  # those that were checked
        self._misfits: dict[str, frozenset[str]] = {}
        self._pieces: dict[str, list[Message]] = {}  # of messages with overlapping signals
        self._ranges: dict[str, dict[str, tuple[float, float]]] = {}  # of the messages encoded so far

    def names(self) -> list[str]:
        return sorted(self._messages)

    def flaw(self, name: str) -> str | None:
        """Why message `name`, which the file has, cannot be used; None if it can."""
        message, what = self._messages[name], ""
        if name in self._twice:
            what = "stands twice, allowed is once"
        elif not 0 <= message.length <= DATA_LENGTH_MAX:
            what = f"has {message.length} bytes, allowed is 0 to {DATA_LENGTH_MAX}"
        if what:
            return f"line {_line_of(self._text, name)}: message {name} {what}"
        if self._strict and (contradiction := _contradiction(message)) is not None:
            line = _line(contradiction, self._text)
            return f"line {line}: {contradiction} (a map with `strict: false` takes it as it is)"
        return None

    def left_out(self) -> str:
        """For a message that names something that the file may have had: the first of `notes`, or ""."""
        return f" ({self.notes[0]})" if self.notes else ""

    def signal_names(self, name: str) -> list[str]:
        return [signal.name for signal in self._message(name).signals]

    def signals(self, name: str) -> list[SignalPlace]:
        """All signals that lie in the message, in their order."""
        return [
            SignalPlace(
                one.name,
                one.start,
                one.length,
                one.byte_order == "little_endian",
                one.is_signed,
                float(one.scale),
                float(one.offset),
                None if one.maximum is None else float(one.maximum),
                one.unit or "",
                self.whole(name, one.name),
                tuple((value, str(choice)) for value, choice in (one.choices or {}).items()),
            )
            for one in self._message(name).signals
            if one.name not in self.misfits(name) and not one.is_float
        ]

    def misfits(self, name: str) -> frozenset[str]:
        """The signals of message `name` that lie outside of it; none where the DBC is read strictly."""
        self._message(name)
        return self._misfits.get(name, frozenset())

    def contradicts(self, name: str) -> bool:
        """True if its signals overlap, or lie outside of it, and it is taken all the same."""
        self._message(name)
        return name in self._pieces

    def can_id(self, name: str) -> int:
        return self._message(name).frame_id

    def extended(self, name: str) -> bool:
        """True if its id has 29 bits."""
        return self._message(name).is_extended_frame

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
        """The messages of a sender that can be used."""
        messages = self._messages.values()
        sent = [m.name for m in messages if node in (sender.lower() for sender in m.senders)]
        return [name for name in sent if self.flaw(name) is None]

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
        message = self._used.get(name)
        if message is not None:
            return message
        message = self._messages.get(name)
        if message is None:
            raise ConfigError(f"{self.path}: {unknown('message', name, self._messages)}{self.left_out()}")
        flaw = self.flaw(name)
        if flaw is not None:
            raise ConfigError(f"{self.path}: {flaw}")
        if not self._strict and not message.is_multiplexed() and _contradiction(message) is not None:
            pieces = {signal.name: _alone(message, signal) for signal in message.signals}
            outside = {one for one, piece in pieces.items() if _contradiction(piece) is not None}
            self._misfits[name] = frozenset(outside)
            self._pieces[name] = [piece for one, piece in pieces.items() if one not in outside]
        self._used[name] = message
        return message

    def _signal(self, name: str, signal: str) -> Signal:
        for candidate in self._message(name).signals:
            if candidate.name == signal:
                return candidate
        reason = unknown(f"signal of {name}", signal, self.signal_names(name))
        raise ConfigError(f"{self.path}: {reason}{self.left_out()}")


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

    With `strict` False a message can be used whose signals overlap, or lie outside of it: see above.
    """
    chosen = path or next((candidate for candidate in _CANDIDATES if candidate.is_file()), None)
    if chosen is None:
        raise ConfigError(f"aftbed.dbc is missing, looked at: {', '.join(map(str, _CANDIDATES))}")
    try:
        if chosen.stat().st_size > DBC_BYTES_MAX:
            raise ConfigError(f"{chosen}: more than {DBC_BYTES_MAX} bytes, not a DBC")
        with chosen.open("rb") as file:
            content = file.read(DBC_BYTES_MAX)
    except OSError as error:
        raise ConfigError(f"{chosen}: cannot be read: {error.strerror}") from error
    if (at := content.find(0)) >= 0:
        raise ConfigError(f"{chosen}: not text, at byte {at}")
    text = _text(content)
    _check_sizes(text, chosen)
    notes: tuple[str, ...] = ()
    try:
        messages = _read_by_cantools(text)
    except _cantools_errors() as error:
        found = _read_by_canmatrix(text)
        if found is None or not found[0]:
            raise ConfigError(f"{chosen}: {_explain(error, text, 'not a DBC that can be read')}") from error
        messages, left_out = found
        notes = (_explain(error, text, "read by canmatrix, as cantools refuses it"), *left_out)
    if not messages:
        raise ConfigError(f"{chosen}: holds no message")
    return Codec(messages, chosen, text, strict=strict, notes=notes)


def _text(content: bytes) -> str:
    """UTF-8 where it is that; else cp1252, which most DBCs are written in."""
    try:
        return content.decode()
    except UnicodeDecodeError:
        return content.decode("cp1252", "replace")


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


def _cantools_errors() -> tuple[type[Exception], ...]:
    """What cantools raises; the general classes were found by feeding it damaged files."""
    import_module("aftbed.vehicle.can.python_can")  # before cantools, which imports python-can
    from cantools.errors import Error  # noqa: PLC0415 - lazily, see above
    from textparser import ParseError  # noqa: PLC0415 - what cantools' parser raises: has line and column

    return (Error, ParseError, ValueError, LookupError, ArithmeticError, AttributeError, TypeError)


def _read_by_cantools(text: str) -> list[Message]:
    import_module("aftbed.vehicle.can.python_can")
    from cantools.database.can import Database  # noqa: PLC0415 - lazily, see above

    database = Database(strict=False)
    database.add_dbc_string(text)
    return database.messages


def _read_by_canmatrix(text: str) -> tuple[list[Message], list[str]] | None:
    """The messages, and what was left out; None if nothing can be made of the file.

    It is given messages, signals and what changes their meaning, so that nothing else can fail. A signal
    behind a message that it cannot read would become one of the message before: such messages are left out.
    """
    lines, left_out = _essential(text), []
    read = _canmatrix_of(lines)
    if read is not None and (bad := [number for number in read[1] if lines[number].startswith("BO_")]):
        for number in bad:
            left_out.append(f"line {number + 1}: message left out, cannot be read")
            end = next((n for n in range(number + 1, len(lines)) if lines[n].startswith("BO_")), len(lines))
            lines[number:end] = [""] * (end - number)
        read = _canmatrix_of(lines)
    if read is None:
        return None
    matrix, unread = read
    left_out += [f"line {number + 1}: left out, cannot be read" for number in unread]
    messages = []
    for frame in matrix.frames:
        if not all(_NAME.fullmatch(one.name) for one in (frame, *frame.signals)):
            left_out.append(f"message {frame.arbitration_id.id:#x} left out: a name that is none")
            continue
        try:
            messages.append(_message_of(frame))
        except _cantools_errors() as error:
            left_out.append(f"message {frame.name} left out: {' '.join(str(error).split())}")
    return messages, left_out


def _essential(text: str) -> list[str]:
    """The lines of `text` that say what messages and signals there are, long names too; others are empty.

    Signals are cut behind their unit: canmatrix takes long for a long line that it cannot read.
    """
    kept, in_comment = [], False
    for line in text.split("\n"):
        words = " ".join(line.split())  # of many spaces in a row, too
        if in_comment:
            in_comment = not words.endswith(";")
            words = ""
        elif words.startswith("CM_"):
            in_comment = '"' in words and not words.endswith(";")
        kept.append(words[:LINE_CHARACTERS_MAX] if _ESSENTIAL.match(words) else "")
    return kept


def _canmatrix_of(lines: list[str]) -> tuple[canmatrix.CanMatrix, list[int]] | None:
    """What canmatrix makes of the lines, and which of them, by index, it could not read. None: nothing."""
    import logging  # noqa: PLC0415 - with it comes `threading`, for which each fork has work to do

    import canmatrix.formats.dbc as reader  # noqa: PLC0415 - lazily, see above

    logging.getLogger("canmatrix").setLevel(logging.CRITICAL)
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            matrix = reader.load(io.BytesIO("\n".join(lines).encode()), dbcImportEncoding="utf-8")
    except (ValueError, LookupError, ArithmeticError, AttributeError, TypeError):
        return None
    return matrix, [int(number) - 1 for number in _UNREAD.findall(printed.getvalue())]


def _message_of(frame: canmatrix.Frame) -> Message:
    """A frame of canmatrix as a message of cantools."""
    from cantools.database.can import Message  # noqa: PLC0415 - lazily, see above
    from cantools.database.can.signal import Signal  # noqa: PLC0415
    from cantools.database.conversion import BaseConversion  # noqa: PLC0415

    selector = next((signal.name for signal in frame.signals if signal.is_multiplexer), None)
    signals = [
        Signal(
            signal.name,
            signal.get_startbit(bit_numbering=1),
            signal.size,
            "little_endian" if signal.is_little_endian else "big_endian",
            signal.is_signed,
            conversion=BaseConversion.factory(
                _number(signal.factor), _number(signal.offset), is_float=signal.is_float
            ),
            minimum=_number(signal.min),
            maximum=_number(signal.max),
            unit=signal.unit or None,
            is_multiplexer=signal.name == selector,
            multiplexer_ids=None if signal.mux_val is None or signal.name == selector else [signal.mux_val],
            multiplexer_signal=None if signal.mux_val is None or signal.name == selector else selector,
        )
        for signal in frame.signals
    ]
    id_ = frame.arbitration_id
    return Message(
        id_.id,
        frame.name,
        frame.size,
        signals,
        senders=frame.transmitters,
        is_extended_frame=id_.extended,
        strict=False,
    )


def _number(value: object) -> float:
    """canmatrix's decimal: an integer where it is one, as cantools has it."""
    number = float(str(value))
    return int(number) if number.is_integer() else number


def _explain(error: Exception, text: str, what: str) -> str:
    """`what` and cantools' reason in one line, with the line of the file where cantools does not give it."""
    reason = " ".join(str(error).split())
    if isinstance(error, KeyError):
        reason = f"{reason} is not defined"
    elif isinstance(error, LookupError | AttributeError | TypeError):
        reason = f"cantools gives up: {reason}"
    line = 0 if " at line " in reason else _line(error, text)
    return f"{f'line {line}: ' if line else ''}{what}: {reason}"


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


def _contradiction(message: Message) -> Exception | None:
    """Why the message contradicts itself: signals that overlap, or lie outside of it."""
    from cantools.errors import Error  # noqa: PLC0415

    try:
        message.refresh(strict=True)
    except Error as error:
        return error
    return None


def _alone(message: Message, signal: Signal) -> Message:
    """The message with this signal only, so that no other overlaps it."""
    wide = message.is_extended_frame
    return type(message)(
        message.frame_id, message.name, message.length, [signal], is_extended_frame=wide, strict=False
    )
