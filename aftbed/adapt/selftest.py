"""The self-test of what was written off line: recorded requests through a whole replica, in memory.

It runs in the process that will host the new brick, before that gets any channel; so whatever the brick
does there harms nobody, and a brick that never ends is killed by the deadline of its preparation. Every
request must be answered. Where the function is the one that runs, the replies must be those of the built-in
bricks, byte for byte; a new function must give its own state back (`restore(capture())`).
"""

from collections import deque
from collections.abc import Callable
from typing import Final

import msgspec

from aftbed.core.brick import CONTROL, Brick, Halt, Send
from aftbed.core.errors import ConfigError
from aftbed.core.graph import BrickSpec, Graph
from aftbed.core.messages import AnyMessage, Message, Rebound, Reply, Request
from aftbed.ftm.compose import chain

STEPS_MAX: Final = 500  # for one request; the longest mechanism takes 40
EPOCH: Final = 1

Make = Callable[[BrickSpec], Brick]


def run(
    graph: Graph, replica: str, make: Make, requests: tuple[bytes, ...], *, deterministic: bool = True
) -> None:
    """Raises ConfigError, naming the brick and the request, if the new bricks of `graph` do not work.

    The replies of a function that is not `deterministic` cannot be compared.
    """
    plain = msgspec.structs.replace(
        graph, bricks=tuple(msgspec.structs.replace(b, source="") for b in graph.bricks)
    )
    found = _Chain(graph, replica, make).replies(requests)
    if not deterministic:
        return
    wanted = _Chain(plain, replica, make).replies(requests)
    for number, (reply, expected) in enumerate(zip(found, wanted, strict=True), 1):
        if reply != expected:
            raise ConfigError(
                f"self-test: {_suspects(graph)}: recorded request {number}: the reply is"
                f" {reply.hex() or 'empty'}, wanted is {expected.hex() or 'empty'}"
            )


def _suspects(graph: Graph) -> str:
    """What is not built in."""
    return ", ".join(sorted({b.source or b.application for b in graph.bricks if b.source or b.application}))


class _Chain:
    """The bricks of one replica, which leads, with a queue per channel."""

    def __init__(self, graph: Graph, replica: str, make: Make) -> None:
        self._graph = graph
        self._names = chain(graph, replica)
        self._bricks = {name: make(graph.brick(name)) for name in self._names}
        self._ways = {(k.source, k.source_port): k for k in graph.links if k.sink in self._bricks}
        self._mail: dict[tuple[str, str], deque[Message]] = {}
        self._entry = f"{replica}/protocol"
        self._replies: list[bytes] = []
        for source, port in self._ways:
            if source in self._bricks:
                self._step(source, CONTROL, Rebound(port, True, EPOCH))

    def replies(self, requests: tuple[bytes, ...]) -> list[bytes]:
        """The reply to each of `requests`."""
        for number, payload in enumerate(requests, 1):
            self._mail.setdefault((self._entry, "pxy2pro"), deque()).append(Request(EPOCH, number, payload))
            for _ in range(STEPS_MAX):
                if not self._move():
                    break
            if len(self._replies) != number:
                raise ConfigError(
                    f"self-test: {_suspects(self._graph)}: recorded request {number} is never answered"
                )
        server = self._bricks[self._names[-1]]
        state = server.capture()
        server.restore(state)
        if server.capture() != state:
            raise ConfigError(f"self-test: {_suspects(self._graph)}: it does not restore what it captures")
        return self._replies

    def _move(self) -> bool:
        """Hand one message to a brick that takes it; False if there is none."""
        for (name, port), waiting in self._mail.items():
            if waiting and port in self._bricks[name].open_ports():
                self._step(name, port, waiting.popleft())
                return True
        return False

    def _step(self, name: str, port: str, message: AnyMessage | Message) -> None:
        try:
            effects = self._bricks[name].step(port, message, 0)  # type: ignore[arg-type]
        except Exception as error:
            raise ConfigError(
                f"self-test: {name}: {type(message).__name__} on {port}: {type(error).__name__}: {error}"
            ) from error
        for effect in effects:
            if isinstance(effect, Halt):
                raise ConfigError(f"self-test: {name} stops: {effect.reason}")
            if isinstance(effect, Send):
                self._send(name, effect)

    def _send(self, name: str, effect: Send) -> None:
        if name == self._entry and effect.port == "pro2pxy":
            assert isinstance(effect.message, Reply)
            self._replies.append(effect.message.payload)
            return
        link = self._ways.get((name, effect.port))
        if link is not None:
            self._mail.setdefault((link.sink, link.sink_port), deque()).append(effect.message)
