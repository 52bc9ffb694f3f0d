"""Radars of other makes as their DBCs in the wild have them, and drives as they would have been recorded.

The DBCs are written here by the frames' layout: names, ids, bits, units. Where the ego's speed is in a DBC of
its own, that one has a mistake of the kind that real files have, so cantools refuses it.
"""

from collections.abc import Callable, Mapping
from functools import cache
from math import atan2, cos, degrees, hypot
from pathlib import Path
from typing import Final

import msgspec
from radarlogs import EGO_MS, FRAME_US, Car, visible

from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.mapped_gateway import toyota_checksum

TSS2 = """\
COUNTER : 7|8@0+ (1,0) [0|255] ""
LAT_DIST : 31|11@0- (0.04,0) [-50|50] "m"
LONG_DIST : 15|15@0+ (0.01,0) [0|300] "m"
NEW_TRACK : 36|1@0+ (1,0) [0|1] ""
REL_SPEED : 47|12@0- (0.025,0) [-100|100] "m/s"
VALID : 48|1@0+ (1,0) [0|1] ""
CHECKSUM : 63|8@0+ (1,0) [0|255] ""
"""
TSS2_B = """\
COUNTER : 7|8@0+ (1,0) [0|255] ""
REL_ACCEL : 15|7@0- (1,0) [-64|63] ""
SCORE : 23|8@0+ (1,0) [0|100] ""
CHECKSUM : 63|8@0+ (1,0) [0|255] ""
"""
ESR = """\
CAN_TX_TRACK_WIDTH : 37|4@0+ (0.5,0) [0|7.5] ""
CAN_TX_TRACK_STATUS : 15|3@0+ (1,0) [0|7] ""
CAN_TX_TRACK_ROLLING_COUNT : 38|1@0+ (1,0) [0|1] ""
CAN_TX_TRACK_RANGE_RATE : 53|14@0- (0.01,0) [-81.92|81.91] "m/s"
CAN_TX_TRACK_RANGE_ACCEL : 33|10@0- (0.05,0) [-25.6|25.55] "m/s^2"
CAN_TX_TRACK_RANGE : 18|11@0+ (0.1,0) [0|204.7] "m"
CAN_TX_TRACK_ONCOMING : 0|1@0+ (1,0) [0|1] ""
CAN_TX_TRACK_MED_RANGE_MODE : 55|2@0+ (1,0) [0|3] ""
CAN_TX_TRACK_LAT_RATE : 7|6@0- (0.25,0) [-8|7.75] ""
CAN_TX_TRACK_ANGLE : 12|10@0- (0.1,0) [-51.2|51.1] ""
"""
ESR_EGO = """\
BO_ 1264 Vehicle_Data: 8 Gateway
 SG_ CAN_RX_YAW_RATE : 11|12@0- (0.0625,0) [-128|127.9375] "deg/s" X
 SG_ CAN_RX_VEHICLE_SPEED_DIRECTION : 12|1@0+ (1,0) [0|1] "" X
 SG_ CAN_RX_VEHICLE_SPEED : 7|11@0+ (0.0625,0) [0|127.9375] "m/s" X
BO_ 1248 ESR_Status: 8 ESR
 SG_ CAN_TX_VEHICLE_SPEED_CALC : 50|11@0+ (0.0625,0) [0|127.9375] "m/s" X
"""
HYUNDAI = """\
UNKNOWN_1 : 7|8@0- (1,0) [-128|127] ""
AZIMUTH : 12|10@0- (0.2,0) [-102.4|102.2] ""
STATE : 15|3@0+ (1,0) [0|7] ""
LONG_DIST : 18|11@0+ (0.1,0) [0|204.7] ""
REL_ACCEL : 33|10@0- (0.02,0) [-10.24|10.22] ""
ZEROS : 37|4@0+ (1,0) [0|255] ""
COUNTER : 38|1@0+ (1,0) [0|1] ""
STATE_3 : 39|1@0+ (1,0) [0|1] ""
REL_SPEED : 53|14@0- (0.01,0) [-81.92|81.92] ""
STATE_2 : 55|2@0+ (1,0) [0|3] ""
"""
HYUNDAI_EGO = """\
BU_: X
BO_ 902 WHL_SPD11: 8 ABS
 SG_ WHL_SPD_FL : 0|14@1+ (0.03125,0) [0|511.96875] "km/h" X
 SG_ WHL_SPD_FR : 16|14@1+ (0.03125,0) [0|511.96875] "km/h" X
BO_ 1265 CLU11: 4 CLU
 SG_ CF_Clu_VanzDecimal : 0|2@1+ (0.125,0) [0|0.375] "" X
 SG_ CF_Clu_Vanz : 8|9@1+ (0.5,0) [0|255.5] "km/h or MPH" X
CM_ SG_ 902 "no name";
"""
TESLA = """\
LongDist : 0|12@1+ (0.0625,0) [0|255.9] "meters"
LongSpeed : 12|12@1+ (0.0625,-128) [-128|128] "meters/sec"
LatDist : 24|11@1+ (0.125,-128) [-128|128] "meters"
ProbExist : 35|5@1+ (3.125,0) [0|96.875] "%"
LongAccel : 40|10@1+ (0.03125,-16) [-16|16] "meters/sec/sec"
ProbObstacle : 50|5@1+ (3.125,0) [0|96.875] "%"
Valid : 55|1@1+ (1,0) [0|1] ""
ProbNonObstacle : 56|5@1+ (3.125,0) [0|96.875] "%"
Meas : 61|1@1+ (1,0) [0|1] ""
Tracked : 62|1@1+ (1,0) [0|1] ""
Index : 63|1@1+ (1,0) [0|1] ""
"""
TESLA_B = """\
LatSpeed : 0|10@1+ (0.125,-64) [-64|64] "meters/sec"
Length : 10|6@1+ (0.125,0) [0|7.875] "m"
dZ : 16|6@1+ (0.25,-5) [-5|10.75] "m"
MovingState : 22|2@1+ (1,0) [0|3] ""
Index2 : 63|1@1+ (1,0) [0|1] ""
"""
TESLA_EGO = """\
BU_: X
BO_ 341 ESP_B: 8 ESP
 SG_ ESP_BrakeTorqueTarget : 51|13@0+ (2,0) [0|16382] "Nm" X
 SG_ ESP_vehicleSpeed : 47|16@0+ (0.01,0) [0|0] "kph" X
VAL_ 568 UI_mapSpeedLimit 31 "SNA";
"""
FORD = """\
CAN_DET_CONFID_AZIMUTH_{n:02} : 33|2@0+ (1,0) [0|3] ""
CAN_DET_SUPER_RES_TARGET_{n:02} : 56|1@0+ (1,0) [0|1] ""
CAN_DET_ND_TARGET_{n:02} : 48|1@0+ (1,0) [0|1] ""
CAN_DET_HOST_VEH_CLUTTER_{n:02} : 49|1@0+ (1,0) [0|1] ""
CAN_DET_VALID_LEVEL_{n:02} : 0|1@0+ (1,0) [0|1] ""
CAN_DET_AZIMUTH_{n:02} : 47|14@0+ (0.0003834,-3.1416) [-3.1416|3.13964] "rad"
CAN_DET_RANGE_{n:02} : 31|14@0+ (0.015625,0) [0|255.984] "m"
CAN_DET_RANGE_RATE_{n:02} : 15|14@0+ (0.015625,-128) [-128|127.984] "m/s"
CAN_DET_AMPLITUDE_{n:02} : 7|7@0+ (1,-64) [-64|63] "dBsm"
CAN_SCAN_INDEX_2LSB_{n:02} : 17|2@0+ (1,0) [0|3] ""
"""
FORD_EGO = """\
BU_: X
BO_ 1045 BrakeSysFeatures: 8 ABS
 SG_ VehVActlBrk_No_Cs : 55|8@0+ (1,0) [0|255] "Unitless" X
 SG_ Veh_V_ActlBrk : 7|16@0+ (0.01,0) [0|655.34] "kph" X
BA_ "Cycle" BO_ 1045 20;
"""


