"""The plan of an adaptation: the difference of two graphs, as a script (paper, III-B).

The smallest set of bricks: a brick that is in both graphs with the same kind stays as it is, where it is. A
node is exchanged if what it hosts changes (in placement `process` a node is a brick, so the set is
smallest; in `replica` and `single` the node is the unit, since its bricks share a fate).

| of the new graph                      | script                                                         |
|---------------------------------------|----------------------------------------------------------------|
| a node that the old one does not have | Stage; its state, if it is a new replica's, by Transfer        |
| a node whose bricks differ            | Stage held, Migrate, Exchange, Resume; Retire in the end       |
| a link at a brick that stays          | Bind, or Unbind where nothing is bound instead                 |
| a node that only the old one has      | Retire                                                         |

All that is slow is in `prepare`. While the client waits: the leader's Protocol is suspended (one request at
a time, so its chain is empty then), the backup is drained, state moves, each node is given its new
channels at once, and the Protocol is resumed.

The paper's recipe (III-B) is here too, as a script of the same kind: SIGSTOP the Protocol, kill, launch,
link, SIGCONT. Nothing is drained, so what is inside is lost.
"""

from collections.abc import Iterable, Iterator
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.graph import PLACEMENTS, BrickSpec, Graph, Link
from aftbed.core.script import (
    RECIPES,
    Align,
    Bind,
    Destroy,
    Drain,
    Exchange,
    Freeze,
    Migrate,
    Resume,
    Retire,
    Script,
    Stage,
    Step,
    Suspend,
    Thaw,
    Together,
    Transfer,
    Unbind,
)
from aftbed.ftm.compose import (
    NONE,
    STATEFUL,
    build,
    chain,
    parse,
    protected_by,
    protecting,
    replication_of,
)

APPLICATION: Final = "app"  # what `adapt update` calls the protected function


class Plan(msgspec.Struct, frozen=True):
    """A script, what it starts from, what it leads to, and what it does as names of bricks."""

    old: Graph
    new: Graph
    script: Script
    replaced: tuple[str, ...]
    added: tuple[str, ...]
    removed: tuple[str, ...]
    kept: tuple[str, ...]
    rebound: tuple[str, ...]  # those of `kept` whose channels change

    @property
    def bricks_changed(self) -> int:
        """How many bricks are made or ended."""
        return len(self.replaced) + len(self.added) + len(self.removed)

    @property
    def bricks_total(self) -> int:
        """How many bricks there are in the larger of both graphs."""
        return max(len(self.old.bricks), len(self.new.bricks))


def leader_of(graph: Graph) -> str:
    """The replica that the Proxy of `graph` is bound to."""
    for link in graph.links:
        if link.source == "proxy" and link.source_port == "pxy2pro" and not link.standby:
            return link.sink.partition("/")[0]
    raise AssertionError("a graph whose Proxy is bound to no replica")


def target(graph: Graph, expression: str) -> Graph:
    """The graph of `expression` in the place of `graph`. Raises ConfigError where there is no way to it."""
    parse(expression)
    if NONE in (graph.ftm, expression):
        raise ConfigError("none has no engine and no Protocol: an adaptation neither starts nor ends there")
    if expression == graph.ftm:
        raise ConfigError(f"{expression} is what runs already")
    new = build(expression, graph.placement, leader_of(graph), protected_by(graph))
    sources = {(b.name, b.kind): b.source for b in graph.bricks}

    def carried_over(spec: BrickSpec) -> BrickSpec:
        return msgspec.structs.replace(spec, source=sources.get((spec.name, spec.kind), ""))

    return msgspec.structs.replace(new, bricks=tuple(map(carried_over, new.bricks)))


def updated(graph: Graph, part: str, source: str) -> Graph:
    """`graph` with `source` in the place of `part`'s class on every replica; `app` is the function.

    Raises ConfigError, naming what there is, if no replica has such a part, and under `none`.
    """
    if graph.ftm == NONE:
        raise ConfigError(f"{NONE} has no engine, so nothing can be updated; any other mechanism has one")
    if part == APPLICATION and source == protected_by(graph):
        name = source or "the built-in function"
        raise ConfigError(f"{name} is what runs already, with the same content: nothing was changed")
    if part == APPLICATION:
        return protecting(graph, source)
    parts = sorted({b.part for b in graph.bricks if b.replica and b.kind != "watchdog"})
    if part not in parts:
        raise unknown("brick", part, (APPLICATION, *parts))
    bricks = (msgspec.structs.replace(b, source=source) if b.part == part else b for b in graph.bricks)
    return msgspec.structs.replace(graph, bricks=tuple(bricks))


def _servers(graph: Graph) -> list[BrickSpec]:
    return [b for b in graph.bricks if b.part == "server"]


