"""One radar slot's tracker: alpha-beta, on range and on the target's speed over ground.

Over ground, and not relative to us, because then our own braking does not look like the target's: a
standing car stays a standing car while we brake towards it. The filter also estimates the target's
acceleration, out of what its speed does unpredicted: a car ahead that brakes is a threat before the gap
says so.

A measurement that no target can reach from the last one belongs to another target: the track starts anew.
Every field stays in the ranges below, so whatever the function can capture it can restore.
"""

from typing import Final

import msgspec

from aftbed.vehicle.aebmessages import RANGE_MAX_M, SPEED_MAX_MS, AebTarget

HITS_CONFIRMED: Final = 3
HITS_MAX: Final = 255
MISSES_MAX: Final = 5

# Gains per cycle of 20 to 50 ms, chosen by the closed loops and the real drive in the tests.
ALPHA: Final = 0.5  # of range
BETA: Final = 0.3  # of speed over ground
GAMMA_PER_S: Final = 1.5  # of acceleration over ground
GATE_M: Final = 5.0
GATE_MS: Final = 5.0

GROUND_SPEED_MAX_MS: Final = 2 * SPEED_MAX_MS
ACCELERATION_MAX_MS2: Final = 50.0


class Track(msgspec.Struct, gc=False):
    """One slot. `hits` 0 means that the slot is free, and then all else is 0 too."""

    hits: int = 0
    misses: int = 0
    range_m: float = 0.0
    speed_ms: float = 0.0  # over ground
    acceleration_ms2: float = 0.0  # over ground

    def confirmed(self) -> bool:
        """True if the track may be acted on."""
        return self.hits >= HITS_CONFIRMED

    def hit(self, target: AebTarget, ego_ms: float, elapsed_s: float) -> None:
        """Correct the track by a measurement `elapsed_s` after the last, or begin it anew."""
        speed_ms = ego_ms + target.rel_speed_ms
        if self.hits and not target.new:
            self.predict(ego_ms, elapsed_s)
            off_m = target.range_m - self.range_m
            off_ms = speed_ms - self.speed_ms
            if -GATE_M <= off_m <= GATE_M and -GATE_MS <= off_ms <= GATE_MS:
                self._correct(off_m, off_ms)
                return
        self.hits, self.misses = 1, 0
        self.range_m, self.speed_ms, self.acceleration_ms2 = target.range_m, speed_ms, 0.0

    def miss(self, ego_ms: float, elapsed_s: float) -> None:
        """Coast, or drop the track."""
        self.misses += 1
        if self.misses > MISSES_MAX:
            self.hits = self.misses = 0
            self.range_m = self.speed_ms = self.acceleration_ms2 = 0.0
        else:
            self.predict(ego_ms, elapsed_s)

    def predict(self, ego_ms: float, elapsed_s: float) -> None:
        """Where the target is now, if nothing changed. A car that brakes does not start backwards."""
        self.range_m = max(0.0, min(RANGE_MAX_M, self.range_m + (self.speed_ms - ego_ms) * elapsed_s))
        ahead_ms = self.speed_ms + self.acceleration_ms2 * elapsed_s
        if ahead_ms < 0.0 < self.speed_ms:
            ahead_ms = self.acceleration_ms2 = 0.0
        self.speed_ms = max(-GROUND_SPEED_MAX_MS, min(GROUND_SPEED_MAX_MS, ahead_ms))

    def _correct(self, off_m: float, off_ms: float) -> None:
        self.range_m += ALPHA * off_m
        self.speed_ms += BETA * off_ms
        change_ms2 = GAMMA_PER_S * off_ms
        self.acceleration_ms2 = max(
            -ACCELERATION_MAX_MS2, min(ACCELERATION_MAX_MS2, self.acceleration_ms2 + change_ms2)
        )
        self.hits = min(self.hits + 1, HITS_MAX)
        self.misses = 0

    def plausible(self) -> bool:
        """True if an execution can have left the track like this. NaN fails every comparison."""
        if self.hits == 0:
            return self == Track()
        return (
            self.misses <= MISSES_MAX
            and 0.0 <= self.range_m <= RANGE_MAX_M
            and -GROUND_SPEED_MAX_MS <= self.speed_ms <= GROUND_SPEED_MAX_MS
            and -ACCELERATION_MAX_MS2 <= self.acceleration_ms2 <= ACCELERATION_MAX_MS2
        )
