"""Requests without a car, and the replies expected to them: their files, and functions that make them.

A request is bytes. A file says them in one of two formats, told apart by its first character:

    CSV          the first line names the columns, `name:type,...`; or it is `hex`
    JSON lines   the first line may be `{"codec": "name:type,..."}`; then each line is an object with those
                 names; or `{"hex": "..."}`, or `{"text": "..."}`

Each line ends with a newline, the last one too: a file that was cut off is refused, not read up to there.

A file is data: nothing of it is executed. `generated` executes the function that its user named.
"""

import csv
import functools
import itertools
import json
import math
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple, Self

import msgspec

from aftbed.core.application import CODES, REPLY_BYTES_MAX
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.input_file import read_input
from aftbed.functions.load import Code

REQUEST_BYTES_MAX: Final = REPLY_BYTES_MAX  # a request has to fit into a packet, as a reply has
REQUESTS_MAX: Final = 100_000
FILE_BYTES_MAX: Final = 64 << 20  # of a file, and of all its requests together
SHOWN_MAX: Final = 60  # characters of what was found
NAMES_SHOWN_MAX: Final = 12

Value = int | float | bool

_RANGES: Final = {
    kind: (0, 2 ** int(kind[1:]) - 1)
    if kind[0] == "u"
    else (-(2 ** (int(kind[1:]) - 1)), 2 ** (int(kind[1:]) - 1) - 1)
    for kind in CODES
    if kind[0] in "ui"
}
_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_.\[\]]{0,63}")
_INTEGER: Final = re.compile(r"[+-]?[0-9]{1,20}")
_DECIMAL: Final = re.compile(r"[+-]?([0-9]{1,400}\.?[0-9]{0,400}|\.[0-9]{1,400})([eE][+-]?[0-9]{1,4})?")
_WORDS_OF_BOOL: Final = {"true": True, "1": True, "false": False, "0": False}
_RAW: Final = ("hex", "text")  # the key of a line that is bytes, not fields


# -- the codec ------------------------------------------------------------------------------------


class FieldCodec(msgspec.Struct, frozen=True):
    """Fields by name and type, one behind the other: little-endian, no padding."""

    fields: tuple[tuple[str, str], ...]

    @classmethod
    def parse(cls, text: str) -> Self:
        """Of `t_us:u64,distance:f64,flag:u8`. Raises ConfigError."""
        return cls.of(text.split(","))

    @classmethod
    def of(cls, cells: list[str]) -> Self:
        """Of one `name:type` each. Raises ConfigError."""
        fields: dict[str, str] = {}
        for number, cell in enumerate(cells, 1):
            name, colon, kind = (part.strip() for part in cell.partition(":"))
            if not colon or not _NAME.fullmatch(name):
                raise ConfigError(f"column {number}: found {_words(cell)}, NAME:TYPE is allowed, as t_us:u64")
            if kind not in CODES:
                raise ConfigError(f"column {number}, {name}: {unknown('type', kind[:SHOWN_MAX], CODES)}")
            if name in fields:
                raise ConfigError(f"column {number}: {name} is there already; each name is allowed once")
            fields[name] = kind
        found = cls(tuple(fields.items()))
        if found.size_bytes > REQUEST_BYTES_MAX:
            raise ConfigError(f"columns of {found.size_bytes} bytes, allowed are {REQUEST_BYTES_MAX}")
        return found

    def __str__(self) -> str:
        return ",".join(f"{name}:{kind}" for name, kind in self.fields)

    @property
    def size_bytes(self) -> int:
        return _layout(self.fields).size

    def encode(self, values: Mapping[str, object]) -> bytes:
        """The bytes of exactly these fields; numbers are finite. Raises ConfigError naming the field."""
        names = dict(self.fields)
        for name in values:
            if name not in names:
                raise ConfigError(f"unknown column {_words(name)}; allowed are {_listed(list(names))}")
        for name in names:
            if name not in values:
                raise ConfigError(f"column {name} is missing; required are {_listed(list(names))}")
        return _layout(self.fields).pack(*(_checked(name, kind, values[name]) for name, kind in self.fields))

    def decode(self, data: bytes) -> dict[str, Value]:
        """The fields. A bool whose byte is neither 0 nor 1 is that number. Raises ConfigError."""
        if len(data) != self.size_bytes:
            raise ConfigError(f"{len(data)} bytes, {self.size_bytes} are required for {_words(str(self))}")
        found = zip(self.fields, _layout(self.fields).unpack(data), strict=True)
        return {
            name: bool(value) if kind == "bool" and value in (0, 1) else value
            for (name, kind), value in found
        }


