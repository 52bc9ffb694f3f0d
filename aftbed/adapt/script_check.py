"""Every reason to refuse a script on the graph that runs, with the step that it is about.

Four looks, each only where those before found nothing:

1. are there such bricks and nodes;
2. is the script sound by itself (`problems`: all that is asked of a script of Recovery), and can the runtime
   carry out each verb;
3. is the graph that it leads to one that can run: each required port bound once, by a channel that carries
   what it takes, no loop in the request path, the leader the same, replicas that speak as `ftm` says;
4. is nothing lost on the way: the leader's Protocol suspended and the backup drained while anything
   changes, every end that leads nowhere unbound, every state moved. (The paper's recipe does not care.)

A rule says what is wrong, not where. Where is found from outside: **the step of a problem is the one since
which it never goes away**, looking at ever longer beginnings of the script. So no rule has to know about
places, and a rule that is written later has them too.
"""

from collections.abc import Callable, Iterator
from functools import cache
from typing import Final, NamedTuple

import msgspec

from aftbed.adapt.planner import drains, leader_of
from aftbed.adapt.script_file import link_words, phases, step_words
from aftbed.core.errors import unknown
from aftbed.core.graph import PLACEMENTS, Graph
from aftbed.core.script import (
    RECIPES,
    Align,
    Attach,
    Bind,
    Destroy,
    Drain,
    Exchange,
    Fence,
    Freeze,
    Kill,
    Migrate,
    Promote,
    Resume,
    Retire,
    Script,
    Spawn,
    Stage,
    Step,
    Suspend,
    Thaw,
    Transfer,
    Unbind,
    after,
    flat,
    names,
    verb_of,
)
from aftbed.ftm.compose import NONE, REPLICAS, STATEFUL, build, known_expressions, replication_of
from aftbed.ftm.registry import KINDS

REQUEST_PORTS: Final = ("pxy2pro", "pro2bfr", "bfr2prd", "prd2srv")  # the way of a request, as outputs
STEPS_MAX: Final = 1024
_OF_NODES: Final = (Migrate, Exchange, Retire, Destroy)

Rule = Callable[[Script], list[str]]


class StepRefusal(NamedTuple):
    """Why a script is refused, and the step that it is about, as `commit[3]`; "": the whole script."""

    place: str
    reason: str

    def __str__(self) -> str:
        return f"{self.place}: {self.reason}" if self.place else self.reason


def refusals(graph: Graph, script: Script) -> list[StepRefusal]:
    """Every reason to refuse `script` where `graph` runs; [] if it may be carried out."""
    found = list(dict.fromkeys(_strangers(graph, script)))
    looks: tuple[tuple[Rule, ...], ...] = (
        (problems, lambda s: _forms(graph, s)),
        (lambda s: _led_to(graph, s),),
        (lambda s: _flow(graph, s), lambda s: _loose_ends(graph, s), lambda s: _states(graph, s)),
    )
    for rules in looks[: 3 if script.recipe == RECIPES[0] else 2]:
        found = found or [reason for rule in rules for reason in _placed(script, rule)]
    return found


# -- what there is --------------------------------------------------------------------------------


def _steps(script: Script) -> Iterator[tuple[str, Step]]:
    """Every step with its place, as `commit[3]`."""
    for phase, verbs in phases(script).items():
        for index, verb in enumerate(verbs):
            yield f"{phase}[{index}]", verb


def _strangers(graph: Graph, script: Script) -> Iterator[StepRefusal]:
    """Names that are neither in the graph nor staged."""
    staged = [v for v in flat((*script.prepare, *script.commit)) if isinstance(v, Stage)]
    bricks = {b.name for b in graph.bricks} | {b.name for v in staged for b in v.bricks}
    for place, step in _steps(script):
        for verb in flat((step,)):
            if isinstance(verb, Stage):
                continue
            is_node = isinstance(verb, _OF_NODES)
            allowed = set(graph.nodes) if is_node else bricks
            for name in names(verb):
                if name not in allowed:
                    wrong = unknown("node" if is_node else "brick", name, allowed)
                    yield StepRefusal(place, f"{verb_of(verb)}: {wrong}")