def plan(old: Graph, new: Graph, recipe: str = RECIPES[0]) -> Plan:
    """The script from `old` to `new`, both led by the same replica. Raises ConfigError on a bad recipe."""
    if recipe not in RECIPES:
        raise unknown("recipe", recipe, RECIPES)
    if recipe != RECIPES[0] and old.placement != PLACEMENTS[0]:
        raise ConfigError(
            f"the paper's recipe exchanges processes of one brick each: placement {PLACEMENTS[0]},"
            f" not {old.placement}"
        )
    if recipe != RECIPES[0] and bool(replication_of(old.ftm)) != bool(replication_of(new.ftm)):
        raise ConfigError(
            f"the paper's recipe exchanges bricks of replicas that are there: not {old.ftm} to {new.ftm}"
        )
    assert leader_of(old) == leader_of(new), "an adaptation does not change the leader"
    change = _Change(old, new)
    if recipe == RECIPES[0]:
        prepare, commit = _drained(change)
        finish = tuple(Retire(node) for node in (*change.exchanged, *change.removed_nodes))
    else:
        prepare, commit, finish = [], _paper(change), ()
    updated_parts = dict.fromkeys(
        b.part for b in change.new_bricks.values() if b != change.old_bricks.get(b.name)
    )
    purpose = f"{old.ftm} to {new.ftm}" if old.ftm != new.ftm else f"update {', '.join(updated_parts)}"
    script = Script(purpose, "", tuple(prepare), tuple(commit), finish, new.ftm, recipe)
    return Plan(old, new, script, *change.names())


def plan_of(old: Graph, new: Graph, script: Script) -> Plan:
    """The Plan of a script that leads from `old` to `new`."""
    return Plan(old, new, script, *_Change(old, new).names())


class _Change:
    """What differs between two graphs."""

    def __init__(self, old: Graph, new: Graph) -> None:
        self.old, self.new = old, new
        self.leader = leader_of(old)  # which an adaptation does not change
        self.old_bricks = {b.name: b for b in old.bricks}
        self.new_bricks = {b.name: b for b in new.bricks}
        self.exchanged = [
            n for n in new.nodes if n in old.nodes and self._content(old, n) != self._content(new, n)
        ]
        self.added_nodes = [n for n in new.nodes if n not in old.nodes]
        self.removed_nodes = [n for n in old.nodes if n not in new.nodes]
        self.staged = {b for n in (*self.exchanged, *self.added_nodes) for b in new.nodes[n]}
        self.old_links = {k.key: k for k in old.links}
        self.new_links = {k.key: k for k in new.links}

    @staticmethod
    def _content(graph: Graph, node: str) -> tuple[tuple[BrickSpec, ...], frozenset[Link]]:
        hosted = graph.nodes[node]
        inside = frozenset(k for k in graph.links if {k.source, k.sink} <= set(hosted))
        return tuple(sorted((graph.brick(b) for b in hosted), key=lambda b: b.name)), inside

    def names(self) -> tuple[tuple[str, ...], ...]:
        """Bricks: replaced, added, removed, kept, rebound."""
        both = [b for b in self.new_bricks if b in self.old_bricks]
        replaced = [b for b in both if b in self.staged]
        kept = [b for b in both if b not in self.staged]
        changed = self.old_links.keys() ^ self.new_links.keys()
        touched = {brick for source, _, sink, _ in changed for brick in (source, sink)}
        return (
            tuple(replaced),
            tuple(b for b in self.new_bricks if b not in self.old_bricks),
            tuple(b for b in self.old_bricks if b not in self.new_bricks),
            tuple(kept),
            tuple(b for b in kept if b in touched),
        )

    def held(self, node: str) -> bool:
        """Whether a new node must not read yet: it shares an input with an old one, or waits for state."""
        waits = any(
            self.new_bricks[b].part in STATEFUL and self.new_bricks[b].replica in self.born()
            for b in self.new.nodes[node]
        )
        if node in self.exchanged or waits:
            return True
        hosted = set(self.new.nodes[node])
        return any(k.sink in hosted and k.key in self.old_links for k in self.new.links)

    def binds(self) -> Iterator[Link]:
        """The links that staged bricks or changed ends need."""
        for key, link in self.new_links.items():
            if key not in self.old_links or {link.source, link.sink} & self.staged:
                yield link

    def unbinds(self) -> Iterator[Unbind]:
        """Ends at bricks that stay, which lead nowhere from now on."""
        taken = {end for k in self.new.links if not k.standby for end in k.ends}
        for key, link in self.old_links.items():
            if key in self.new_links or link.standby:
                continue
            for brick, port, side in link.ends:
                stays = brick in self.new_bricks and brick not in self.staged
                if stays and (brick, port, side) not in taken:
                    yield Unbind(brick, port)

    def drains(self) -> list[str]:
        """Of the backup, from the brick that receives from the leader on: what may still hold a request.

        Nothing of it changes if only what no request passes through does: a PBR backup does not compute.
        """
        replication = replication_of(self.old.ftm)
        if not replication or not replication_of(self.new.ftm):
            return []
        backup = next(b.replica for b in self.old.bricks if b.replica not in (None, self.leader))
        assert backup is not None
        path = [n for n in chain(self.old, backup) if n != f"{backup}/protocol" and not n.endswith("/server")]
        first = path.index(f"{backup}/{replication[0][0]}")
        apart = [
            n for n in path[first:] if self.old.node_of(n) != self.old.node_of(f"{self.leader}/protocol")
        ]
        concerned = {*apart, *(f"{backup}/{part}" for part in STATEFUL)}
        if not concerned - (self.new_bricks.keys() - self.staged):
            return []
        firsts: dict[str, str] = {}  # by node
        for brick in apart:
            firsts.setdefault(self.old.node_of(brick), brick)
        return list(firsts.values())

    def stateful(self, node: str) -> bool:
        """Whether the old node holds state that the new one needs."""
        for name in self.new.nodes[node]:
            old, new = self.old_bricks.get(name), self.new_bricks[name]
            if old is not None and (new.part in STATEFUL or new.source or old.source):
                return True
        return False

    def born(self) -> list[str]:
        """Replicas that only the new graph has."""
        before = {b.replica for b in self.old.bricks}
        return list(
            dict.fromkeys(b.replica for b in self.new.bricks if b.replica and b.replica not in before)
        )


