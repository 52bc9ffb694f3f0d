"""MF4 (ASAM MDF 4, bus logging): read by python-can, written through asammdf, whose table types python-can
has.

python-can's own writer dates every file with the moment of its writing and lets older frames lie before
that, which other tools show as negative times. Here the date of the log is written, and each kind of frame
in one go.

MDF wants the times of a table to grow, so frames are sorted by time; frames of one instant that are of
different kinds come back in the order data, error, remote. Its times are seconds in floating point.
Channels are numbered from 0, as by python-can. The extra `mf4` brings asammdf.
"""

import gc
import io
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from aftbed.core.errors import ConfigError
from aftbed.vehicle.logs.frames import Kind, Log, LoggedFrame, content, numbers, origin_us
from aftbed.vehicle.logs.messages import READ_ERRORS, taken
from aftbed.vehicle.pythoncan import with_asammdf

NAMES: Final = {Kind.DATA: "CAN_DataFrame", Kind.ERROR: "CAN_ErrorFrame", Kind.REMOTE: "CAN_RemoteFrame"}
MAGIC: Final = b"MDF     "
UNFINISHED: Final = b"UnFinMF "


def read(path: Path) -> Log:
    """The log at `path`. Raises ConfigError naming the file."""
    data = content(path)
    if not data.startswith((MAGIC, UNFINISHED)):
        raise ConfigError(f"{path}: not an MF4: it does not begin with MDF")
    _needed()
    from asammdf.blocks.utils import MdfException  # noqa: PLC0415 - slow to import

    failed = ""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        try:
            return _read(path, data)
        except (*READ_ERRORS, MdfException, OSError, MemoryError) as error:
            failed = str(error) if str(error) and "BytesIO" not in str(error) else type(error).__name__
        gc.collect()  # what asammdf has half made is not fit to be closed, and would complain at any time
    finally:
        sys.unraisablehook = hook
    raise ConfigError(f"{path}: not an MF4 that can be read: torn or malformed: {failed}")


def _read(path: Path, data: bytes) -> Log:
    with_asammdf()
    from can.io.mf4 import MF4Reader  # noqa: PLC0415 - slow to import

    reader = MF4Reader(io.BytesIO(data))
    try:
        return taken(path, reader, lambda: "in its tables of frames")
    finally:
        reader.stop()


def write(log: Log, path: Path) -> None:
    """All frames."""
    _needed()
    with_asammdf()
    import numpy  # noqa: PLC0415 - slow to import, all of them
    from asammdf import MDF, Signal  # noqa: PLC0415
    from asammdf.blocks.v4_blocks import SourceInformation  # noqa: PLC0415
    from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS  # noqa: PLC0415
    from can.io.mf4 import ERR_DTYPE, RTR_DTYPE, STD_DTYPE  # noqa: PLC0415

    types = {Kind.DATA: STD_DTYPE, Kind.ERROR: ERR_DTYPE, Kind.REMOTE: RTR_DTYPE}
    channels = numbers(log.frames)
    start_us = origin_us(log.frames)
    frames = sorted(log.frames, key=lambda frame: frame.t_us)
    with MDF(version="4.10") as mdf:
        mdf.header.start_time = datetime.fromtimestamp(start_us // 1_000_000, UTC)
        for kind, name in NAMES.items():
            table = [frame for frame in frames if frame.kind is kind]
            samples = numpy.zeros(len(table), dtype=types[kind])
            for at, frame in enumerate(table):
                for field, value in _fields(frame, channels[frame.interface]).items():
                    samples[f"{name}.{field}"][at] = value
                if kind is not Kind.REMOTE:
                    samples[f"{name}.DataBytes"][at, : len(frame.data)] = list(frame.data)
            times_s = numpy.array([(frame.t_us - start_us) / 1e6 for frame in table], dtype="<f8")
            source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
            mdf.append(Signal(name=name, samples=samples, timestamps=times_s, source=source))
        with path.open("wb") as file:
            mdf.save(file, compression=2)


def _fields(frame: LoggedFrame, channel: int) -> dict[str, int]:
    length = frame.length if frame.kind is Kind.REMOTE else len(frame.data)
    return {
        "BusChannel": channel,
        "ID": frame.can_id,
        "IDE": int(frame.extended),
        "DLC": length,
        "DataLength": 0 if frame.kind is Kind.REMOTE else length,
        "Dir": int(frame.sent),
    }


def _needed() -> None:
    try:
        import asammdf  # noqa: F401, PLC0415 - an extra, and slow to import
    except ImportError:
        raise ConfigError('MF4 needs asammdf: pip install "aftbed[mf4]"') from None
