"""MF4 (ASAM MDF 4, bus logging): read by python-can, written through asammdf, whose table types python-can
has.

python-can's own writer dates every file with the moment of its writing and lets older frames lie before
that, which other tools show as negative times. Here the date of the log is written, and each kind of frame
in one go.

MDF wants the times of a table to grow, so frames are sorted by time; frames of one instant that are of
different kinds come back in the order data, error, remote. Its times are seconds in floating point.
Channels are numbered from 0, as by python-can. The extra `mf4` brings asammdf.
"""

import fcntl
import io
import os
import sys
from datetime import UTC, datetime
from importlib.util import find_spec
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Final

from aftbed.core.errors import ConfigError
from aftbed.vehicle.can.python_can import with_asammdf
from aftbed.vehicle.logs.frames import Kind, Log, LoggedFrame, content, numbers, origin_us
from aftbed.vehicle.logs.messages import taken

NAMES: Final = {Kind.DATA: "CAN_DataFrame", Kind.ERROR: "CAN_ErrorFrame", Kind.REMOTE: "CAN_RemoteFrame"}
MAGIC: Final = b"MDF     "
UNFINISHED: Final = b"UnFinMF "
READ_SECONDS_MAX: Final = 600.0  # 300 000 frames take 6 s
UNREADABLE: Final = "{path}: not an MF4 that can be read: torn or malformed: {why}"


def read(path: Path) -> Log:
    """The log at `path`. Raises ConfigError naming the file.

    A process of its own reads it: there is native code in asammdf that follows a malformed file to wherever
    that points, and dies of it.
    """
    if not content(path).startswith((MAGIC, UNFINISHED)):
        raise ConfigError(f"{path}: not an MF4: it does not begin with MDF")
    _needed()
    context = get_context("spawn")
    ours, its = context.Pipe(duplex=False)
    reader = context.Process(target=_answer, args=(path, its))
    reader.start()
    its.close()
    try:
        found: Log | str = UNREADABLE.format(path=path, why=f"it takes more than {READ_SECONDS_MAX:g} s")
        if ours.poll(READ_SECONDS_MAX):
            found = ours.recv()
    except EOFError:
        reader.join()
        found = UNREADABLE.format(path=path, why=f"its reader ended with {reader.exitcode}")
    finally:
        reader.kill()  # it has nothing more to say
        reader.join()
        ours.close()
    if isinstance(found, str):
        raise ConfigError(found)
    return found


def _answer(path: Path, its: Connection) -> None:
    """The reader: the log, or why there is none. Its standard error would be asammdf's."""
    _die_with_parent()
    with Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), sys.stderr.fileno())
    try:
        its.send(_read(path))
    except ConfigError as error:
        its.send(str(error))
    except Exception as error:  # noqa: BLE001 - asammdf's, python-can's, those of four decompressors
        why = str(error) if str(error) and "BytesIO" not in str(error) else type(error).__name__
        its.send(UNREADABLE.format(path=path, why=why))


def _die_with_parent() -> None:
    """Whatever native code is at: the parent holds the other end of a pipe, and SIGIO kills (fcntl(2))."""
    parent = parent_process()
    assert parent is not None and isinstance(parent.sentinel, int)
    fcntl.fcntl(parent.sentinel, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(parent.sentinel, fcntl.F_SETFL, os.O_ASYNC)
    if wait([parent.sentinel], 0.0):  # it was gone before
        os._exit(1)


def _read(path: Path) -> Log:
    with_asammdf()
    from can.io.mf4 import MF4Reader  # noqa: PLC0415 - slow to import

    return taken(path, MF4Reader(io.BytesIO(content(path))), lambda: "in its tables of frames")


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
    if find_spec("asammdf") is None:
        raise ConfigError('MF4 needs asammdf: pip install "aftbed[mf4]"')
