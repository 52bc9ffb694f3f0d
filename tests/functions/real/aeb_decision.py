"""The decision chain of mono-aeb (package mono-aeb) as a protected function: ranges in, risk level out.

The chain begins behind camera, detector and tracker: a request has what those found in a frame.

    u32 frame; f64 speed of the own car, m/s; u8 number of objects; for each of them
    u16 track; f64 distance, m; f64 height of its box, pixels

The reply is of the object of highest risk: u8 level (0 to 3: brake), f64 time to collision, s (inf: none),
f64 deceleration that is required, m/s^2. The state is that of three objects of the package: the history of
each track, the time to collision that is held over a gap, and the level, which has a hysteresis.
"""

import struct
import warnings
from collections import deque
from collections.abc import Iterator
from math import inf, isfinite
from random import Random
from typing import Final

from aeb.config import AEBConfig
from aeb.decision import RiskStateMachine
from aeb.ttc import DistanceTTC, ScaleTTC, TrackHistory, TTCFusion
from aeb.types import RiskFeature, RiskLevel

from aftbed.core.application import Characteristics, Field
from aftbed.core.errors import PeerError

HEAD: Final = struct.Struct("<IdB")
OBJECT: Final = struct.Struct("<Hdd")
REPLY: Final = struct.Struct("<Bdd")
COUNTS: Final = struct.Struct("<dIII")
SEEN: Final = struct.Struct("<Idd")  # frame, distance, height
HELD: Final = struct.Struct("<HId")
LEVEL: Final = struct.Struct("<HB")
MARGIN: Final = 2.0  # the chain takes the median of ten frames for the distance
SPARE_M: Final = 5.0


class AebDecision:
    """The chain of `aeb.pipeline.AEBPipeline.process` from the history on."""

    characteristics = Characteristics()
    reply_fields = (Field("level", "u8", 0), Field("ttc_s", "f64", 1), Field("deceleration", "f64", 9))

    def __init__(self) -> None:
        config = AEBConfig()
        self._safe_m = config.risk.d_safe
        self._history = TrackHistory(config.history_len)
        self._by_distance, self._by_scale = DistanceTTC(config.fps), ScaleTTC(config.fps)
        self._fusion = TTCFusion(config.persist_k)
        self._machine = RiskStateMachine(config.risk, ego_speed_mps=config.ego_speed_mps)

    def execute(self, request: bytes) -> bytes:
        frame, speed_mps, objects = read(request)
        self._machine.set_ego_speed(speed_mps)
        for track, distance_m, height in objects:
            self._history.push(track, frame, distance_m, height)
        self._history.prune({track for track, _, _ in objects})
        worst = (0, -inf, 0.0)
        for track, distance_m, _ in objects:
            by_distance = self._by_distance.estimate(track, self._history)
            by_scale = self._by_scale.estimate(track, self._history)
            ttc_s = self._fusion.fuse(track, frame, by_distance, by_scale)
            closing = self._by_distance.closing_speed(track, self._history)
            risk = RiskFeature(
                track, in_path=True, distance=distance_m, closing_speed=closing, ttc_fused=ttc_s
            )
            level = self._machine.decide(risk)
            gap_m = distance_m - self._safe_m
            required = closing**2 / (2 * gap_m) if gap_m > 0 and closing > 0 else 0.0
            worst = max(worst, (int(level), -ttc_s, required))
        return REPLY.pack(worst[0], -worst[1], worst[2])

    def capture(self) -> bytes:
        tracks, held, levels = self._history._bufs, self._fusion._last, self._machine._level
        parts = [COUNTS.pack(self._machine.ego_speed, len(tracks), len(held), len(levels))]
        for track, seen in sorted(tracks.items()):
            parts += [struct.pack("<HH", track, len(seen)), *(SEEN.pack(*one) for one in seen)]
        parts += [HELD.pack(track, frame, ttc_s) for track, (frame, ttc_s) in sorted(held.items())]
        parts += [LEVEL.pack(track, level) for track, level in sorted(levels.items())]
        return b"".join(parts)

    def restore(self, state: bytes) -> None:
        tracks: dict[int, deque[tuple[int, float, float]]] = {}
        try:
            speed_mps, *counts = COUNTS.unpack_from(state)
            at = COUNTS.size
            for _ in range(counts[0]):
                track, length = struct.unpack_from("<HH", state, at)
                at += 4
                seen = [SEEN.unpack_from(state, at + SEEN.size * number) for number in range(length)]
                tracks[track] = deque(seen, self._history.max_len)
                at += SEEN.size * length
            levels_at = at + HELD.size * counts[1]
            if len(state) != levels_at + LEVEL.size * counts[2]:
                raise PeerError(f"not a state: {len(state)} bytes")
            held = {track: (frame, ttc_s) for track, frame, ttc_s in HELD.iter_unpack(state[at:levels_at])}
            levels = {track: RiskLevel(level) for track, level in LEVEL.iter_unpack(state[levels_at:])}
        except (struct.error, ValueError) as error:
            raise PeerError(f"not a state: {error}") from None
        self._machine.ego_speed = speed_mps
        self._history._bufs, self._fusion._last, self._machine._level = tracks, held, levels

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        return len(reply) == REPLY.size or not reply


