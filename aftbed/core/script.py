"""What the runtime can be asked to do, as data: a script of steps, and the way back from them.

Recovery and the Adaptation Engine order scripts; a file that a person writes may hold one. `prepare` acts on
new nodes only, `commit` on what serves, `finish` ends what no longer serves. A script is one value, so the
whole of it is checked before its first step runs, journalled, simulated and crashed.

`after` computes the graph that a script leads to, `inverse` the steps that lead back: a part of a plan and
then its inverse are the identity on the graph.
"""

from collections.abc import Iterable, Iterator, Sequence
from enum import Enum
from typing import Final

import msgspec

from aftbed.core.graph import BrickSpec, End, Graph, Kind, Link, LinkKey


class ScriptStep(msgspec.Struct, frozen=True, tag=True):
    """Base of the steps. Bricks are named `a/protocol`, replicas `a` and `b`, nodes as in the graph."""


class Spawn(ScriptStep, frozen=True):
    """Create all nodes of a new generation of `replica` and bind the channels among them."""

    replica: str


class Fence(ScriptStep, frozen=True):
    """Shut the channels that lead out of `replica`: what was sent stays readable, then they end.

    A leader's channel to the Proxy is shut by the Attach that follows, behind its checkpoint channel.
    """

    replica: str


class Kill(ScriptStep, frozen=True):
    """SIGKILL the nodes of `replica`. One that leads has been fenced before."""

    replica: str


class Promote(ScriptStep, frozen=True):
    """Have `replica` drain the channels from its leader to their end, then lead under `epoch`."""

    replica: str
    epoch: int


class Attach(ScriptStep, frozen=True):
    """Bind the Proxy to `replica`; it resends what is unanswered."""

    replica: str
    epoch: int


class Suspend(ScriptStep, frozen=True):
    """Let the node of `brick` finish the request inside it and take no further one; mail waits."""

    brick: str


class Drain(ScriptStep, frozen=True):
    """Let the node of `brick` work off its mail, then take no more. The brick that feeds it is suspended."""

    brick: str


class Resume(ScriptStep, frozen=True):
    """End a Suspend or Drain; or let a node that was staged `held` begin."""

    brick: str


class Transfer(ScriptStep, frozen=True):
    """Capture the state of `source` and restore it in `sink` (both quiescent)."""

    source: str
    sink: str


class Align(ScriptStep, frozen=True):
    """Make the state of `sink` that of `source`, compared by digest; nothing moves where they are equal."""

    source: str
    sink: str


class Bind(ScriptStep, frozen=True, repr_omit_defaults=True):
    """Bind `port` of `brick` to `target_port` of `target` (`""`: of the same name).

    In `prepare`, only bricks that are staged get their end; the other end waits in the runtime.
    """

    brick: str
    port: str
    target: str
    target_port: str = ""
    standby: bool = False  # in an inverse only: the runtime keeps the end of the Proxy

    @property
    def link(self) -> Link:
        """The link that this makes."""
        return Link(self.brick, self.port, self.target, self.target_port or self.port, self.standby)


class Unbind(ScriptStep, frozen=True):
    """Let `port` of `brick` lead nowhere."""

    brick: str
    port: str


class Stage(ScriptStep, frozen=True):
    """Create `node` with these bricks beside what serves. `held`: it takes no mail before Resume."""

    node: str
    bricks: tuple[BrickSpec, ...]
    held: bool = False


class Migrate(ScriptStep, frozen=True):
    """Hand the state of each brick of `node` to the brick of that name in the node beside it (quiescent)."""

    node: str


class Exchange(ScriptStep, frozen=True):
    """What stands beside `node` takes its place; what had it stands beside it, suspended, until Retire."""

    node: str


class Retire(ScriptStep, frozen=True):
    """End what stands beside `node`; or, where nothing does, a node that the new graph does not have."""

    node: str


class Freeze(ScriptStep, frozen=True):
    """SIGSTOP to the node of `brick`, whatever it is doing. In the paper's recipe only."""

    brick: str


class Thaw(ScriptStep, frozen=True):
    """SIGCONT to the node of `brick`. In the paper's recipe only."""

    brick: str


class Destroy(ScriptStep, frozen=True):
    """SIGKILL to `node`, with whatever is inside it. In the paper's recipe only."""

    node: str


class Together(ScriptStep, frozen=True):
    """These in any order, at the same time: each node gets all that concerns it in one order."""

    steps: "tuple[Step, ...]"


Step = (
    Spawn | Fence | Kill | Promote | Attach | Suspend | Drain | Resume | Transfer | Align | Bind | Unbind
    | Stage | Migrate | Exchange | Retire | Freeze | Thaw | Destroy | Together
)  # fmt: skip
RECIPES: Final = ("drained", "paper")