def messages(layout: str, names: Mapping[int, tuple[str, int]]) -> str:
    """Messages of 8 bytes with one layout; `names` has the name of each id, and the number in its signals."""
    text = ""
    for can_id, (name, number) in names.items():
        text += f"BO_ {can_id} {name}: 8 X\n"
        text += "".join(f" SG_ {line.replace('{n:02}', f'{number:02}')} X\n" for line in layout.splitlines())
    return text


Values = Callable[[Car, float], dict[str, float]]


class Foreign(msgspec.Struct, frozen=True):
    """A radar. `values` are those of a target; `file` is its real DBC, as opendbc calls it.

    `ego` is the frame that has its speed, of a DBC of its own if there is one.
    """

    file: str
    dbc: str
    tracks: dict[int, tuple[str, int]]
    values: Values
    ego: tuple[int, bytes]
    ego_dbc: str = ""
    rest: tuple[int, ...] = ()  # of other messages, in each cycle behind the tracks
    cycle_ms: int = 50
    toyota: bool = False


def polar(ahead: str, angle: str, speed: str, per_radian: float, more: Mapping[str, float]) -> Values:
    def values(car: Car, ahead_m: float) -> dict[str, float]:
        aside = atan2(car.beside_m, ahead_m)
        return {
            ahead: hypot(ahead_m, car.beside_m),
            angle: aside * per_radian,
            speed: (car.speed_ms - EGO_MS) * cos(aside),
            **more,
        }

    return values


def cartesian(ahead: str, beside: str, speed: str, more: Mapping[str, float]) -> Values:
    return lambda car, ahead_m: {ahead: ahead_m, beside: car.beside_m, speed: car.speed_ms - EGO_MS, **more}


