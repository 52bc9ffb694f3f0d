"""The gateway on another car's bus: real frames in, by a map; our own AEB_REQ out.

Each frame is judged by the rule of its id, in this order: time, length, checksum, counter, range. A frame
that is refused is counted by the reason and changes nothing at all. Where a message is protected by E2E,
the profile and its supervision judge length, checksum and sequence, as on our own bus (`e2e`); any other
checksum and counter are weaker than that: an 8-bit sum, no data id, and no window of statuses.

The frame that ends the radar's cycle makes the request, out of the tracks that were refreshed in that
cycle: a slot whose frame was lost or refused is a miss to the function, never an old value. A cycle whose
last frame is lost or refused makes no request. Where the radar announces how many objects it will send,
the cycle ends with the last of them, or at once if there are none; one that lacks some ends with the next
announcement, and makes its request out of what came.
"""

from collections.abc import Mapping
from math import cos, isfinite, sin
from typing import Final

import msgspec

from aftbed.vehicle.aeb.messages import (
    SLOTS,
    SPEED_MAX_MS,
    AebInput,
    AebTarget,
    EncodeRequest,
    encode_request,
)
from aftbed.vehicle.can.dbc_file import Codec
from aftbed.vehicle.can.e2e import Receiver
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.gateway import BusGateway, target_of
from aftbed.vehicle.replay.map_file import BoundMap, FrameRule, TrackReading

FRESH_CYCLES: Final = 1.5  # a log's time stamps come in batches, so a cycle may look longer than it was


def toyota_checksum(can_id: int, data: bytes) -> int:
    """Of a frame of Toyota's: the sum of its length, the bytes of its id and all data but the last byte."""
    return (len(data) + (can_id >> 8) + (can_id & 0xFF) + sum(data[:-1])) & 0xFF


class SlotBook:
    """Which of the function's `SLOTS` slots an object has, where the radar numbers more objects than slots.

    Of the objects in our path the nearest ones get a slot each: the others cannot be hit before them. An
    object keeps its slot while it is seen, and until another needs it, so a moment in which it is not seen
    has no effect; the one that was not seen for longest gives way. A target in a slot of another object is
    marked new.
    """

    def __init__(self) -> None:
        self._slots: dict[int, int] = {}  # by object; those not seen for longest come first

    def assign(self, seen: Mapping[int, AebTarget]) -> tuple[AebTarget, ...]:
        """The targets of one cycle, by object; those that get a slot, by slot."""
        nearest = sorted(seen, key=lambda number: (seen[number].range_m, number))[:SLOTS]
        known = [number for number in nearest if number in self._slots]
        for number in known:
            self._slots[number] = self._slots.pop(number)
        found = {self._slots[number]: seen[number] for number in known}
        for number in nearest:
            if number not in known:
                taken = set(self._slots.values())
                slot = next((slot for slot in range(SLOTS) if slot not in taken), None)
                if slot is None:
                    slot = self._slots.pop(next(iter(self._slots)))
                self._slots[number] = slot
                found[slot] = msgspec.structs.replace(seen[number], new=True)
        return tuple(msgspec.structs.replace(found[slot], slot=slot) for slot in sorted(found))


class SeenTrack(msgspec.Struct, frozen=True):
    """The content of an object's last frame, at `t_us`; no target if it was not valid or not in our path."""

    t_us: int
    target: AebTarget | None


