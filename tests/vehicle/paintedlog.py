"""A car painted into a real drive: it stands on the road, at a place that the real ego car drives over.

It goes into a track that the radar leaves empty in all of the log. Distance and relative speed follow the
speed that is in the log; counters are those of the log, checksums are made anew: to the gateway, the frames
are as good as any.
"""

from collections.abc import Iterator

import cantools
from buslog import read_log
from cantools.database import Database
from puredrive import TOYOTA_DBC, TOYOTA_LOG

from aftbed.vehicle.can.candump import LogFrame
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.mapped_gateway import toyota_checksum

WHY_NOT = f"the real drive is not here: no data/{TOYOTA_LOG.name} in the folder that AFTBED_SHARED names"

TRACK = "TRACK_A_15"
EGO_ID = 0x0B4
SEEN_US = 3_000_000  # after the log's first frame
SEEN_M = 55.0  # ahead, when it is first seen


def real_drive() -> list[LogFrame]:
    log, counts = read_log(TOYOTA_LOG)
    assert counts.frames == 6920
    return log


def ego_ms(frame: Frame) -> float:
    return int.from_bytes(frame.data[5:7], "big") * 0.01 / 3.6


def painted(log: list[LogFrame], lateral_m: float = 0.0) -> Iterator[LogFrame]:
    """The log with the car in it, from `SEEN_US` until the ego is over it."""
    database = cantools.database.load_file(TOYOTA_DBC)
    assert isinstance(database, Database)
    message = database.get_message_by_name(TRACK)
    speed_ms, range_m, last_us, new = 0.0, SEEN_M, log[0].frame.t_us + SEEN_US, True
    for entry in log:
        frame = entry.frame
        if frame.t_us > last_us:
            range_m -= speed_ms * (frame.t_us - last_us) / 1e6
            last_us = frame.t_us
        if frame.can_id == EGO_ID:
            speed_ms = ego_ms(frame)
        if frame.can_id != message.frame_id or frame.t_us < log[0].frame.t_us + SEEN_US or range_m <= 0.0:
            yield entry
            continue
        signals = message.decode(frame.data, decode_choices=False)
        assert isinstance(signals, dict)
        assert not signals["VALID"], f"{TRACK} is not free"
        assert message.encode(signals, strict=False) == frame.data, "bits that the DBC does not know"
        car = {
            "VALID": 1,
            "NEW_TRACK": int(new),
            "LONG_DIST": range_m,
            "LAT_DIST": lateral_m,
            "REL_SPEED": -speed_ms,
        }
        data = message.encode({**signals, **car}, strict=True)
        data = data[:-1] + bytes([toyota_checksum(frame.can_id, data)])
        new = False
        yield LogFrame(entry.interface, Frame(frame.t_us, frame.can_id, data))
