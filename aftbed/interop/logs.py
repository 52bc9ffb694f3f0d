"""Reads logs of a CAN bus, to replay or convert them: candump, ASC, BLF, TRC, MF4, CSV. Writes them, too.

ASC, BLF, TRC and MF4 are read by python-can's readers; ASC, BLF and TRC are written by its writers. This
module adds what python-can loses, as the tests show:

- candump is read and written here. python-can's reader takes most error frames for data frames and gives no
  line number for a malformed line. Its writer drops the length of a remote frame and the interface of an
  error frame, and moves a frame that is out of order to the time of the frame before.
- ASC: a log without a readable date, or dated before 1990, counts from its start. `timestamps relative` is
  refused: each time counts from the frame before, and python-can reads them as absolute. python-can writes
  the milliseconds of a date without leading zeros, so the date is a whole second. It takes an FD frame
  without data for a remote frame.
- BLF: the structure is checked first, and python-can gets only the frames. It reads what is left of a torn
  container, ends without a word at an object that is too short, and loops forever on one of length 0. Its
  writer would take the time of the first frame for the start of a log without a date.
- TRC: the reader does not subtract the 1 that the writer adds to a channel, and gives the length of an FD
  frame as its code. Error and remote frames are left out: the format has no error frames, and python-can does
  not write remote frames, nor FD frames, whose lines are written here.
- MF4: read in a process of its own, with a deadline, because asammdf's native code may crash or hang on a
  malformed file. Written through asammdf: python-can's writer dates each file with the time of writing, so
  older frames get negative times.
- CSV: python-can does not read those of other programs, and has no line numbers.
- A warning of python-can is an error, because it skips what it cannot parse; so is a data frame with fewer
  bytes than its length. Errors name the file, and the line or byte if there is one. Whoever reads a log may
  have such parts skipped, and counted (`BadParts`).

What a format has beside frames (statistics, comments, triggers) is dropped. Frames that the other format
lacks are left out, counted by reason and reported. The length code of a classic frame may be 9 to 15 and
means 8 bytes (ISO 11898-1), so that is its length here.

Times are whole microseconds since 1970 if the log has a date, or else since its start. Seconds in floating
point, as in python-can, hold microseconds until 2106, through a BLF until 2038. Vector's tools take the start
of a BLF for local time.

candump names interfaces, the other formats number them. A name that ends in digits gets their number; any
other, and a name whose number is taken, gets the lowest free one. Number n becomes `canN`.
"""

import csv
import io
import logging
import re
import struct
import zlib
from base64 import b64decode
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from typing import Final, Protocol, cast

import msgspec

from aftbed.core.errors import ConfigError, PeerError, spreadsheet_text, unknown
from aftbed.interop.files import write_whole
from aftbed.runtime.unix.confined import JobFailedError, ProcessLimits, ask, serve
from aftbed.runtime.unix.interrupts import scratch_directory
from aftbed.vehicle.can.candump import Refusal
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.frame import CAN_ID_MAX, DATA_LENGTH_MAX, Frame
from aftbed.vehicle.can.python_can import can, with_asammdf
from aftbed.vehicle.replay.map_file import find_dbc
from aftbed.vehicle.replay.player import LogReport, PlayedLog

LOG_BYTES_MAX: Final = 256 * 1024 * 1024
LINE_SHOWN_CHARACTERS_MAX: Final = 60
EXTENDED_ID_MAX: Final = 0x1FFFFFFF
TIME_US_MAX: Final = 2**32 * 1_000_000 - 1  # in 2106
DATED_US_MIN: Final = 631_152_000 * 1_000_000  # 1990
CHANNELS_MAX: Final = 255  # MF4 stores a channel in one byte
FD: Final = "CAN FD frame"
SKIP_BAD: Final = "--skip-bad"
FD_LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)


# -- frames ---------------------------------------------------------------------------------------


class FrameKind(Enum):
    DATA = "data frame"
    REMOTE = "remote frame"
    ERROR = "error frame"


class FdFlags(msgspec.Struct, frozen=True):
    """Of a CAN FD frame: its data had the higher bit rate; its sender was error-passive."""

    bit_rate_switch: bool = False
    error_state: bool = False


class LoggedFrame(msgspec.Struct, frozen=True):
    """A frame of a log, a classic one unless it has `fd`. Raises PeerError for values that no frame has.

    `length`: the bytes that a remote frame asks for. The `can_id` of an error frame is its error class.
    `sent`: by the node that wrote the log.
    """

    t_us: int
    interface: str
    can_id: int
    data: bytes = b""
    extended: bool = False
    kind: FrameKind = FrameKind.DATA
    length: int = 0
    sent: bool = False
    fd: FdFlags | None = None

    def __post_init__(self) -> None:
        id_max = EXTENDED_ID_MAX if self.extended else CAN_ID_MAX
        if not 0 <= self.can_id <= id_max:
            raise PeerError(f"CAN id {self.can_id:#x}, allowed is 0 to {id_max:#x}")
        if self.fd is not None:
            if self.kind is not FrameKind.DATA:
                raise PeerError(f"{self.kind.value}: it cannot be a CAN FD frame")
            if len(self.data) not in FD_LENGTHS:
                lengths = "0 to 8, 12, 16, 20, 24, 32, 48 and 64"
                raise PeerError(f"a CAN FD frame of {len(self.data)} bytes, allowed are {lengths}")
        elif len(self.data) > DATA_LENGTH_MAX:
            raise PeerError(f"{len(self.data)} bytes, allowed are 0 to {DATA_LENGTH_MAX}")
        if not 0 <= self.length <= DATA_LENGTH_MAX:
            raise PeerError(f"a remote frame for {self.length} bytes, allowed are 0 to {DATA_LENGTH_MAX}")
        if not 0 <= self.t_us <= TIME_US_MAX:
            raise PeerError(f"time {self.t_us / 1e6:.6f} s, allowed is 0 to {TIME_US_MAX // 10**6} s")


