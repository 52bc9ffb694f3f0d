"""The protected function, automatic emergency braking (AEB): decides when to brake, and how hard.

One request is one radar cycle: bus time, ego speed, and the targets in our path. One reply is the demand
on the brakes. In between:

1. **Tracks** (`Track`). Confirmed after 3 hits, dropped after `MISSES_MAX` misses.
2. **Threat** (`worst`). Of all confirmed tracks, the one that takes the most braking.
3. **Stage.** NONE, WARN, PARTIAL (4 m/s2), FULL. The warning lasts 0.8 s before full braking where there is
   time (UN R152); where there is none, brakes come first. No stage is left for a lesser one until the
   ego has stood for `STILL_MS`, or nothing has been a threat for `CLEAR_MS`. A lost obstacle may still
   be there: without a confirmed track the stage outlives the last threat by `LOST_MS`.

A request without a valid radar or ego speed is blind and decides nothing: tracks coast, and the stage is
held, for at most `BLIND_MS`. An unusable radar frame must never end a braking. Time that runs backwards, or
jumps by more than `GAP_MS`, drops all tracks.

The state is one fixed layout of `STATE_BYTES`, doubles as they are, so that a restored replica continues
bit for bit; a slot without a track is zero in it. Only + - * / and comparisons on doubles: the same
replies on every machine.

A request is served between context switches, with cold caches: its cost is the number of objects and
functions touched. So only slots with a target have a track, limits are comparisons and not calls of `min` and
`max`, and `Track` is a plain class with slots (a msgspec struct assigns more slowly).
"""

from collections.abc import Mapping, Set
from random import Random
from struct import Struct
from typing import Final

import msgspec

from aftbed.core.application import BITS, CODES, Application, Characteristics, Field, Width
from aftbed.core.errors import PeerError
from aftbed.vehicle.aeb.messages import (
    COUNTER_COUNT,
    RANGE_MAX_M,
    SLOTS,
    SPEED_MAX_MS,
    STAGE_FULL,
    STAGE_NONE,
    STAGE_PARTIAL,
    STAGE_WARN,
    T_MS_MAX,
    AebInput,
    AebOutput,
    AebTarget,
    decode_reply,
    decode_request,
    encode_fixed,
    encode_reply,
    encode_request,
)

# -- tracks ---------------------------------------------------------------------------------------

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
    """The target in one slot: an alpha-beta filter on its range and on its speed over ground.

    Over ground, because a standing car then stays a standing car while the ego brakes towards it. The
    change of speed that was not predicted gives the target's acceleration: a car ahead that brakes is a
    threat before the gap shows it. A measurement outside of the gates is another target: the track starts
    anew.

    Every field stays in the ranges above, so every captured state can be restored.
    """

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
                self.range_m += ALPHA * off_m
                self.speed_ms += BETA * off_ms
                speeding_ms2 = self.acceleration_ms2 + GAMMA_PER_S * off_ms
                if not -ACCELERATION_MAX_MS2 <= speeding_ms2 <= ACCELERATION_MAX_MS2:
                    speeding_ms2 = ACCELERATION_MAX_MS2 if speeding_ms2 > 0.0 else -ACCELERATION_MAX_MS2
                self.acceleration_ms2 = speeding_ms2
                self.misses = 0
                if self.hits < HITS_MAX:
                    self.hits += 1
                return
        self.hits, self.misses = 1, 0
        self.range_m, self.speed_ms, self.acceleration_ms2 = target.range_m, speed_ms, 0.0

    def predict(self, ego_ms: float, elapsed_s: float) -> None:
        """Move on by `elapsed_s` without a measurement. A target that brakes stops; it does not reverse."""
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

    def plausible(self) -> bool:
        """True if an execution can have left the track like this. NaN fails every comparison."""
        return (
            self.hits > 0
            and self.misses <= MISSES_MAX
            and 0.0 <= self.range_m <= RANGE_MAX_M
            and -GROUND_SPEED_MAX_MS <= self.speed_ms <= GROUND_SPEED_MAX_MS
            and -ACCELERATION_MAX_MS2 <= self.acceleration_ms2 <= ACCELERATION_MAX_MS2
        )