@functools.lru_cache(maxsize=8)
def _layout(fields: tuple[tuple[str, str], ...]) -> struct.Struct:
    return struct.Struct("<" + "".join(CODES[kind] for _, kind in fields))


@functools.lru_cache(maxsize=8)
def _codec_of(text: str) -> FieldCodec:
    return FieldCodec.parse(text)


def _checked(name: str, kind: str, value: object) -> Value:
    """`value` as `struct` takes it. Raises ConfigError."""
    if kind == "bool":
        if not isinstance(value, bool):
            raise _not_allowed(name, value, "true or false")
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _not_allowed(name, value, _allowed(kind))
    if kind in _RANGES:
        least, most = _RANGES[kind]
        if not isinstance(value, int) or not least <= value <= most:
            raise _not_allowed(name, value, _allowed(kind))
        return value
    try:
        number = float(value)
        struct.pack("<" + CODES[kind], number)
    except OverflowError:
        raise _not_allowed(name, value, _allowed(kind)) from None
    if not math.isfinite(number):
        raise _not_allowed(name, value, f"{_allowed(kind)}; any other as hex")
    return number


def _allowed(kind: str) -> str:
    if kind in _RANGES:
        least, most = _RANGES[kind]
        return f"{least} to {most} ({kind})"
    return f"a finite number ({kind})"


def _not_allowed(name: str, value: object, allowed: str) -> ConfigError:
    return ConfigError(f"column {name}: found {_words(value)}, allowed is {allowed}")


def _words(value: object) -> str:
    """A value that anyone may have written, for a message."""
    try:
        text = repr(value)
    except ValueError:  # of an integer with thousands of digits
        return "a number with too many digits"
    return text if len(text) <= SHOWN_MAX else f"{text[:SHOWN_MAX]}..."


def _listed(names: list[str]) -> str:
    more = ", ..." if len(names) > NAMES_SHOWN_MAX else ""
    return ", ".join(names[:NAMES_SHOWN_MAX]) + more


# -- what a file holds ----------------------------------------------------------------------------


class RequestList(msgspec.Struct, frozen=True):
    """The requests of a file, in its order. `codec` is None where they are bytes and no more."""

    requests: tuple[bytes, ...]
    codec: FieldCodec | None = None


class ExpectedReplies(msgspec.Struct, frozen=True):
    """What each request has to be answered, from request 1 on.

    `codec`: the fields of a reply, as text; "": replies are compared byte by byte. Numbers of type f32 and
    f64 may differ by `tolerance`.
    """

    replies: tuple[bytes, ...]
    codec: str = ""
    tolerance: float = 0.0

    def difference(self, number: int, found: bytes) -> str:
        """The first one between the reply `found` and the one expected to request `number`; "" if none."""
        expected = self.replies[number - 1]
        if found == expected:
            return ""
        if len(found) != len(expected):
            return f"request {number}: found {_length(found)}, expected {_length(expected)}"
        codec = _codec_of(self.codec) if self.codec else None
        if codec is None or codec.size_bytes != len(found):
            at = next(at for at, (one, other) in enumerate(zip(found, expected, strict=True)) if one != other)
            return f"request {number}: byte {at}: found 0x{found[at]:02x}, expected 0x{expected[at]:02x}"
        values, wanted = codec.decode(found), codec.decode(expected)
        for name, _ in codec.fields:
            if not _alike(values[name], wanted[name], self.tolerance):
                within = f" (tolerance {self.tolerance:g})" if isinstance(wanted[name], float) else ""
                return f"request {number}: {name}: found {values[name]}, expected {wanted[name]}{within}"
        return ""