DEGREES: Final = degrees(1.0)
KMH: Final = EGO_MS * 3.6
_TSS2_A = {0x180 + n: (f"TRACK_A_{n}", n) for n in range(16)}
_TSS2_B = {0x190 + n: (f"TRACK_B_{n}", n) for n in range(16)}
_ESR = {0x500 + n: (f"Target{n + 1}", n + 1) for n in range(64)}
_HYUNDAI = {0x500 + n: (f"RADAR_TRACK_{0x500 + n:x}", n) for n in range(32)}
_TESLA_A = {0x310 + 3 * n: (f"RadarPoint{n}_A", n) for n in range(32)}
_TESLA_B = {0x311 + 3 * n: (f"RadarPoint{n}_B", n) for n in range(32)}
_FORD = {0x120 + n: (f"MRR_Detection_{n + 1:03}", n + 1) for n in range(64)}
FOREIGN: Final[dict[str, Foreign]] = {
    "toyota-tss2": Foreign(
        "toyota_tss2_adas.dbc",
        "BU_: X\n" + messages(TSS2, _TSS2_A) + messages(TSS2_B, _TSS2_B),
        _TSS2_A,
        cartesian("LONG_DIST", "LAT_DIST", "REL_SPEED", {"VALID": 1}),
        (0x0B4, bytes(5) + round(KMH * 100).to_bytes(2, "big") + b"\0"),
        rest=tuple(_TSS2_B),
        toyota=True,
    ),
    "esr": Foreign(
        "ESR.dbc",
        "BU_: X\n" + ESR_EGO + messages(ESR, _ESR),
        _ESR,
        polar(
            "CAN_TX_TRACK_RANGE",
            "CAN_TX_TRACK_ANGLE",
            "CAN_TX_TRACK_RANGE_RATE",
            DEGREES,
            {"CAN_TX_TRACK_STATUS": 3},
        ),
        (1264, (round(EGO_MS / 0.0625) << 5).to_bytes(2, "big") + bytes(6)),
    ),
    "hyundai": Foreign(
        "hyundai_kia_mando_front_radar_generated.dbc",
        "BU_: X\n" + messages(HYUNDAI, _HYUNDAI),
        _HYUNDAI,
        polar("LONG_DIST", "AZIMUTH", "REL_SPEED", DEGREES, {"STATE": 3}),
        (902, round(KMH / 0.03125).to_bytes(2, "little") * 2 + bytes(4)),
        HYUNDAI_EGO,
    ),
    "tesla": Foreign(
        "tesla_radar_bosch_generated.dbc",
        "BU_: X\n" + messages(TESLA, _TESLA_A) + messages(TESLA_B, _TESLA_B),
        _TESLA_A,
        cartesian("LongDist", "LatDist", "LongSpeed", {"Valid": 1, "Tracked": 1}),
        (341, bytes(5) + round(KMH * 100).to_bytes(2, "big") + b"\0"),
        TESLA_EGO,
    ),
    "ford": Foreign(
        "FORD_CADS.dbc",
        "BU_: X\n" + messages(FORD, _FORD),
        _FORD,
        polar(
            "CAN_DET_RANGE_{n}",
            "CAN_DET_AZIMUTH_{n}",
            "CAN_DET_RANGE_RATE_{n}",
            1.0,
            {"CAN_DET_VALID_LEVEL_{n}": 1},
        ),
        (1045, round(KMH * 100).to_bytes(2, "big") + bytes(6)),
        FORD_EGO,
    ),
}


def saved(radar: str, folder: Path, real: Path | None = None) -> list[Path]:
    """The DBC of the radar, or the `real` one, and the one with the ego's speed, if it is another."""
    one = FOREIGN[radar]
    path = real or folder / one.file
    if real is None:
        path.write_text(one.dbc)
    if not one.ego_dbc:
        return [path]
    (folder / "car.dbc").write_text(one.ego_dbc)
    return [path, folder / "car.dbc"]


@cache
def foreign_drive(radar: str, cars: tuple[Car, ...], seconds: float, dbc: Path) -> tuple[Frame, ...]:
    """The frames of a drive, one after the other within each cycle; `dbc` is that of the radar."""
    one, codec = FOREIGN[radar], load_dbc(dbc, strict=False)
    frames = []
    for cycle in range(round(seconds * 1000 / one.cycle_ms)):
        start_us = cycle * one.cycle_ms * 1000
        sent = [one.ego]
        ahead = [found for found in visible(cars, start_us / 1e6) if abs(found[1].beside_m) < found[2]]
        seen = {list(one.tracks)[(3 * n) % len(one.tracks)]: (car, range_m) for n, car, range_m in ahead}
        for can_id, (name, number) in one.tracks.items():
            signals = codec.signals(name)
            values = {signal.name: max(signal.offset, 0.0) for signal in signals}
            if can_id in seen:
                given = one.values(*seen[can_id])
                values |= {key.replace("{n}", f"{number:02}"): value for key, value in given.items()}
            values |= {"COUNTER": cycle % 256} if one.toyota else {}
            sent.append((can_id, codec.encode(name, values)))
        sent += [(can_id, bytes([cycle % 256]) + bytes(7)) for can_id in one.rest]
        for index, (can_id, data) in enumerate(sent):
            if one.toyota:
                data = data[:-1] + bytes([toyota_checksum(can_id, data)])  # noqa: PLW2901
            frames.append(Frame(start_us + index * FRAME_US, can_id, data))
    return tuple(frames)