# -- threat ---------------------------------------------------------------------------------------

MARGIN_M: Final = 1.5  # bumper to bumper, at standstill
REACTION_S: Final = 0.2  # dead time and lag of the brakes
LEAD_BRAKING_MS2: Final = 1.0  # a target that brakes less counts as driving on
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
    """The worst of the confirmed tracks, by two measures.

    A warning goes by the time to collision (TTC) at present speeds, which ignores that a car ahead brakes
    at our own speed. The required deceleration is the least constant one that leaves `MARGIN_M`, after the
    time our brakes take to bite; at 10 km/h it stays small until it would be too late to warn.
    """

    slot: int
    range_m: float
    required_ms2: float
    ttc_s: float | None  # None if the gap is not closing

    def persists(self) -> bool:
        """True if a braking that has begun must go on: it ends with our speed, or with the threat."""
        if self.required_ms2 >= THREAT_MS2:
            return True
        return self.ttc_s is not None and (self.range_m <= NEAR_THREAT_M or self.ttc_s <= WARN_TTC_S)

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
    """The confirmed track that takes the most braking (of equals, the lowest slot); None if none does."""
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
        # The target stops v/a seconds and v*v/2a metres from now. If we stop later than that, the place
        # where it stands counts; if sooner, the moment at which the speeds are equal.
        braking_ms2 = min(-track.acceleration_ms2, LEAD_BRAKING_MAX_MS2)
        total_m = room_m + speed_ms * speed_ms / (2.0 * braking_ms2)
        if 2.0 * total_m / ego_ms >= speed_ms / braking_ms2:
            required_ms2 = ego_ms * ego_ms / (2.0 * total_m)
        else:
            closing_ms = max(0.0, closing_ms)
            required_ms2 = braking_ms2 + closing_ms * closing_ms / (2.0 * room_m)
    elif closing_ms > 0.0:
        required_ms2 = closing_ms * closing_ms / (2.0 * room_m)
    else:
        return 0.0
    return required_ms2 if required_ms2 < REQUIRED_MAX_MS2 else REQUIRED_MAX_MS2


# -- the function ---------------------------------------------------------------------------------

DEMAND_MS2: Final = (0.0, 0.0, 4.0, 9.0)  # by stage; full is more than the tyres give
GAP_MS: Final = 500
WARNED_MS: Final = 800
CLEAR_MS: Final = 100
LOST_MS: Final = 600
STILL_MS: Final = 2000
STILL_SPEED_MS: Final = 0.05
BLIND_MS: Final = 2000
TIMER_MAX_MS: Final = 60_000

OFF_M: Final = (1.0 - ALPHA) * GATE_M  # greatest distance of a track from the measurement that corrected it
OFF_MS: Final = (1.0 - BETA) * GATE_MS
ROUNDING: Final = 1e-6  # m, m/s: more than doubles lose on the way

VERSION: Final = 1


def _fields(prefix: str, offset_bytes: int, layout: Mapping[str, Width]) -> list[Field]:
    """The variables of `layout`, one behind the other."""
    found = []
    for name, kind in layout.items():
        found.append(Field(prefix + name, kind, offset_bytes))
        offset_bytes += BITS[kind] // 8
    return found


_HEADER_LAYOUT: Final[Mapping[str, Width]] = {
    "version": "u8", "counter": "u8", "stage": "u8", "started": "u8", "ego_ms": "f64", "t_ms": "i64",
    "warned_ms": "u32", "clear_ms": "u32", "still_ms": "u32", "blind_ms": "u32",
}  # fmt: skip
_TRACK_LAYOUT: Final[Mapping[str, Width]] = {
    "hits": "u8", "misses": "u8", "range_m": "f64", "speed_ms": "f64", "acceleration_ms2": "f64",
}  # fmt: skip
_HEADER: Final = Struct("<" + "".join(map(CODES.__getitem__, _HEADER_LAYOUT.values())))
_TRACK: Final = Struct("<" + "".join(map(CODES.__getitem__, _TRACK_LAYOUT.values())))
STATE_BYTES: Final = _HEADER.size + _TRACK.size * SLOTS
_OFFSETS: Final = tuple(range(_HEADER.size, STATE_BYTES, _TRACK.size))  # by slot
_EMPTY: Final = bytes(STATE_BYTES)
_FREE: Final = bytes(_TRACK.size)
_ALL_FREE: Final = tuple(bytes(STATE_BYTES - offset) for offset in _OFFSETS)  # from that slot on