class CanLog(msgspec.Struct, frozen=True):
    """The frames in the order of their file; those left out, by reason; parts of the file that were skipped.

    `first_skipped`: where, and why.
    """

    frames: tuple[LoggedFrame, ...]
    left_out: dict[str, int] = {}
    skipped: int = 0
    first_skipped: str = ""

    def only(self, frames: Iterable[LoggedFrame], dropped: Mapping[str, int]) -> "CanLog":
        """The log with these frames, and those `dropped` left out too."""
        left_out = dict(Counter(self.left_out) + Counter(dropped))
        return msgspec.structs.replace(self, frames=tuple(frames), left_out=left_out)


def without(log: CanLog, *kinds: FrameKind) -> CanLog:
    """The log without frames of these kinds, which count as left out."""
    dropped = Counter(frame.kind.value for frame in log.frames if frame.kind in kinds)
    return log.only((frame for frame in log.frames if frame.kind not in kinds), dropped)


class BadParts:
    """Parts of a log that cannot be read: the first raises ConfigError; to `skip` them, all are counted."""

    def __init__(self, path: Path, *, skip: bool) -> None:
        self.path = path
        self._skip = skip
        self._count = 0
        self._first = ""

    def found(self, where: str, why: str) -> None:
        """A part that cannot be read."""
        if not self._skip:
            raise ConfigError(f"{self.path}: {where}: {why}; {SKIP_BAD} leaves out such parts")
        self._count += 1
        self._first = self._first or f"{where}: {why}"

    def log(self, frames: Iterable[LoggedFrame], left_out: Mapping[str, int] | None = None) -> CanLog:
        """What could be read."""
        return CanLog(tuple(frames), dict(left_out or {}), self._count, self._first)


def origin_us(frames: Iterable[LoggedFrame]) -> int:
    """The date to write into a file: the whole second in which a dated log begins, or else 0 (1970)."""
    first_us = min((frame.t_us for frame in frames), default=0)
    return first_us - first_us % 1_000_000 if first_us >= DATED_US_MIN else 0


def channels_of(frames: Iterable[LoggedFrame]) -> dict[str, int]:
    """The number of each interface. Raises ConfigError if there are more than a format can number."""
    names = list(dict.fromkeys(frame.interface for frame in frames))
    if len(names) > CHANNELS_MAX:
        raise ConfigError(f"{len(names)} interfaces in one log, allowed are {CHANNELS_MAX}")
    own: dict[str, int | None] = {}
    for name in names:
        digits = re.fullmatch(r"\D*?(\d{1,3})", name)
        own[name] = int(digits[1]) if digits is not None and int(digits[1]) < CHANNELS_MAX else None
    found: dict[str, int] = {}
    for name in sorted(names, key=lambda n: n != f"can{own[n]}"):  # canN before others that end in N
        number = own[name]
        if number is not None and number not in found.values():
            found[name] = number
    free = iter(sorted(set(range(CHANNELS_MAX)) - set(found.values())))
    return {name: found[name] if name in found else next(free) for name in names}


def content(path: Path) -> bytes:
    """The bytes of the log at `path`. Raises ConfigError if it cannot be read, is too large, or empty."""
    try:
        size_bytes = path.stat().st_size
        if size_bytes > LOG_BYTES_MAX:
            raise ConfigError(f"{path}: {size_bytes} bytes, a log may have {LOG_BYTES_MAX}")
        with path.open("rb") as file:
            found = file.read(LOG_BYTES_MAX)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    if not found:
        raise ConfigError(f"{path}: the file is empty")
    return found


# -- candump --------------------------------------------------------------------------------------

