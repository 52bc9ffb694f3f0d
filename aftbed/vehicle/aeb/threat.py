"""How bad a track is: the deceleration that it takes, and the stage of braking that this calls for.

Two measures, because each is blind where the other sees. Time to collision (TTC) at present speeds is
what a warning goes by; it is blind to a car ahead that brakes at our own speed. The required
deceleration is the least constant one that leaves `MARGIN_M`, after the time our brakes take to bite;
at 10 km/h it stays small until the last moment, where a warning would come too late.
"""

from collections.abc import Mapping
from typing import Final

import msgspec

from aftbed.vehicle.aeb.messages import STAGE_FULL, STAGE_NONE, STAGE_PARTIAL, STAGE_WARN
from aftbed.vehicle.aeb.tracker import HITS_CONFIRMED, Track

MARGIN_M: Final = 1.5  # bumper to bumper, at standstill
REACTION_S: Final = 0.2  # dead time and lag of the brakes
LEAD_BRAKING_MS2: Final = 1.0  # a target that brakes less is taken to drive on
LEAD_BRAKING_MAX_MS2: Final = 10.0  # no car brakes harder; more is noise
ROOM_MIN_M: Final = 0.1
REQUIRED_MAX_MS2: Final = 99.0

THREAT_MS2: Final = 1.0  # a threat that takes less, and is far, ends a braking
NEAR_THREAT_M: Final = 15.0  # nearer than this, it is a threat for as long as we move towards it
WARN_TTC_S: Final = 2.7
WARN_MS2: Final = 3.0
PARTIAL_MS2: Final = 5.0
FULL_MS2: Final = 6.5
NO_TIME_MS2: Final = 8.5  # more than this cannot wait for the warning to have lasted


class Threat(msgspec.Struct, frozen=True, gc=False):
    """The worst of the confirmed tracks."""

    slot: int
    range_m: float
    required_ms2: float
    ttc_s: float | None  # None if the gap is not closing

    def persists(self) -> bool:
        """True if a braking that has begun must go on: it ends with our speed, or with the threat."""
        if self.required_ms2 >= THREAT_MS2:
            return True
        return self.ttc_s is not None and (self.range_m <= NEAR_THREAT_M or self.ttc_s <= WARN_TTC_S)

    def pressing(self) -> bool:
        """True if full braking cannot wait for the warning to have lasted."""
        return self.required_ms2 >= NO_TIME_MS2

    def stage(self) -> int:
        """The stage that this threat calls for by itself."""
        if self.required_ms2 >= FULL_MS2:
            return STAGE_FULL
        if self.required_ms2 >= PARTIAL_MS2:
            return STAGE_PARTIAL
        if self.required_ms2 >= WARN_MS2 or (self.ttc_s is not None and self.ttc_s <= WARN_TTC_S):
            return STAGE_WARN
        return STAGE_NONE


def worst(tracks: Mapping[int, Track], ego_ms: float) -> Threat | None:
    """The confirmed track, by slot, that takes the most braking; None if none does.

    Of equals it is the lowest slot, in whatever order they come.
    """
    worst_slot, most_ms2 = -1, 0.0
    for slot, track in tracks.items():
        if track.hits >= HITS_CONFIRMED:
            required_ms2 = required_deceleration_ms2(track, ego_ms)
            if required_ms2 > most_ms2 or (required_ms2 == most_ms2 and slot < worst_slot):
                worst_slot, most_ms2 = slot, required_ms2
    if worst_slot < 0:
        return None
    range_m, closing_ms = tracks[worst_slot].range_m, ego_ms - tracks[worst_slot].speed_ms
    return Threat(worst_slot, range_m, most_ms2, range_m / closing_ms if closing_ms > 0.0 else None)


def required_deceleration_ms2(track: Track, ego_ms: float) -> float:
    """The least constant deceleration, m/s2, that leaves `MARGIN_M`; 0 if no braking is needed."""
    speed_ms = track.speed_ms
    closing_ms = ego_ms - speed_ms
    free_m = track.range_m - MARGIN_M - (closing_ms * REACTION_S if closing_ms > 0.0 else 0.0)
    room_m = free_m if free_m > ROOM_MIN_M else ROOM_MIN_M
    if -track.acceleration_ms2 >= LEAD_BRAKING_MS2 and speed_ms > 0.0 and ego_ms > 0.0:
        required_ms2 = _behind_a_braking_car_ms2(track, ego_ms, room_m)
    elif closing_ms > 0.0:
        required_ms2 = closing_ms * closing_ms / (2.0 * room_m)
    else:
        return 0.0
    return required_ms2 if required_ms2 < REQUIRED_MAX_MS2 else REQUIRED_MAX_MS2


def _behind_a_braking_car_ms2(track: Track, ego_ms: float, room_m: float) -> float:
    """The target stops v/a seconds and v*v/2a metres from now. If we stop later than that, what counts
    is the place where it stands; if sooner, the moment at which the speeds are equal."""
    braking_ms2 = min(-track.acceleration_ms2, LEAD_BRAKING_MAX_MS2)
    total_m = room_m + track.speed_ms * track.speed_ms / (2.0 * braking_ms2)
    if 2.0 * total_m / ego_ms >= track.speed_ms / braking_ms2:
        return ego_ms * ego_ms / (2.0 * total_m)
    closing_ms = max(0.0, ego_ms - track.speed_ms)
    return braking_ms2 + closing_ms * closing_ms / (2.0 * room_m)
