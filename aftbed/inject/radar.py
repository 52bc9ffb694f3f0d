"""Insufficiencies of the car's radar: what it reports is well-formed and wrong (ISO 21448, SOTIF).

    radar ghost range 30 speed 10    a target that is not there, at 30 m, closing at 10 m/s
    radar missed                     the target is not reported
    radar bias by -5                 the range is 5 m too short
    radar drift by 2                 the range grows by 2 m in each second since the fault began
    radar latency by 100ms           each track shows the target as it was 100 ms ago
    radar fov range 40 angle 20      no target beyond 40 m, or outside of 20 degrees, is seen (or one of both)
              ... [after 2s | when ttc|gap|speed <|> VALUE]
                  [for 500ms | intermittent p 0.1 | intermittent every N | permanent]

A fault of the bus strikes frames, and E2E protection detects most of them. These strike before the frame is
made: counter and CRC are right, and each replica is given the same wrong target.

The radar reports one target, the nearest. So a ghost hides a car behind it, and is hidden by a car ahead of
it. The noise of the radar is on top of all this, the same as without a fault.

A fault begins at once, after some bus time, or in the first step of the car in which its condition holds,
and lasts for good if nothing else is said; `for` counts from the beginning, `intermittent` counts the
radar's cycles. The vehicle process and the simulated car have one `RadarFaults` each, which the radar ECU
asks (`vehicle.ecus.RadarDisturber`): so the same seed gives the same tracks in both.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from random import Random
from typing import ClassVar, Final, Self, get_args

import msgspec

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.graph import Graph
from aftbed.core.units import duration, milliseconds, number, whole_milliseconds
from aftbed.inject.bus import Opening
from aftbed.inject.grammar import (
    FOR,
    INTERMITTENT,
    NUMBER,
    PERMANENT,
    Chance,
    Every,
    FaultWords,
    Lasting,
    Permanent,
    Trigger,
    read_persistence,
    read_trigger,
)
from aftbed.inject.kind import AnyFault, FaultKind, Injection, RunControl, Steps, receipt_of_car
from aftbed.inject.next_words import EXAMPLES, next_words
from aftbed.inject.receipts import RadarReport, Receipt, ReceiptState
from aftbed.vehicle.condition import Condition
from aftbed.vehicle.radar import RANGE_MAX_M, SPEED_MAX_MS, Target

RADAR: Final = "radar"  # the name of the faults, and their target
BIAS_MAX_M: Final = RANGE_MAX_M
DRIFT_MAX_MS: Final = SPEED_MAX_MS
LATENCY_MS_MAX: Final = 2000
ANGLE_MAX_DEG: Final = 179.0
GHOST_ID: Final = 1  # of its track: the radar's other one is `vehicle.radar.TRACK_ID`
WHEN_KEYS: Final = ("after", "when", FOR, INTERMITTENT, PERMANENT)


# -- what is wrong ----------------------------------------------------------------------------------


class Insufficiency(msgspec.Struct, frozen=True, tag=True):
    """Base of what a radar can do wrong. As text: the words behind the name.

    Each has `reported(target, open_us)`: what the radar reports in place of `target`, so long after the fault
    has begun.
    """

    NAME: ClassVar[str] = ""
    KEYS: ClassVar[tuple[str, ...]] = ()
    EXAMPLES: ClassVar[Mapping[str, Sequence[str]]] = EXAMPLES | {"by": ("-5", "2")}

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        """Raises ConfigError."""
        return cls()

    @property
    def delay_ms(self) -> int:
        """How old the target is that `reported` is given."""
        return 0

    def __str__(self) -> str:
        return ""


class Ghost(Insufficiency, frozen=True):
    """There is a target that is not there, until it has come to the car or left the radar's range."""

    range_m: float
    speed_ms: float = 0.0  # at which it closes

    NAME = "ghost"
    KEYS = ("range", "speed")

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        speed = _metres(words, "speed", -SPEED_MAX_MS, SPEED_MAX_MS, "m/s") if "speed" in words else 0.0
        return cls(_range(words), speed)

    def reported(self, target: Target | None, open_us: int) -> Target | None:
        range_m = self.range_m - self.speed_ms * open_us / 1e6
        if not 0.0 < range_m <= RANGE_MAX_M or (target is not None and target.range_m <= range_m):
            return target
        return Target(range_m, -self.speed_ms, 0.0, GHOST_ID)

    def __str__(self) -> str:
        return f"range {number(self.range_m)} speed {number(self.speed_ms)}"