class AebFunction:
    """The application. Only `execute` and `restore` change it."""

    characteristics = Characteristics()
    fields: tuple[Field, ...] = (
        *_fields("", 0, _HEADER_LAYOUT)[1:],  # without the version
        *(
            field
            for slot, offset in enumerate(_OFFSETS)
            for field in _fields(f"track{slot}.", offset, _TRACK_LAYOUT)
        ),
    )

    def __init__(self) -> None:
        self._counter = 0
        self._stage = STAGE_NONE
        self._started = False  # while False, `_t_ms` and `_ego_ms` mean nothing
        self._ego_ms = 0.0  # last valid
        self._t_ms = 0
        self._warned_ms = 0  # since the stage left NONE
        self._clear_ms = 0  # since something was last a threat
        self._still_ms = 0  # since the ego stood
        self._blind_ms = 0  # since a request last was not blind
        self._tracks: dict[int, Track] = {}  # by slot, of the slots that are not free; in no order

    def execute(self, request: bytes) -> bytes:
        """Decide for one radar cycle. Raises PeerError, with nothing changed, on a bad request."""
        cycle = decode_request(request)
        elapsed_ms = cycle.t_ms - self._t_ms
        if not (self._started and 0 <= elapsed_ms <= GAP_MS):
            self._tracks = {}
            elapsed_ms = 0
        self._t_ms, self._started = cycle.t_ms, True
        if cycle.ego_valid:
            self._ego_ms = cycle.ego_speed_ms
        if cycle.ego_valid and cycle.radar_valid:
            self._blind_ms = 0
            self._measure(cycle.targets, elapsed_ms / 1000)
            threat = worst(self._tracks, self._ego_ms)
            self._decide(threat, elapsed_ms)
        else:
            self._blind_ms = _later(self._blind_ms, elapsed_ms)
            self._coast(frozenset(), elapsed_ms / 1000)
            if self._blind_ms > BLIND_MS:
                self._stage, self._warned_ms = STAGE_NONE, 0
            threat = worst(self._tracks, self._ego_ms)
        counter, stage = self._counter, self._stage
        self._counter = (counter + 1) % COUNTER_COUNT
        if threat is None:
            return encode_reply(AebOutput(stage, DEMAND_MS2[stage], None, None, counter))
        return encode_reply(AebOutput(stage, DEMAND_MS2[stage], threat.ttc_s, threat.slot, counter))

    def capture(self) -> bytes:
        """The whole state, `STATE_BYTES` long."""
        state = bytearray(_EMPTY)
        _HEADER.pack_into(
            state, 0, VERSION, self._counter, self._stage, self._started, self._ego_ms, self._t_ms,
            self._warned_ms, self._clear_ms, self._still_ms, self._blind_ms,
        )  # fmt: skip
        for slot, track in self._tracks.items():
            _TRACK.pack_into(
                state, _OFFSETS[slot],
                track.hits, track.misses, track.range_m, track.speed_ms, track.acceleration_ms2,
            )  # fmt: skip
        return bytes(state)

    def restore(self, state: bytes) -> None:
        """Return to a captured state. Raises PeerError, with nothing changed, if `state` is not one."""
        if len(state) != STATE_BYTES:
            raise PeerError(f"state of {len(state)} bytes, expected {STATE_BYTES}")
        version, counter, stage, started, ego_ms, t_ms, *timers = _HEADER.unpack_from(state)
        if version != VERSION:
            raise PeerError(f"state of version {version}, expected {VERSION}")
        if counter >= COUNTER_COUNT or stage > STAGE_FULL or started > 1:
            raise PeerError(f"state with counter {counter}, stage {stage}, started {started}")
        if not (0.0 <= ego_ms <= SPEED_MAX_MS and 0 <= t_ms <= T_MS_MAX and max(timers) <= TIMER_MAX_MS):
            raise PeerError(f"state with ego speed {ego_ms} m/s, time {t_ms} ms, timers {timers} ms")
        tracks: dict[int, Track] = {}
        for slot, offset in enumerate(_OFFSETS):
            if state.endswith(_ALL_FREE[slot]):
                break
            if state[offset : offset + _TRACK.size] != _FREE:  # to the bit, or the next capture would differ
                track = tracks[slot] = Track(*_TRACK.unpack_from(state, offset))
                if not track.plausible():
                    raise PeerError(f"state with {track} in slot {slot}")
        self._counter, self._stage, self._started = counter, stage, bool(started)
        self._ego_ms, self._t_ms, self._tracks = ego_ms, t_ms, tracks
        self._warned_ms, self._clear_ms, self._still_ms, self._blind_ms = timers

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        """The executable assertion: true of every reply of this function, to whatever came before `request`.

        Of the bits of replies in sample drives it notices 96 % flipped where there is no threat, 64 % where
        there is one, and in both every one that changes the demand on the brakes. It cannot notice, without
        the state, the fraction of the time to collision, the counter, and the choice between NONE and WARN
        where both can be.
        """
        try:
            cycle = decode_request(request)
        except PeerError:
            return reply == b""
        try:
            output = decode_reply(reply)
        except PeerError:
            return False
        # Byte for byte: the demand is that of the stage, and each value is written in the one way there is.
        demanded = AebOutput(
            output.stage, DEMAND_MS2[output.stage], output.ttc_s, output.slot, output.counter
        )
        return reply == encode_reply(demanded) and _plausible(cycle, output)

    def _measure(self, targets: tuple[AebTarget, ...], elapsed_s: float) -> None:
        """Correct the tracks that were seen, begin new ones, coast the others."""
        tracks, ego_ms = self._tracks, self._ego_ms
        for target in targets:
            track = tracks.get(target.slot)
            if track is None:
                tracks[target.slot] = Track(1, 0, target.range_m, ego_ms + target.rel_speed_ms)
            else:
                track.hit(target, ego_ms, elapsed_s)
        if len(tracks) > len(targets):  # every target has its track by now, and no slot comes twice
            self._coast({target.slot for target in targets}, elapsed_s)

    def _coast(self, seen: Set[int], elapsed_s: float) -> None:
        """Predict the tracks that were not seen, and drop those with too many misses."""
        for slot in [slot for slot in self._tracks if slot not in seen]:
            track = self._tracks[slot]
            track.misses += 1
            track.predict(self._ego_ms, elapsed_s)
            if track.misses > MISSES_MAX:
                del self._tracks[slot]

    def _decide(self, threat: Threat | None, elapsed_ms: int) -> None:
        """Raise the stage as the threat requires; end it when the threat is gone, or the ego has stood."""
        still = self._ego_ms <= STILL_SPEED_MS
        self._still_ms = _later(self._still_ms, elapsed_ms) if still else 0
        self._warned_ms = _later(self._warned_ms, elapsed_ms) if self._stage else 0
        persists = threat is not None and threat.persists()
        self._clear_ms = 0 if persists else _later(self._clear_ms, elapsed_ms)
        if self._still_ms > STILL_MS or (not (still or persists) and self._is_clear()):
            self._stage, self._warned_ms = STAGE_NONE, 0
        elif threat is not None and persists and not still:
            stage = threat.stage()
            if stage == STAGE_FULL and self._warned_ms < WARNED_MS and threat.required_ms2 < NO_TIME_MS2:
                stage = STAGE_PARTIAL  # until the warning has lasted long enough
            self._stage = max(self._stage, stage)

    def _is_clear(self) -> bool:
        """True if nothing has been a threat for long enough; longer without a confirmed track to show it."""
        if self._clear_ms <= CLEAR_MS:
            return False
        if self._clear_ms > LOST_MS:
            return True
        return any(track.hits >= HITS_CONFIRMED for track in self._tracks.values())