EXPECTED: Final = "(SECONDS.MICROSECONDS) INTERFACE ID#DATA, e.g. (0000000012.345678) can0 130#01020304"
ERROR_FLAG: Final = 0x20000000  # in the identifier of an error frame
FD_BRS: Final = 1  # linux/can.h
FD_ESI: Final = 2
_LINE: Final = re.compile(  # asc2log of can-utils writes 1000000 microseconds where a second is full
    rb"\((?P<s>[0-9]{1,10})\.(?P<us>[0-9]{6}|1000000)\) (?P<interface>[!-~]{1,15}) "
    rb"(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    rb"(?:(?P<remote>[Rr])(?P<length>[0-9]?(?:(?<=8)_[9A-Fa-f])?)"  # _9 to _F: the length code was that
    rb"|#(?P<fd>[0-9A-Fa-f])(?P<fd_data>(?:[0-9A-Fa-f]{2})*)"
    rb"|(?P<data>(?:[0-9A-Fa-f]{2})*)(?:(?<=#[0-9A-Fa-f]{16})_[9A-Fa-f])?)"
    rb"(?: (?P<direction>[RT]))?\r?"
)


def read_candump(path: Path, *, skip_bad: bool = False) -> CanLog:
    """A line that is not candump is bad. A last line without newline counts as torn and is left out.

    A logger that is killed may write a part of its last line, which may still parse.
    """
    bad = BadParts(path, skip=skip_bad)
    *lines, rest = content(path).split(b"\n")
    frames: list[LoggedFrame] = []
    for number, line in enumerate(lines, 1):
        try:
            frames.append(parse_candump(line))
        except PeerError as error:
            bad.found(f"line {number}", str(error))
    return bad.log(frames, {str(Refusal.TORN): 1} if rest else {})


def parse_candump(line: bytes) -> LoggedFrame:
    """The frame in `line` (without newline). Raises PeerError."""
    match = _LINE.fullmatch(line)
    if match is None:
        shown = line[:LINE_SHOWN_CHARACTERS_MAX].decode("ascii", "replace")
        raise PeerError(f"not a candump line: {shown!r}, expected {EXPECTED}")
    can_id, extended = int(match["id"], 16), len(match["id"]) > 3
    is_error = extended and bool(can_id & ERROR_FLAG)
    if is_error and match["remote"]:
        raise PeerError("a frame cannot be an error frame and a remote frame")
    flags = int(match["fd"], 16) if match["fd"] is not None else None
    return LoggedFrame(
        t_us=int(match["s"]) * 1_000_000 + int(match["us"]),
        interface=match["interface"].decode("ascii"),
        can_id=can_id & ~ERROR_FLAG if is_error else can_id,
        data=bytes.fromhex((match["data"] or match["fd_data"] or b"").decode("ascii")),
        extended=extended,
        kind=FrameKind.ERROR if is_error else FrameKind.REMOTE if match["remote"] else FrameKind.DATA,
        length=int((match["length"] or b"0").partition(b"_")[0]),
        sent=match["direction"] == b"T",
        fd=FdFlags(bool(flags & FD_BRS), bool(flags & FD_ESI)) if flags is not None else None,
    )


def write_candump(log: CanLog, path: Path) -> None:
    path.write_text("".join(map(candump_line, log.frames)), encoding="ascii", newline="\n")


def candump_line(frame: LoggedFrame) -> str:
    """One line, with its newline."""
    seconds, micros = divmod(frame.t_us, 1_000_000)
    can_id = frame.can_id | (ERROR_FLAG if frame.kind is FrameKind.ERROR else 0)
    shown_id = f"{can_id:08X}" if frame.extended or frame.kind is FrameKind.ERROR else f"{can_id:03X}"
    data = f"R{frame.length or ''}" if frame.kind is FrameKind.REMOTE else frame.data.hex().upper()
    if frame.fd is not None:
        data = f"#{FD_BRS * frame.fd.bit_rate_switch + FD_ESI * frame.fd.error_state:X}{data}"
    return f"({seconds:010d}.{micros:06d}) {frame.interface} {shown_id}#{data}\n"


# -- python-can -----------------------------------------------------------------------------------


READ_ERRORS: Final = (  # what python-can's readers raise on a malformed file
    ValueError, LookupError, TypeError, ArithmeticError, AttributeError, AssertionError, RuntimeError,
    EOFError, struct.error, zlib.error,
)  # fmt: skip


class _WarningIsError(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        raise ValueError(record.getMessage())


@contextmanager
def _strict_python_can() -> Iterator[None]:
    """Raise ValueError where python-can logs a warning."""
    logger, handler = logging.getLogger("can.io"), _WarningIsError(logging.WARNING)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def _log_of(
    bad: BadParts, reader: Iterable[can.Message], where: Callable[[], str], channel_min: int = 0
) -> CanLog:
    """The frames of a reader; `where` is its position. It goes on behind an error if it is iterated again."""
    frames: list[LoggedFrame] = []
    failed_at = ""
    messages = iter(reader)
    with _strict_python_can():
        while True:
            try:
                message = next(messages, None)
            except READ_ERRORS as error:
                bad.found(where(), f"cannot be read: {error or type(error).__name__}")
                if where() == failed_at:
                    break  # it does not get on
                failed_at, messages = where(), iter(reader)
                continue
            if message is None:
                break
            try:
                frames.append(_frame_of(message, channel_min))
            except PeerError as error:
                bad.found(where(), str(error))
    return bad.log(frames)


def _frame_of(message: can.Message, channel_min: int) -> LoggedFrame:
    """Raises PeerError. `channel_min` is the number that the reader gives to the first channel."""
    is_error, is_fd = bool(message.is_error_frame), bool(message.is_fd)
    is_remote = bool(message.is_remote_frame) and not is_fd
    kind = FrameKind.ERROR if is_error else FrameKind.REMOTE if is_remote else FrameKind.DATA
    data = bytes(message.data) if kind is not FrameKind.REMOTE else b""
    length = message.dlc if is_fd else min(message.dlc, DATA_LENGTH_MAX)
    lengths = (len(data), can.util.len2dlc(len(data))) if is_fd else (len(data),)
    if kind is FrameKind.DATA and length not in lengths:
        raise PeerError(f"a frame of {length} bytes with {len(data)}")
    channel = message.channel - channel_min if isinstance(message.channel, int) else 0
    flags = FdFlags(bool(message.bitrate_switch), bool(message.error_state_indicator))
    return LoggedFrame(
        t_us=round(message.timestamp * 1e6),
        interface=f"can{max(channel, 0)}",
        can_id=message.arbitration_id,
        data=data,
        extended=bool(message.is_extended_id) or is_error,
        kind=kind,
        length=length if kind is FrameKind.REMOTE else 0,
        sent=not message.is_rx and not is_error,
        fd=flags if is_fd and not is_error else None,
    )


def _messages_of(log: CanLog) -> Iterator[can.Message]:
    channels = channels_of(log.frames)
    for frame in log.frames:
        is_remote = frame.kind is FrameKind.REMOTE
        yield can.Message(
            timestamp=frame.t_us / 1e6,
            arbitration_id=frame.can_id,
            is_extended_id=frame.extended,
            is_remote_frame=is_remote,
            is_error_frame=frame.kind is FrameKind.ERROR,
            channel=channels[frame.interface],
            dlc=frame.length if is_remote else len(frame.data),
            data=None if is_remote else frame.data,
            is_rx=not frame.sent,
            is_fd=frame.fd is not None,
            bitrate_switch=frame.fd is not None and frame.fd.bit_rate_switch,
            error_state_indicator=frame.fd is not None and frame.fd.error_state,
        )


class _Lines(io.StringIO):
    """A text that counts the lines that were read."""

    number = 0

    def __next__(self) -> str:  # type: ignore[override]  # a text yields text
        line = super().__next__()
        self.number += 1
        return line

    def where(self) -> str:
        return f"line {self.number}"


def _lines(path: Path) -> _Lines:
    return _Lines(content(path).decode("latin-1"))  # never fails; the parts that matter are ASCII


# -- ASC (Vector) and TRC (PEAK) ------------------------------------------------------------------

TRC_LACKS: Final = (FrameKind.REMOTE, FrameKind.ERROR)
TRC_FD_KINDS: Final = {  # by bit rate switch and error state
    (False, False): "FD", (True, False): "FB", (True, True): "FE", (False, True): "BI"
}  # fmt: skip


class _RelativeTimesError(Exception):
    """The times of an ASC count from frame to frame."""


class _AscReader(can.ASCReader):
    """Goes on behind a line that it could not read. A date that it cannot read is none."""

    _begun = False

    def _extract_header(self) -> None:
        if not self._begun:
            super()._extract_header()
            self._begun = True

    @staticmethod
    def _datetime_to_timestamp(datetime_string: str) -> float:
        try:
            return can.ASCReader._datetime_to_timestamp(datetime_string)
        except ValueError:
            return 0.0

    def __iter__(self) -> Generator[can.Message, None, None]:
        for message in super().__iter__():
            if self.timestamps_format == "relative":
                raise _RelativeTimesError
            if self.start_time < DATED_US_MIN / 1e6:
                message.timestamp -= self.start_time
            yield message


def read_asc(path: Path, *, skip_bad: bool = False) -> CanLog:
    lines = _lines(path)
    try:
        return _log_of(
            BadParts(path, skip=skip_bad), _AscReader(lines, relative_timestamp=False), lines.where
        )
    except _RelativeTimesError:
        reason = "its times count from frame to frame; `timestamps absolute` is allowed"
        raise ConfigError(f"{path}: {reason}") from None


def write_asc(log: CanLog, path: Path) -> None:
    with path.open("w", encoding="ascii") as file, can.ASCWriter(file) as writer:
        writer.log_event("// written by aftbed", origin_us(log.frames) / 1e6)
        for message in _messages_of(log):
            writer.on_message_received(message)


class _TrcReader(can.TRCReader):
    """Goes on behind a line that it could not read."""

    _begun = False

    def _extract_header(self) -> str:
        if self._begun:
            return next((line for line in map(str.strip, self.file) if line and line[0] != ";"), "")
        first = super()._extract_header()
        self._begun = True
        return first

    def _parse_line(self, line: str) -> can.Message | None:
        return super()._parse_line(line) if line else None


def read_trc(path: Path, *, skip_bad: bool = False) -> CanLog:
    lines = _lines(path)
    return _log_of(BadParts(path, skip=skip_bad), _TrcReader(lines), lines.where, channel_min=1)


def write_trc(log: CanLog, path: Path) -> None:
    """Writes the data frames."""
    start_s = origin_us(log.frames) / 1e6
    with path.open("w", encoding="ascii") as file, can.TRCWriter(file) as writer:
        writer.filepath = "written by aftbed"  # instead of the path of a temporary file
        writer.first_timestamp = start_s
        writer.write_header(start_s)
        for message in _messages_of(without(log, *TRC_LACKS)):
            if message.is_fd:
                writer.log_event(_trc_fd_line(message, writer.msgnr, start_s), message.timestamp)
                writer.msgnr += 1
            else:
                writer.on_message_received(message)


def _trc_fd_line(message: can.Message, number: int, start_s: float) -> str:
    """As PEAK has it, in the columns of python-can's writer."""
    kind = TRC_FD_KINDS[message.bitrate_switch, message.error_state_indicator]
    time_ms, channel = (message.timestamp - start_s) * 1000, cast("int", message.channel) + 1
    can_id = f"{message.arbitration_id:0{7 if message.is_extended_id else 4}X}"
    to = "Rx" if message.is_rx else "Tx"
    code, data = can.util.len2dlc(len(message.data)), message.data.hex(" ").upper()
    return f"{number:>7} {time_ms:13.3f} {kind} {channel:>2} {can_id:>8} {to:>2} -  {code:<4} {data}"


# -- BLF (Vector) ---------------------------------------------------------------------------------
# A header, then containers of compressed objects; some objects are frames. There is no public specification;
# the layout is that of python-can and Vector_BLF.

BLF_SIGNATURE: Final = b"LOGG"
BLF_OBJECT: Final = b"LOBJ"
BLF_HEADER_BYTES_MIN: Final = 72
BLF_UNPACKED_BYTES_MAX: Final = 8 * LOG_BYTES_MAX
_CONTAINER: Final = 10  # type of an object
_STORED, _DEFLATED = 0, 2  # compression methods of a container
_OBJECT_HEAD: Final = struct.Struct("<4sHHLL")  # signature, header size, header version, size, type
_CONTAINER_HEAD: Final = struct.Struct("<H6xL4x")  # method, size unpacked
_CONTAINER_BYTES: Final = _OBJECT_HEAD.size + _CONTAINER_HEAD.size
_FRAME_HEAD_BYTES: Final = {1: 32, 2: 40}  # by version
_FRAME_BYTES: Final = {1: 16, 86: 16, 73: 32, 100: 84, 101: 40}  # without its head, at least; by type
_FILE_HEAD: Final = struct.Struct("<4sL8xQ")  # signature, header size, file size


def read_blf(path: Path, *, skip_bad: bool = False) -> CanLog:
    bad = BadParts(path, skip=skip_bad)
    data = content(path)
    try:
        head_bytes = _blf_head(data)
    except PeerError as error:
        raise ConfigError(f"{path}: {error}") from None
    objects = _blf_frames(_blf_unpacked(data, head_bytes, bad), bad)
    frames = b"".join(objects)
    container = _OBJECT_HEAD.pack(
        BLF_OBJECT, _OBJECT_HEAD.size, 1, _CONTAINER_BYTES + len(frames), _CONTAINER
    )
    whole = data[:head_bytes] + container + _CONTAINER_HEAD.pack(_STORED, len(frames)) + frames
    with can.BLFReader(io.BytesIO(whole)) as reader:
        return _log_of(bad, reader, lambda: f"among its {len(objects)} frames")


def write_blf(log: CanLog, path: Path) -> None:
    with path.open("wb") as file, can.BLFWriter(file) as writer:
        writer.start_timestamp = origin_us(log.frames) / 1e6
        for message in _messages_of(log):
            writer.on_message_received(message)


def _blf_head(data: bytes) -> int:
    """The length of the header. Raises PeerError."""
    if len(data) < BLF_HEADER_BYTES_MIN or not data.startswith(BLF_SIGNATURE):
        raise PeerError("not a BLF: it does not begin with a header and its LOGG")
    _, header_bytes, _ = _FILE_HEAD.unpack_from(data)
    if not BLF_HEADER_BYTES_MIN <= header_bytes <= len(data):
        raise PeerError(f"a BLF with a header of {header_bytes} bytes: torn or malformed")
    return int(header_bytes)


def _blf_unpacked(data: bytes, head_bytes: int, bad: BadParts) -> bytes:
    """What is in the containers of the file."""
    _, _, file_bytes = _FILE_HEAD.unpack_from(data)
    if file_bytes > len(data):
        bad.found("its end", f"torn: {len(data)} bytes of the {file_bytes} that its header tells of")
    unpacked = bytearray()
    for at, size, kind in _blf_objects(data, head_bytes, "byte", bad):
        if kind != _CONTAINER:
            continue
        try:
            unpacked += _unpack(data[at + _OBJECT_HEAD.size : at + size])
        except PeerError as error:
            bad.found(f"byte {at}", str(error))
        if len(unpacked) > BLF_UNPACKED_BYTES_MAX:
            raise ConfigError(f"{bad.path}: byte {at}: more than {BLF_UNPACKED_BYTES_MAX} bytes unpacked")
    return bytes(unpacked)


def _blf_frames(unpacked: bytes, bad: BadParts) -> list[bytes]:
    """The objects that are frames, each with its padding."""
    found = []
    for at, size, kind in _blf_objects(unpacked, 0, "unpacked byte", bad):
        if kind not in _FRAME_BYTES:
            continue
        version = _OBJECT_HEAD.unpack_from(unpacked, at)[2]
        if version not in _FRAME_HEAD_BYTES:
            bad.found(f"unpacked byte {at}", f"an object with a head of version {version}")
        elif size < (least := _FRAME_HEAD_BYTES[version] + _FRAME_BYTES[kind]):
            bad.found(f"unpacked byte {at}", f"a frame of {size} bytes, it has at least {least}")
        else:
            found.append(unpacked[at : at + size])
    return found


def _blf_objects(data: bytes, start: int, unit: str, bad: BadParts) -> Iterator[tuple[int, int, int]]:
    """Offset, size and type of each object. Up to 3 bytes of padding lie between two.

    What is bad ends where the next object seems to begin.
    """
    end = start
    while end < len(data):
        at = data.find(BLF_OBJECT, end)
        if at < 0 or at - end > 3:
            if len(data) - end > 3:
                bad.found(f"{unit} {end}", "no object begins here: torn or malformed")
            if at < 0:
                return
        if at + _OBJECT_HEAD.size > len(data):
            bad.found(f"{unit} {at}", "torn in the head of an object")
            return
        _, head_bytes, _, size, kind = _OBJECT_HEAD.unpack_from(data, at)
        end = at + size
        if not _OBJECT_HEAD.size <= head_bytes <= size:
            bad.found(f"{unit} {at}", f"an object of {size} bytes with a head of {head_bytes}")
            end = at + len(BLF_OBJECT)
        elif end > len(data):
            bad.found(f"{unit} {at}", f"torn: {len(data) - at} of the {size} bytes of an object")
            end = at + len(BLF_OBJECT)
        else:
            yield at, size, kind


def _unpack(body: bytes) -> bytes:
    """What is in a container. Raises PeerError."""
    if len(body) < _CONTAINER_HEAD.size:
        raise PeerError(f"a container of {len(body)} bytes")
    method, size = _CONTAINER_HEAD.unpack_from(body)
    packed = body[_CONTAINER_HEAD.size :]
    if method == _STORED:
        return packed
    if method != _DEFLATED:
        raise PeerError(f"a container packed in an unknown way ({method})")
    if size > BLF_UNPACKED_BYTES_MAX:
        raise PeerError(f"a container of {size} bytes unpacked")
    unpacker = zlib.decompressobj()
    try:
        found = unpacker.decompress(packed, size + 1)
    except zlib.error as error:
        raise PeerError(f"a container that cannot be unpacked: {error}") from None
    if len(found) != size or not unpacker.eof:
        raise PeerError(f"a container of {len(found)} bytes unpacked, {size} are announced")
    return found


# -- MF4 (ASAM MDF 4, bus logging) ----------------------------------------------------------------
# The times of a table must not fall, so frames are sorted by time. Frames of the same time come back in the
# order data, error, remote.

MF4_TABLES: Final = {
    FrameKind.DATA: "CAN_DataFrame",
    FrameKind.ERROR: "CAN_ErrorFrame",
    FrameKind.REMOTE: "CAN_RemoteFrame",
}
MF4_SIGNATURES: Final = (b"MDF     ", b"UnFinMF ")
MF4_LIMITS: Final = ProcessLimits(  # 300 000 frames take 6 s; asammdf may write temporary files
    seconds=600.0, memory_bytes=16 << 30
)
MF4_TORN: Final = "not an MF4 that can be read: torn or malformed: "
MF4_UNREADABLE: Final = f"{{path}}: {MF4_TORN}{{why}}"


def read_mf4(path: Path, *, skip_bad: bool = False) -> CanLog:
    """Reads in a process of its own."""
    if not content(path).startswith(MF4_SIGNATURES):
        raise ConfigError(f"{path}: not an MF4: it does not begin with MDF")
    _require_asammdf()
    try:
        with scratch_directory("aftbed-mf4-") as folder:  # asammdf leaves a file there
            job = msgspec.msgpack.encode((str(path.absolute()), skip_bad))
            answer = ask(__name__, job, MF4_LIMITS, {"TMPDIR": str(folder)})
        found = msgspec.msgpack.decode(answer, type=CanLog | str)
    except JobFailedError as error:
        raise ConfigError(MF4_UNREADABLE.format(path=path, why=f"its reader {error}")) from None
    except msgspec.DecodeError as error:
        raise ConfigError(MF4_UNREADABLE.format(path=path, why=f"its reader answered {error}")) from None
    if isinstance(found, str):
        raise ConfigError(f"{path}: {found}")
    return found


def _read_mf4_here(job: bytes) -> bytes:
    """In the process of the reader: the log of a path, or what is wrong with it."""
    name, skip_bad = msgspec.msgpack.decode(job, type=tuple[str, bool])
    path = Path(name)
    answer: CanLog | str
    try:
        reader = with_asammdf().MF4Reader(io.BytesIO(content(path)))
        answer = _log_of(BadParts(path, skip=skip_bad), reader, lambda: "in its tables of frames")
    except ConfigError as error:
        answer = str(error).removeprefix(f"{path}: ")
    except Exception as error:  # noqa: BLE001 - of asammdf, python-can, and four decompressors
        why = str(error) if str(error) and "BytesIO" not in str(error) else type(error).__name__
        answer = f"{MF4_TORN}{why}"
    return msgspec.msgpack.encode(answer)


def write_mf4(log: CanLog, path: Path) -> None:
    _require_asammdf()
    with_asammdf()
    import numpy  # noqa: PLC0415 - all of them are slow to import
    from asammdf import MDF, Signal  # noqa: PLC0415
    from asammdf.blocks.v4_blocks import SourceInformation  # noqa: PLC0415
    from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS  # noqa: PLC0415
    from can.io.mf4 import ERR_DTYPE, RTR_DTYPE, STD_DTYPE  # noqa: PLC0415

    columns = {FrameKind.DATA: STD_DTYPE, FrameKind.ERROR: ERR_DTYPE, FrameKind.REMOTE: RTR_DTYPE}
    channels = channels_of(log.frames)
    start_us = origin_us(log.frames)
    with MDF(version="4.10") as mdf:
        mdf.header.start_time = datetime.fromtimestamp(start_us // 1_000_000, UTC)
        for kind, name in MF4_TABLES.items():
            frames = [frame for frame in sorted(log.frames, key=lambda f: f.t_us) if frame.kind is kind]
            table = numpy.zeros(len(frames), dtype=columns[kind])
            for row, frame in zip(table, frames, strict=True):
                row[f"{name}.BusChannel"] = channels[frame.interface]
                row[f"{name}.ID"] = frame.can_id
                row[f"{name}.IDE"] = frame.extended
                row[f"{name}.Dir"] = frame.sent
                if kind is FrameKind.REMOTE:
                    row[f"{name}.DLC"] = frame.length
                else:
                    row[f"{name}.DLC"] = can.util.len2dlc(len(frame.data))
                    row[f"{name}.DataLength"] = len(frame.data)
                    row[f"{name}.DataBytes"][: len(frame.data)] = list(frame.data)
                if frame.fd is not None:
                    row[f"{name}.EDL"] = True
                    row[f"{name}.BRS"] = frame.fd.bit_rate_switch
                    row[f"{name}.ESI"] = frame.fd.error_state
            times_s = numpy.array([(frame.t_us - start_us) / 1e6 for frame in frames], dtype="<f8")
            source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
            mdf.append(Signal(name=name, samples=table, timestamps=times_s, source=source))
        with path.open("wb") as file:
            mdf.save(file, compression=2)


def _require_asammdf() -> None:
    if find_spec("asammdf") is None:
        raise ConfigError('MF4 needs asammdf: pip install "aftbed[mf4]"')


# -- CSV by frame -----------------------------------------------------------------------------------


def _frame_of_python_can(row: Mapping[str, str]) -> LoggedFrame:
    is_error, is_remote = row["error"] == "1", row["remote"] == "1"
    data = b64decode(row["data"], validate=True)
    is_fd = len(data) > DATA_LENGTH_MAX
    length = int(row["dlc"]) if is_fd else min(int(row["dlc"]), DATA_LENGTH_MAX)
    if not is_error and not is_remote and len(data) != length:
        raise PeerError(f"a frame of {row['dlc']} bytes with {len(data)}")
    return LoggedFrame(
        t_us=round(float(row["timestamp"]) * 1e6),
        interface="can0",
        can_id=int(row["arbitration_id"], 16),
        data=data,
        extended=is_error or row["extended"] == "1",
        kind=FrameKind.ERROR if is_error else FrameKind.REMOTE if is_remote else FrameKind.DATA,
        length=length if is_remote else 0,
        fd=FdFlags() if is_fd else None,
    )


def _frame_of_savvycan(row: Mapping[str, str]) -> LoggedFrame:
    length = int(row["len"])
    return LoggedFrame(
        t_us=int(row["time stamp"]),
        interface=f"can{int(row['bus'])}",
        can_id=int(row["id"], 16),
        data=bytes(int(row[f"d{number}"], 16) for number in range(1, length + 1)),
        extended=row["extended"].lower() == "true",
        sent=row.get("dir") == "Tx",
        fd=FdFlags() if length > DATA_LENGTH_MAX else None,
    )


def _frame_of_cabana(row: Mapping[str, str]) -> LoggedFrame:
    can_id = int(row["addr"], 0)  # decimal in older files
    data = bytes.fromhex(row["data"].removeprefix("0x"))
    return LoggedFrame(
        t_us=round(float(row["time"]) * 1e6),
        interface=f"can{int(row['bus'])}",
        can_id=can_id,
        data=data,
        extended=can_id > CAN_ID_MAX,
        fd=FdFlags() if len(data) > DATA_LENGTH_MAX else None,
    )


class CsvForm(msgspec.Struct, frozen=True):
    """A program's CSV with a frame in each row: the columns that it has at least, and what a row means."""

    program: str
    columns: tuple[str, ...]
    frame_of: Callable[[Mapping[str, str]], LoggedFrame]


CSV_FORMS: Final = (
    CsvForm(
        "python-can",
        ("timestamp", "arbitration_id", "extended", "remote", "error", "dlc", "data"),
        _frame_of_python_can,
    ),
    CsvForm("SavvyCAN", ("time stamp", "id", "extended", "bus", "len", "d1"), _frame_of_savvycan),
    CsvForm("cabana", ("time", "addr", "bus", "data"), _frame_of_cabana),
)


def read_csv(path: Path, *, skip_bad: bool = False) -> CanLog:
    """A CSV with a frame in each row, by one of these programs; times are kept as they are."""
    bad = BadParts(path, skip=skip_bad)
    rows = csv.reader(io.StringIO(content(path).decode("utf-8-sig", "replace"), newline=""))
    frames: list[LoggedFrame] = []
    head: list[str] = []
    form = None
    while True:
        try:
            cells = next(rows, None)
        except csv.Error as error:
            bad.found(f"line {rows.line_num}", str(error))
            continue
        if cells is None:
            break
        if form is None:
            head = [cell.strip().lower() for cell in cells]
            form = _csv_form(path, head)
        elif cells:
            try:
                frames.append(form.frame_of(dict(zip(head, map(str.strip, cells), strict=False))))
            except (ValueError, KeyError, OverflowError, PeerError) as error:
                why = error if isinstance(error, PeerError) else f"not a row of {form.program}"
                shown = ",".join(cells)[:LINE_SHOWN_CHARACTERS_MAX]
                bad.found(f"line {rows.line_num}", f"{why}: {shown!r}")
    return bad.log(frames)


def _csv_form(path: Path, head: Sequence[str]) -> CsvForm:
    """The form that has these columns. Raises ConfigError."""
    for form in CSV_FORMS:
        if set(form.columns) <= set(head):
            return form
    shown = ",".join(head)[:LINE_SHOWN_CHARACTERS_MAX]
    allowed = "; ".join(f"{','.join(form.columns)} ({form.program})" for form in CSV_FORMS)
    raise ConfigError(
        f"{path}: line 1: its columns {shown!r} are not those of a log of frames, allowed are: {allowed}"
    )


# -- CSV by signal, for PlotJuggler and spreadsheets ----------------------------------------------

NOT_IN_DBC: Final = "frame that the DBC does not have"
OTHER_LENGTH: Final = "frame of another length than the DBC says"


def write_csv(log: CanLog, codec: Codec, path: Path) -> CanLog:
    """Writes the decoded signals; the frames that were decoded. Raises ConfigError if there are none.

    Columns: `time` in seconds, then `Message.Signal` in the order of the DBC, or `can1.Message.Signal` for a
    message on several interfaces. One row for each frame, sorted by time, empty where the frame has no value.
    Values are in physical units. Checksums are not checked.
    """
    kept, rows = _decode(log, codec)
    if not rows:
        raise ConfigError(f"{codec.path}: describes none of the {len(log.frames)} frames")
    interfaces: dict[str, list[str]] = {}
    for frame, name, _ in rows:
        if frame.interface not in interfaces.setdefault(name, []):
            interfaces[name].append(frame.interface)

    def column(interface: str, name: str, signal: str) -> str:
        if len(interfaces[name]) == 1:
            return f"{name}.{signal}"
        return spreadsheet_text(f"{interface}.{name}.{signal}")

    columns = [
        column(interface, name, signal)
        for name in sorted(interfaces)
        for interface in interfaces[name]
        for signal in codec.signal_names(name)
        if signal not in codec.misfits(name)
    ]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["time", *columns], restval="", lineterminator="\n")
        writer.writeheader()
        for frame, name, values in sorted(rows, key=lambda row: row[0].t_us):
            time = {"time": f"{frame.t_us // 1_000_000}.{frame.t_us % 1_000_000:06d}"}
            row = {column(frame.interface, name, signal): _shown(value) for signal, value in values.items()}
            writer.writerow(time | row)
    return kept


def _shown(value: float) -> str:
    """Without binary rounding: 13.889, not 13.889000000000001."""
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _decode(log: CanLog, codec: Codec) -> tuple[CanLog, list[tuple[LoggedFrame, str, dict[str, float]]]]:
    """The decodable frames, and each with its message's name and signals."""
    usable = [name for name in codec.names() if codec.flaw(name) is None]
    names = {(codec.can_id(name), codec.extended(name)): name for name in usable}
    data = without(log, FrameKind.REMOTE, FrameKind.ERROR)
    reasons = Counter(data.left_out)
    found = []
    for frame in data.frames:
        name = names.get((frame.can_id, frame.extended))
        if name is None:
            reasons[NOT_IN_DBC] += 1
            continue
        try:
            found.append((frame, name, codec.decode(name, frame.data)))
        except PeerError:
            reasons[OTHER_LENGTH] += 1
    kept = msgspec.structs.replace(log, frames=tuple(frame for frame, _, _ in found), left_out=dict(reasons))
    return kept, found


# -- replay -----------------------------------------------------------------------------------------


EXTENDED: Final = "29-bit identifier"


def read_for_replay(path: Path, *, skip_bad: bool = False) -> PlayedLog:
    """The frames of the log at `path` that the bus carries. A name whose ending says no format is a candump.

    Times of a log with several interfaces may go back by a little. A frame that is earlier than the one
    before it is left out, because bus time never runs backwards. Raises ConfigError.
    """
    name = ENDINGS.get(path.suffix.lower(), "candump")
    log = read_log(path, name, skip_bad=skip_bad)
    left_out = Counter(log.left_out)
    frames: list[Frame] = []
    last_us = 0
    for logged in log.frames:
        if logged.kind is not FrameKind.DATA:
            left_out[logged.kind.value] += 1
        elif logged.fd is not None:
            left_out[FD] += 1
        elif logged.extended:
            left_out[EXTENDED] += 1
        elif logged.t_us < last_us:
            left_out[str(Refusal.TIME)] += 1
        else:
            last_us = logged.t_us
            frames.append(Frame(logged.t_us, logged.can_id, logged.data))
    if not frames:
        why = "; ".join(f"{count} times {reason}" for reason, count in left_out.items())
        raise ConfigError(f"{path}: no frame in it that the bus carries, read as {name} ({why})")
    report = LogReport(name, len(frames), dict(left_out), log.skipped, log.first_skipped)
    return PlayedLog(tuple(frames), report)


# -- conversion -----------------------------------------------------------------------------------

CSV: Final = "csv"  # read by frame, written by signal


class Reader(Protocol):
    """Reads the log at `path`. Raises ConfigError, unless to `skip_bad`, where a part cannot be read."""

    def __call__(self, path: Path, *, skip_bad: bool = False) -> CanLog: ...


READERS: Final[dict[str, Reader]] = {
    "candump": read_candump, "asc": read_asc, "blf": read_blf, "trc": read_trc, "mf4": read_mf4, CSV: read_csv
}  # fmt: skip
WRITERS: Final[dict[str, Callable[[CanLog, Path], None]]] = {
    "candump": write_candump, "asc": write_asc, "blf": write_blf, "trc": write_trc, "mf4": write_mf4
}  # fmt: skip


ENDINGS: Final = {".log": "candump"} | {f".{name}": name for name in (*WRITERS, CSV)}


class Conversion(msgspec.Struct, frozen=True):
    """`frames` were written, from one format to the other; `left_out` were not, by reason. See `CanLog`."""

    source: str
    sink: str
    frames: int
    left_out: dict[str, int]
    skipped: int
    first_skipped: str


def format_of(path: Path, given: str | None, option: str, allowed: tuple[str, ...]) -> str:
    """The format `given`, or that of the ending of `path`. Raises ConfigError with the allowed ones."""
    if given is not None:
        if given not in allowed:
            raise unknown(f"format of {option}", given, allowed)
        return given
    found = ENDINGS.get(path.suffix.lower())
    if found not in allowed:
        ending = f"the ending {path.suffix!r}" if path.suffix else "a name without an ending"
        raise ConfigError(
            f"{path}: {ending} says no format; {option} does (one of: {', '.join(sorted(allowed))})"
        )
    return found


def read_log(path: Path, format_name: str, *, skip_bad: bool = False) -> CanLog:
    """The log at `path`, which has frames. Raises ConfigError."""
    log = READERS[format_name](path, skip_bad=skip_bad)
    if not log.frames:
        counted = [f"{count} times {reason}" for reason, count in log.left_out.items()]
        if log.skipped:
            counted.append(f"{log.skipped} parts cannot be read, the first: {log.first_skipped}")
        raise ConfigError(
            f"{path}: no frame in it, read as {format_name}" + (f" ({'; '.join(counted)})" if counted else "")
        )
    return log


def convert(
    source: Path,
    sink: Path,
    from_format: str | None = None,
    to_format: str | None = None,
    dbc: Path | None = None,
    *,
    skip_bad: bool = False,
    show: Callable[[str], None] = lambda _: None,
) -> Conversion:
    """Write the log `source` to `sink`. Raises ConfigError; then `sink` is as it was.

    `show` is told what is done next.
    """
    read_as = format_of(source, from_format, "--from", tuple(READERS))
    write_as = format_of(sink, to_format, "--to", (*WRITERS, CSV))
    if dbc is not None and write_as != CSV:
        raise ConfigError(
            f"--dbc says what is in the frames, which only {CSV} asks: {write_as} keeps them as they are"
        )
    if sink.exists() and source.exists() and sink.samefile(source):
        raise ConfigError(f"{sink}: would be written over itself")
    codec = None
    if write_as == CSV:  # a DBC of the user may contradict itself: what lies within its messages is decoded
        codec = load_dbc() if dbc is None else load_dbc(find_dbc(str(dbc)), strict=False)
    show(f"reading {source}")
    log = read_log(source, read_as, skip_bad=skip_bad)
    show(f"writing {len(log.frames)} frames")
    if codec is not None:
        kept = write_whole(sink, lambda path: write_csv(log, codec, path))
    else:
        kept = without(log, *TRC_LACKS) if write_as == "trc" else log
        write_whole(sink, lambda path: WRITERS[write_as](kept, path))
    return Conversion(read_as, write_as, len(kept.frames), kept.left_out, log.skipped, log.first_skipped)


if __name__ == "__main__":
    serve(_read_mf4_here)