class Missed(Insufficiency, frozen=True):
    """There is a target, and none is reported."""

    NAME = "missed"

    def reported(self, target: Target | None, open_us: int) -> Target | None:
        return None


class Bias(Insufficiency, frozen=True):
    """The range is wrong by so much."""

    by_m: float

    NAME = "bias"
    KEYS = ("by",)

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        return cls(_metres(words, "by", -BIAS_MAX_M, BIAS_MAX_M, "m", zero=False))

    def reported(self, target: Target | None, open_us: int) -> Target | None:
        return _farther(target, self.by_m)

    def __str__(self) -> str:
        return f"by {number(self.by_m)}"


class Drift(Insufficiency, frozen=True):
    """The range becomes wrong, at that rate. The relative speed is measured by itself, and stays right."""

    by_ms: float

    NAME = "drift"
    KEYS = ("by",)

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        return cls(_metres(words, "by", -DRIFT_MAX_MS, DRIFT_MAX_MS, "m/s", zero=False))

    def reported(self, target: Target | None, open_us: int) -> Target | None:
        return _farther(target, self.by_ms * open_us / 1e6)

    def __str__(self) -> str:
        return f"by {number(self.by_ms)}"


class Latency(Insufficiency, frozen=True):
    """Tracks come in time with what was measured before; at first, with the oldest that the radar has."""

    by_ms: int

    NAME = "latency"
    KEYS = ("by",)
    EXAMPLES = EXAMPLES

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        text = _given(words, "by")
        by_ms = whole_milliseconds("latency", text)
        if by_ms > LATENCY_MS_MAX:
            raise ConfigError(f"fault {words.text!r}: by {text}: up to {LATENCY_MS_MAX}ms is allowed")
        return cls(by_ms)

    @property
    def delay_ms(self) -> int:
        return self.by_ms

    def reported(self, target: Target | None, open_us: int) -> Target | None:
        return target

    def __str__(self) -> str:
        return f"by {duration(self.by_ms)}"


class FieldOfView(Insufficiency, frozen=True):
    """The radar sees no farther than `range_m`, and only so many degrees, half of them to each side."""

    range_m: float = RANGE_MAX_M
    angle_deg: float = ANGLE_MAX_DEG

    NAME = "fov"
    KEYS = ("range", "angle")

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        if words.first_of(cls.KEYS) is None:
            raise ConfigError(f"fault {words.text!r}: 'range' in m or 'angle' in degrees is missing")
        range_m = _range(words) if "range" in words else RANGE_MAX_M
        if "angle" not in words:
            return cls(range_m)
        return cls(range_m, _metres(words, "angle", 0.0, ANGLE_MAX_DEG, "degrees", zero=False))

    def reported(self, target: Target | None, open_us: int) -> Target | None:
        if target is None or target.range_m > self.range_m:
            return None
        half_m = math.tan(math.radians(self.angle_deg) / 2.0) * target.range_m
        return target if -half_m <= target.lateral_m <= half_m else None

    def __str__(self) -> str:
        return f"range {number(self.range_m)} angle {number(self.angle_deg)}"


RadarEffect = Ghost | Missed | Bias | Drift | Latency | FieldOfView
EFFECTS: Final[dict[str, type[RadarEffect]]] = {effect.NAME: effect for effect in get_args(RadarEffect)}
RadarPersistence = Permanent | Lasting | Chance | Every