# -- by itself ------------------------------------------------------------------------------------


def problems(script: Script) -> list[str]:
    """Every reason to refuse `script` by itself, or []. What it makes of a graph is judged by `after`."""
    found = _prepare_problems(script) + _suspension_problems(script) + _mastership_problems(script)
    if len(script.prepare) + len(script.commit) + len(script.finish) > STEPS_MAX:
        found.append(f"more than {STEPS_MAX} steps")
    wrong = [s for s in flat(script.finish) if not isinstance(s, Retire)]
    return found + [f"finish only retires: {step}" for step in wrong]


def _suspension_problems(script: Script) -> list[str]:
    """What is suspended is resumed, and nothing is changed while requests flow."""
    staged = {s.node for s in flat(script.prepare) if isinstance(s, Stage)}
    waiting = {b.name for s in flat(script.prepare) if isinstance(s, Stage) and s.held for b in s.bricks}
    held: set[str] = set()
    found: list[str] = []
    for step in flat(script.commit):
        match step:
            case Suspend(brick) | Drain(brick) | Freeze(brick):
                held.add(brick)
            case Resume(brick) | Thaw(brick) if brick in held:
                held.remove(brick)
            case Resume(brick) | Thaw(brick) if brick not in waiting:
                found.append(f"resumed, not suspended: {brick}")
            case Transfer() | Align() | Bind() | Migrate() | Exchange() if not held:
                found.append(f"changed while requests flow: {step}")
            case Exchange(node) | Migrate(node) if node not in staged:
                found.append(f"nothing is staged to take the place of {node}")
            case Destroy(node) if script.recipe == RECIPES[0]:
                found.append(f"killed with a request inside: {node}")
            case Spawn(node) | Stage(node) if script.recipe == RECIPES[0]:
                found.append(f"spawned while the client waits: {node}")
            case _:
                pass
    exchanged = {s.node for s in flat(script.commit) if isinstance(s, Exchange)}
    ended = {s.node for s in flat(script.finish) if isinstance(s, Retire)} - exchanged
    left = sorted(brick for brick in held if brick not in ended and _head(brick) not in ended)
    return found + [f"suspended, not resumed: {brick}" for brick in left]


def _mastership_problems(script: Script) -> list[str]:
    """The old master is fenced before there is a new one, and before it is killed."""
    fenced: set[str] = set()
    found = []
    for step in flat(script.commit):
        match step:
            case Fence(replica):
                fenced.add(replica)
            case Kill(replica) if replica not in fenced:
                found.append(f"killed before it was fenced: {replica}")
            case Promote(replica) | Attach(replica) if not fenced - {replica}:
                found.append(f"a new master while the old one is not fenced: {step}")
            case Promote(replica) | Attach(replica) if replica in fenced:
                found.append(f"a master that is fenced: {step}")
            case _:
                pass
    return found


def _prepare_problems(script: Script) -> list[str]:
    """Prepare acts on nothing but what it has made before."""
    new: set[str] = set()
    found = []
    for step in flat(script.prepare):
        match step:
            case Spawn(replica):
                new.add(replica)
            case Stage(node, bricks):
                new |= {node, *(b.name for b in bricks)}
            case Bind(brick, _, target) if {brick, target} & new or {_head(brick), _head(target)} <= new:
                pass
            case _ if not {_head(name) for name in names(step)} <= new:
                found.append(f"prepare touches what already serves: {step}")
            case _:
                pass
    return found


def _head(name: str) -> str:
    """The replica of a brick, or the name of a node itself."""
    return name.partition("/")[0]


# -- what a script may do -------------------------------------------------------------------------