def _length(reply: bytes) -> str:
    if not reply:
        return "an empty reply (the request was refused)"
    return f"{len(reply)} byte{'s' if len(reply) > 1 else ''}"


def _alike(one: Value, other: Value, tolerance: float) -> bool:
    if one == other or (one != one and other != other):  # noqa: PLR0124 - NaN
        return True
    return isinstance(one, float) and isinstance(other, float) and abs(one - other) <= tolerance


class GivenRequests(msgspec.Struct, frozen=True):
    """What `--requests`, `--expect` and `--tolerance` give a run: what was named, and what is in it."""

    source: str
    requests: tuple[bytes, ...]
    expect: str = ""
    expected: ExpectedReplies | None = None
    tolerance: float | None = None


# -- reading --------------------------------------------------------------------------------------


def read_requests(path: Path) -> RequestList:
    """Raises ConfigError naming the file, the line and the column."""
    found = _read(path, "request", with_tolerance=False)
    return RequestList(found.payloads, found.codec)


def read_replies(path: Path, tolerance: float | None = None) -> ExpectedReplies:
    """The same formats; a header of JSON lines may also have a `tolerance`, which a CSV gets from here.

    Raises ConfigError naming the file, the line and the column.
    """
    found = _read(path, "reply", with_tolerance=True)
    if tolerance is not None:
        check_tolerance("--tolerance", tolerance)
        if found.tolerance is not None:
            raise ConfigError(f"{path}: line 1 has a tolerance: leave out --tolerance")
        if found.codec is None:
            raise ConfigError(f"{path}: has no codec, so --tolerance is about no number: leave it out")
    allowed = found.tolerance if found.tolerance is not None else tolerance
    return ExpectedReplies(found.payloads, str(found.codec) if found.codec else "", allowed or 0.0)


def check_tolerance(name: str, tolerance: object) -> float:
    """Raise ConfigError if `tolerance` is not a finite number from 0 on."""
    number = isinstance(tolerance, int | float) and not isinstance(tolerance, bool)
    if not number or not 0 <= tolerance < math.inf:  # type: ignore[operator]
        raise ConfigError(f"{name}: found {_words(tolerance)}, allowed is a finite number from 0 on")
    return float(tolerance)  # type: ignore[arg-type]


class _Content(NamedTuple):
    payloads: tuple[bytes, ...]
    codec: FieldCodec | None
    tolerance: float | None


class _Header(NamedTuple):
    codec: FieldCodec | None
    tolerance: float | None
    lines: int  # that it takes: 0 or 1


def _read(path: Path, what: str, *, with_tolerance: bool) -> _Content:
    lines = _lines_of(path, what)
    reader = _json_header if lines[0].lstrip().startswith("{") else _csv_header
    try:
        header = reader(lines[0], with_tolerance=with_tolerance)
    except ConfigError as error:
        raise ConfigError(f"{path}: line 1: {error}") from None
    payload_of = _json_payload if reader is _json_header else _csv_payload
    payloads, total_bytes = [], 0
    for number, line in enumerate(lines[header.lines :], 1 + header.lines):
        try:
            payload = payload_of(line, header.codec)
            check_payload(payload, what)
        except ConfigError as error:
            raise ConfigError(f"{path}: line {number}: {error}") from None
        payloads.append(payload)
        total_bytes += len(payload)
    if not payloads:
        raise ConfigError(f"{path}: a header, and no {what} below it; at least one is required")
    if len(payloads) > REQUESTS_MAX:
        raise ConfigError(f"{path}: {len(payloads)} lines with a {what}, allowed are {REQUESTS_MAX}")
    if total_bytes > FILE_BYTES_MAX:
        raise ConfigError(f"{path}: {total_bytes} bytes in all, allowed are {FILE_BYTES_MAX}")
    return _Content(tuple(payloads), header.codec, header.tolerance)


def check_payload(payload: bytes, what: str = "request") -> None:
    """Raise ConfigError if it is too long for a packet."""
    if len(payload) > REQUEST_BYTES_MAX:
        raise ConfigError(f"a {what} of {len(payload)} bytes, allowed are {REQUEST_BYTES_MAX}")


