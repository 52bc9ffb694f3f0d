"""Converts logs of a CAN bus between candump, ASC, BLF, TRC and MF4, and writes their signals as CSV.

ASC, BLF, TRC and MF4 are read by python-can's readers; ASC, BLF and TRC are written by its writers. This
module adds what python-can loses, as the tests show:

- candump is read and written here. python-can's reader takes most error frames for data frames and gives no
  line number for a malformed line. Its writer drops the length of a remote frame and the interface of an
  error frame, and moves a frame that is out of order to the time of the frame before.
- ASC: a log without a readable date, or dated before 1990, counts from its start. `timestamps relative` is
  refused: each time counts from the frame before, and python-can reads them as absolute. python-can writes
  the milliseconds of a date without leading zeros, so the date is a whole second.
- BLF: the structure is checked first. python-can reads what is left of a torn container, and loops forever on
  an object of length 0. Its writer would take the time of the first frame for the start of a log without a
  date.
- TRC: the reader does not subtract the 1 that the writer adds to a channel. Error and remote frames are left
  out: the format has no error frames, and python-can does not write remote frames.
- MF4: read in a process of its own, with a deadline, because asammdf's native code may crash or hang on a
  malformed file. Written through asammdf: python-can's writer dates each file with the time of writing, so
  older frames get negative times.
- A warning of python-can is an error, because it skips what it cannot parse; so is a data frame with fewer
  bytes than its length. Errors name the file, and the line or byte if there is one.

What a format has beside frames (statistics, comments, triggers) is dropped. CAN FD frames, and frames that
the other format lacks, are left out, counted by reason and reported.

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
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError, PeerError, spreadsheet_text, unknown
from aftbed.interop.files import write_whole
from aftbed.runtime.unix.confined import JobFailedError, ProcessLimits, ask, serve
from aftbed.vehicle.can.candump import LINE_SHOWN_CHARACTERS_MAX, LOG_BYTES_MAX, Refusal
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.frame import CAN_ID_MAX, DATA_LENGTH_MAX
from aftbed.vehicle.can.python_can import can, with_asammdf
from aftbed.vehicle.replay.map_file import find_dbc

EXTENDED_ID_MAX: Final = 0x1FFFFFFF
TIME_US_MAX: Final = 2**32 * 1_000_000 - 1  # in 2106
DATED_US_MIN: Final = 631_152_000 * 1_000_000  # 1990
CHANNELS_MAX: Final = 255  # MF4 stores a channel in one byte
FD: Final = "CAN FD frame"


# -- frames ---------------------------------------------------------------------------------------


class FrameKind(Enum):
    DATA = "data frame"
    REMOTE = "remote frame"
    ERROR = "error frame"


class LoggedFrame(msgspec.Struct, frozen=True):
    """A frame of a log. Raises PeerError for values that no classic CAN frame has.

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

    def __post_init__(self) -> None:
        id_max = EXTENDED_ID_MAX if self.extended else CAN_ID_MAX
        if not 0 <= self.can_id <= id_max:
            raise PeerError(f"CAN id {self.can_id:#x}, allowed is 0 to {id_max:#x}")
        if len(self.data) > DATA_LENGTH_MAX:
            raise PeerError(f"{len(self.data)} bytes, allowed are 0 to {DATA_LENGTH_MAX}")
        if not 0 <= self.length <= DATA_LENGTH_MAX:
            raise PeerError(f"a remote frame for {self.length} bytes, allowed are 0 to {DATA_LENGTH_MAX}")
        if not 0 <= self.t_us <= TIME_US_MAX:
            raise PeerError(f"time {self.t_us / 1e6:.6f} s, allowed is 0 to {TIME_US_MAX // 10**6} s")


class CanLog(msgspec.Struct, frozen=True):
    """The frames in the order of their file, and the number of frames left out, by reason."""

    frames: tuple[LoggedFrame, ...]
    left_out: dict[str, int] = {}


