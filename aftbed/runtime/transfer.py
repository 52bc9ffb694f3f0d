"""What an adaptation asks of processes, and their ends; state on its way from one brick to another.

A brick captures its state as bytes and takes bytes back (design 4, the brick contract); what they mean is
its own affair. Both ends are quiet while it happens: that is the business of whoever asks.
"""

import contextlib
import functools
from collections.abc import Callable, Generator, Iterable
from hashlib import blake2b
from typing import Final

from aftbed.core.errors import StepFailed
from aftbed.core.graph import Graph
from aftbed.runtime import control
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.interface import Process, ProcessKind
from aftbed.runtime.jobs import Key, Wait

EXCHANGE_SECONDS_MAX: Final = 0.5

Answer = Generator[Wait, dict[Key, bytes], bytes]
Seat = tuple[str, Process]  # a brick, and who hosts it


def ask(
    deployment: Deployment,
    process: Process,
    make: Callable[[int], control.ToNode],
    seconds: float = EXCHANGE_SECONDS_MAX,
) -> Answer:
    """What `process` answers to one order. Raises `StepFailed` if it dies, refuses, or takes too long."""
    key, name = deployment.order_to(process, make)
    got = yield Wait(frozenset({key}), frozenset({name}), seconds)
    return got[key]


def answered(sent: list[tuple[Key, str]], seconds: float = EXCHANGE_SECONDS_MAX) -> Keys:
    """Wait for what several processes answer, among them such as have no place in the graph yet."""
    if sent:
        yield Wait(frozenset(k for k, _ in sent), frozenset(n for _, n in sent), seconds)


def end(process: Process) -> None:
    """It dies, and its death is no news."""
    process.kind = ProcessKind.KILLED
    process.kill()


def seen_dead(processes: Iterable[Process]) -> Keys:
    """End them all, and wait: one that lived a moment longer would take mail that is for others.

    One that will not die within the time is let be.
    """
    living = [process for process in processes if process.alive]
    for process in living:
        end(process)
    with contextlib.suppress(StepFailed):
        yield Wait(frozenset(("died", p.name, p.pid) for p in living), seconds=EXCHANGE_SECONDS_MAX)


def transfer(deployment: Deployment, source: Seat, sink: Seat) -> Keys:
    """The sink's state is the source's."""
    state = yield from ask(deployment, source[1], lambda token: control.Capture(token, source[0]))
    yield from ask(deployment, sink[1], lambda token: control.Restore(token, sink[0], state))


def align(deployment: Deployment, source: Seat, sink: Seat) -> Keys:
    """The same, where the two differ: both are asked at once, and the digests are compared."""
    asked = [
        deployment.order_to(process, functools.partial(control.Capture, brick=brick))
        for brick, process in (source, sink)
    ]
    got = yield Wait(frozenset(k for k, _ in asked), frozenset(n for _, n in asked), EXCHANGE_SECONDS_MAX)
    states = [got[key] for key, _ in asked]
    if blake2b(states[0]).digest() != blake2b(states[1]).digest():
        yield from ask(deployment, sink[1], lambda token: control.Restore(token, sink[0], states[0]))


def migrate(
    deployment: Deployment, given: Graph, giver: Process, taken: Graph, taker: Process, node: str
) -> Keys:
    """The state of every brick that `node` has in both graphs. What has none needs no taker."""
    for brick in given.nodes[node]:
        if brick not in taken.nodes[node]:
            continue
        state = yield from ask(deployment, giver, functools.partial(control.Capture, brick=brick))
        changed = given.brick(brick) != taken.brick(brick)
        if state:
            restored = functools.partial(control.Restore, brick=brick, state=state, migrate=changed)
            yield from ask(deployment, taker, restored)
