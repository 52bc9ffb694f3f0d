"""The car and the car ahead: longitudinal truth, in fixed steps of 1 ms.

The ego's brakes do nothing for a dead time, then approach what is asked of them as a first-order lag,
and no tyre gives more than friction times gravity. The driver holds the speed until braking is asked
for, then takes the foot off for good: drag and rolling resistance act from there on. The car ahead
stands, drives on at constant speed, or brakes with a linear ramp.

Contact is interpolated inside the step in which the gap closes, so the impact speed does not depend on
the step. After contact the drive is over and nothing moves any more. Only + - * / on doubles: the same
drive on every machine, bit for bit.

Limits: one dimension, one target, no road gradient, no load transfer, no ABS dynamics.
"""

from collections import deque
from typing import Final

import msgspec

from aftbed.vehicle.report import VehicleResult

STEP_US: Final = 1000
_STEP_S: Final = 0.001
GRAVITY_MS2: Final = 9.81
KMH_PER_MS: Final = 3.6
DEAD_TIME_STEPS: Final = 100  # 0.1 s: hydraulics build no pressure yet
LAG_S: Final = 0.1
ROLLING_MS2: Final = 0.12  # rolling resistance of a passenger car, 0.012 g
DRAG_PER_M: Final = 0.000_27  # 0.5 rho cd A / m, for 0.66 m2 and 1500 kg


class LeadBraking(msgspec.Struct, frozen=True):
    """The car ahead brakes from `after_ms` on, reaching `deceleration_ms2` after `ramp_ms`."""

    after_ms: int
    deceleration_ms2: float
    ramp_ms: int = 0


class Lead(msgspec.Struct, frozen=True):
    """The car ahead at the start of the drive."""

    gap_m: float
    speed_ms: float = 0.0
    braking: LeadBraking | None = None


class PlantSetup(msgspec.Struct, frozen=True):
    """The start of a drive. `lead` None is an empty road; `jerk_max_ms3` None is no limit."""

    speed_ms: float
    lead: Lead | None = None
    friction: float = 0.9
    jerk_max_ms3: float | None = None


class Plant:
    """The state of both cars at `t_us`, microseconds of bus time since the start."""

    def __init__(self, setup: PlantSetup) -> None:
        lead = setup.lead
        self.setup = setup
        self.t_us = 0
        self.speed_ms = setup.speed_ms
        self.acceleration_ms2 = 0.0
        self.lead_speed_ms = lead.speed_ms if lead else 0.0
        self.gap_m = lead.gap_m if lead else None
        self.collided = False
        self._brake_ms2 = 0.0
        self._pipe = deque([0.0] * DEAD_TIME_STEPS, maxlen=DEAD_TIME_STEPS)
        self._braked = False
        self._impact_speed_ms: float | None = None
        self._min_gap_m = self.gap_m
        self._stop_gap_m: float | None = None
        self._max_deceleration_ms2 = 0.0

    def step(self, demand_ms2: float) -> None:
        """Advance by 1 ms with `demand_ms2` asked of the brakes: m/s2, 0 or more."""
        assert demand_ms2 >= 0.0
        self.t_us += STEP_US
        if self.collided:
            return
        self._braked = self._braked or demand_ms2 > 0.0
        closing_before_ms = self.speed_ms - self.lead_speed_ms
        ego_m = self._move_ego(demand_ms2)
        if self.gap_m is not None:
            self._move_gap(self.gap_m, self._move_lead() - ego_m, closing_before_ms)
        if self.speed_ms == 0.0 and self._stop_gap_m is None and not self.collided:
            self._stop_gap_m = self.gap_m

    def stopped(self) -> bool:
        """True when the ego stands still, or the drive has ended in a collision."""
        return self.collided or self.speed_ms == 0.0

    def ttc_s(self) -> float | None:
        """Seconds to contact at the present speeds; None if the gap is not closing."""
        closing_ms = self.speed_ms - self.lead_speed_ms
        if self.gap_m is None or closing_ms <= 0.0:
            return None
        return self.gap_m / closing_ms

    def result(self) -> VehicleResult:
        """What this drive came to, so far."""
        impact_ms = self._impact_speed_ms
        return VehicleResult(
            collision=self.collided,
            impact_speed_kmh=None if impact_ms is None else impact_ms * KMH_PER_MS,
            min_gap_m=self._min_gap_m,
            stop_gap_m=self._stop_gap_m,
            max_deceleration_ms2=self._max_deceleration_ms2,
            braked=self._braked,
        )

    def _move_ego(self, demand_ms2: float) -> float:
        """Metres that the ego moves in this step."""
        self._move_brake(demand_ms2)
        resistance_ms2 = ROLLING_MS2 + DRAG_PER_M * self.speed_ms * self.speed_ms if self._braked else 0.0
        deceleration_ms2 = self._brake_ms2 + resistance_ms2
        before_ms = self.speed_ms
        self.speed_ms = max(0.0, before_ms - deceleration_ms2 * _STEP_S)
        self.acceleration_ms2 = (self.speed_ms - before_ms) / _STEP_S
        self._max_deceleration_ms2 = max(self._max_deceleration_ms2, -self.acceleration_ms2)
        return (before_ms + self.speed_ms) / 2.0 * _STEP_S

    def _move_brake(self, demand_ms2: float) -> None:
        """Dead time, lag, jerk limit, and what the tyres can give."""
        asked_ms2 = min(self._pipe[0], self.setup.friction * GRAVITY_MS2)
        self._pipe.append(demand_ms2)  # the oldest one leaves by itself
        change_ms2 = (asked_ms2 - self._brake_ms2) * (_STEP_S / LAG_S)
        if self.setup.jerk_max_ms3 is not None:
            limit_ms2 = self.setup.jerk_max_ms3 * _STEP_S
            change_ms2 = max(-limit_ms2, min(limit_ms2, change_ms2))
        self._brake_ms2 += change_ms2

    def _move_lead(self) -> float:
        """Metres that the car ahead moves in this step."""
        before_ms = self.lead_speed_ms
        self.lead_speed_ms = max(0.0, before_ms - self._lead_deceleration_ms2() * _STEP_S)
        return (before_ms + self.lead_speed_ms) / 2.0 * _STEP_S

    def _lead_deceleration_ms2(self) -> float:
        braking = self.setup.lead.braking if self.setup.lead else None
        if braking is None:
            return 0.0
        since_ms = self.t_us / 1000 - braking.after_ms
        if since_ms <= 0.0:
            return 0.0
        if since_ms >= braking.ramp_ms:
            return braking.deceleration_ms2
        return braking.deceleration_ms2 * since_ms / braking.ramp_ms

    def _move_gap(self, before_m: float, change_m: float, closing_before_ms: float) -> None:
        """Change the gap; find contact inside the step."""
        after_m = before_m + change_m
        if after_m <= 0.0 < before_m:
            part = before_m / (before_m - after_m)
            closing_ms = self.speed_ms - self.lead_speed_ms
            self._impact_speed_ms = closing_before_ms + part * (closing_ms - closing_before_ms)
            self.collided, after_m = True, 0.0
            self.speed_ms = self.lead_speed_ms = self.acceleration_ms2 = 0.0
        self.gap_m = after_m
        assert self._min_gap_m is not None
        self._min_gap_m = min(self._min_gap_m, after_m)
