"""A made-up document of `aftbed bench paper`, for tests of what is made of it."""

from aftbed.bench.cycle import CycleResult
from aftbed.bench.paper import (
    CYCLE_PBR,
    Paper,
    PlacementResult,
    ProcessCount,
    PublishedFigure,
    figure,
)
from aftbed.bench.resources import LoadResult, Usage
from aftbed.bench.rounds import Meanwhile, beside_limit
from aftbed.bench.runs import percentiles
from aftbed.bench.sweep import StateResult
from aftbed.campaign.ledger import Environment

USAGE = Usage(1.0, 17, 6, 13.15, 83.4, 7, 0.5, 26.6)
TIMES = percentiles([0.1, 0.2, 0.4])
RING, OURS = percentiles([75.0, 76.0, 90.0]), percentiles([100.0, 110.0, 180.0])
BESIDE = beside_limit("bare ring of 12 hops", [[100.0, 110.0, 180.0]], [[75.0, 76.0, 90.0]], 1)
CYCLE = CycleResult(
    "pbr",
    "process",
    3,
    OURS,
    RING,
    12,
    1.4,
    (1.4,),
    limit=BESIDE.limit,
    ratio=BESIDE.ratio,
    machine=Meanwhile(1.0, 0.0, 50.0, 100.0, 0.1, None, None),
)

STILL = PublishedFigure(300, 300, "still")


def made_up(note: str = "", refused: str = "too large") -> Paper:
    """One row of each kind, the second of some."""
    return Paper(
        title="Title",
        source="place, id",
        their_machine="slow",
        environment=Environment("CPython 3", "Linux 6", "2 of 2, fast", "aftbed bench paper"),
        quick=True,
        seconds=12.4,
        speed_kmh=50.0,
        deceleration_ms2=8.83,
        rospy_cycle_ms=0.6,
        figures=(
            figure("cycle.pbr", "cycle of pbr", TIMES, 3, 75.0, CYCLE_PBR),
            figure("start", "start", percentiles([408.0]), 1, 75.0, note=note),
            figure(
                "whole",
                "whole",
                percentiles([130.0]),
                1,
                75.0,
                PublishedFigure(300, 300, "still"),
                served=True,
            ),
        ),
        processes=(ProcessCount("pbr", "process", 17, 17), ProcessCount("pbr", "replica", 9, None)),
        placements=(PlacementResult("process", True, CYCLE, USAGE, USAGE),),
        state=(
            StateResult("pbr", 100, 900, percentiles([110.0, 120.0]), 75.0, 2, TIMES, TIMES),
            StateResult("pbr", 60_000, 900, percentiles([310.0, 320.0]), 75.0, 2, TIMES, TIMES),
            StateResult("pbr", 10_000_000, refused=refused),
        ),
        load=(
            LoadResult("pbr", "process", 10.0, 30, 10.0, TIMES, 75.0, USAGE),
            LoadResult("pbr", "process", 2000.0, 6000, 1999.7, TIMES, 75.0, USAGE),
        ),
        notes=("something is missing",),
    )
