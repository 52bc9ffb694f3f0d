"""The protected function: decides when to brake, and remembers why. This is what a mechanism protects.

One request is one radar cycle: bus time, ego speed, and the targets of the cycle. One reply is what the
brakes are asked for. In between:

1. **Tracks** (`tracker`). Confirmed after 3 hits, dropped after more misses than a short gap makes.
2. **Threat** (`threat`). Of all confirmed tracks, the one that takes the most braking.
3. **Stage.** NONE, WARN, PARTIAL (4 m/s2), FULL. The warning lasts 0.8 s before full braking where there is
   time (UN R152); where there is none, brakes come first. No stage is left for a lesser one until the
   ego has stood for `STILL_MS`, or nothing has been a threat for `CLEAR_MS`. Losing sight of an
   obstacle is not the end of it: where no track is left to show that the threat is gone, the stage
   outlives it by `LOST_MS`.

The gateway does the lateral selection: what is in a request is in our path.

A request without a valid radar or ego speed is blind and decides nothing: tracks coast, and the stage is
held, for at most `BLIND_MS`. That a radar cannot be believed must never end a braking.
Time that runs backwards, or jumps by more than `GAP_MS`, starts all tracks anew: nothing old may brake.

The state is one fixed layout of `STATE_BYTES`, doubles as they are, so that a restored replica goes on
bit for bit; a slot without a track is zero in it. Only + - * / and comparisons on doubles: the same
replies on every machine.
"""

from collections.abc import Set
from random import Random
from struct import Struct
from typing import Final

from aftbed.core.application import Application, Characteristics, Field
from aftbed.core.errors import PeerError
from aftbed.vehicle.aeb.messages import (
    COUNTER_COUNT,
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
    encode_reply,
    encode_request,
)
from aftbed.vehicle.aeb.threat import WARN_TTC_S, Threat, worst
from aftbed.vehicle.aeb.tracker import ALPHA, BETA, GATE_M, GATE_MS, HITS_CONFIRMED, Track

DEMAND_MS2: Final = (0.0, 0.0, 4.0, 9.0)  # by stage; full is more than the tyres give
GAP_MS: Final = 500
WARNED_MS: Final = 800
CLEAR_MS: Final = 100
LOST_MS: Final = 600
STILL_MS: Final = 2000
STILL_SPEED_MS: Final = 0.05
BLIND_MS: Final = 2000
TIMER_MAX_MS: Final = 60_000

OFF_M: Final = (1.0 - ALPHA) * GATE_M  # how far a track can be from the measurement that it was corrected by
OFF_MS: Final = (1.0 - BETA) * GATE_MS
ROUNDING: Final = 1e-6  # m, m/s: more than doubles lose on the way

VERSION: Final = 1
_HEADER: Final = Struct("<BBBBdqIIII")  # version, counter, stage, started, ego speed, time, four timers
_TRACK: Final = Struct("<BBddd")  # hits, misses, range, speed, acceleration; all zero if the slot is free
STATE_BYTES: Final = _HEADER.size + _TRACK.size * SLOTS
_OFFSETS: Final = tuple(range(_HEADER.size, STATE_BYTES, _TRACK.size))  # by slot
_EMPTY: Final = bytes(STATE_BYTES)
_FIELDS: Final = (  # of the header, behind the version
    Field("counter", "u8", 1),
    Field("stage", "u8", 2),
    Field("started", "u8", 3),
    Field("ego_ms", "f64", 4),
    Field("t_ms", "i64", 12),
    Field("warned_ms", "u32", 20),
    Field("clear_ms", "u32", 24),
    Field("still_ms", "u32", 28),
    Field("blind_ms", "u32", 32),
)
_TRACK_FIELDS: Final = (
    Field("hits", "u8", 0),
    Field("misses", "u8", 1),
    Field("range_m", "f64", 2),
    Field("speed_ms", "f64", 10),
    Field("acceleration_ms2", "f64", 18),
)
_FREE: Final = bytes(_TRACK.size)


