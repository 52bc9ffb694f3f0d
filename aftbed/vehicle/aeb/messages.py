"""What goes into the protected function and what comes out of it: the payloads of request and reply.

A request is one radar cycle, a reply is one braking demand. Both are MessagePack arrays without field
names, because they lie on the measured path. To the mechanism that carries them they are opaque bytes;
`decode_request` and `decode_reply` check a whole payload before any of it is used.

A function that is no Python class is asked in a fixed layout instead, little-endian without gaps, and may
answer with a deceleration alone:

| request        | type | means                                                       |
|----------------|------|-------------------------------------------------------------|
| layout         | u8   | 1: no MessagePack array begins so                           |
| t_ms           | u64  | bus time                                                    |
| ego_speed_ms   | f64  |                                                             |
| ego_valid      | u8   | 0: the speed is not known                                   |
| radar_valid    | u8   | 0: not known whether there are targets                      |
| target         | u8   | 1: there is one; of several it is the nearest               |
| range_m        | f64  | of the target, or 0                                         |
| rel_speed_ms   | f64  | of the target, or 0; negative: closing                      |

| reply          | f64  | the deceleration in m/s2, 0 to 12; full braking from 6 on   |
"""

from collections.abc import Callable
from struct import Struct
from typing import Final

import msgspec

from aftbed.core.errors import PeerError

SLOTS: Final = 16
COUNTER_COUNT: Final = 15  # E2E profile 11: 0 to 14
STAGE_NONE, STAGE_WARN, STAGE_PARTIAL, STAGE_FULL = range(4)

T_MS_MAX: Final = 2**40
SPEED_MAX_MS: Final = 150.0
RANGE_MAX_M: Final = 1000.0
DEMAND_MAX_MS2: Final = 12.0
REQUEST_BYTES_MAX: Final = 1024
REPLY_BYTES_MAX: Final = 64
FULL_FROM_MS2: Final = 6.0  # a demand in the fixed layout that is at least this is full braking


class AebTarget(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True, gc=False):
    """A target in our path: radar slot 0 to 15, range in m, relative speed in m/s (negative: closing)."""

    slot: int
    range_m: float
    rel_speed_ms: float
    new: bool = False


class AebInput(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True, gc=False):
    """One radar cycle: bus time in ms, ego speed in m/s, the targets in our path.

    Not valid means unknown. An unknown radar is not an empty road, nor an unknown speed a standing car.
    """

    t_ms: int
    ego_speed_ms: float
    ego_valid: bool
    radar_valid: bool
    targets: tuple[AebTarget, ...]


class AebOutput(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True, gc=False):
    """What the brakes are asked for; `ttc_s` and `slot` are those of the worst threat, None without one.

    `counter` is the E2E counter of the frame that this reply becomes. It is part of the function's state, so
    that a failover neither skips nor repeats one; None in the fixed layout: the gateway counts.
    """

    stage: int
    deceleration_ms2: float
    ttc_s: float | None
    slot: int | None
    counter: int | None


class Sight(msgspec.Struct, frozen=True):
    """What the function sees in one radar cycle, and asks of the brakes: for people.

    None is unknown, or there is none. `range_m` is that of the nearest of the `targets`, `ttc_s` that of the
    worst.
    """

    t_ms: int
    speed_ms: float | None
    targets: int | None
    range_m: float | None
    ttc_s: float | None
    stage: int
    deceleration_ms2: float


def sight_of(cycle: AebInput, stage: int, deceleration_ms2: float) -> Sight:
    targets = cycle.targets
    times_s = (one.range_m / -one.rel_speed_ms for one in targets if one.rel_speed_ms < 0)
    return Sight(
        t_ms=cycle.t_ms,
        speed_ms=cycle.ego_speed_ms if cycle.ego_valid else None,
        targets=len(targets) if cycle.radar_valid else None,
        range_m=min((one.range_m for one in targets), default=None),
        ttc_s=min(times_s, default=None),
        stage=stage,
        deceleration_ms2=deceleration_ms2,
    )


FIXED_LAYOUT: Final = 1
FIXED_REQUEST: Final = Struct("<BQdBBBdd")
FIXED_REPLY: Final = Struct("<d")
EncodeRequest = Callable[[AebInput], bytes]

_encode = msgspec.msgpack.Encoder().encode
_decode_request = msgspec.msgpack.Decoder(AebInput).decode
_decode_reply = msgspec.msgpack.Decoder(AebOutput).decode


def encode_request(cycle: AebInput) -> bytes:
    return _encode(cycle)


