"""What becomes of an `Assign`: the bricks of a node, made, tried where they are not built in, joined and
bound.

The self-test sends recorded requests through a whole replica in memory. It runs in the process that will host
the new brick, before that gets any channel: so whatever the brick does there harms nothing, and a brick that
never ends is killed by the deadline of its preparation. Every request must be answered. Where the function is
the one that runs, the replies must be those of the built-in bricks, byte for byte; a new function must give
its own state back (`restore(capture())`), and know all its changes if it knows any.
"""

from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from typing import Final, TypeVar

import msgspec

from aftbed.adapt.plugins import make_brick
from aftbed.core.application import Application, KnowsChanges, close, knows_changes
from aftbed.core.brick import Brick, Effect
from aftbed.core.errors import ConfigError, FunctionFailedError, PeerError
from aftbed.core.graph import BrickSpec, Graph
from aftbed.core.messages import AnyMessage, Message, Reply, Request
from aftbed.ftm.compose import REPLICAS, chain
from aftbed.ftm.pages import PAGE_BYTES
from aftbed.ftm.registry import Setting
from aftbed.ftm.server import Server
from aftbed.functions.load import Code, load_application
from aftbed.functions.source import is_foreign
from aftbed.runtime import control
from aftbed.runtime.devices import Device
from aftbed.runtime.node import MemoryIO, Node, Stopped, nowhere

STEPS_MAX: Final = 500  # of a self-test, for one request; the longest mechanism takes 40
TEST_EPOCH: Final = 1

Result = TypeVar("Result")
MakeSetting = Callable[[BrickSpec, Setting], Brick]
MakeBrick = Callable[[BrickSpec], Brick]
In = TypeVar("In")
Out = TypeVar("Out")


class Assembler:
    """`function`: what is protected if the graph names nothing else; `page_bytes`: see `Setting`."""

    def __init__(
        self,
        function: Callable[[], Application],
        code: Code,
        make: MakeSetting | None = None,
        page_bytes: int = PAGE_BYTES,
    ) -> None:
        self._function, self._code, self._page_bytes = function, code, page_bytes
        self._opaque: dict[str, Callable[[], Application]] = {}  # makers of functions that are no classes
        self._made: list[Application] = []
        self._make: MakeSetting = make or (lambda spec, setting: make_brick(spec, setting, code))

    def build(
        self, node: Node[In, Out], order: control.Assign, fds: list[int], make_device: Callable[[], Device]
    ) -> None:
        """Make of `node` what `order` describes; answer it. Raises ConfigError where a class is no good."""
        node.suspended = order.held
        for spec in order.bricks:
            node.add(spec.name, self._make(spec, self._setting(spec, order)))
        if order.trial is not None:
            self._try_out(order, order.trial)
        for local in order.locals:
            node.link_inside(local, order.epoch)
        if order.device:
            node.attach(make_device(), order.bricks[0].name)
        for port in order.inputs:
            node.bind_input(port.brick, port.port, fds[port.index])
        node.ack(order.token)
        for port in order.outputs:
            node.bind_output(port.brick, port.port, fds[port.index], order.epoch)

    def _setting(self, spec: BrickSpec, order: control.Assign, leader: str = "") -> Setting:
        """What a brick is made for: its replica, whether that leads, and the function if it is not the
        default.
        """
        number = REPLICAS.index(spec.replica) + 1 if spec.replica else 0
        named = self._maker(spec.application) if spec.application else self._function
        epoch = TEST_EPOCH if leader else order.epoch
        leads = spec.replica == (leader or order.leader)
        return Setting(number, epoch, leads, named, self._page_bytes)

    def _maker(self, application: str) -> Callable[[], Application]:
        """Each class is loaded anew: replicas share no variable of a module, even in one process."""
        make = self._opaque.get(application) or load_application(application, self._code)
        if is_foreign(application):
            self._opaque[application] = make

        def made() -> Application:
            function = make()
            self._made.append(function)
            return function

        return made

    def close(self) -> None:
        """Close all functions that were made: programs end, models are removed."""
        for function in self._made:
            close(function)
        self._made.clear()

    def _try_out(self, order: control.Assign, trial: control.SelfTest) -> None:
        """The self-test of bricks that are not built in."""
        replica = next(s.replica for s in order.bricks if s.replica)
        server = next(b for b in trial.graph.bricks if b.part == "server")

        def setting(spec: BrickSpec) -> Setting:
            return self._setting(spec, order, leader=replica)

        function = setting(server).application()
        if server.application and server in order.bricks:
            _check_understands(server.application, function, trial.requests)
        self_test(
            trial.graph,
            replica,
            lambda spec: self._make(spec, setting(spec)),
            trial.requests,
            deterministic=function.characteristics.deterministic,
        )


def _check_understands(source: str, function: Application, requests: tuple[bytes, ...]) -> None:
    """Raise ConfigError if it refuses all of `requests`: it would answer, and never do anything."""
    why = ""
    for request in requests:
        try:
            function.execute(request)
        except PeerError as refusal:
            why = str(refusal)
        except FunctionFailedError as error:
            raise ConfigError(f"self-test: {source}: {error}") from error
        else:
            return
    if requests:
        raise ConfigError(
            f"self-test: {source} refuses each of the {len(requests)} requests recorded in this run: {why}"
        )


