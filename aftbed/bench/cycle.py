"""Cycle time seen by the client, and the bare ring with as many hops, in turn in the same run."""

import itertools
import os
from typing import Final

from aftbed.bench.ring import ring_us
from aftbed.bench.runs import cycles_us, finish, start
from aftbed.bench.statistics import summary
from aftbed.campaign.statistics import quantile
from aftbed.core.graph import Graph
from aftbed.ftm.compose import NONE, build, chain
from aftbed.ftm.registry import BRICKS
from aftbed.runtime.unix.options import LoadRun
from aftbed.vehicle.aeb.function import sample_requests

ROUNDS: Final = 5
WARM_UP: Final = 200


def path(graph: Graph) -> list[str]:
    """The bricks that a request and its reply meet, in their order; what goes to the backup is beside it."""
    if graph.ftm == NONE:
        return ["client", "proxy", "a/server", "proxy", "client"]
    found = ["client", "proxy"]
    for name in chain(graph, "a")[:-1]:
        found += [name, *["a/server", name] * BRICKS[graph.brick(name).kind].asks_server]
        if name.endswith("after"):
            found.append(f"{name.removesuffix('after')}protocol")
    return [*found, "proxy", "client"]


def hops(graph: Graph) -> int:
    """How many channels between processes a request and its reply pass."""
    return sum(a != b for a, b in itertools.pairwise(graph.node_of(name) for name in path(graph)))


def bench_cycle(
    ftm: str, placement: str, count: int, *, pin: bool = True, rounds: int = ROUNDS
) -> dict[str, object]:
    """`cycle_us{p50,p95,p99,max}, ring_us{...}, hops, ratio_p50`."""
    wanted = hops(build(ftm, placement))
    cpus = sorted(os.sched_getaffinity(0))
    cpu = cpus[0] if pin and len(cpus) > 1 else None
    size = sum(map(len, sample_requests(0, 64))) // 64
    cycles: list[float] = []
    ring: list[float] = []
    ratios: list[float] = []
    for _ in range(rounds):
        share = -(-count // rounds)
        bare = ring_us(wanted, size, share, cpu)
        record = finish(start(ftm, placement, LoadRun(share + WARM_UP, 0.0), pin=pin))
        ours = cycles_us(record, WARM_UP)
        ratios.append(quantile(ours, 0.5) / quantile(bare, 0.5))
        cycles += ours
        ring += bare
    return {
        "ftm": ftm,
        "placement": placement,
        "requests": len(cycles),
        "cycle_us": summary(cycles),
        "ring_us": summary(ring),
        "hops": wanted,
        "ratio_p50": round(quantile(ratios, 0.5), 3),
        "ratio_rounds": [round(r, 3) for r in ratios],
    }