class WithoutFusion(AebDecision):
    """The same, but what is held over a gap was forgotten when `capture` was written."""

    def capture(self) -> bytes:
        held, self._fusion._last = self._fusion._last, {}
        try:
            return super().capture()
        finally:
            self._fusion._last = held


class CheckedByRss(AebDecision):
    """With the stopping distance of ad-rss (package ad-rss) as its executable assertion.

    By responsibility-sensitive safety (RSS), a car that stays behind an object by this distance can stop. To
    brake for an object that is far beyond it is wrong, so such a reply is not acceptable. The reverse, a
    danger that is not reported, cannot be asserted from one request: the chain needs four frames of a track.
    """

    def __init__(self) -> None:
        super().__init__()
        risk = AEBConfig().risk
        with warnings.catch_warnings():  # both of its modules register the same converters
            warnings.simplefilter("ignore")
            from ad_rss import physics, rss  # noqa: PLC0415 - another package, for this class only
        self._physics, self._distance = (
            physics,
            rss.structured.calculateLongitudinalDistanceOffsetAfterStatedBrakingPattern,
        )
        self._response, self._no = physics.Duration(risk.t_react), physics.Acceleration(0.0)
        self._braking = physics.Acceleration(-risk.a_max)

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        if not reply:
            return True
        if len(reply) != REPLY.size:
            return False
        _, speed_mps, objects = read(request)
        level, _, _ = REPLY.unpack(reply)
        if level < RiskLevel.AEB_WARNING:
            return True
        nearest_m = min((distance_m for _, distance_m, _ in objects), default=inf)
        return bool(
            level == RiskLevel.AEB_WARNING and nearest_m <= MARGIN * self._stopping_m(speed_mps) + SPARE_M
        )

    def _stopping_m(self, speed_mps: float) -> float:
        speed, found = self._physics.Speed(min(speed_mps, 99.0)), self._physics.Distance()
        known = self._distance(
            speed, self._physics.Speed(100.0), self._response, self._no, self._braking, found
        )
        return float(found.toBaseType) if known else inf


def read(request: bytes) -> tuple[int, float, list[tuple[int, float, float]]]:
    """Frame, speed, and track, distance and height of each object. Raises PeerError."""
    try:
        frame, speed_mps, count = HEAD.unpack_from(request)
    except struct.error as error:
        raise PeerError(f"not a request: {error}") from None
    if len(request) != HEAD.size + OBJECT.size * count:
        raise PeerError(f"{len(request)} bytes, for {count} objects")
    objects = list(OBJECT.iter_unpack(request[HEAD.size :]))
    numbers = [speed_mps, *(number for _, *pair in objects for number in pair)]
    if not all(isfinite(number) and number >= 0 for number in numbers):
        raise PeerError("a number that is negative or not finite")
    if len({track for track, _, _ in objects}) < count:
        raise PeerError("a track is there twice")
    return frame, speed_mps, objects


def drive(seed: int) -> Iterator[bytes]:
    """A car that closes in on others at 30 frames a second; some frames miss an object, each is noisy."""
    draw = Random(seed)
    frame, speed_mps, next_track, ahead = 0, 6.0, 0, dict[int, tuple[float, float]]()
    while True:
        frame += 1
        speed_mps = max(3.0, min(20.0, speed_mps + draw.uniform(-0.5, 0.5)))
        while len(ahead) < 3:
            next_track = (next_track + 1) % 0x10000
            ahead[next_track] = (draw.uniform(6, 40), draw.uniform(-2, 15))  # distance, closing speed
        ahead = {track: (gap - closing / 30, closing) for track, (gap, closing) in ahead.items()}
        ahead = {track: one for track, one in ahead.items() if 3 < one[0] < 60}
        seen = [
            OBJECT.pack(track, gap * draw.gauss(1, 0.002), 1650 / gap * draw.gauss(1, 0.002))
            for track, (gap, _) in ahead.items()
            if draw.random() < 0.9
        ]
        yield HEAD.pack(frame, speed_mps, len(seen)) + b"".join(seen)
