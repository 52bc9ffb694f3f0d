"""BLF (Vector): a header, then containers of compressed objects; frames are some of the objects.

python-can reads and writes the format; how it is laid out is known from there and from Vector_BLF, there is
no public specification. Two things are not left to it. It decompresses what there is of a container that
was cut off, and goes round for ever on an object of no length: so the whole file is walked before, and the
place of what is torn or malformed is named. And it dates a log without a date by its first frame, which
would begin at 0 then: so its start is given to it.

Times are in nanoseconds from a start in UTC, as python-can has it; Vector's tools take the start for local
time.
"""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from aftbed.core.errors import ConfigError, PeerError
from aftbed.vehicle.can.candump import LOG_BYTES_MAX
from aftbed.vehicle.can.python_can import lean
from aftbed.vehicle.logs.frames import Log, content, numbers, origin_us
from aftbed.vehicle.logs.messages import Memory, message_of, taken

SIGNATURE: Final = b"LOGG"
OBJECT: Final = b"LOBJ"
HEADER_BYTES_MIN: Final = 72
UNPACKED_BYTES_MAX: Final = 8 * LOG_BYTES_MAX
CONTAINER: Final = 10  # the type of an object
PLAIN, DEFLATED = 0, 2  # how the content of a container is packed
_HEAD: Final = struct.Struct("<4sHHLL")  # signature, header size, header version, size, type
_PACKED: Final = struct.Struct("<H6xL4x")  # method, size unpacked
_FILE: Final = struct.Struct("<4sL8xQ")  # signature, header size, file size


def read(path: Path) -> Log:
    """The log at `path`. Raises ConfigError naming the file and the byte at which it is wrong."""
    try:
        objects = _check(content(path))
    except PeerError as error:
        raise ConfigError(f"{path}: {error}") from None
    lean()
    from can import BLFReader  # noqa: PLC0415 - slow to import

    with BLFReader(path) as reader:
        return taken(path, reader, lambda: f"among its {objects} objects", channel_offset=0)


def write(log: Log, path: Path) -> None:
    """All frames."""
    lean()
    from can import BLFWriter  # noqa: PLC0415

    channels = numbers(log.frames)
    memory = Memory()
    with BLFWriter(memory) as writer:
        writer.start_timestamp = origin_us(log.frames) / 1e6
        for frame in log.frames:
            writer.on_message_received(message_of(frame, channels[frame.interface]))
    path.write_bytes(memory.written)


def _check(data: bytes) -> int:
    """How many objects there are. Raises PeerError unless all of them are whole."""
    if len(data) < HEADER_BYTES_MIN or not data.startswith(SIGNATURE):
        raise PeerError("not a BLF: it does not begin with a header and its LOGG")
    _, header_bytes, file_bytes = _FILE.unpack_from(data)
    if not HEADER_BYTES_MIN <= header_bytes <= len(data):
        raise PeerError(f"a BLF with a header of {header_bytes} bytes: torn or malformed")
    if file_bytes > len(data):
        raise PeerError(f"torn: {len(data)} bytes of the {file_bytes} that its header tells of")
    unpacked = bytearray()
    for at, size, kind in _objects(data, header_bytes, "byte"):
        if kind == CONTAINER:
            unpacked += _unpack(data[at + _HEAD.size : at + size], at)
        if len(unpacked) > UNPACKED_BYTES_MAX:
            raise PeerError(f"byte {at}: more than {UNPACKED_BYTES_MAX} bytes unpacked")
    return sum(1 for _ in _objects(bytes(unpacked), 0, "unpacked byte"))


def _objects(data: bytes, start: int, word: str) -> Iterator[tuple[int, int, int]]:
    """Place, size and type of each object. What is between two is padding, up to three bytes of it."""
    end = start
    while end < len(data):
        at = data.find(OBJECT, end, end + 3 + len(OBJECT))
        if at < 0:
            if len(data) - end <= 3:
                return
            raise PeerError(f"{word} {end}: no object begins here: torn or malformed")
        if at + _HEAD.size > len(data):
            raise PeerError(f"{word} {at}: torn in the head of an object")
        _, head_bytes, _, size, kind = _HEAD.unpack_from(data, at)
        if not _HEAD.size <= head_bytes <= size:
            raise PeerError(f"{word} {at}: an object of {size} bytes with a head of {head_bytes}")
        end = at + size
        if end > len(data):
            raise PeerError(f"{word} {at}: torn: {len(data) - at} of the {size} bytes of an object")
        yield at, size, kind


def _unpack(body: bytes, at: int) -> bytes:
    if len(body) < _PACKED.size:
        raise PeerError(f"byte {at}: a container of {len(body)} bytes")
    method, size = _PACKED.unpack_from(body)
    packed = body[_PACKED.size :]
    if method == PLAIN:
        return packed
    if method != DEFLATED:
        raise PeerError(f"byte {at}: a container packed in an unknown way ({method})")
    if size > UNPACKED_BYTES_MAX:
        raise PeerError(f"byte {at}: a container of {size} bytes unpacked")
    unpacker = zlib.decompressobj()
    try:
        found = unpacker.decompress(packed, size + 1)
    except zlib.error as error:
        raise PeerError(f"byte {at}: a container that cannot be unpacked: {error}") from None
    if len(found) != size or not unpacker.eof:
        raise PeerError(f"byte {at}: a container of {len(found)} bytes unpacked, {size} are announced")
    return found