def _farther(target: Target | None, by_m: float) -> Target | None:
    return None if target is None else target._replace(range_m=max(0.0, target.range_m + by_m))


# -- words ------------------------------------------------------------------------------------------


def _given(words: FaultWords, key: str) -> str:
    if key not in words:
        raise ConfigError(f"fault {words.text[:200]!r}: {key!r} with its value is missing")
    return words[key]


def _metres(words: FaultWords, key: str, least: float, most: float, unit: str, *, zero: bool = True) -> float:
    """The number behind `key`, in its limits. Raises ConfigError. `zero`: it may be 0."""
    text = _given(words, key)
    value = float(text) if NUMBER.fullmatch(text) else math.nan
    if not least <= value <= most or (value == 0.0 and not zero):
        limits = f"from {number(least)} to {number(most)} {unit}"
        if not zero:
            limits = f"above 0 and up to {number(most)} {unit}" if least == 0.0 else f"{limits}, but not 0,"
        raise ConfigError(f"fault {words.text[:200]!r}: {key} {text[:40]!r}: a number {limits} is allowed")
    return value


def _range(words: FaultWords) -> float:
    return _metres(words, "range", 0.0, RANGE_MAX_M, "m (the radar sees no farther)", zero=False)


class RadarFault(FaultKind, frozen=True, tag="radar"):
    """One insufficiency of the radar: what is wrong, from when on, and for how long."""

    effect: RadarEffect
    opening: Opening = Opening()
    persistence: RadarPersistence = Permanent()

    NAMES = (RADAR,)

    needs_car = True

    def __post_init__(self) -> None:
        if self.opening.nth != 1:
            raise ValueError("a fault of the radar lasts, and strikes no nth track")

    @classmethod
    def read(cls, words: Sequence[str]) -> AnyFault:
        """Raises ConfigError naming the word that is wrong."""
        effect = EFFECTS.get(words[1])
        if effect is None:
            raise unknown("insufficiency of the radar", words[1][:40], EFFECTS)
        found = FaultWords(words, (*effect.KEYS, *WHEN_KEYS))
        trigger = read_trigger(found)
        return AnyFault(
            cls(
                effect.from_words(found),
                Opening(round(trigger.after_ms * 1000), trigger.when),
                _persistence(found),
            ),
            RADAR,
        )

    @classmethod
    def next_words(cls, words: Sequence[str], graph: Graph) -> Iterable[str]:
        if len(words) == 1:
            return EFFECTS
        effect = EFFECTS.get(words[1])
        return (
            ()
            if effect is None
            else next_words(words[2:], (*effect.KEYS, *WHEN_KEYS), graph, effect.EXAMPLES)
        )

    def subject(self, target: str) -> list[str]:
        """All the rest: it has words of its own for when and how often, as a fault of the bus."""
        return [self.effect.NAME, str(self.effect), str(self.opening), str(self.persistence)]

    def validate(self, fault: AnyFault) -> None:
        if (fault.trigger, fault.target) != (Trigger(), RADAR):
            raise ValueError("a fault of the radar has its own words for when")
        super().validate(fault)

    def check(self, fault: AnyFault, graph: Graph) -> None:
        """It names nothing in the graph."""

    def act(self, injection: Injection, run: RunControl) -> Steps[None]:
        yield from run.disturb(injection)

    def receipt(self, injection: Injection, run: RunControl) -> Receipt:
        return receipt_of_car(injection, run, self.opening.when)


def _persistence(words: FaultWords) -> RadarPersistence:
    if FOR not in words:
        found = read_persistence(words)
        return found if isinstance(found, Permanent | Chance | Every) else Permanent()
    other = words.first_of((PERMANENT, INTERMITTENT))
    if other is not None:
        raise ConfigError(f"'{FOR} {words[FOR]}' and {other!r}: one of them is allowed")
    for_us = round(milliseconds("duration", words[FOR]) * 1000)
    if for_us == 0:
        raise ConfigError(f"duration {words[FOR]!r}: a microsecond is the least")
    return Lasting(for_us)


