"""One radar slot's tracker: alpha-beta, on range and on the target's speed over ground.

Over ground, and not relative to us, because then our own braking does not look like the target's: a
standing car stays a standing car while we brake towards it. The filter also estimates the target's
acceleration, from the unpredicted part of its change of speed: a car ahead that brakes is a threat before the
gap shows it.

A measurement that no target can reach from the last one belongs to another target: the track starts anew.
Every field stays in the ranges below, so whatever the function can capture it can restore.

A request is served between context switches, with cold caches: what counts is how many objects and
functions it touches. So there are tracks only where there are targets, limits are comparisons and not
calls of `min` and `max`, and `Track` is a plain class with slots (a msgspec struct takes a slower way to
each assignment).
"""

from dataclasses import dataclass
from typing import Final

from aftbed.vehicle.aeb.messages import RANGE_MAX_M, SPEED_MAX_MS, AebTarget

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


@dataclass(slots=True)
class Track:
    """The target in one slot. There is none without a hit: a free slot has no track."""

    hits: int
    misses: int
    range_m: float
    speed_ms: float  # over ground
    acceleration_ms2: float = 0.0  # over ground

    def hit(self, target: AebTarget, ego_ms: float, elapsed_s: float) -> None:
        """Correct the track by a measurement `elapsed_s` after the last, or begin it anew."""
        speed_ms = ego_ms + target.rel_speed_ms
        if not target.new:
            self.predict(ego_ms, elapsed_s)
            off_m = target.range_m - self.range_m
            off_ms = speed_ms - self.speed_ms
            if -GATE_M <= off_m <= GATE_M and -GATE_MS <= off_ms <= GATE_MS:
                self._correct(off_m, off_ms)
                return
        self.hits, self.misses = 1, 0
        self.range_m, self.speed_ms, self.acceleration_ms2 = target.range_m, speed_ms, 0.0

    def miss(self, ego_ms: float, elapsed_s: float) -> bool:
        """Coast. False if the track has to be dropped."""
        self.misses += 1
        self.predict(ego_ms, elapsed_s)
        return self.misses <= MISSES_MAX

    def predict(self, ego_ms: float, elapsed_s: float) -> None:
        """Where the target is now, if nothing changed. A car that brakes does not start backwards."""
        before_ms = self.speed_ms
        range_m = self.range_m + (before_ms - ego_ms) * elapsed_s
        if not 0.0 < range_m <= RANGE_MAX_M:
            range_m = RANGE_MAX_M if range_m > 0.0 else 0.0
        self.range_m = range_m
        speed_ms = before_ms + self.acceleration_ms2 * elapsed_s
        if speed_ms < 0.0 < before_ms:
            speed_ms = self.acceleration_ms2 = 0.0
        elif not -GROUND_SPEED_MAX_MS <= speed_ms <= GROUND_SPEED_MAX_MS:
            speed_ms = GROUND_SPEED_MAX_MS if speed_ms > 0.0 else -GROUND_SPEED_MAX_MS
        self.speed_ms = speed_ms

    def _correct(self, off_m: float, off_ms: float) -> None:
        self.range_m += ALPHA * off_m
        self.speed_ms += BETA * off_ms
        speeding_ms2 = self.acceleration_ms2 + GAMMA_PER_S * off_ms
        if not -ACCELERATION_MAX_MS2 <= speeding_ms2 <= ACCELERATION_MAX_MS2:
            speeding_ms2 = ACCELERATION_MAX_MS2 if speeding_ms2 > 0.0 else -ACCELERATION_MAX_MS2
        self.acceleration_ms2 = speeding_ms2
        self.misses = 0
        if self.hits < HITS_MAX:
            self.hits += 1

    def plausible(self) -> bool:
        """True if an execution can have left the track like this. NaN fails every comparison."""
        return (
            self.hits > 0
            and self.misses <= MISSES_MAX
            and 0.0 <= self.range_m <= RANGE_MAX_M
            and -GROUND_SPEED_MAX_MS <= self.speed_ms <= GROUND_SPEED_MAX_MS
            and -ACCELERATION_MAX_MS2 <= self.acceleration_ms2 <= ACCELERATION_MAX_MS2
        )