def _later(timer_ms: int, elapsed_ms: int) -> int:
    later_ms = timer_ms + elapsed_ms
    return later_ms if later_ms < TIMER_MAX_MS else TIMER_MAX_MS


def _plausible(cycle: AebInput, output: AebOutput) -> bool:
    """Whether some track can have led to `output`: one that `cycle` measures, or one that is coasting."""
    if output.slot is None:
        return output.ttc_s is None
    if not (cycle.ego_valid and cycle.radar_valid):
        return True  # nothing was measured, and nothing decided
    moving = cycle.ego_speed_ms > STILL_SPEED_MS
    if moving and output.ttc_s is not None and output.ttc_s <= WARN_TTC_S and output.stage < STAGE_WARN:
        return False
    return all(_can_be(target, output.ttc_s) for target in cycle.targets if target.slot == output.slot)


def _can_be(target: AebTarget, ttc_s: float | None) -> bool:
    """Whether a confirmed track that `target` has just corrected can have this time to collision."""
    if target.new:
        return False  # not confirmed by now
    closing_most_ms = OFF_MS + ROUNDING - target.rel_speed_ms
    closing_least_ms = -target.rel_speed_ms - OFF_MS - ROUNDING
    if ttc_s is None:
        return closing_least_ms <= 0.0
    if closing_most_ms <= 0.0 or ttc_s * closing_most_ms < target.range_m - OFF_M - ROUNDING:
        return False
    return closing_least_ms <= 0.0 or ttc_s * closing_least_ms <= target.range_m + OFF_M + ROUNDING


