"""What the runtime can be asked to do, as data: a script of verbs, executed in order.

Recovery and the Adaptation Engine order scripts, a file written by hand may hold one. `prepare` steps touch
new nodes only and can be undone; `commit` steps act on what serves; `finish` steps end what no longer does.
A script is one value, so that the whole of it can be checked before its first step runs, journalled,
simulated and crashed. What it makes of a graph is computed by `after` (graph in, graph out).
"""

from collections.abc import Iterator
from enum import Enum
from typing import Final

import msgspec

from aftbed.core.graph import BrickSpec, Graph, Kind, Link, ends


class Verb(msgspec.Struct, frozen=True, tag=True):
    """Base of the verbs. Bricks are named `a/protocol`, replicas `a` and `b`, nodes as in the graph."""


class Spawn(Verb, frozen=True):
    """Create all nodes of a new generation of `replica` and bind the channels among them."""

    replica: str


class Fence(Verb, frozen=True):
    """Shut what leads out of `replica`: what was sent stays readable, then ends.

    A leader's way to the Proxy is shut by the Attach that follows, behind its checkpoint channel.
    """

    replica: str


class Kill(Verb, frozen=True):
    """SIGKILL the nodes of `replica` (fenced before)."""

    replica: str


class Promote(Verb, frozen=True):
    """Have `replica` drain what its leader sent to the end and lead under `epoch`."""

    replica: str
    epoch: int


class Attach(Verb, frozen=True):
    """Bind the Proxy to `replica`; it resends what is unanswered."""

    replica: str
    epoch: int


class Suspend(Verb, frozen=True):
    """Let the node of `brick` finish the request inside it and take no further one; mail waits."""

    brick: str


class Drain(Verb, frozen=True):
    """Let the node of `brick` work off what waits for it, then take no more. Who feeds it is suspended."""

    brick: str


class Resume(Verb, frozen=True):
    """Undo Suspend or Drain; or let a node that was staged `held` begin."""

    brick: str


class Transfer(Verb, frozen=True):
    """Capture the state of `source` and restore it in `sink` (both quiescent)."""

    source: str
    sink: str


class Align(Verb, frozen=True):
    """Make the state of `sink` that of `source`, checked by digest; nothing moves where they are equal."""

    source: str
    sink: str


class Bind(Verb, frozen=True):
    """Bind `port` of `brick` to `target_port` of `target` (`""`: of the same name).

    In `prepare`, only bricks that are staged get their end; the other end waits in the runtime.
    """

    brick: str
    port: str
    target: str
    target_port: str = ""

    @property
    def link(self) -> Link:
        """The link that this makes."""
        return Link(self.brick, self.port, self.target, self.target_port or self.port)


class Unbind(Verb, frozen=True):
    """Let `port` of `brick` lead nowhere."""

    brick: str
    port: str


class Stage(Verb, frozen=True):
    """Create `node` with these bricks beside what serves. `held`: it takes no mail before Resume."""

    node: str
    bricks: tuple[BrickSpec, ...]
    held: bool = False


class Migrate(Verb, frozen=True):
    """Hand the state of each brick of the serving `node` to its like in the staged one (quiescent)."""

    node: str


class Exchange(Verb, frozen=True):
    """The staged `node` takes the place of the serving one, which is kept, suspended, until Retire."""

    node: str


class Retire(Verb, frozen=True):
    """End what no longer serves: the node that was exchanged, or that the new graph does not have."""

    node: str


class Freeze(Verb, frozen=True):
    """SIGSTOP to the node of `brick`, whatever it is doing. The paper's recipe, and nobody else's."""

    brick: str


class Thaw(Verb, frozen=True):
    """SIGCONT to the node of `brick`."""

    brick: str


class Destroy(Verb, frozen=True):
    """SIGKILL to `node`, with whatever is inside it. The paper's recipe, and nobody else's."""

    node: str


class Together(Verb, frozen=True):
    """These in any order, at the same time: each node hears of all that concerns it at once."""

    verbs: "tuple[AnyVerb, ...]"


