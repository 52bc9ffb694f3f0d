"""From an FTM expression to a graph: `pbr` in placement `process` is the paper's graph (III-A).

The paper's 17 processes are the 16 nodes made here and the supervisor, which has the place of the
ROS master.
"""

from typing import Final

import msgspec

from aftbed.core.errors import unknown
from aftbed.core.graph import PLACEMENTS, BrickSpec, Graph, Link
from aftbed.ftm.catalog import KINDS

REPLICAS: Final = ("a", "b")


class Mechanism(msgspec.Struct, frozen=True):
    """The rows of design table "Before | Proceed | After": kinds of bricks for one replica."""

    before: str
    proceed: str
    after: str


MECHANISMS: Final = {"pbr": Mechanism("pass.before", "compute.proceed", "pbr.after")}
EXPRESSIONS: Final = ("none", *MECHANISMS)

_CHAIN: Final = (  # within one replica
    ("protocol", "pro2bfr", "before"),
    ("before", "bfr2prd", "proceed"),
    ("proceed", "prd2srv", "server"),
    ("server", "srv2prd", "proceed"),
    ("proceed", "prd2aft", "after"),
    ("after", "aft2srv", "server"),
    ("server", "srv2aft", "after"),
    ("after", "aft2pro", "protocol"),
)
CHAIN_PARTS: Final = ("protocol", "before", "proceed", "after", "server")


def build(expression: str, placement: str) -> Graph:
    """The graph of `expression`; its first replica leads. Raises ConfigError on an unknown name."""
    if placement not in PLACEMENTS:
        raise unknown("placement", placement, PLACEMENTS)
    if expression not in EXPRESSIONS:
        raise unknown("FTM", expression, EXPRESSIONS)
    graph = _bare(placement) if expression == "none" else _duplex(expression, placement)
    problems = graph.problems(KINDS)
    assert not problems, problems
    return graph


def _bare(placement: str) -> Graph:
    links = (
        Link("client", "clt2pxy", "proxy", "clt2pxy"),
        Link("proxy", "pxy2pro", "a/server", "prd2srv"),
        Link("a/server", "srv2prd", "proxy", "pro2pxy"),
        Link("proxy", "pxy2clt", "client", "pxy2clt"),
    )
    bricks = (
        BrickSpec("client", "client"),
        BrickSpec("proxy", "proxy"),
        BrickSpec("a/server", "bare.server"),
    )
    nodes: dict[str, tuple[str, ...]] = {b.name: (b.name,) for b in bricks}
    return Graph("none", placement, bricks, links, nodes)


def _duplex(expression: str, placement: str) -> Graph:
    mechanism = MECHANISMS[expression]
    singles = [BrickSpec(name, name) for name in ("client", "proxy", "recovery", "engine")]
    singles += [BrickSpec(f"{replica}/watchdog", "watchdog") for replica in REPLICAS]
    bricks = singles
    nodes: dict[str, tuple[str, ...]] = {b.name: (b.name,) for b in singles}
    links = [
        Link("client", "clt2pxy", "proxy", "clt2pxy"),
        Link("proxy", "pxy2clt", "client", "pxy2clt"),
        Link("a/watchdog", "wdg2rec", "recovery", "wdg2rec"),
        Link("b/watchdog", "wdg2rec", "recovery", "wdg2rec.b"),
        Link("a/after", "aft2aft", "b/after", "aft2aft"),
    ]
    for replica in REPLICAS:
        chain = replica_bricks(mechanism, replica)
        bricks = bricks + chain
        links += replica_links(replica, standby=replica != REPLICAS[0])
        names = tuple(b.name for b in chain)
        nodes |= {n: (n,) for n in names} if placement == "process" else {replica: names}
    return Graph(expression, placement, tuple(bricks), tuple(links), nodes)


def replica_bricks(mechanism: Mechanism, replica: str) -> list[BrickSpec]:
    """Protocol, Before, Proceed, After, Server of one replica."""
    kinds = ("protocol", mechanism.before, mechanism.proceed, mechanism.after, "server")
    return [BrickSpec(f"{replica}/{part}", kind) for part, kind in zip(CHAIN_PARTS, kinds, strict=True)]


def replica_links(replica: str, *, standby: bool) -> list[Link]:
    """The links inside one replica, and its two to the Proxy (`standby`: not the Proxy's yet)."""
    links = [Link(f"{replica}/{s}", port, f"{replica}/{k}", port) for s, port, k in _CHAIN]
    return links + [
        Link("proxy", "pxy2pro", f"{replica}/protocol", "pxy2pro", standby),
        Link(f"{replica}/protocol", "pro2pxy", "proxy", "pro2pxy", standby),
    ]