def _forms(graph: Graph, script: Script) -> list[str]:
    """Verbs that the runtime cannot carry out on `graph`."""
    verbs = list(flat((*script.prepare, *script.commit, *script.finish)))
    staged = [v.node for v in verbs if isinstance(v, Stage)]
    replaced = {v.node for v in verbs if isinstance(v, Exchange | Destroy)}
    found = [f"{node} is staged twice" for index, node in enumerate(staged) if node in staged[:index]]
    found += [
        f"{node} serves, and what is staged beside it never takes its place"
        for node in staged
        if node in graph.nodes and node not in replaced
    ]
    new = _staged_bricks(script)
    found += [
        f"unbinds what is new: {v.brick}.{v.port}" for v in verbs if isinstance(v, Unbind) and v.brick in new
    ]
    standby = {k.key for k in graph.links if k.standby}
    found += [
        f"an adaptation does not change the leader: {link_words(v.link)} is on standby"
        for v in flat(script.commit)
        if isinstance(v, Bind) and v.link.key in standby
    ]
    if script.recipe == RECIPES[0]:
        paper = [v for v in verbs if isinstance(v, Freeze | Thaw)]
        found += [f"{verb_of(v)} is for recipe {RECIPES[1]} only: {v.brick}" for v in paper]
    elif graph.placement != PLACEMENTS[0]:
        found.append(f"recipe {script.recipe} is for placement {PLACEMENTS[0]} only, found {graph.placement}")
    return found


def _staged_bricks(script: Script) -> set[str]:
    staged = flat((*script.prepare, *script.commit))
    return {b.name for v in staged if isinstance(v, Stage) for b in v.bricks}


# -- where it leads -------------------------------------------------------------------------------


def _led_to(graph: Graph, script: Script) -> list[str]:
    """What is wrong with the graph that comes of it."""
    new = after(graph, script, KINDS)
    found = new.problems(KINDS)
    found += [
        f"prepared, and not bound in commit: {link_words(k)}"
        for k in new.links
        if k.standby and "proxy" not in (k.source, k.sink)
    ]
    found += [
        f"{k.source}.{k.source_port} does not carry what {k.sink}.{k.sink_port} takes"
        for k in new.links
        if (k.source_port, k.sink_port) not in _linked_ports(known_expressions())
    ]
    found += _loops(new)
    if NONE in (graph.ftm, script.ftm):
        return [*found, f"an adaptation neither starts nor ends at {NONE}"]
    return found + _masters(graph, new)


@cache
def _linked_ports(expressions: tuple[str, ...]) -> frozenset[tuple[str, str]]:
    """Pairs of ports that some mechanism links."""
    graphs = [build(e, PLACEMENTS[0]) for e in expressions if e != NONE]
    return frozenset((k.source_port, k.sink_port) for g in graphs for k in g.links)


def _loops(graph: Graph) -> list[str]:
    """Bricks that a request would come back to. TR's own loop is of messages of its own."""
    onward = {k.source: k.sink for k in graph.links if k.source_port in REQUEST_PORTS and not k.standby}
    found: dict[frozenset[str], str] = {}
    for start in onward:
        way = [start]
        while (brick := onward.get(way[-1])) is not None and brick not in way:
            way.append(brick)
        if brick is not None:
            loop = way[way.index(brick) :]
            found.setdefault(frozenset(loop), f"a loop in the request path: {' -> '.join((*loop, brick))}")
    return list(found.values())


def _masters(old: Graph, new: Graph) -> list[str]:
    """A change of the leader, and ports by which no leader sends to its backup."""
    leader = leader_of(old)
    led = {k.sink for k in new.links if k.source == "proxy" and k.source_port == "pxy2pro" and not k.standby}
    found = [
        f"an adaptation does not change the leader: proxy.pxy2pro leads to {sink}, {leader} leads"
        for sink in sorted(led)
        if sink.partition("/")[0] != leader
    ]
    replicas = {b.name: b.replica for b in new.bricks}
    between = {
        (k.source.partition("/")[2], k.source_port)
        for k in new.links
        if replicas.get(k.source) and replicas.get(k.sink) and replicas[k.source] != replicas[k.sink]
    }
    wanted = set(replication_of(new.ftm))
    if between != wanted:
        found.append(
            f"under {new.ftm} replicas speak through {_ports(wanted)}, found {_ports(between)}:"
            " say in `ftm` what runs afterwards"
        )
    return found