AnyVerb = (
    Spawn | Fence | Kill | Promote | Attach | Suspend | Drain | Resume | Transfer | Align | Bind | Unbind
    | Stage | Migrate | Exchange | Retire | Freeze | Thaw | Destroy | Together
)  # fmt: skip
RECIPES: Final = ("drained", "paper")
STEPS_MAX: Final = 1024


class Phase(Enum):
    """The parts of a script that are ordered one by one; `UNDO` takes back what was done."""

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

    `ftm` is the expression of what runs after it, `""` for what ran before.
    `replica` is the one that a script of Recovery is about, `""` for an adaptation.
    """

    purpose: str
    replica: str
    prepare: tuple[AnyVerb, ...]
    commit: tuple[AnyVerb, ...]
    finish: tuple[AnyVerb, ...] = ()
    ftm: str = ""
    recipe: str = RECIPES[0]
    kind: ScriptKind = ScriptKind.ADAPTATION


def flat(verbs: tuple[AnyVerb, ...]) -> Iterator[AnyVerb]:
    """Every single verb, in order."""
    for verb in verbs:
        if isinstance(verb, Together):
            yield from flat(verb.verbs)
        else:
            yield verb


def problems(script: Script) -> list[str]:
    """Every reason to refuse `script` by itself, or []. What it makes of a graph is judged by `after`."""
    found = _prepare_problems(script) + _suspension_problems(script) + _mastership_problems(script)
    if len(script.prepare) + len(script.commit) + len(script.finish) > STEPS_MAX:
        found.append(f"more than {STEPS_MAX} steps")
    wrong = [v for v in flat(script.finish) if not isinstance(v, Retire)]
    return found + [f"finish only retires: {verb}" for verb in wrong]


def _suspension_problems(script: Script) -> list[str]:
    """What is suspended is resumed, and nothing is changed while requests flow."""
    staged = {v.node for v in flat(script.prepare) if isinstance(v, Stage)}
    waiting = {b.name for v in flat(script.prepare) if isinstance(v, Stage) and v.held for b in v.bricks}
    held: set[str] = set()
    found: list[str] = []
    for verb in flat(script.commit):
        match verb:
            case Suspend(brick) | Drain(brick) | Freeze(brick):
                held.add(brick)
            case Resume(brick) | Thaw(brick) if brick in held:
                held.remove(brick)
            case Resume(brick) | Thaw(brick) if brick not in waiting:
                found.append(f"resumed, not suspended: {brick}")
            case Transfer() | Align() | Bind() | Migrate() | Exchange() if not held:
                found.append(f"changed while requests flow: {verb}")
            case Exchange(node) | Migrate(node) if node not in staged:
                found.append(f"nothing is staged to take the place of {node}")
            case Destroy(node) if script.recipe == RECIPES[0]:
                found.append(f"killed with a request inside: {node}")
            case Spawn(node) | Stage(node) if script.recipe == RECIPES[0]:
                found.append(f"spawned while the client waits: {node}")
            case _:
                pass
    exchanged = {v.node for v in flat(script.commit) if isinstance(v, Exchange)}
    ended = {v.node for v in flat(script.finish) if isinstance(v, Retire)} - exchanged
    left = sorted(brick for brick in held if brick not in ended and _head(brick) not in ended)
    return found + [f"suspended, not resumed: {brick}" for brick in left]


def _mastership_problems(script: Script) -> list[str]:
    """The old master is fenced before there is a new one, and before it is killed."""
    fenced: set[str] = set()
    found = []
    for verb in flat(script.commit):
        match verb:
            case Fence(replica):
                fenced.add(replica)
            case Kill(replica) if replica not in fenced:
                found.append(f"killed before it was fenced: {replica}")
            case Promote(replica) | Attach(replica) if not fenced - {replica}:
                found.append(f"a new master while the old one is not fenced: {verb}")
            case Promote(replica) | Attach(replica) if replica in fenced:
                found.append(f"a master that is fenced: {verb}")
            case _:
                pass
    return found


def _prepare_problems(script: Script) -> list[str]:
    """Prepare acts on nothing but what it has made before."""
    new: set[str] = set()
    found = []
    for verb in flat(script.prepare):
        match verb:
            case Spawn(replica):
                new.add(replica)
            case Stage(node, bricks):
                new |= {node, *(b.name for b in bricks)}
            case Bind(brick, _, target) if {brick, target} & new or {_head(brick), _head(target)} <= new:
                pass
            case _ if not {_head(name) for name in names(verb)} <= new:
                found.append(f"prepare touches what already serves: {verb}")
            case _:
                pass
    return found


def _head(name: str) -> str:
    return name.partition("/")[0]


def names(verb: AnyVerb) -> tuple[str, ...]:
    """The replicas, nodes and bricks that `verb` acts on."""
    match verb:
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
        case Together(verbs):
            return tuple(name for inner in verbs for name in names(inner))


# -- against a graph ------------------------------------------------------------------------------

End = tuple[str, str, str]  # brick, port, side: one port name may be both an input and an output


def after(graph: Graph, script: Script, kinds: dict[str, Kind]) -> Graph:
    """What `script` makes of `graph`: bricks staged and retired, links bound and unbound."""
    bricks = {b.name: b for b in graph.bricks}
    nodes = dict(graph.nodes)
    verbs = tuple(flat((*script.prepare, *script.commit, *script.finish)))
    for verb in verbs:
        if isinstance(verb, Stage):
            nodes[verb.node] = tuple(b.name for b in verb.bricks)
            bricks |= {b.name: b for b in verb.bricks}
    exchanged = {v.node for v in verbs if isinstance(v, Exchange)}
    gone = {v.node for v in verbs if isinstance(v, Retire | Destroy)} - exchanged
    nodes = {node: held for node, held in nodes.items() if node not in gone or _staged(node, verbs)}
    hosted = {name for held in nodes.values() for name in held}
    bricks = {name: spec for name, spec in bricks.items() if name in hosted}
    new = {b.name for v in verbs if isinstance(v, Stage) for b in v.bricks}
    fresh = _bound(graph, script, new)
    freed = {end for k in fresh if not k.standby for end in ends(k)} | {
        _unbound(v, bricks, kinds) for v in verbs if isinstance(v, Unbind)
    }
    kept = [
        k
        for k in graph.links
        if {k.source, k.sink} <= set(bricks)
        and new.isdisjoint((k.source, k.sink))
        and (k.standby or freed.isdisjoint(ends(k)))
    ]
    return Graph(script.ftm or graph.ftm, graph.placement, tuple(bricks.values()), (*kept, *fresh), nodes)


def _bound(graph: Graph, script: Script, new: set[str]) -> list[Link]:
    """The links that the script makes; one whose end at an old brick is never given away is on standby."""
    old = {(k.source, k.source_port, k.sink, k.sink_port): k for k in graph.links}
    in_commit = {v.link for v in flat(script.commit) if isinstance(v, Bind)}
    links = []
    for link in dict.fromkeys(v.link for v in flat((*script.prepare, *script.commit)) if isinstance(v, Bind)):
        waits = link not in in_commit and not {link.source, link.sink} <= new
        standing = old.get((link.source, link.source_port, link.sink, link.sink_port))
        links.append(standing or msgspec.structs.replace(link, standby=waits))
    return links


def _staged(node: str, verbs: tuple[AnyVerb, ...]) -> bool:
    return any(isinstance(v, Stage) and v.node == node for v in verbs)


def _unbound(verb: Unbind, bricks: dict[str, BrickSpec], kinds: dict[str, Kind]) -> End:
    spec = bricks.get(verb.brick)
    outputs = kinds[spec.kind].outputs if spec is not None and spec.kind in kinds else ()
    return (verb.brick, verb.port, "out" if verb.port in outputs else "in")


def bricks_changed(old: Graph, new: Graph, script: Script) -> int:
    """How many bricks `script`, which leads from `old` to `new`, makes or ends."""
    staged = [v for v in flat((*script.prepare, *script.commit)) if isinstance(v, Stage)]
    made = {b.name for v in staged for b in v.bricks}
    return len(made | ({b.name for b in old.bricks} - {b.name for b in new.bricks}))