def drains(old: Graph, new: Graph, staged: Iterable[str] = ()) -> list[str]:
    """Bricks of the backup, one per node, that are to be drained on the way from `old` to `new`, in order.

    `staged`: bricks that are exchanged even where they do not differ.
    """
    change = _Change(old, new)
    change.staged |= set(staged)
    return change.drains()


def _drained(change: _Change) -> tuple[list[Step], list[Step]]:
    """Prepare and commit: nothing is inside when anything is exchanged."""
    new, staged = change.new, change.staged
    stages = [_stage(change, n, held=change.held(n)) for n in (*change.exchanged, *change.added_nodes)]
    prepare: list[Step] = [*stages, *(_bind(k) for k in change.binds() if {k.source, k.sink} & staged)]

    leads = f"{change.leader}/protocol"
    drains = change.drains()
    commit: list[Step] = [Suspend(leads), *(Drain(brick) for brick in drains)]
    if replication_of(change.old.ftm) and replication_of(new.ftm) != replication_of(change.old.ftm):
        commit += [
            Align(f"{change.leader}/server", s.name)
            for s in _servers(new)
            if s.replica != change.leader and s.name in change.old_bricks
        ]
    if migrations := tuple(Migrate(node) for node in change.exchanged if change.stateful(node)):
        commit.append(Together(migrations))
    for replica in change.born():
        commit += [Transfer(f"{change.leader}/{part}", f"{replica}/{part}") for part in STATEFUL]
    moved = [
        _bind(k)
        for k in change.binds()
        if not k.standby and not {k.source, k.sink} <= staged and k.key not in change.old_links
    ]
    commit.append(Together((*map(Exchange, change.exchanged), *moved, *change.unbinds())))

    # What took a place begins only when its predecessor has stopped: they read the same channels.
    first = new.node_of(leads)
    drained = {new.node_of(b): b for b in drains if b in change.new_bricks}
    held = [n for n in (*change.exchanged, *change.added_nodes) if change.held(n) and n != first]
    kept = [b for b in drains if b in change.new_bricks and b not in staged]
    resumed = [*(drained.get(n, new.nodes[n][0]) for n in held), *kept, leads]
    commit.append(Together(tuple(map(Resume, resumed))))
    return prepare, commit


def _paper(change: _Change) -> list[Step]:
    """SIGSTOP the Protocol, kill, launch, link, SIGCONT (paper, III-B). All of it while the client waits."""
    frozen = [p for s in _servers(change.old) if (p := f"{s.replica}/protocol") not in change.staged]
    commit: list[Step] = [Freeze(brick) for brick in frozen]
    commit += [Destroy(node) for node in (*change.exchanged, *change.removed_nodes)]
    commit += [_stage(change, n, held=False) for n in (*change.exchanged, *change.added_nodes)]
    linked = [_bind(k) for k in change.binds() if not k.standby]
    return [*commit, Together((*linked, *change.unbinds())), *(Thaw(brick) for brick in frozen)]


def _stage(change: _Change, node: str, *, held: bool) -> Stage:
    return Stage(node, tuple(change.new_bricks[b] for b in change.new.nodes[node]), held)


def _bind(link: Link) -> Bind:
    same = link.source_port == link.sink_port
    return Bind(link.source, link.source_port, link.sink, "" if same else link.sink_port)