class AebFunction:
    """The application. `execute` is the only thing that changes it; see the module's theory."""

    characteristics = Characteristics()
    fields: tuple[Field, ...] = (
        *_FIELDS,
        *(
            Field(f"track{slot}.{field.name}", field.kind, offset + field.offset_bytes)
            for slot, offset in enumerate(_OFFSETS)
            for field in _TRACK_FIELDS
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
        elapsed_ms = self._advance(cycle)
        if cycle.ego_valid and cycle.radar_valid:
            self._blind_ms = 0
            self._measure(cycle.targets, elapsed_ms / 1000)
            threat = worst(self._tracks, self._ego_ms)
            self._decide(threat, elapsed_ms)
        else:
            threat = self._coast(elapsed_ms)
        counter, stage = self._counter, self._stage
        self._counter = (counter + 1) % COUNTER_COUNT
        if threat is None:
            return encode_reply(AebOutput(stage, DEMAND_MS2[stage], None, None, counter))
        return encode_reply(AebOutput(stage, DEMAND_MS2[stage], threat.ttc_s, threat.slot, counter))

    def capture(self) -> bytes:
        """The whole state, `STATE_BYTES` long."""
        state = bytearray(_EMPTY)
        _HEADER.pack_into(
            state,
            0,
            VERSION,
            self._counter,
            self._stage,
            self._started,
            self._ego_ms,
            self._t_ms,
            self._warned_ms,
            self._clear_ms,
            self._still_ms,
            self._blind_ms,
        )
        for slot, track in self._tracks.items():
            _TRACK.pack_into(
                state,
                _OFFSETS[slot],
                track.hits,
                track.misses,
                track.range_m,
                track.speed_ms,
                track.acceleration_ms2,
            )
        return bytes(state)

    def restore(self, state: bytes) -> None:
        """Become what `capture` saw. Raises PeerError, with nothing changed, if `state` is not one."""
        if len(state) != STATE_BYTES:
            raise PeerError(f"state of {len(state)} bytes, expected {STATE_BYTES}")
        version, counter, stage, started, ego_ms, t_ms, *timers = _HEADER.unpack_from(state)
        if version != VERSION:
            raise PeerError(f"state of version {version}, expected {VERSION}")
        if counter >= COUNTER_COUNT or stage > STAGE_FULL or started > 1:
            raise PeerError(f"state with counter {counter}, stage {stage}, started {started}")
        if not (0.0 <= ego_ms <= SPEED_MAX_MS and 0 <= t_ms <= T_MS_MAX and max(timers) <= TIMER_MAX_MS):
            raise PeerError(f"state with ego speed {ego_ms} m/s, time {t_ms} ms, timers {timers} ms")
        tracks = _unpack_tracks(state)
        self._counter, self._stage, self._started = counter, stage, bool(started)
        self._ego_ms, self._t_ms, self._tracks = ego_ms, t_ms, tracks
        self._warned_ms, self._clear_ms, self._still_ms, self._blind_ms = timers

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        """The executable assertion: true of every reply of this function, to whatever came before `request`.

        Of the bits of replies in sample drives it notices 96 % flipped where there is no threat, 64 % where
        there is one, and in both every one that changes what the brakes are asked for. What it cannot
        notice takes the state to know: the fraction of the time to collision, the counter, and which of
        NONE and WARN it is where both can be.
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

    def _advance(self, cycle: AebInput) -> int:
        """Milliseconds since the last request; 0, with all tracks dropped, where that means nothing."""
        elapsed_ms = cycle.t_ms - self._t_ms
        if not (self._started and 0 <= elapsed_ms <= GAP_MS):
            self._tracks = {}
            elapsed_ms = 0
        self._t_ms, self._started = cycle.t_ms, True
        if cycle.ego_valid:
            self._ego_ms = cycle.ego_speed_ms
        return elapsed_ms

    def _measure(self, targets: tuple[AebTarget, ...], elapsed_s: float) -> None:
        """Move all tracks on: correct those that were seen, begin those that are new, coast the others."""
        tracks, ego_ms = self._tracks, self._ego_ms
        for target in targets:
            track = tracks.get(target.slot)
            if track is None:
                tracks[target.slot] = Track(1, 0, target.range_m, ego_ms + target.rel_speed_ms)
            else:
                track.hit(target, ego_ms, elapsed_s)
        if len(tracks) > len(targets):  # every target has its track by now, and no slot comes twice
            self._miss({target.slot for target in targets}, elapsed_s)

    def _miss(self, seen: Set[int], elapsed_s: float) -> None:
        """Coast the tracks that were not seen, and drop those that have not been for too long."""
        for slot in [slot for slot in self._tracks if slot not in seen]:
            if not self._tracks[slot].miss(self._ego_ms, elapsed_s):
                del self._tracks[slot]

    def _coast(self, elapsed_ms: int) -> Threat | None:
        """A blind cycle: the stage is held, for at most `BLIND_MS`. Returns the threat for the record."""
        self._blind_ms = _later(self._blind_ms, elapsed_ms)
        self._miss(frozenset(), elapsed_ms / 1000)
        if self._blind_ms > BLIND_MS:
            self._rest()
        return worst(self._tracks, self._ego_ms)

    def _decide(self, threat: Threat | None, elapsed_ms: int) -> None:
        """Raise the stage as the threat asks; end it when the threat is gone, or the ego has stood."""
        still = self._ego_ms <= STILL_SPEED_MS
        self._still_ms = _later(self._still_ms, elapsed_ms) if still else 0
        self._warned_ms = _later(self._warned_ms, elapsed_ms) if self._stage else 0
        persists = threat is not None and threat.persists()
        self._clear_ms = 0 if persists else _later(self._clear_ms, elapsed_ms)
        if self._still_ms > STILL_MS or (not (still or persists) and self._gone()):
            self._rest()
        elif threat is not None and persists and not still:
            self._stage = max(self._stage, self._allowed(threat))

    def _gone(self) -> bool:
        """True if nothing has been a threat for long enough; longer, where no track is left to show it."""
        if self._clear_ms <= CLEAR_MS:
            return False
        if self._clear_ms > LOST_MS:
            return True
        return any(track.hits >= HITS_CONFIRMED for track in self._tracks.values())

    def _allowed(self, threat: Threat) -> int:
        """The stage that the threat calls for, or less while the warning has not lasted long enough."""
        stage = threat.stage()
        if stage == STAGE_FULL and self._warned_ms < WARNED_MS and not threat.pressing():
            return STAGE_PARTIAL
        return stage

    def _rest(self) -> None:
        self._stage, self._warned_ms = STAGE_NONE, 0


def _plausible(cycle: AebInput, output: AebOutput) -> bool:
    """Whether some track can have led to `output`: one that `cycle` has seen, or one that is coasting."""
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


def _later(timer_ms: int, elapsed_ms: int) -> int:
    later_ms = timer_ms + elapsed_ms
    return later_ms if later_ms < TIMER_MAX_MS else TIMER_MAX_MS


def _unpack_tracks(state: bytes) -> dict[int, Track]:
    """The tracks of a state, by slot. Raises PeerError on values that no execution can reach.

    A free slot is zero to the bit, or what is captured next would not be this state.
    """
    tracks: dict[int, Track] = {}
    for slot, offset in enumerate(_OFFSETS):
        if state[offset : offset + _TRACK.size] != _FREE:
            tracks[slot] = Track(*_TRACK.unpack_from(state, offset))
            if not tracks[slot].plausible():
                raise PeerError(f"state with {tracks[slot]} in slot {slot}")
    return tracks


def default_application() -> Application:
    """A new instance of the function, as every replica starts it."""
    return AebFunction()


SAMPLE_CYCLE_MS: Final = 20
SAMPLE_LIMIT_MS2: Final = 6.0


def sample_requests(seed: int, count: int) -> list[bytes]:
    """`count` radar cycles of 20 ms for load and benches: approaches to a car ahead, one after the other.

    In each, the ego closes in on a slower or standing car, brakes late and steadily down to its speed,
    follows for a second, and meets the next one. Nothing is fed back: the same seed gives the same bytes.
    """
    random = Random(seed)
    requests: list[bytes] = []
    while len(requests) < count:
        requests += _sample_approach(random, len(requests) * SAMPLE_CYCLE_MS)
    return requests[:count]


def _sample_approach(random: Random, start_ms: int) -> list[bytes]:
    """One approach, from a random speed and gap to a second of following."""
    ego_ms, lead_ms = random.uniform(8.0, 17.0), random.choice((0.0, 0.0, random.uniform(2.0, 7.0)))
    gap_m = random.uniform(3.0, 4.5) * (ego_ms - lead_ms)
    cycle_s = SAMPLE_CYCLE_MS / 1000
    requests: list[bytes] = []
    following = 0
    while following * SAMPLE_CYCLE_MS < 1000:
        targets = _sample_targets(random, gap_m, lead_ms - ego_ms, not requests)
        t_ms = start_ms + len(requests) * SAMPLE_CYCLE_MS
        requests.append(encode_request(AebInput(t_ms, ego_ms, True, True, targets)))
        closing_ms = ego_ms - lead_ms
        gap_m -= closing_ms * cycle_s
        if closing_ms * closing_ms >= 2.0 * SAMPLE_LIMIT_MS2 * max(0.1, gap_m - 3.0):
            ego_ms = max(lead_ms, ego_ms - SAMPLE_LIMIT_MS2 * cycle_s)
        following += closing_ms <= 0.0 or gap_m < 1.0
    return requests


def _sample_targets(random: Random, gap_m: float, rel_ms: float, new: bool) -> tuple[AebTarget, ...]:
    """The car ahead and, farther away, the one before it, both with a radar's noise."""
    near = AebTarget(0, max(0.0, gap_m + random.uniform(-0.1, 0.1)), rel_ms + random.uniform(-0.1, 0.1), new)
    far = AebTarget(1, gap_m + 20.0 + random.uniform(-0.1, 0.1), rel_ms + random.uniform(-0.1, 0.1), new)
    return (near, far)