def _lines_of(path: Path, what: str) -> list[str]:
    """At least one, without their ends. Raises ConfigError."""
    try:
        data = read_input(path, FILE_BYTES_MAX)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # a NUL in its name
        raise ConfigError(f"{str(path)!r}: cannot be read: {error}") from None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        number = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}: line {number}: not UTF-8: byte 0x{data[error.start]:02x}") from None
    *lines, torn = text.split("\n")
    if torn:
        raise ConfigError(
            f"{path}: line {len(lines) + 1}: cut off: found {_words(torn)} without a newline behind it;"
            " each line ends with one"
        )
    if not lines:
        raise ConfigError(f"{path}: empty; a header and a line for each {what} are required")
    return [line.removesuffix("\r") for line in lines]


# -- CSV


def _csv_header(line: str, *, with_tolerance: bool) -> _Header:
    cells = _cells(line)
    if cells == ["hex"]:
        return _Header(None, None, 1)
    return _Header(FieldCodec.of(cells), None, 1)


def _csv_payload(line: str, codec: FieldCodec | None) -> bytes:
    cells = _cells(line)
    names = ["hex"] if codec is None else [name for name, _ in codec.fields]
    if len(cells) != len(names):
        raise ConfigError(f"{len(cells)} columns, allowed are {len(names)}: {_listed(names)}")
    if codec is None:
        return _from_hex(cells[0])
    fields = zip(codec.fields, cells, strict=True)
    return codec.encode({name: _cell_value(name, kind, cell) for (name, kind), cell in fields})


def _cells(line: str) -> list[str]:
    try:
        found = next(csv.reader([line], strict=True), [])
    except csv.Error as error:
        raise ConfigError(f"not CSV: {error}") from None
    if not found:
        raise ConfigError('empty; no line may be (a request without a byte is "" below hex)')
    return [cell.strip() for cell in found]


def _cell_value(name: str, kind: str, cell: str) -> Value:
    if kind == "bool":
        value = _WORDS_OF_BOOL.get(cell.lower())
        if value is None:
            raise _not_allowed(name, cell, "true, false, 1 or 0")
        return value
    if kind in _RANGES:
        if not _INTEGER.fullmatch(cell):
            raise _not_allowed(name, cell, _allowed(kind))
        return int(cell)
    if not _DECIMAL.fullmatch(cell):
        raise _not_allowed(name, cell, _allowed(kind))
    return float(cell)


# -- JSON lines


def _json_header(line: str, *, with_tolerance: bool) -> _Header:
    found = _json_object(line)
    if "codec" not in found:
        return _Header(None, None, 0)
    known = ("codec", "tolerance") if with_tolerance else ("codec",)
    for key in found:
        if key not in known:
            raise ConfigError(f"unknown key {_words(key)} beside codec; allowed are {_listed(list(known))}")
    text = found["codec"]
    if not isinstance(text, str):
        raise ConfigError(f'codec: found {_words(text)}, a text is allowed, as "t_us:u64,flag:u8"')
    tolerance = check_tolerance("tolerance", found["tolerance"]) if "tolerance" in found else None
    return _Header(FieldCodec.parse(text), tolerance, 1)


def _json_payload(line: str, codec: FieldCodec | None) -> bytes:
    found = _json_object(line)
    names = [name for name, _ in codec.fields] if codec is not None else []
    raw = next((key for key in _RAW if list(found) == [key] and names != [key]), None)
    if raw is None:
        if codec is None:
            raise ConfigError(
                f"found the keys {_listed(list(map(_words, found)))}, allowed is"
                ' {"hex": "..."} or {"text": "..."}; others need {"codec": "name:type,..."} in line 1'
            )
        return codec.encode(found)
    text = found[raw]
    if not isinstance(text, str):
        raise _not_allowed(raw, text, "a text")
    if raw == "hex":
        return _from_hex(text)
    try:
        return text.encode()
    except UnicodeEncodeError:
        raise _not_allowed(raw, text, "a text of whole characters") from None


