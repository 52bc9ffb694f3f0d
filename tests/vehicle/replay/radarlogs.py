"""Made-up drives, as radars of other makes would have recorded them: an ego at steady speed, and traffic.

Positions are exact and noise-free; what the radar makes of them is up to its signals' resolution.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from math import atan2, cos, degrees, hypot
from pathlib import Path

import msgspec

from aftbed.vehicle.can.candump import log_line
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.map_file import find_dbc

EGO_MS = 14.0  # about 50 km/h
ESR_EGO_ID = 0x4F0
FRAME_US = 250  # on a bus with 500 kbit/s


class Car(msgspec.Struct, frozen=True):
    """Another road user: where it is at the start, and how fast it is over ground (less than 0: oncoming)."""

    ahead_m: float
    speed_ms: float
    beside_m: float = 0.0

    def ahead_at_m(self, t_s: float) -> float:
        return self.ahead_m + (self.speed_ms - EGO_MS) * t_s


STANDING = Car(60.0, 0.0)
FAR = (
    Car(55.0, EGO_MS),  # follows the same road at the same speed
    Car(140.0, EGO_MS + 3.0),
    *(Car(30.0 + 25.0 * n, 0.0, -4.0) for n in range(6)),  # parked along the road
    *(Car(90.0 + 40.0 * n, -EGO_MS, 3.5) for n in range(8)),  # oncoming, in their own lane
)

Cycle = Callable[[int, int, tuple[Car, ...]], Iterator[tuple[int, bytes]]]


def visible(cars: tuple[Car, ...], t_s: float) -> list[tuple[int, Car, float]]:
    """The cars that are ahead and within reach, each with its number and how far ahead it is."""
    places = [(number, car, car.ahead_at_m(t_s)) for number, car in enumerate(cars)]
    return [place for place in places if 1.0 < place[2] < 170.0]


@cache
def codec(radar: str) -> Codec:
    return load_dbc(find_dbc(radar))


def ars408(number: int, t_us: int, cars: tuple[Car, ...]) -> Iterator[tuple[int, bytes]]:
    """One cycle: the ego speed, the announcement, the objects."""
    dbc, seen = codec("ars408-like"), visible(cars, t_us / 1e6)
    ego = {"RadarDevice_SpeedDirection": 1, "RadarDevice_Speed": EGO_MS}
    yield 0x300, dbc.encode("SpeedInformation", ego)
    status = {"Obj_NofObjects": len(seen), "Obj_MeasCounter": number % 65536, "Obj_InterfaceVersion": 1}
    yield 0x60A, dbc.encode("Obj_0_Status", status)
    for index, car, ahead_m in seen:
        yield (
            0x60B,
            dbc.encode(
                "Obj_1_General",
                {
                    "Obj_ID": 20 + index,
                    "Obj_DistLong": round(ahead_m, 1),
                    "Obj_DistLat": car.beside_m,
                    "Obj_VrelLong": round(4 * (car.speed_ms - EGO_MS)) / 4,
                    "Obj_VrelLat": 0,
                    "Obj_DynProp": 1,
                    "Obj_RCS": 10,
                },
            ),
        )


def esr(number: int, t_us: int, cars: tuple[Car, ...]) -> Iterator[tuple[int, bytes]]:
    """One cycle: the ego speed, and all 64 tracks, most of them empty."""
    dbc = codec("esr-like")
    yield ESR_EGO_ID, (round(EGO_MS / 0.0625) << 5).to_bytes(2, "big") + bytes(6)
    names = {
        "status": "CAN_TX_TRACK_STATUS",
        "angle": "CAN_TX_TRACK_ANGLE",
        "range": "CAN_TX_TRACK_RANGE",
        "rate": "CAN_TX_TRACK_RANGE_RATE",
    }
    rest = {"CAN_TX_TRACK_WIDTH": 1.5, "CAN_TX_TRACK_ROLLING_COUNT": number % 2}
    seen = {64 - 4 * index: (car, ahead) for index, car, ahead in visible(cars, t_us / 1e6)}
    for track in range(1, 65):
        values = dict.fromkeys(names.values(), 0.0)
        if track in seen:
            car, ahead_m = seen[track]
            angle = atan2(car.beside_m, ahead_m)
            if abs(degrees(angle)) < 45.0:
                values = {
                    names["status"]: 1 if number == 0 else 3,
                    names["angle"]: degrees(angle),
                    names["range"]: hypot(ahead_m, car.beside_m),
                    names["rate"]: (car.speed_ms - EGO_MS) * cos(angle),
                }
        yield 0x4FF + track, dbc.encode(f"ESR_Track{track:02}", values | rest)


RADARS: dict[str, tuple[Cycle, int]] = {"ars408-like": (ars408, 75_000), "esr-like": (esr, 50_000)}


@cache
def drive(radar: str, cars: tuple[Car, ...], seconds: float) -> tuple[Frame, ...]:
    """The frames of a drive, one after the other within each cycle."""
    cycle, cycle_us = RADARS[radar]
    frames = []
    for number in range(round(seconds * 1e6 / cycle_us)):
        start_us = number * cycle_us
        for index, (can_id, data) in enumerate(cycle(number, start_us, cars)):
            frames.append(Frame(start_us + index * FRAME_US, can_id, data))
    return tuple(frames)


def write(path: Path, frames: Sequence[Frame]) -> Path:
    """As `candump -l` would have."""
    path.write_text("".join(log_line(frame, "can0") for frame in frames))
    return path
