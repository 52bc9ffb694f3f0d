"""The gateway on somebody else's bus: real frames in, by a map; our own AEB_REQ out.

Each frame is judged by the rule of its id, in this order: time, length, checksum, counter, range. A frame
that is refused is counted by the reason and changes nothing at all. The frame that ends the radar's cycle
makes the request, out of the tracks that were refreshed in that cycle: a slot whose frame was lost or
refused is a miss to the function, never an old value. A cycle whose last frame is lost or refused makes
no request.

Such rules are weaker than E2E: an 8-bit sum and a counter without a data id, and no window of statuses.
"""

from pathlib import Path
from typing import Final

import msgspec

from aftbed.vehicle.aebmessages import SPEED_MAX_MS, AebInput, AebTarget, encode_request
from aftbed.vehicle.dbcfile import Codec, load_dbc
from aftbed.vehicle.frame import Frame
from aftbed.vehicle.gateway import GatewayCounts, ReplySender, target_of
from aftbed.vehicle.mapfile import TO_SI, Quantity, Rule, bind

FRESH_CYCLES: Final = 1.5  # a log's time stamps come in batches, so a cycle may look longer than it was


def toyota_checksum(can_id: int, data: bytes) -> int:
    """Of a frame of Toyota's: the sum of its length, the bytes of its id and all data but the last byte."""
    return (len(data) + (can_id >> 8) + (can_id & 0xFF) + sum(data[:-1])) & 0xFF


class SeenTrack(msgspec.Struct, frozen=True):
    """What a slot's last frame said, at `t_us`; no target if it was not valid or not in our path."""

    t_us: int
    target: AebTarget | None


class MappedGateway:
    """A `BusGateway` that reads frames by a user's DBC and map; `codec` is aftbed's own, for the way out."""

    def __init__(self, codec: Codec, dbc: Path, map_file: Path) -> None:
        """Raises ConfigError if the DBC does not parse, or the map does not fit it."""
        self.counts = GatewayCounts()
        self._sender = ReplySender(codec)
        self._bound = bind(map_file, load_dbc(dbc))
        self._t_us = 0
        self._counters: dict[int, int] = {}
        self._tracks: dict[int, SeenTrack] = {}
        self._ego: tuple[int, float] | None = None  # bus time and speed, last accepted

    def on_frame(self, frame: Frame) -> bytes | None:
        """See `BusGateway.on_frame`: a request for each frame that ends a cycle and is believed."""
        rule = self._bound.rules.get(frame.can_id)
        if rule is None:
            self.counts.ignored += 1
            return None
        reason = self._accept(frame, rule)
        if reason is not None:
            self.counts.refuse(reason)
            return None
        self.counts.accepted += 1
        self._t_us = frame.t_us
        return self._request(frame.t_us) if frame.can_id == self._bound.cycle_end_id else None

    def on_reply(self, reply: bytes, t_us: int, replica: int, epoch: int, answered: int) -> list[Frame]:
        """See `BusGateway.on_reply`."""
        return self._sender.frames(reply, t_us, replica, epoch, answered)

    def _accept(self, frame: Frame, rule: Rule) -> str | None:
        """Take what the frame says, or say why not; then nothing has changed."""
        if frame.t_us < self._t_us:
            return "time"
        if len(frame.data) != rule.length:
            return "length"
        if rule.checksum == "toyota" and toyota_checksum(rule.can_id, frame.data) != frame.data[-1]:
            return "checksum"
        signals = self._bound.codec.decode(rule.name, frame.data) if rule.name is not None else {}
        counter = int(signals[rule.counter.signal]) if rule.counter else None
        if rule.counter and not self._continues(rule.can_id, counter, rule.counter.modulo):
            return "repeated"
        if not self._take(frame, rule, signals):
            return "range"
        if counter is not None:
            self._counters[rule.can_id] = counter
        return None

    def _continues(self, can_id: int, counter: int | None, modulo: int) -> bool:
        """True unless it is the same frame again. Lost frames are no reason to refuse the next."""
        return counter is not None and counter < modulo and counter != self._counters.get(can_id)

    def _take(self, frame: Frame, rule: Rule, signals: dict[str, float]) -> bool:
        """Keep a track or the ego speed. False, and nothing kept, if a value is beyond any sensor."""
        if frame.can_id == self._bound.ego_id:
            speed_ms = _si(self._bound.map.ego.speed, signals, frame.data)
            if not 0.0 <= speed_ms <= SPEED_MAX_MS:
                return False
            self._ego = (frame.t_us, speed_ms)
        if rule.slot is not None:
            target = self._target(rule.slot, signals, frame.data)
            if target is None and signals[self._bound.map.tracks.valid]:
                return False
            in_path = target is not None and self._in_path(signals, frame.data)
            self._tracks[rule.slot] = SeenTrack(frame.t_us, target if in_path else None)
        return True

    def _target(self, slot: int, signals: dict[str, float], data: bytes) -> AebTarget | None:
        """The slot's target, None if there is none or its values are beyond any sensor."""
        tracks = self._bound.map.tracks
        if not signals[tracks.valid]:
            return None
        new = tracks.new is not None and bool(signals[tracks.new])
        range_m, speed_ms = _si(tracks.range, signals, data), _si(tracks.relative_speed, signals, data)
        return target_of(slot, range_m, speed_ms, new)

    def _in_path(self, signals: dict[str, float], data: bytes) -> bool:
        lateral_m = _si(self._bound.map.tracks.lateral_offset, signals, data)
        return abs(lateral_m) <= self._bound.map.lane_half_width_m

    def _request(self, t_us: int) -> bytes:
        fresh_us = round(FRESH_CYCLES * self._bound.map.cycle_ms * 1000)
        fresh = [seen for _, seen in sorted(self._tracks.items()) if t_us - seen.t_us <= fresh_us]
        targets = tuple(seen.target for seen in fresh if seen.target is not None)
        self._tracks.clear()
        known = self._ego is not None and t_us - self._ego[0] <= self._bound.map.ego.timeout_ms * 1000
        speed_ms = self._ego[1] if self._ego is not None and known else 0.0
        return encode_request(AebInput(t_us // 1000, speed_ms, known, bool(fresh), targets))


def _si(quantity: Quantity, signals: dict[str, float], data: bytes) -> float:
    """A mapped quantity in metres or metres per second."""
    if quantity.raw is not None:
        return quantity.raw.read(data) * TO_SI[quantity.unit]
    assert quantity.signal is not None
    return signals[quantity.signal] * TO_SI[quantity.unit]