def without(log: CanLog, *kinds: FrameKind) -> CanLog:
    """The log without frames of these kinds, which count as left out."""
    kept = tuple(frame for frame in log.frames if frame.kind not in kinds)
    dropped = Counter(frame.kind.value for frame in log.frames if frame.kind in kinds)
    return CanLog(kept, dict(Counter(log.left_out) + dropped))


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
_LINE: Final = re.compile(  # asc2log of can-utils writes 1000000 microseconds where a second is full
    rb"\((?P<s>[0-9]{1,10})\.(?P<us>[0-9]{6}|1000000)\) (?P<interface>[!-~]{1,15}) "
    rb"(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    rb"(?:(?P<remote>[Rr])(?P<length>[0-9]?)|(?P<fd>#[0-9A-Fa-f](?:[0-9A-Fa-f]{2})*)|(?P<data>(?:[0-9A-Fa-f]{2})*))"
    rb"(?: (?P<direction>[RT]))?\r?"
)


def read_candump(path: Path) -> CanLog:
    """A line that is not candump is an error. A last line without newline counts as torn and is left out.

    A logger that is killed may write a part of its last line, which may still parse. A replay reads logs by
    `vehicle.can.candump`, which takes only 11-bit data frames.
    """
    *lines, rest = content(path).split(b"\n")
    frames: list[LoggedFrame] = []
    for number, line in enumerate(lines, 1):
        try:
            frame = parse_candump(line)
        except PeerError as error:
            raise ConfigError(f"{path}: line {number}: {error}") from None
        if frame is not None:
            frames.append(frame)
    left_out = {FD: len(lines) - len(frames), str(Refusal.TORN): int(bool(rest))}
    return CanLog(tuple(frames), {reason: count for reason, count in left_out.items() if count})


def parse_candump(line: bytes) -> LoggedFrame | None:
    """The frame in `line` (without newline); None if it is a CAN FD frame. Raises PeerError."""
    match = _LINE.fullmatch(line)
    if match is None:
        shown = line[:LINE_SHOWN_CHARACTERS_MAX].decode("ascii", "replace")
        raise PeerError(f"not a candump line: {shown!r}, expected {EXPECTED}")
    if match["fd"] is not None:
        return None
    can_id, extended = int(match["id"], 16), len(match["id"]) > 3
    is_error = extended and bool(can_id & ERROR_FLAG)
    if is_error and match["remote"]:
        raise PeerError("a frame cannot be an error frame and a remote frame")
    return LoggedFrame(
        t_us=int(match["s"]) * 1_000_000 + int(match["us"]),
        interface=match["interface"].decode("ascii"),
        can_id=can_id & ~ERROR_FLAG if is_error else can_id,
        data=bytes.fromhex((match["data"] or b"").decode("ascii")),
        extended=extended,
        kind=FrameKind.ERROR if is_error else FrameKind.REMOTE if match["remote"] else FrameKind.DATA,
        length=int(match["length"] or 0),
        sent=match["direction"] == b"T",
    )


def write_candump(log: CanLog, path: Path) -> None:
    path.write_text("".join(map(candump_line, log.frames)), encoding="ascii", newline="\n")


def candump_line(frame: LoggedFrame) -> str:
    """One line, with its newline."""
    seconds, micros = divmod(frame.t_us, 1_000_000)
    can_id = frame.can_id | (ERROR_FLAG if frame.kind is FrameKind.ERROR else 0)
    shown_id = f"{can_id:08X}" if frame.extended or frame.kind is FrameKind.ERROR else f"{can_id:03X}"
    data = f"R{frame.length or ''}" if frame.kind is FrameKind.REMOTE else frame.data.hex().upper()
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
    path: Path, messages: Iterable[can.Message], where: Callable[[], str], channel_min: int = 0
) -> CanLog:
    """The frames of a reader; `where` is its position. Raises ConfigError naming file and position."""
    frames: list[LoggedFrame] = []
    fd = 0
    try:
        with _strict_python_can():
            for message in messages:
                if message.is_fd and not message.is_error_frame:
                    fd += 1
                else:
                    frames.append(_frame_of(message, channel_min))
    except PeerError as error:
        raise ConfigError(f"{path}: {where()}: {error}") from None
    except READ_ERRORS as error:
        raise ConfigError(f"{path}: {where()}: cannot be read: {error or type(error).__name__}") from None
    return CanLog(tuple(frames), {FD: fd} if fd else {})


def _frame_of(message: can.Message, channel_min: int) -> LoggedFrame:
    """Raises PeerError. `channel_min` is the number that the reader gives to the first channel."""
    is_error, is_remote = bool(message.is_error_frame), bool(message.is_remote_frame)
    kind = FrameKind.ERROR if is_error else FrameKind.REMOTE if is_remote else FrameKind.DATA
    data = bytes(message.data) if kind is not FrameKind.REMOTE else b""
    if kind is FrameKind.DATA and len(data) != message.dlc:
        raise PeerError(f"a frame of {message.dlc} bytes with {len(data)}")
    channel = message.channel - channel_min if isinstance(message.channel, int) else 0
    return LoggedFrame(
        t_us=round(message.timestamp * 1e6),
        interface=f"can{max(channel, 0)}",
        can_id=message.arbitration_id,
        data=data,
        extended=bool(message.is_extended_id) or is_error,
        kind=kind,
        length=message.dlc if kind is FrameKind.REMOTE else 0,
        sent=not message.is_rx and not is_error,
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


def read_asc(path: Path) -> CanLog:
    try:
        return _read_asc(path, dated=True)
    except ConfigError as error:
        if "Incompatible datetime string" not in str(error):  # python-can's text
            raise
    return _read_asc(path, dated=False)


def _read_asc(path: Path, *, dated: bool) -> CanLog:
    lines = _lines(path)
    reader = can.ASCReader(lines, relative_timestamp=not dated)

    def messages() -> Iterator[can.Message]:
        for message in reader:
            if reader.timestamps_format == "relative":
                reason = "its times count from frame to frame; `timestamps absolute` is allowed"
                raise ConfigError(f"{path}: {reason}")
            if reader.start_time < DATED_US_MIN / 1e6:
                message.timestamp -= reader.start_time
            yield message

    return _log_of(path, messages(), lines.where)


def write_asc(log: CanLog, path: Path) -> None:
    with path.open("w", encoding="ascii") as file, can.ASCWriter(file) as writer:
        writer.log_event("// written by aftbed", origin_us(log.frames) / 1e6)
        for message in _messages_of(log):
            writer.on_message_received(message)


def read_trc(path: Path) -> CanLog:
    lines = _lines(path)
    return _log_of(path, can.TRCReader(lines), lines.where, channel_min=1)


def write_trc(log: CanLog, path: Path) -> None:
    """Writes the data frames."""
    start_s = origin_us(log.frames) / 1e6
    with path.open("w", encoding="ascii") as file, can.TRCWriter(file) as writer:
        writer.filepath = "written by aftbed"  # instead of the path of a temporary file
        writer.first_timestamp = start_s
        writer.write_header(start_s)
        for message in _messages_of(without(log, *TRC_LACKS)):
            writer.on_message_received(message)


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
_FILE_HEAD: Final = struct.Struct("<4sL8xQ")  # signature, header size, file size


def read_blf(path: Path) -> CanLog:
    try:
        objects = _check_blf(content(path))
    except PeerError as error:
        raise ConfigError(f"{path}: {error}") from None
    with can.BLFReader(path) as reader:
        return _log_of(path, reader, lambda: f"among its {objects} objects")


def write_blf(log: CanLog, path: Path) -> None:
    with path.open("wb") as file, can.BLFWriter(file) as writer:
        writer.start_timestamp = origin_us(log.frames) / 1e6
        for message in _messages_of(log):
            writer.on_message_received(message)


def _check_blf(data: bytes) -> int:
    """The number of objects. Raises PeerError unless all of them are complete."""
    if len(data) < BLF_HEADER_BYTES_MIN or not data.startswith(BLF_SIGNATURE):
        raise PeerError("not a BLF: it does not begin with a header and its LOGG")
    _, header_bytes, file_bytes = _FILE_HEAD.unpack_from(data)
    if not BLF_HEADER_BYTES_MIN <= header_bytes <= len(data):
        raise PeerError(f"a BLF with a header of {header_bytes} bytes: torn or malformed")
    if file_bytes > len(data):
        raise PeerError(f"torn: {len(data)} bytes of the {file_bytes} that its header tells of")
    unpacked = bytearray()
    for at, size, kind in _blf_objects(data, header_bytes, "byte"):
        if kind == _CONTAINER:
            unpacked += _unpack(data[at + _OBJECT_HEAD.size : at + size], at)
        if len(unpacked) > BLF_UNPACKED_BYTES_MAX:
            raise PeerError(f"byte {at}: more than {BLF_UNPACKED_BYTES_MAX} bytes unpacked")
    return sum(1 for _ in _blf_objects(bytes(unpacked), 0, "unpacked byte"))


def _blf_objects(data: bytes, start: int, unit: str) -> Iterator[tuple[int, int, int]]:
    """Offset, size and type of each object. Up to 3 bytes of padding lie between two."""
    end = start
    while end < len(data):
        at = data.find(BLF_OBJECT, end, end + 3 + len(BLF_OBJECT))
        if at < 0:
            if len(data) - end <= 3:
                return
            raise PeerError(f"{unit} {end}: no object begins here: torn or malformed")
        if at + _OBJECT_HEAD.size > len(data):
            raise PeerError(f"{unit} {at}: torn in the head of an object")
        _, head_bytes, _, size, kind = _OBJECT_HEAD.unpack_from(data, at)
        if not _OBJECT_HEAD.size <= head_bytes <= size:
            raise PeerError(f"{unit} {at}: an object of {size} bytes with a head of {head_bytes}")
        end = at + size
        if end > len(data):
            raise PeerError(f"{unit} {at}: torn: {len(data) - at} of the {size} bytes of an object")
        yield at, size, kind


def _unpack(body: bytes, at: int) -> bytes:
    if len(body) < _CONTAINER_HEAD.size:
        raise PeerError(f"byte {at}: a container of {len(body)} bytes")
    method, size = _CONTAINER_HEAD.unpack_from(body)
    packed = body[_CONTAINER_HEAD.size :]
    if method == _STORED:
        return packed
    if method != _DEFLATED:
        raise PeerError(f"byte {at}: a container packed in an unknown way ({method})")
    if size > BLF_UNPACKED_BYTES_MAX:
        raise PeerError(f"byte {at}: a container of {size} bytes unpacked")
    unpacker = zlib.decompressobj()
    try:
        found = unpacker.decompress(packed, size + 1)
    except zlib.error as error:
        raise PeerError(f"byte {at}: a container that cannot be unpacked: {error}") from None
    if len(found) != size or not unpacker.eof:
        raise PeerError(f"byte {at}: a container of {len(found)} bytes unpacked, {size} are announced")
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


def read_mf4(path: Path) -> CanLog:
    """Reads in a process of its own."""
    if not content(path).startswith(MF4_SIGNATURES):
        raise ConfigError(f"{path}: not an MF4: it does not begin with MDF")
    _require_asammdf()
    try:
        with TemporaryDirectory(prefix="aftbed-mf4-") as folder:  # asammdf leaves a file there
            answer = ask(__name__, str(path.absolute()).encode(), MF4_LIMITS, {"TMPDIR": folder})
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
    path = Path(job.decode())
    answer: CanLog | str
    try:
        reader = with_asammdf().MF4Reader(io.BytesIO(content(path)))
        answer = _log_of(path, reader, lambda: "in its tables of frames")
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
                    row[f"{name}.DLC"] = row[f"{name}.DataLength"] = len(frame.data)
                    row[f"{name}.DataBytes"][: len(frame.data)] = list(frame.data)
            times_s = numpy.array([(frame.t_us - start_us) / 1e6 for frame in frames], dtype="<f8")
            source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
            mdf.append(Signal(name=name, samples=table, timestamps=times_s, source=source))
        with path.open("wb") as file:
            mdf.save(file, compression=2)


def _require_asammdf() -> None:
    if find_spec("asammdf") is None:
        raise ConfigError('MF4 needs asammdf: pip install "aftbed[mf4]"')


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
    return CanLog(tuple(frame for frame, _, _ in found), dict(reasons)), found


# -- conversion -----------------------------------------------------------------------------------

CSV: Final = "csv"
READERS: Final[dict[str, Callable[[Path], CanLog]]] = {
    "candump": read_candump, "asc": read_asc, "blf": read_blf, "trc": read_trc, "mf4": read_mf4
}  # fmt: skip
WRITERS: Final[dict[str, Callable[[CanLog, Path], None]]] = {
    "candump": write_candump, "asc": write_asc, "blf": write_blf, "trc": write_trc, "mf4": write_mf4
}  # fmt: skip


ENDINGS: Final = {".log": "candump"} | {f".{name}": name for name in (*WRITERS, CSV)}


class Conversion(msgspec.Struct, frozen=True):
    """`frames` were written, from one format to the other; `left_out` were not, by reason."""

    source: str
    sink: str
    frames: int
    left_out: dict[str, int]


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


def convert(
    source: Path,
    sink: Path,
    from_format: str | None = None,
    to_format: str | None = None,
    dbc: Path | None = None,
) -> Conversion:
    """Write the log `source` to `sink`. Raises ConfigError; then `sink` is as it was."""
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
    log = READERS[read_as](source)
    if not log.frames:
        counted = "; ".join(f"{count} times {reason}" for reason, count in log.left_out.items())
        raise ConfigError(
            f"{source}: no frame in it, read as {read_as}" + (f" ({counted})" if counted else "")
        )
    if codec is not None:
        kept = write_whole(sink, lambda path: write_csv(log, codec, path))
    else:
        kept = without(log, *TRC_LACKS) if write_as == "trc" else log
        write_whole(sink, lambda path: WRITERS[write_as](kept, path))
    return Conversion(read_as, write_as, len(kept.frames), kept.left_out)


if __name__ == "__main__":
    serve(_read_mf4_here)
