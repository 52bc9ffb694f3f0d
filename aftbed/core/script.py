"""What the runtime can be asked to do, as data: a script of verbs, executed in order.

Recovery orders scripts today, the Adaptation Engine and hand-written files will. `prepare` steps
touch new nodes only and can be undone; `commit` steps act on what serves. A script is one value, so
that the whole of it can be checked before its first step runs, journalled, simulated and crashed.
"""

from typing import Final

import msgspec


class Verb(msgspec.Struct, frozen=True, tag=True):
    """Base of the verbs. Bricks are named `a/protocol`, replicas `a` and `b`."""


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
    """Have `replica` drain its checkpoint channel to the end and lead under `epoch`."""

    replica: str
    epoch: int


class Attach(Verb, frozen=True):
    """Bind the Proxy to `replica`; it resends what is unanswered."""

    replica: str
    epoch: int


class Suspend(Verb, frozen=True):
    """Let `brick` finish the request inside it and take no further one; mail waits in its channel."""

    brick: str


class Resume(Verb, frozen=True):
    """Undo Suspend."""

    brick: str


class Transfer(Verb, frozen=True):
    """Capture the state of `source` and restore it in `sink` (both quiescent)."""

    source: str
    sink: str


class Bind(Verb, frozen=True):
    """Bind `port` of `brick` to the same port of `target`."""

    brick: str
    port: str
    target: str


class Unbind(Verb, frozen=True):
    """Let `port` of `brick` lead nowhere."""

    brick: str
    port: str


AnyVerb = Spawn | Fence | Kill | Promote | Attach | Suspend | Resume | Transfer | Bind | Unbind

STEPS_MAX: Final = 1024


class Script(msgspec.Struct, frozen=True):
    """`purpose` is what a person reads: `failover`, `drop backup`, `new backup`."""

    purpose: str
    replica: str
    prepare: tuple[AnyVerb, ...]
    commit: tuple[AnyVerb, ...]


def problems(script: Script) -> list[str]:
    """Every reason to refuse `script`, or []."""
    found = _prepare_problems(script)
    if len(script.prepare) + len(script.commit) > STEPS_MAX:
        found.append(f"more than {STEPS_MAX} steps")
    held: set[str] = set()
    fenced: set[str] = set()
    for verb in script.commit:
        match verb:
            case Suspend(brick):
                held.add(brick)
            case Resume(brick) if brick not in held:
                found.append(f"resumed, not suspended: {brick}")
            case Resume(brick):
                held.remove(brick)
            case Fence(replica):
                fenced.add(replica)
            case Kill(replica) if replica not in fenced:
                found.append(f"killed before it was fenced: {replica}")
            case Promote(replica) | Attach(replica) if not fenced - {replica}:
                found.append(f"a new master while the old one is not fenced: {verb}")
            case Promote(replica) | Attach(replica) if replica in fenced:
                found.append(f"a master that is fenced: {verb}")
            case Transfer() | Bind() if not held:
                found.append(f"changed while requests flow: {verb}")
            case Spawn():
                found.append(f"spawned while the client waits: {verb}")
            case _:
                pass
    return found + [f"suspended, not resumed: {brick}" for brick in sorted(held)]


def _prepare_problems(script: Script) -> list[str]:
    """Prepare acts on nothing but what it has spawned before."""
    new: set[str] = set()
    found = []
    for verb in script.prepare:
        if isinstance(verb, Spawn):
            new.add(verb.replica)
        elif not _touches(verb) <= new:
            found.append(f"prepare touches what already serves: {verb}")
    return found


def _touches(verb: AnyVerb) -> set[str]:
    """The replicas that `verb` acts on."""
    match verb:
        case Spawn(replica) | Fence(replica) | Kill(replica) | Promote(replica) | Attach(replica):
            return {replica}
        case Suspend(brick) | Resume(brick) | Unbind(brick):
            return {brick.partition("/")[0]}
        case Transfer(source, sink):
            return {source.partition("/")[0], sink.partition("/")[0]}
        case Bind(brick, _, target):
            return {brick.partition("/")[0], target.partition("/")[0]}