def _ports(ends_of: set[tuple[str, str]]) -> str:
    return ", ".join(sorted(f"{part}.{port}" for part, port in ends_of)) or "nothing"


# -- what is lost on the way ----------------------------------------------------------------------


def _flow(graph: Graph, script: Script) -> list[str]:
    """What changes while a request may be inside, and what never begins."""
    leader = leader_of(graph)
    leads, backups = f"{leader}/protocol", set(REPLICAS) - {leader}
    staged = [b.name for v in flat(script.prepare) if isinstance(v, Stage) for b in v.bricks]
    undrained = set(drains(graph, after(graph, script, KINDS), staged))
    suspended, resumed, found = False, set[str](), list[str]()
    for verb in flat(script.commit):
        match verb:
            case Suspend(brick) | Drain(brick):
                suspended = suspended or brick == leads
                undrained.discard(brick)
            case Resume(brick):
                suspended = suspended and brick != leads
                resumed.add(brick)
            case Transfer() | Align() | Bind() | Unbind() | Migrate() | Exchange():
                if not suspended:
                    found.append(f"changed while {leads} lets requests in: {step_words(verb)}")
                if undrained and backups & {name.partition("/")[0] for name in names(verb)}:
                    found.append(
                        f"changed before {', '.join(sorted(undrained))} is drained: {step_words(verb)}"
                    )
            case _:
                pass
    held = [v for v in flat(script.prepare) if isinstance(v, Stage) and v.held]
    return found + [
        f"held, and never resumed: {v.node}" for v in held if resumed.isdisjoint(b.name for b in v.bricks)
    ]


def _loose_ends(graph: Graph, script: Script) -> list[str]:
    """Ends at bricks that stay, whose channel goes and is not unbound."""
    new = after(graph, script, KINDS)
    stay = {b.name for b in new.bricks} & {b.name for b in graph.bricks} - _staged_bricks(script)
    kept = {end for k in new.links if not k.standby for end in k.ends}
    unbound = {(v.brick, v.port) for v in flat(script.commit) if isinstance(v, Unbind)}
    gone = [end for k in graph.links if not k.standby for end in k.ends if end[0] in stay and end not in kept]
    return [f"leads nowhere, and is not unbound: {b}.{p}" for b, p, _ in gone if (b, p) not in unbound]


def _states(graph: Graph, script: Script) -> list[str]:
    """Bricks that begin with no state, or with another one than their leader's."""
    new, old = after(graph, script, KINDS), {b.name for b in graph.bricks}
    verbs = list(flat((*script.prepare, *script.commit)))
    equal = {v.sink for v in verbs if isinstance(v, Transfer | Align)}
    migrated = {b for v in verbs if isinstance(v, Migrate) for b in new.nodes.get(v.node, ())} & old
    stateful = [b for b in new.bricks if b.part in STATEFUL]
    begins = _staged_bricks(script) - equal - migrated
    found = [f"begins without a state: {b.name}" for b in stateful if b.name in begins]
    if replication_of(graph.ftm) not in ((), replication_of(new.ftm)):
        leads = f"{leader_of(graph)}/server"
        backups = [b.name for b in stateful if b.part == "server" and b.name in old - equal - {leads}]
        found += [f"may be behind {leads}, and is not aligned: {name}" for name in backups]
    return found


# -- which step -----------------------------------------------------------------------------------


def _placed(script: Script, rule: Rule) -> list[StepRefusal]:
    """What `rule` finds, each with the step since which it is there."""
    reasons = list(dict.fromkeys(rule(script)))
    steps, places = list(_steps(script)), dict[str, str]()
    for count in range(len(steps) - 1, -1, -1):
        left = [reason for reason in reasons if reason not in places]
        if not left:
            break
        rest, beginning = count, dict[str, tuple[Step, ...]]()
        for phase, verbs in phases(script).items():
            beginning[phase] = verbs[:rest]
            rest -= len(beginning[phase])
        before = rule(msgspec.structs.replace(script, **beginning))
        places |= {reason: steps[count][0] for reason in left if reason not in before}
    return [StepRefusal(places.get(reason, ""), reason) for reason in reasons]
