"""From an FTM expression to a graph: `pbr` in placement `process` is the paper's graph (III-A).

An expression names mechanisms, the outermost first: `pbr+tr`. One rule holds for any depth: **the inner
mechanism's Protocol-Before-Proceed-After stands where the outer one's Proceed stood**. The bricks of an inner
mechanism carry its name: `a/tr.before`.

A mechanism that replicates can only be outermost, one that repeats the computation only innermost. The
paper's 17 processes of a duplex (23 when composed) are the nodes made here and the supervisor, which has
the place of the ROS master.
"""

import itertools
from functools import cache
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.graph import PLACEMENTS, BrickSpec, Graph, Link
from aftbed.ftm import registry
from aftbed.ftm.declaration import FaultClass
from aftbed.ftm.registry import BRICKS, ENGINE, KINDS, MECHANISMS, SHIPPED

REPLICAS: Final = ("a", "b")
NONE: Final = "none"
DUPLEX: Final = tuple(name for name in SHIPPED if MECHANISMS[name].replication)
SIMPLEX: Final = tuple(name for name in SHIPPED if not MECHANISMS[name].replication)
STATEFUL: Final = ("protocol", "server")  # the parts whose state a new backup needs
ONWARD: Final = ("pro2bfr", "bfr2prd", "prd2aft", "pro2pxy")  # the way of a request, the nearest first


def parse(expression: str) -> tuple[str, ...]:
    """The names of the mechanisms in `expression`, the outermost first; () for `none`. `PBR` is `pbr`.

    Raises ConfigError on an unknown name and on an order that makes no sense.
    """
    expression = expression.lower()
    if expression == NONE:
        return ()
    names = tuple(name.strip() for name in expression.split("+"))
    if "," in expression:
        meant = "+".join(name.strip() for name in expression.split(","))
        raise ConfigError(f"FTM {expression!r}: mechanisms are joined by '+', as {meant!r}")
    for name in names:
        if registry.find(name) is None:
            raise unknown("FTM", name, (NONE, *registry.names()))
    for index, name in enumerate(names):
        if replicates(name) and index > 0:
            meant = "+".join((name, *(n for n in names if not replicates(n))))
            raise ConfigError(f"{expression}: {name} replicates, so it can only be outermost ({meant}?)")
        if MECHANISMS[name].innermost and index < len(names) - 1:
            meant = "+".join((*(n for n in names if n != name), name))
            raise ConfigError(
                f"{expression}: {name} repeats the computation itself, so it can only be innermost ({meant}?)"
            )
        if name in names[:index]:
            raise ConfigError(f"{expression}: {name} within {name} adds nothing")
    return names


def canonical(expression: str) -> str:
    """The expression as it is named everywhere. Raises ConfigError as `parse` does."""
    return "+".join(parse(expression)) or NONE


def replicates(name: str) -> bool:
    """Whether the mechanism `name`, which `parse` has found, sends to a second replica."""
    return bool(MECHANISMS[name].replication)


def _expressions(mechanisms: tuple[str, ...]) -> tuple[str, ...]:
    """Every expression of one or two mechanisms that makes sense and is listed, `none` first."""
    duplex = [name for name in mechanisms if replicates(name)]
    simplex = [name for name in mechanisms if not replicates(name)]
    pairs = (f"{outer}+{inner}" for outer, inner in itertools.product(mechanisms, simplex))
    return (NONE, *duplex, *simplex, *filter(is_listed, pairs))


def is_listed(expression: str) -> bool:
    """Whether it is `none`, one mechanism, or a pair that makes sense and is listed.

    Raises ConfigError where a package that declares a mechanism in it cannot be used.
    """
    names = expression.split("+") if expression != NONE else []
    if not all(registry.find(name) for name in names):
        return False
    try:
        parse(expression)
    except ConfigError:
        return False
    return len(names) < 2 or (
        len(names) == 2 and (replicates(names[0]) or all(MECHANISMS[name].combined for name in names))
    )