class Phase(Enum):
    """The parts of a script that are ordered one by one; `UNDO` runs the inverse of what was done."""

    WHOLE = "whole"
    PREPARE = "prepare"
    COMMIT = "commit"
    FINISH = "finish"
    UNDO = "undo"


class ScriptKind(Enum):
    """What a script does as a whole."""

    FAILOVER = "failover"
    DROP_BACKUP = "drop backup"
    NEW_BACKUP = "new backup"
    ADAPTATION = "adaptation"


LOSSES: Final = frozenset((ScriptKind.FAILOVER, ScriptKind.DROP_BACKUP))  # each follows the loss of a replica


class Script(msgspec.Struct, frozen=True):
    """`purpose` is text for people: `failover`, `new backup`, `pbr to pbr+tr`.

    `ftm` is the expression that runs after it, `""` for the one that ran before.
    `replica` is the one that a script of Recovery is about, `""` for an adaptation.
    """

    purpose: str
    replica: str
    prepare: tuple[Step, ...]
    commit: tuple[Step, ...]
    finish: tuple[Step, ...] = ()
    ftm: str = ""
    recipe: str = RECIPES[0]
    kind: ScriptKind = ScriptKind.ADAPTATION


def flat(steps: Iterable[Step]) -> Iterator[Step]:
    """Every single step, in order."""
    for step in steps:
        if isinstance(step, Together):
            yield from flat(step.steps)
        else:
            yield step


def verb_of(step: type[Step] | Step) -> str:
    """Its word, in script files and for people."""
    kind = step if isinstance(step, type) else type(step)
    return kind.__name__.lower()


def names(step: Step) -> tuple[str, ...]:
    """The replicas, nodes and bricks that `step` acts on."""
    match step:
        case Spawn(replica) | Fence(replica) | Kill(replica) | Promote(replica) | Attach(replica):
            return (replica,)
        case Suspend(name) | Drain(name) | Resume(name) | Unbind(name) | Freeze(name) | Thaw(name):
            return (name,)
        case Stage(name) | Migrate(name) | Exchange(name) | Retire(name) | Destroy(name):
            return (name,)
        case Transfer(source, sink) | Align(source, sink):
            return (source, sink)
        case Bind(brick, _, target):
            return (brick, target)
        case Together(steps):
            return tuple(name for inner in steps for name in names(inner))


# -- against a graph ------------------------------------------------------------------------------


class Layout(msgspec.Struct, frozen=True):
    """A graph in the middle of a script.

    `staged`: bricks of nodes that stand beside a node of the same name and have not served yet.
    `replaced`: bricks of nodes whose place another one has taken; they can take it again until Retire.
    `added`: nodes that the script has made and the graph did not have.
    `prepared`: links that are not in force yet; one on standby has not been bound in the commit so far.
    `suspended`: nodes of the graph that take no mail.
    """

    graph: Graph
    staged: dict[str, tuple[BrickSpec, ...]] = {}
    replaced: dict[str, tuple[BrickSpec, ...]] = {}
    added: frozenset[str] = frozenset()
    prepared: tuple[Link, ...] = ()
    suspended: frozenset[str] = frozenset()


def after(graph: Graph, script: Script, kinds: dict[str, Kind]) -> Graph:
    """The graph that `script` leads to. What it stages counts as in place, exchanged or not."""
    reached = _MutableLayout(Layout(graph), kinds)
    reached.apply(script.prepare, committing=False)
    reached.apply((*script.commit, *script.finish), committing=True)
    for node in list(reached.staged):
        reached.exchange(node)
    waiting = [k for key, k in reached.prepared.items() if key not in reached.links]
    found = reached.layout().graph
    return msgspec.structs.replace(found, ftm=script.ftm or graph.ftm, links=(*found.links, *waiting))


def applied(
    layout: Layout, steps: Iterable[Step], kinds: dict[str, Kind], *, committing: bool = True
) -> Layout:
    """What `steps` make of `layout`. While not `committing`, bricks that serve keep their links."""
    reached = _MutableLayout(layout, kinds)
    reached.apply(steps, committing=committing)
    return reached.layout()