def encode_reply(output: AebOutput) -> bytes:
    return _encode(output)


def encode_fixed(cycle: AebInput) -> bytes:
    """In the fixed layout."""
    nearest = min(cycle.targets, key=lambda target: target.range_m, default=None)
    seen = (0, 0.0, 0.0) if nearest is None else (1, nearest.range_m, nearest.rel_speed_ms)
    return FIXED_REQUEST.pack(
        FIXED_LAYOUT, cycle.t_ms, cycle.ego_speed_ms, cycle.ego_valid, cycle.radar_valid, *seen
    )


def _decode_fixed(request: bytes) -> AebInput:
    _, t_ms, speed_ms, ego_valid, radar_valid, target, range_m, rel_speed_ms = FIXED_REQUEST.unpack(request)
    targets = (AebTarget(0, range_m, rel_speed_ms),) if target else ()
    return AebInput(t_ms, speed_ms, bool(ego_valid), bool(radar_valid), targets)


def decode_request(request: bytes) -> AebInput:
    """`request` as a struct. Raises PeerError on anything that is not one radar cycle."""
    if len(request) > REQUEST_BYTES_MAX:
        raise PeerError(f"request of {len(request)} bytes, allowed are {REQUEST_BYTES_MAX}")
    try:
        fixed = len(request) == FIXED_REQUEST.size and request[0] == FIXED_LAYOUT
        cycle = _decode_fixed(request) if fixed else _decode_request(request)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise PeerError(f"not a radar cycle: {error}") from error
    # A comparison with NaN is false: written this way round, the ranges refuse it too.
    if not 0 <= cycle.t_ms <= T_MS_MAX:
        raise PeerError(f"t_ms {cycle.t_ms}, allowed is 0 to {T_MS_MAX}")
    if not 0.0 <= cycle.ego_speed_ms <= SPEED_MAX_MS:
        raise PeerError(f"ego_speed_ms {cycle.ego_speed_ms}, allowed is 0 to {SPEED_MAX_MS}")
    _check_targets(cycle.targets)
    return cycle


def decode_reply(reply: bytes) -> AebOutput:
    """`reply` as a struct. Raises PeerError on anything that is not a braking demand."""
    if len(reply) > REPLY_BYTES_MAX:
        raise PeerError(f"reply of {len(reply)} bytes, allowed are {REPLY_BYTES_MAX}")
    if len(reply) == FIXED_REPLY.size:  # MessagePack takes 14 bytes at least
        (demand_ms2,) = FIXED_REPLY.unpack(reply)
        stage = STAGE_FULL if demand_ms2 >= FULL_FROM_MS2 else STAGE_PARTIAL if demand_ms2 > 0 else STAGE_NONE
        if not 0.0 <= demand_ms2 <= DEMAND_MAX_MS2:
            raise PeerError(f"{demand_ms2} m/s2, allowed is 0 to {DEMAND_MAX_MS2}")
        return AebOutput(stage, demand_ms2, None, None, None)
    try:
        output = _decode_reply(reply)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise PeerError(f"not a braking demand: {error}") from error
    if not (STAGE_NONE <= output.stage <= STAGE_FULL and 0.0 <= output.deceleration_ms2 <= DEMAND_MAX_MS2):
        raise PeerError(f"stage {output.stage} with {output.deceleration_ms2} m/s2")
    if output.counter is None or not 0 <= output.counter < COUNTER_COUNT:
        raise PeerError(f"counter {output.counter}, allowed is 0 to {COUNTER_COUNT - 1}")
    if output.slot is not None and not 0 <= output.slot < SLOTS:
        raise PeerError(f"slot {output.slot}, allowed is 0 to {SLOTS - 1}")
    if output.ttc_s is not None and not output.ttc_s >= 0.0:
        raise PeerError(f"ttc_s {output.ttc_s}, allowed is 0 or more")
    return output


def _check_targets(targets: tuple[AebTarget, ...]) -> None:
    seen = 0
    for target in targets:
        if not 0 <= target.slot < SLOTS or seen >> target.slot & 1:
            raise PeerError(f"slot {target.slot}, allowed is 0 to {SLOTS - 1}, each once")
        if not 0.0 <= target.range_m <= RANGE_MAX_M:
            raise PeerError(f"range_m {target.range_m}, allowed is 0 to {RANGE_MAX_M}")
        if not -SPEED_MAX_MS <= target.rel_speed_ms <= SPEED_MAX_MS:
            raise PeerError(f"rel_speed_ms {target.rel_speed_ms}, allowed is +-{SPEED_MAX_MS}")
        seen |= 1 << target.slot
