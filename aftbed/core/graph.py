"""The graph: which bricks there are, how their ports are linked, and which share a node. As data.

A brick is named by its replica and its part (`a/protocol`), or by its part alone where it belongs to
no replica (`proxy`). A link is one-way and has two ends, `brick:port`; it is called by the port names
of the paper (`pxy2pro`, ...). A *standby* link exists and is bound at the replica, while its other end
is kept by the runtime: the way between the Proxy and the backup.
"""

from collections import Counter
from typing import Final

import msgspec

PLACEMENTS: Final = ("process", "replica", "single")
End = tuple[str, str, str]  # brick, port, side: one port name may be both an input and an output
LinkKey = tuple[str, str, str, str]
STAGED: Final = "'"  # behind the name of a process that is to become that node, or was it before


class Kind(msgspec.Struct, frozen=True):
    """What the graph must know of a kind of brick: its ports, and which of them may stay unbound."""

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    optional: tuple[str, ...] = ()


class BrickSpec(msgspec.Struct, frozen=True):
    """A brick in the graph: `name` is unique, `kind` names an entry of the catalog.

    `source` names a class that takes the place of the catalog's own, written off line (`MODULE:CLASS`
    or `FILE.py:CLASS`); `application` one that takes the place of the function that a Server protects.
    """

    name: str
    kind: str
    source: str = ""
    application: str = ""

    @property
    def replica(self) -> str | None:
        """`a` or `b`, or None for a brick outside of the replicas."""
        head, slash, _ = self.name.partition("/")
        return head if slash else None

    @property
    def part(self) -> str:
        """The name without the replica."""
        return self.name.rpartition("/")[2]


class Link(msgspec.Struct, frozen=True):
    """A one-way channel from an output port to an input port."""

    source: str
    source_port: str
    sink: str
    sink_port: str
    standby: bool = False

    @property
    def name(self) -> str:
        """As in the paper: the port at its source."""
        return self.source_port

    @property
    def key(self) -> LinkKey:
        """What it links, on standby or not."""
        return self.source, self.source_port, self.sink, self.sink_port

    @property
    def ends(self) -> tuple[End, End]:
        """Both ends, the source first."""
        return (self.source, self.source_port, "out"), (self.sink, self.sink_port, "in")


class Graph(msgspec.Struct, frozen=True):
    """`nodes` maps the name of a node to the bricks that it hosts."""

    ftm: str
    placement: str
    bricks: tuple[BrickSpec, ...]
    links: tuple[Link, ...]
    nodes: dict[str, tuple[str, ...]]

    def brick(self, name: str) -> BrickSpec:
        """The brick called `name`; KeyError if there is none."""
        for spec in self.bricks:
            if spec.name == name:
                return spec
        raise KeyError(name)

    def node_of(self, brick: str) -> str:
        """The node that hosts `brick`; KeyError if there is none."""
        for node, hosted in self.nodes.items():
            if brick in hosted:
                return node
        raise KeyError(brick)

    def led_by(self, leader: str) -> "Graph":
        """The same with `leader` leading: where the Proxy is bound to, and which way replication goes."""
        specs = {b.name: b for b in self.bricks}

        def turned(link: Link) -> Link:
            source, sink = specs[link.source].replica, specs[link.sink].replica
            if source and sink and source not in (sink, leader):
                return Link(link.sink, link.source_port, link.source, link.sink_port)
            if "proxy" in (link.source, link.sink) and (source or sink):
                return msgspec.structs.replace(link, standby=(source or sink) != leader)
            return link

        return msgspec.structs.replace(self, links=tuple(turned(k) for k in self.links))

    def problems(self, kinds: dict[str, Kind]) -> list[str]:
        """Every reason to refuse this graph, or []."""
        times = Counter(b.name for b in self.bricks)
        found = [f"two bricks are called {name}" for name, n in times.items() if n > 1]
        found += [f"{b.name}: no such kind of brick: {b.kind}" for b in self.bricks if b.kind not in kinds]
        if found:
            return found
        sides = {b.name: {"out": kinds[b.kind].outputs, "in": kinds[b.kind].inputs} for b in self.bricks}
        for link in self.links:
            for brick, port, side in link.ends:
                if brick not in sides:
                    found.append(f"{link.name}: no brick is called {brick}")
                elif port not in sides[brick][side]:
                    found.append(f"{link.name}: {brick} has no {side}put port {port}")

        bound = Counter(end for k in self.links if not k.standby for end in k.ends)
        standby = {end for k in self.links if k.standby for end in k.ends}
        found += [f"{b}:{p} is bound {n} times" for (b, p, _), n in bound.items() if n > 1]
        found += [
            f"{b.name}:{port} is not bound"
            for b in self.bricks
            for side, ports in sides[b.name].items()
            for port in ports
            if port not in kinds[b.kind].optional
            and not bound[b.name, port, side]
            and (b.name, port, side) not in standby
        ]

        hosted = Counter(brick for bricks in self.nodes.values() for brick in bricks)
        found += [f"{name} is hosted by {hosted[name]} nodes" for name in sorted(sides) if hosted[name] != 1]
        return found + [
            f"a node hosts {name}, which is not a brick" for name in sorted(hosted.keys() - sides)
        ]