def default_application() -> Application:
    """A new instance of the function, as every replica starts it."""
    return AebFunction()


SAMPLE_CYCLE_MS: Final = 20
SAMPLE_LIMIT_MS2: Final = 6.0


def sample_requests(seed: int, count: int, *, fixed: bool = False) -> list[bytes]:
    """`count` radar cycles of 20 ms for load and benches: approaches to a car ahead, one after the other.

    In each, the ego closes in on a slower or standing car, brakes late and steadily down to its speed,
    follows for a second, and meets the next one. No feedback: the same seed gives the same bytes.

    `fixed`: in the fixed layout, in which a car asks a function that is no class.
    """
    random = Random(seed)
    requests: list[bytes] = []
    while len(requests) < count:
        requests += _sample_approach(random, len(requests) * SAMPLE_CYCLE_MS)
    found = requests[:count]
    return [encode_fixed(decode_request(request)) for request in found] if fixed else found


def _sample_approach(random: Random, start_ms: int) -> list[bytes]:
    """One approach, from a random speed and gap to a second of following."""
    ego_ms, lead_ms = random.uniform(8.0, 17.0), random.choice((0.0, 0.0, random.uniform(2.0, 7.0)))
    gap_m = random.uniform(3.0, 4.5) * (ego_ms - lead_ms)
    cycle_s = SAMPLE_CYCLE_MS / 1000
    requests: list[bytes] = []
    following = 0

    def noise() -> float:
        return random.uniform(-0.1, 0.1)

    while following * SAMPLE_CYCLE_MS < 1000:
        new, relative_ms = not requests, lead_ms - ego_ms

        # the car ahead and, farther away, the one before it
        near = AebTarget(0, max(0.0, gap_m + noise()), relative_ms + noise(), new)
        far = AebTarget(1, gap_m + 20.0 + noise(), relative_ms + noise(), new)
        t_ms = start_ms + len(requests) * SAMPLE_CYCLE_MS
        requests.append(encode_request(AebInput(t_ms, ego_ms, True, True, (near, far))))
        closing_ms = ego_ms - lead_ms
        gap_m -= closing_ms * cycle_s
        if closing_ms * closing_ms >= 2.0 * SAMPLE_LIMIT_MS2 * max(0.1, gap_m - 3.0):
            ego_ms = max(lead_ms, ego_ms - SAMPLE_LIMIT_MS2 * cycle_s)
        following += closing_ms <= 0.0 or gap_m < 1.0
    return requests
