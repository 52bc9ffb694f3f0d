"""What `aftbed bench paper` ends with: one document, of which terminal, markdown, page and JSON are made."""

import msgspec

from aftbed.bench.placements import Loaded, Placed, Times
from aftbed.bench.published import Published
from aftbed.bench.road import OnRoad, on_road
from aftbed.bench.sweep import Sized
from aftbed.campaign.ledger import Environment


class Figure(msgspec.Struct, frozen=True):
    """One time. `ratio` is its p50 in rounds of the bare ring; `road` has the p50 and the p99 of ours,
    and is None of a time in which the service goes on."""

    name: str
    what: str
    samples: int
    ours_ms: Times
    ring_us: float
    ratio: float
    road: tuple[OnRoad, OnRoad] | None
    paper: Published | None = None
    paper_road: tuple[OnRoad, OnRoad] | None = None
    note: str = ""


class Count(msgspec.Struct, frozen=True):
    """Processes of a graph, the supervisor in the place of the ROS master."""

    ftm: str
    placement: str
    ours: int
    paper: int | None


class Paper(msgspec.Struct, frozen=True):
    """The whole document."""

    title: str
    source: str
    their_machine: str
    environment: Environment
    quick: bool
    seconds: float
    speed_kmh: float
    deceleration_ms2: float
    rospy_cycle_ms: float
    figures: tuple[Figure, ...]
    processes: tuple[Count, ...]
    placements: tuple[Placed, ...]
    state: tuple[Sized, ...]
    load: tuple[Loaded, ...]
    notes: tuple[str, ...]


def figure(
    name: str,
    what: str,
    ours_ms: Times,
    samples: int,
    ring_us: float,
    paper: Published | None = None,
    note: str = "",
    *,
    served: bool = False,
) -> Figure:
    """A row, with what follows from its times; `served`: the service goes on meanwhile."""
    return Figure(
        name,
        what,
        samples,
        ours_ms,
        ring_us,
        round(ours_ms.p50 * 1e3 / ring_us, 2),
        None if served else (on_road(ours_ms.p50), on_road(ours_ms.p99)),
        paper,
        (on_road(paper.low), on_road(paper.high)) if paper else None,
        note,
    )