class MappedGateway(BusGateway):
    """Reads frames by a user's map and DBC; `codec` is aftbed's own, for what it sends."""

    def __init__(self, codec: Codec, bound: BoundMap, encode: EncodeRequest = encode_request) -> None:
        super().__init__(codec, encode)
        self._bound = bound
        self._receivers = {
            rule.can_id: Receiver(rule.watch) for rule in self._bound.rules.values() if rule.watch is not None
        }
        self._book = SlotBook() if self._bound.allots else None
        self._t_us = 0
        self._counters: dict[int, int] = {}
        self._tracks: dict[int, SeenTrack] = {}  # by number: of the object, or of the message
        self._announced = 0  # by the last announcement
        self._awaited = 0  # so many objects make the cycle whole; 0 is none that is open
        self._ego: tuple[int, float] | None = None  # bus time and speed, last accepted

    def _request_of(self, frame: Frame) -> bytes | None:
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
        if frame.can_id == self._bound.cycle_end_id:
            return self._request(frame.t_us)
        if frame.can_id == self._bound.count_id:
            return self._announce(frame.t_us)
        if rule.track is not None and 0 < self._awaited <= len(self._tracks):
            self._awaited = 0
            return self._request(frame.t_us)
        return None

    def _accept(self, frame: Frame, rule: FrameRule) -> str | None:
        """Take the content of the frame, or return the reason to refuse it; then nothing has changed."""
        if frame.t_us < self._t_us:
            return "time"
        receiver = self._receivers.get(rule.can_id)
        if receiver is not None:
            refusal = receiver.refusal(frame.data, receiver.check(frame.data, frame.t_us))
            if refusal is not None:
                return refusal
        if len(frame.data) != rule.length:
            return "length"
        if rule.checksum == "toyota" and toyota_checksum(rule.can_id, frame.data) != frame.data[-1]:
            return "checksum"
        signals = self._bound.codec.decode(rule.name, frame.data) if rule.name is not None else {}
        counter = int(signals[rule.counter.signal]) if rule.counter else None
        last = self._counters.get(rule.can_id)  # lost frames between them are no reason to refuse this one
        if rule.counter and counter is not None and (counter >= rule.counter.modulo or counter == last):
            return "repeated"
        if not self._take(frame, rule, signals):
            return "range"
        if counter is not None:
            self._counters[rule.can_id] = counter
        return None

    def _take(self, frame: Frame, rule: FrameRule, signals: dict[str, float]) -> bool:
        """Keep a track or the ego speed. False, and nothing kept, if a value is beyond any sensor."""
        if frame.can_id == self._bound.ego_id:
            speed_ms = self._bound.ego_speed.si(signals, frame.data)
            if not 0.0 <= speed_ms <= SPEED_MAX_MS:
                return False
            self._ego = (frame.t_us, speed_ms)
        count = self._bound.map.tracks.count
        if count is not None and frame.can_id == self._bound.count_id:
            self._announced = int(signals[count.signal])
        return rule.track is None or self._take_track(frame, rule.track, signals)

    def _take_track(self, frame: Frame, track: TrackReading, signals: dict[str, float]) -> bool:
        """Keep a track: that of the object that the frame names, or else of its message."""
        number = track.number if track.slot is None else int(signals[track.slot])
        target = None
        if track.valid is None or track.valid.is_set(signals):
            new = track.new is not None and track.new.is_set(signals)
            ahead_m = track.range.si(signals, frame.data)
            if track.angle is None:
                assert track.lateral_offset is not None
                beside_m = track.lateral_offset.si(signals, frame.data)
            elif isfinite(angle := track.angle.si(signals, frame.data)):
                ahead_m, beside_m = ahead_m * cos(angle), ahead_m * sin(angle)
            else:
                return False
            target = target_of(0, ahead_m, track.relative_speed.si(signals, frame.data), new)
            if target is None or not isfinite(beside_m):
                return False
            if abs(beside_m) > self._bound.map.lane_half_width_m:
                target = None
        self._tracks[number] = SeenTrack(frame.t_us, target)
        return True

    def _announce(self, t_us: int) -> bytes | None:
        """A new cycle: the one before ends now if it lacks something, the new one if it will have nothing."""
        made = self._request(t_us) if self._awaited else None
        self._tracks.clear()
        self._awaited = self._announced
        return made if self._awaited else self._request(t_us, empty=True)

    def _request(self, t_us: int, *, empty: bool = False) -> bytes:
        """`empty`: the radar has announced no objects, which is not the same as no frame of the radar."""
        fresh_us = round(FRESH_CYCLES * self._bound.map.cycle_ms * 1000)
        fresh = {number: seen for number, seen in self._tracks.items() if t_us - seen.t_us <= fresh_us}
        found = {number: seen.target for number, seen in fresh.items() if seen.target is not None}
        if self._book is not None:
            targets = self._book.assign(found)
        else:
            targets = tuple(msgspec.structs.replace(found[number], slot=number) for number in sorted(found))
        self._tracks.clear()
        known = self._ego is not None and t_us - self._ego[0] <= self._bound.map.ego.timeout_ms * 1000
        speed_ms = self._ego[1] if self._ego is not None and known else 0.0
        return self.encode(AebInput(t_us // 1000, speed_ms, known, bool(fresh) or empty, targets))