def chain(graph: Graph, replica: str) -> tuple[str, ...]:
    """The bricks of `replica` that a request meets, in their order, the Server last; no Watchdog.

    The order is read off the links, since an adaptation changes the order of the bricks.
    """
    server = f"{replica}/server"
    bricks = {b.name for b in graph.bricks if b.replica == replica and b.kind != "watchdog"}
    onward = {(k.source, k.source_port): k.sink for k in graph.links}
    found: list[str] = []
    ahead = bricks - {server}

    def visit(brick: str) -> None:
        if brick in ahead:
            ahead.remove(brick)
            found.append(brick)
            for port in ONWARD:
                visit(onward.get((brick, port), server))

    visit(f"{replica}/protocol")
    return (*found, *sorted(ahead), *(bricks & {server}))


def path(graph: Graph, replica: str = REPLICAS[0]) -> list[str]:
    """The bricks that a request and its reply pass, in order; what goes to the backup is left out."""
    if graph.ftm == NONE:
        return ["client", "proxy", f"{replica}/server", "proxy", "client"]
    found = ["client", "proxy"]
    for name in chain(graph, replica)[:-1]:
        found += [name, *[f"{replica}/server", name] * BRICKS[graph.brick(name).kind].asks_server]
        if name.endswith("after"):
            found.append(f"{name.removesuffix('after')}protocol")
    return [*found, "proxy", "client"]


def hops(graph: Graph) -> int:
    """The number of channels between processes that a request and its reply pass."""
    return sum(a != b for a, b in itertools.pairwise(graph.node_of(name) for name in path(graph)))


def _around_each(mechanisms: tuple[str, ...]) -> tuple[str, ...]:
    """Each mechanism that replicates, alone and around each other one."""
    inside = ((), *((name,) for name in mechanisms if not replicates(name)))
    outside = [name for name in mechanisms if replicates(name)]
    return tuple("+".join((outer, *inner)) for inner in inside for outer in outside)


EXPRESSIONS: Final = _expressions(SHIPPED)  # those of our own mechanisms: the same on every machine
DUPLEX_EXPRESSIONS: Final = _around_each(SHIPPED)


def expressions() -> tuple[str, ...]:
    """EXPRESSIONS with those of the mechanisms of installed packages."""
    load_installed()
    return known_expressions()


def known_expressions() -> tuple[str, ...]:
    """EXPRESSIONS with those of the installed mechanisms that were asked for in this process."""
    return EXPRESSIONS if len(MECHANISMS) == len(SHIPPED) else _expressions(_known())


def _known() -> tuple[str, ...]:
    return tuple(name for name in registry.names() if name in MECHANISMS)


def duplex_expressions() -> tuple[str, ...]:
    """DUPLEX_EXPRESSIONS with those of the mechanisms of installed packages."""
    load_installed()
    return _around_each(_known())


@cache
def load_installed() -> tuple[str, ...]:
    """Find the mechanisms of all installed packages; why some cannot be used, a sentence each."""
    found = registry.load_installed()
    for name in registry.installed_mechanisms():
        try:
            build(name, PLACEMENTS[0])
        except ConfigError as error:
            registry.leave_out(name, error)
            found.append(str(error))
    return tuple(found)


def tolerates(expression: str, fault: FaultClass) -> bool:
    """Whether a mechanism in `expression` tolerates `fault` by itself."""
    return any(fault in MECHANISMS[name].suitability.tolerates for name in parse(expression))


def detects(expression: str, fault: FaultClass) -> bool:
    """Whether a mechanism in `expression` stops its replica at `fault`."""
    return any(fault in MECHANISMS[name].suitability.detects for name in parse(expression))


def replication_of(expression: str) -> tuple[tuple[str, str], ...]:
    """The parts and ports by which a leader sends to its backup; () with one replica."""
    names = parse(expression)
    return MECHANISMS[names[0]].replication if names else ()


def build(expression: str, placement: str, leader: str = REPLICAS[0], application: str = "") -> Graph:
    """The graph of `expression`; `leader` leads, and `application` is protected ("": the built-in function).

    Raises ConfigError on an unknown name.
    """
    if placement not in PLACEMENTS:
        raise unknown("placement", placement, PLACEMENTS)
    names = parse(expression)
    graph = _protected(names, placement, leader) if names else _bare(placement)
    if problems := graph.problems(KINDS):
        theirs = [name for name in names if name not in SHIPPED]
        assert theirs, problems
        raise registry.misfit(theirs[0], problems)
    return protecting(graph, application) if application else graph