class _MutableLayout:
    """A Layout that steps are applied to."""

    def __init__(self, layout: Layout, kinds: dict[str, Kind]) -> None:
        self._graph, self._kinds = layout.graph, kinds
        self._committing = False
        self._made: set[LinkKey] = set()  # links that these steps have made: no later one takes their ends
        self.bricks = {b.name: b for b in layout.graph.bricks}
        self.nodes = dict(layout.graph.nodes)
        self.links = {k.key: k for k in layout.graph.links}
        self.staged, self.replaced = dict(layout.staged), dict(layout.replaced)
        self.added, self.suspended = set(layout.added), set(layout.suspended)
        self.prepared = {k.key: k for k in layout.prepared}

    def layout(self) -> Layout:
        graph = msgspec.structs.replace(
            self._graph,
            bricks=tuple(self.bricks.values()),
            links=tuple(self.links.values()),
            nodes=self.nodes,
        )
        added, suspended = frozenset(self.added), frozenset(self.suspended)
        return Layout(graph, self.staged, self.replaced, added, tuple(self.prepared.values()), suspended)

    def apply(self, steps: Iterable[Step], *, committing: bool) -> None:
        """Of steps that happen together, Exchange comes first."""
        self._committing = committing
        for step in steps:
            inner = list(flat((step,)))
            for one in sorted(inner, key=lambda s: not isinstance(s, Exchange)):
                self._apply(one)

    def _apply(self, step: Step) -> None:
        match step:
            case Stage(node, bricks, held):
                self._stage(node, bricks, held=held)
            case Bind():
                self._bind(step.link)
            case Unbind(brick, port):
                self._free({self._end(brick, port)})
            case Exchange(node):
                self.exchange(node)
            case Retire(node) | Destroy(node):
                self._remove(node)
            case Suspend(brick) | Drain(brick) | Freeze(brick):
                self.suspended |= self._host(brick)
            case Resume(brick) | Thaw(brick):
                self.suspended -= self._host(brick)
            case _:
                pass  # moves state, or changes the leader

    def _host(self, brick: str) -> set[str]:
        return {node for node, hosted in self.nodes.items() if brick in hosted}

    def _stage(self, node: str, bricks: tuple[BrickSpec, ...], *, held: bool) -> None:
        if node in self.nodes:
            self.staged[node] = bricks
            return
        self._place(node, bricks)
        self.added.add(node)
        self.suspended |= {node} if held else set()

    def _place(self, node: str, bricks: tuple[BrickSpec, ...]) -> None:
        self.nodes[node] = tuple(b.name for b in bricks)
        self.bricks |= {b.name: b for b in bricks}

    def _staged_bricks(self) -> set[str]:
        return {b.name for bricks in self.staged.values() for b in bricks}

    def _bind(self, link: Link) -> None:
        key, bricks, staged = link.key, {link.source, link.sink}, self._staged_bricks()
        new = staged | {b for node in self.added for b in self.nodes[node]}
        waits = not self._committing and not bricks <= new
        if waits or bricks & staged:
            self.prepared[key] = msgspec.structs.replace(link, standby=waits)
            return
        self.prepared.pop(key, None)
        if key not in self.links:
            self._put_in_force(link)

    def _put_in_force(self, link: Link) -> None:
        if not link.standby:
            self._free(set(link.ends))
        self.links[link.key] = link
        self._made.add(link.key)

    def _free(self, freed: set[End]) -> None:
        self.links = {
            key: k
            for key, k in self.links.items()
            if k.standby or key in self._made or freed.isdisjoint(k.ends)
        }

    def _end(self, brick: str, port: str) -> End:
        spec = self.bricks.get(brick)
        outputs = self._kinds[spec.kind].outputs if spec is not None and spec.kind in self._kinds else ()
        return (brick, port, "out" if port in outputs else "in")

    def exchange(self, node: str) -> None:
        """Links that both nodes have stay as they are. One that comes back has none until they are bound."""
        comes_back = node in self.replaced
        if node not in self.nodes or not (comes_back or node in self.staged):
            return
        incoming = self.replaced.pop(node) if comes_back else self.staged.pop(node)
        outgoing = self.nodes[node]
        self.replaced[node] = tuple(self.bricks[name] for name in outgoing)
        bricks = {*outgoing, *(b.name for b in incoming)}
        if comes_back:
            self.prepared = _apart_from(bricks, self.prepared)
        apart = _apart_from(bricks, self.links)
        self.links = {key: k for key, k in self.links.items() if key in self.prepared or key in apart}
        for name in outgoing:
            del self.bricks[name]
        self._place(node, incoming)
        self.suspended.add(node)
        staged = self._staged_bricks()
        for key, link in list(self.prepared.items()):
            both = {link.source, link.sink}
            if both & bricks and not both & staged and key in self.links:
                del self.prepared[key]
            elif both & bricks and not both & staged and not link.standby:
                self._put_in_force(self.prepared.pop(key))

    def _remove(self, node: str) -> None:
        if node in self.staged:
            gone = {b.name for b in self.staged.pop(node)}
        elif node in self.replaced:
            del self.replaced[node]
            return
        else:
            gone = set(self.nodes.pop(node, ()))
            self.bricks = {name: b for name, b in self.bricks.items() if name not in gone}
            self.links = _apart_from(gone, self.links)
            self.added.discard(node)
            self.suspended.discard(node)
        self.prepared = _apart_from(gone, self.prepared)