def _json_object(line: str) -> dict[str, object]:
    """Raises ConfigError, also where a key comes twice, or a number is NaN or infinite."""
    try:
        found = json.loads(line, object_pairs_hook=_once, parse_constant=_no_number)
    except json.JSONDecodeError as error:
        raise ConfigError(f"column {error.colno}: not JSON: {error.msg}: found {_words(line)}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"not JSON: {str(error)[: 2 * SHOWN_MAX]}") from None
    if not isinstance(found, dict):
        raise ConfigError(f"found {_words(found)}, a JSON object is allowed")
    return found


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(key for at, (key, _) in enumerate(pairs) if key in dict(pairs[:at]))
        raise ConfigError(f"key {_words(twice)} is there twice; each is allowed once")
    return found


def _no_number(word: str) -> float:
    raise ConfigError(f"found {word}, a finite number is allowed; any other as hex")


def _from_hex(text: str) -> bytes:
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise _not_allowed("hex", text, "pairs of hexadecimal digits") from None


# -- a function that makes them -------------------------------------------------------------------


def names_function(source: str) -> bool:
    """Whether `source` is `MODULE:FUNCTION` or `FILE.py:FUNCTION`, and no file is called so."""
    place, colon, name = source.rpartition(":")
    return bool(colon and place) and name.isidentifier() and not Path(source).exists()


def located_requests(source: str, folder: Path | None = None) -> str:
    """`source` with an absolute path, which is looked up in `folder`, here if left out.

    Nothing is executed. Raises ConfigError where a file is missing.
    """
    here = (folder or Path.cwd()).resolve()
    place, name = source, ""
    if not (here / source).exists() and names_function(source):
        place, _, name = source.rpartition(":")
        if not place.endswith(".py"):
            return source
    path = (here / place).resolve()
    if not path.exists():  # what else is wrong with it, its reader says
        if source.isdecimal():
            raise ConfigError(
                f"--requests {source}: a file or MODULE:FUNCTION; how many is '--count {source}'"
            )
        raise ConfigError(f"{source}: {path}: no such file")
    return f"{path}:{name}" if name else str(path)


def requests_from(source: str, count: int, seed: int, code: Code) -> GivenRequests:
    """All requests of a file, or `count` of a function, which is executed. Raises ConfigError."""
    if names_function(source):
        return GivenRequests(source, tuple(generated(source, count, seed, code)))
    try:
        written_ns = Path(source).stat().st_mtime_ns
    except OSError:
        written_ns = 0  # reading it says why
    return GivenRequests(source, _read_once(source, written_ns).requests)


@functools.lru_cache(maxsize=1)
def _read_once(source: str, written_ns: int) -> RequestList:
    """Not anew for each experiment of a campaign."""
    return read_requests(Path(source))


def generated(source: str, count: int, seed: int, code: Code) -> list[bytes]:
    """The first `count` requests of `function(seed)`, where `source` is `MODULE:FUNCTION` or
    `FILE.py:FUNCTION`.

    Executes it: only for a command in which its user named it. Raises ConfigError, whatever it does.
    """
    place, _, name = source.rpartition(":")
    try:
        module = code.module(place)
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{source}: cannot be imported: {_error(error)}") from error
    function = getattr(module, name, None)
    if not callable(function):
        raise ConfigError(f"{source}: {place} has no function {name}")
    found: list[bytes] = []
    total_bytes = 0
    for payload in _made(source, function, seed, count):
        where = f"{source}: request {len(found) + 1}"
        if not isinstance(payload, bytes):
            raise ConfigError(f"{where}: found {_words(payload)}, bytes are required")
        try:
            check_payload(payload)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None
        found.append(payload)
        total_bytes += len(payload)
        if total_bytes > FILE_BYTES_MAX:
            raise ConfigError(f"{where}: {total_bytes} bytes in all, allowed are {FILE_BYTES_MAX}")
    if len(found) < count:
        raise ConfigError(f"{source}: ended after {len(found)} requests, {count} are asked for (--count)")
    return found


def _made(
    source: str, function: Callable[[int], Iterable[object]], seed: int, count: int
) -> Iterator[object]:
    try:
        yield from itertools.islice(function(seed), count)
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{source}: raised {_error(error)}") from error


def _error(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"[: 4 * SHOWN_MAX]