# -- the self-test --------------------------------------------------------------------------------


def self_test(
    graph: Graph, replica: str, make: MakeBrick, requests: tuple[bytes, ...], *, deterministic: bool = True
) -> None:
    """Raises ConfigError, naming the brick and the request, if the new bricks of `graph` do not work.

    The replies of a function that is not `deterministic` cannot be compared.
    """
    plain = msgspec.structs.replace(
        graph, bricks=tuple(msgspec.structs.replace(b, source="") for b in graph.bricks)
    )
    found = _TestedChain(graph, replica, make).replies(requests)
    if not deterministic:
        return
    wanted = _TestedChain(plain, replica, make).replies(requests)
    for number, (reply, expected) in enumerate(zip(found, wanted, strict=True), 1):
        if reply != expected:
            raise ConfigError(
                f"self-test: {_suspects(graph)}: recorded request {number}: the reply is"
                f" {reply.hex() or 'empty'}, wanted is {expected.hex() or 'empty'}"
            )


def _suspects(graph: Graph) -> str:
    """What is not built in."""
    return ", ".join(sorted({b.source or b.application for b in graph.bricks if b.source or b.application}))


def _told(error: Exception) -> str:
    known = isinstance(error, FunctionFailedError)
    return str(error) if known else f"{type(error).__name__}: {error}"


def _all_known(function: KnowsChanges, requests: tuple[bytes, ...]) -> bool:
    before = function.capture()
    function.changes(PAGE_BYTES)
    for request in requests:
        with suppress(PeerError):
            function.execute(request)
    after, pages = function.capture(), function.changes(PAGE_BYTES)
    function.restore(before)
    function.patch(PAGE_BYTES, pages)
    return function.capture() == after and len(before) == len(after)


class _Checked(Brick):
    """A brick whose exceptions are ConfigErrors."""

    def __init__(self, name: str, brick: Brick) -> None:
        self._name, self._brick = name, brick

    def open_ports(self) -> tuple[str, ...]:
        return self._brick.open_ports()

    def quiescent(self) -> bool:
        return self._brick.quiescent()

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        try:
            return self._brick.step(port, msg, now_ns)
        except Exception as error:
            raise ConfigError(
                f"self-test: {self._name}: {type(msg).__name__} on {port}: {_told(error)}"
            ) from error


class _TestedChain:
    """The bricks of one replica, which leads, in one node in memory. What leaves it is dropped, but for
    replies.
    """

    def __init__(self, graph: Graph, replica: str, make: MakeBrick) -> None:
        self._graph, self._entry = graph, f"{replica}/protocol"
        names = chain(graph, replica)
        bricks = {name: make(graph.brick(name)) for name in names}
        self._server = bricks[names[-1]]
        self._replies: list[bytes] = []
        self._node = Node("self-test", MemoryIO())
        for name, brick in bricks.items():
            hosted = self._node.add(name, _Checked(name, brick))
            hosted.outputs = defaultdict(lambda: nowhere, hosted.outputs)
        for link in graph.links:
            if link.source in bricks and link.sink in bricks:
                local = control.Local(link.source, link.source_port, link.sink, link.sink_port)
                self._node.link_inside(local, TEST_EPOCH)
        self._node.bricks[self._entry].outputs["pro2pxy"] = self._keep_reply

    def _keep_reply(self, message: Message) -> None:
        assert isinstance(message, Reply)
        self._replies.append(message.payload)

    def replies(self, requests: tuple[bytes, ...]) -> list[bytes]:
        """The reply to each of `requests`. Raises ConfigError."""
        for number, payload in enumerate(requests, 1):
            self._node.post(self._entry, "pxy2pro", Request(TEST_EPOCH, number, payload))
            try:
                for _ in range(STEPS_MAX):
                    if not self._node.turn():
                        break
            except Stopped as stop:
                raise ConfigError(f"self-test: {stop}") from stop
            if len(self._replies) != number:
                raise ConfigError(
                    f"self-test: {_suspects(self._graph)}: recorded request {number} is never answered"
                )
        state = self._tried(self._server.capture, "capture")
        self._tried(lambda: self._server.restore(state), "restore")
        if self._tried(self._server.capture, "capture") != state:
            raise ConfigError(f"self-test: {_suspects(self._graph)}: it does not restore what it captures")
        if isinstance(self._server, Server):
            self._try_changes(self._server.application, requests)
        return self._replies

    def _try_changes(self, function: Application, requests: tuple[bytes, ...]) -> None:
        """Its changes, put on the state of before, are its state. Raises ConfigError."""
        has = [name for name in ("changes", "patch") if hasattr(function, name)]
        if len(has) == 1:
            raise ConfigError(f"self-test: {_suspects(self._graph)}: it has {has[0]}, and not the other one")
        if knows_changes(function) and not self._tried(lambda: _all_known(function, requests), "changes"):
            raise ConfigError(
                f"self-test: {_suspects(self._graph)}: changes and patch do not give the state of capture"
            )

    def _tried(self, call: Callable[[], Result], what: str) -> Result:
        """What the call returns. Raises ConfigError for any exception of it."""
        try:
            return call()
        except Exception as error:
            text = f"{what}: {_told(error)}"
            raise ConfigError(f"self-test: {_suspects(self._graph)}: {text}") from error
