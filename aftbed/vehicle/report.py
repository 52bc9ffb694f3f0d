"""What the car tells about itself: live telemetry, and the result of a whole drive.

The plant is the only source of truth here: nothing in these two structs comes off the bus, so a
frame fault cannot make a collision look like a stop. Warning and demand are what the brake ECU has
made of what it believed: the frames that it refused, and what the function only meant to ask for, are
not in them.
"""

import msgspec


class VehicleResult(msgspec.Struct, frozen=True):
    """A whole drive. `min_gap_m` and `stop_gap_m` are None without a target or without a stop.

    `warning_s` is the time from the first warning to the first braking that the function asks for, however
    little: UN R152 calls every such demand emergency braking. 0.0 if the two came together, None without
    braking. `demand_max_ms2` is the greatest deceleration that it asks for. `braked` is true also of a driver
    who has heeded the warning.
    """

    collision: bool
    impact_speed_kmh: float | None
    min_gap_m: float | None
    stop_gap_m: float | None
    max_deceleration_ms2: float
    braked: bool
    warning_s: float | None = None
    demand_max_ms2: float = 0.0


class Telemetry(msgspec.Struct, frozen=True):
    """One instant of the drive, for the live view. `stage` is the stage that the brakes follow."""

    t_ms: int
    speed_ms: float
    gap_m: float | None
    ttc_s: float | None
    stage: int
    deceleration_ms2: float
    fallback: int
    frames_accepted: int
    frames_refused: int
