"""A map tried out on a log: how many of its frames are accepted, and what they say."""

from collections.abc import Iterable, Sequence
from typing import Final

import msgspec

from aftbed.vehicle.aeb.messages import AebInput, decode_request
from aftbed.vehicle.can.dbc_file import own_dbc
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.plant import KMH_PER_MS
from aftbed.vehicle.replay.map_file import BoundMap
from aftbed.vehicle.replay.mapped_gateway import MappedGateway

CYCLES_SHOWN: Final = 5

Span = tuple[float, float]


class CycleSeen(msgspec.Struct, frozen=True):
    """One radar cycle; the targets in our path by distance in metres and relative speed in m/s."""

    t_s: float
    ego_kmh: float | None
    targets: tuple[tuple[float, float], ...]


class Decoded(msgspec.Struct, frozen=True):
    """What a map makes of a log. Spans are the least and the greatest, over all cycles; None: there is none.

    `targets` is the most in one cycle; `with_targets` and `with_ego` count cycles; `shown` are a few of them.
    """

    frames: int
    accepted: int
    ignored: int
    refused: dict[str, int]
    cycles: int
    with_ego: int
    with_targets: int
    targets: int
    ego_kmh: Span | None
    range_m: Span | None
    relative_speed_ms: Span | None
    shown: tuple[CycleSeen, ...]

    def problems(self) -> list[str]:
        """What is wrong with the map, as far as this log tells."""
        found = []
        if not self.accepted:
            found.append("no frame of the log is one of the map's messages")
        elif not self.cycles:
            found.append("no radar cycle ends in the log: nothing is asked of the function")
        else:
            if not self.with_ego:
                found.append("no cycle knows the ego's speed")
            if not self.with_targets:
                found.append("no cycle has a target in our path")
        return found


def try_out(bound: BoundMap, frames: Sequence[Frame]) -> Decoded:
    """Read the frames by the map, as a run would."""
    gateway = MappedGateway(own_dbc(), bound)
    start_us = frames[0].t_us if frames else 0
    cycles = []
    for frame in frames:
        made = gateway.on_frame(Frame(frame.t_us - start_us, frame.can_id, frame.data))
        if made is not None:
            cycles.append(decode_request(made))
    counts = gateway.counts
    targets = [target for cycle in cycles for target in cycle.targets]
    return Decoded(
        len(frames),
        counts.accepted,
        counts.ignored,
        dict(counts.refused),
        len(cycles),
        sum(cycle.ego_valid for cycle in cycles),
        sum(bool(cycle.targets) for cycle in cycles),
        max((len(cycle.targets) for cycle in cycles), default=0),
        _span(cycle.ego_speed_ms * KMH_PER_MS for cycle in cycles if cycle.ego_valid),
        _span(target.range_m for target in targets),
        _span(target.rel_speed_ms for target in targets),
        tuple(_seen(cycle) for cycle in _spread([c for c in cycles if c.targets] or cycles)),
    )


def _span(values: Iterable[float]) -> Span | None:
    found = [round(value, 3) for value in values]
    return (min(found), max(found)) if found else None


def _spread(cycles: list[AebInput]) -> list[AebInput]:
    """At most `CYCLES_SHOWN` of them, from the first to the last."""
    step = max(1, -(-(len(cycles) - 1) // (CYCLES_SHOWN - 1)))
    return cycles[::step]


def _seen(cycle: AebInput) -> CycleSeen:
    nearest = sorted(cycle.targets, key=lambda target: target.range_m)
    return CycleSeen(
        cycle.t_ms / 1000,
        round(cycle.ego_speed_ms * KMH_PER_MS, 1) if cycle.ego_valid else None,
        tuple((round(one.range_m, 2), round(one.rel_speed_ms, 2)) for one in nearest),
    )