# -- in the radar -----------------------------------------------------------------------------------


class _ArmedRadarFault:
    """A fault, and what it has come to."""

    def __init__(self, number: int, fault: RadarFault, draw: int) -> None:
        self.number, self.fault = number, fault
        self._chance = Random(draw)
        self._past: deque[Target | None] = deque(maxlen=fault.effect.delay_ms + 1)  # by ms, the newest last
        self._armed_us: int | None = None
        self._began_us: int | None = None
        self._seen = 0  # cycles since it began
        self._struck = 0  # of them, those in which another target was reported
        self._first_us = 0
        self._answered = False

    def step(self, t_us: int, target: Target | None, holds: Callable[[Condition], bool]) -> None:
        self._past.append(target)
        opening = self.fault.opening
        self._armed_us = t_us if self._armed_us is None else self._armed_us
        if self._began_us is not None:
            return
        if holds(opening.when) if opening.when is not None else t_us >= self._armed_us + opening.after_us:
            self._began_us = t_us

    def reported(self, t_us: int, target: Target | None) -> Target | None:
        if self._began_us is None:
            return target
        open_us = t_us - self._began_us
        if not self._strikes(open_us):
            return target
        effect = self.fault.effect
        found = effect.reported(self._past[0] if effect.delay_ms else target, open_us)
        if found != target:
            self._first_us = self._first_us if self._struck else t_us
            self._struck += 1
        return found

    def _strikes(self, open_us: int) -> bool:
        """Whether it strikes the cycle of now."""
        match self.fault.persistence:
            case Lasting(for_us):
                strikes = open_us < for_us
                self._seen += strikes
                return strikes
            case Every(count):
                self._seen += 1
                return (self._seen - 1) % count == 0
            case Chance(p):
                self._seen += 1
                return self._chance.random() < p
            case Permanent():
                self._seen += 1
                return True

    def answered(self) -> None:
        self._answered = self._answered or self._struck > 0

    def report(self) -> RadarReport:
        return RadarReport(
            self.number, self._receipt(), waits=self._began_us is None and self.fault.opening.when is not None
        )

    def _receipt(self) -> Receipt:
        if not self._seen:
            return Receipt()
        if not self._struck:
            detail = f"it changed none of {_tracks(self._seen)}"
            return Receipt(ReceiptState.NOT_ACTIVATED, detail)
        first = f"{'the first ' if self._struck > 1 else ''}at {self._first_us / 1e6:.6f} s"
        detail = f"{_tracks(self._struck)}, {first}; {'answered' if self._answered else 'not answered'}"
        return Receipt(ReceiptState.ACTIVATED if self._answered else ReceiptState.APPLIED, detail)


def _tracks(count: int) -> str:
    return f"{count} track{'s' if count > 1 else ''}"


class RadarFaults:
    """All faults of one radar: its `vehicle.radar.RadarDisturber`. In the order of arming, each is given what
    the one before reports.
    """

    def __init__(self) -> None:
        self._armed: list[_ArmedRadarFault] = []

    def arm(self, number: int, fault: RadarFault, draw: int) -> None:
        """From the next step of the car on; `draw` seeds its chance."""
        self._armed.append(_ArmedRadarFault(number, fault, draw))

    def reports(self) -> list[RadarReport]:
        return [armed.report() for armed in self._armed]

    # -- for the radar ECU

    def step(self, t_us: int, target: Target | None, holds: Callable[[Condition], bool]) -> None:
        for armed in self._armed:
            armed.step(t_us, target, holds)

    def reported(self, t_us: int, target: Target | None) -> Target | None:
        for armed in self._armed:
            target = armed.reported(t_us, target)
        return target

    def answered(self) -> None:
        for armed in self._armed:
            armed.answered()