def protecting(graph: Graph, application: str) -> Graph:
    """`graph` with another function in its Servers, and in the bricks that check replies by its assertion."""

    def brick(spec: BrickSpec) -> BrickSpec:
        concerned = spec.part == "server" or (spec.kind != ENGINE.name and BRICKS[spec.kind].checks_replies)
        return msgspec.structs.replace(spec, application=application) if concerned else spec

    return msgspec.structs.replace(graph, bricks=tuple(map(brick, graph.bricks)))


def protected_by(graph: Graph) -> str:
    """The function that the Servers of `graph` protect, "" for the built-in one."""
    return next(b.application for b in graph.bricks if b.part == "server")


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
    return Graph(NONE, placement, bricks, links, nodes)


def _protected(names: tuple[str, ...], placement: str, leader: str) -> Graph:
    replication = MECHANISMS[names[0]].replication
    follower = next(r for r in REPLICAS if r != leader)
    replicas = REPLICAS if replication else (leader,)
    bricks = [BrickSpec(name, name) for name in ("client", "proxy", "recovery", "engine")]
    bricks += [BrickSpec(f"{replica}/watchdog", "watchdog") for replica in replicas]
    nodes: dict[str, tuple[str, ...]] = {b.name: (b.name,) for b in bricks}
    links = [
        Link("client", "clt2pxy", "proxy", "clt2pxy"),
        Link("proxy", "pxy2clt", "client", "pxy2clt"),
        *(Link(f"{r}/watchdog", "wdg2rec", "recovery", ALARMS[r]) for r in replicas),
        *(Link(f"{leader}/{part}", port, f"{follower}/{part}", port) for part, port in replication),
    ]
    hosted: dict[str, tuple[str, ...]] = {}
    for replica in replicas:
        chain, inside = _stage(names, "", replica)
        chain.append(BrickSpec(f"{replica}/server", "server"))
        bricks += chain
        links += inside
        standby = replica != leader
        links += [
            Link("proxy", "pxy2pro", f"{replica}/protocol", "pxy2pro", standby),
            Link(f"{replica}/protocol", "pro2pxy", "proxy", "pro2pxy", standby),
        ]
        chain_names = tuple(b.name for b in chain)
        hosted |= {n: (n,) for n in chain_names} if placement == "process" else {replica: chain_names}
    if placement == "single":  # both replicas in one node: nothing that a crash would leave over
        hosted = {"single": tuple(name for bricks_of in hosted.values() for name in bricks_of)}
    return Graph("+".join(names), placement, tuple(bricks), tuple(links), nodes | hosted)


ALARMS: Final = {"a": "wdg2rec", "b": "wdg2rec.b"}  # Recovery's port for each replica's Watchdog


def _stage(names: tuple[str, ...], prefix: str, replica: str) -> tuple[list[BrickSpec], list[Link]]:
    """Protocol, Before, Proceed and After of `names[0]`, with the rest of `names` as its Proceed.

    The bricks are in the order of a request; the links are those among them and with the Server.
    """
    row, rest = MECHANISMS[names[0]], names[1:]
    server = f"{replica}/server"

    def brick(part: str) -> str:
        return server if part == "server" else f"{replica}/{prefix}{part}"

    protocol = BrickSpec(brick("protocol"), "inner.protocol" if prefix else "protocol")
    before, after = BrickSpec(brick("before"), row.before.name), BrickSpec(brick("after"), row.after.name)
    links = [Link(protocol.name, "pro2bfr", before.name, "pro2bfr")]
    if rest:
        inner, inner_links = _stage(rest, f"{rest[0]}.", replica)
        links += [
            Link(before.name, "bfr2prd", inner[0].name, "pxy2pro"),
            *inner_links,
            Link(inner[0].name, "pro2pxy", after.name, "prd2aft"),
        ]
    else:
        inner = [BrickSpec(brick("proceed"), row.proceed.name)]
        links += [
            Link(before.name, "bfr2prd", inner[0].name, "bfr2prd"),
            Link(inner[0].name, "prd2srv", server, "prd2srv"),
            Link(server, "srv2prd", inner[0].name, "srv2prd"),
            Link(inner[0].name, "prd2aft", after.name, "prd2aft"),
        ]
    links += [Link(brick(source), port, brick(sink), port) for source, port, sink in row.links]
    links.append(Link(after.name, "aft2pro", protocol.name, "aft2pro"))
    return [protocol, before, *inner, after], links