def _apart_from(bricks: set[str], links: dict[LinkKey, Link]) -> dict[LinkKey, Link]:
    return {key: k for key, k in links.items() if bricks.isdisjoint((k.source, k.sink))}


# -- the way back ---------------------------------------------------------------------------------

ONE_WAY: Final = (Fence, Kill, Promote, Attach, Retire, Destroy)  # these end processes, or a mastership


def reversible(steps: Iterable[Step]) -> bool:
    """Whether there is a way back from `steps`."""
    return not any(isinstance(step, ONE_WAY) for step in flat(steps))


def inverse(
    graph: Graph, done: Sequence[Step], kinds: dict[str, Kind], drains: Sequence[str] = ()
) -> list[Step]:
    """The steps that undo `done`, which was done to `graph` and is reversible.

    They have the shape of a commit: what serves is suspended and hands its state back, what was replaced
    takes its place again, what was staged is ended, and what was suspended is resumed, the leader last. State
    is handed back only where requests may have passed meanwhile; `drains` are the bricks of the backup that
    are to be drained first then, in order. A node that comes back is bound to all its channels again: its
    neighbours may have been replaced meanwhile.
    """
    assert reversible(done), done
    steps = list(flat(done))
    begun = next((at for at, step in enumerate(done) if isinstance(step, Suspend | Drain)), len(done))
    reached = applied(Layout(graph), done[:begun], kinds, committing=False)
    reached = applied(reached, done[begun:], kinds)
    stopped = [step.brick for step in steps if isinstance(step, Suspend | Drain)]
    first = stopped[0] if stopped else ""  # the Protocol of the leader
    back: list[Step] = []
    drained: list[str] = []  # nodes
    if Resume(first) in steps:
        moved = [s.node for s in steps if isinstance(s, Migrate) and s.node in reached.replaced]
        back += [Suspend(first), *(Drain(brick) for brick in drains), *_at_once(map(Migrate, moved))]
        drained = [reached.graph.node_of(brick) for brick in drains]
    back += _at_once(Retire(node) for node in reached.staged)
    rebound = _links_back(graph, reached)
    back += _at_once(rebound)
    back += _at_once(Retire(node) for node in (*reached.replaced, *sorted(reached.added)))
    back += [Kill(step.replica) for step in steps if isinstance(step, Spawn)]
    waiting = (*reached.replaced, *sorted(reached.suspended), *map(graph.node_of, stopped), *drained)
    resumed = [_stopped_as(graph.nodes[n], stopped) for n in dict.fromkeys(waiting) if n in graph.nodes]
    resumed.sort(key=lambda brick: brick == first)
    return [*back, *_at_once(map(Resume, resumed))]


def _at_once(steps: Iterable[Step]) -> list[Step]:
    found = tuple(steps)
    return [Together(found)] if found else []


def _stopped_as(hosted: tuple[str, ...], stopped: list[str]) -> str:
    """The brick of a node by which it was suspended."""
    return next((brick for brick in stopped if brick in hosted), hosted[0])


def _links_back(graph: Graph, reached: Layout) -> list[Step]:
    """What leads from the links of `reached` to those of `graph`, and each node to its place."""
    returning = {name for node in reached.replaced for name in graph.nodes[node]}
    stay = {b.name for b in graph.bricks} & {b.name for b in reached.graph.bricks} - returning
    there, wanted = ({k.key: k for k in links} for links in (reached.graph.links, graph.links))
    taken = {end for k in graph.links if not k.standby for end in k.ends}
    binds = [
        Bind(k.source, k.source_port, k.sink, k.sink_port, k.standby)
        for key, k in wanted.items()
        if returning & {k.source, k.sink} or (key not in there and not k.standby)
    ]
    loose = [end for key, k in there.items() if key not in wanted and not k.standby for end in k.ends]
    unbinds = [
        Unbind(brick, port)
        for brick, port, side in loose
        if brick in stay and (brick, port, side) not in taken
    ]
    return [*map(Exchange, reached.replaced), *binds, *unbinds]


def bricks_changed(old: Graph, new: Graph, script: Script) -> int:
    """How many bricks `script`, which leads from `old` to `new`, makes or ends."""
    staged = [s for s in flat((*script.prepare, *script.commit)) if isinstance(s, Stage)]
    made = {b.name for s in staged for b in s.bricks}
    return len(made | ({b.name for b in old.bricks} - {b.name for b in new.bricks}))
