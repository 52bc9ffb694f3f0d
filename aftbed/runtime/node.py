"""The host of bricks, for every runtime: mail in, `step`, effects out.

A `Node` hosts one or more bricks. It decides what is handled next, performs the effects of each step in list
order, carries out the orders of the executive, and calls the fault agent where a fault waits. How bytes move,
how time passes and how a node ends is its `NodeIO`: `unix.node_io` over sockets and the kernel's clock,
`sim.node_io` over virtual time, `MemoryIO` here for chains without a process. The order of things:

1. Orders of the executive come before data (the NodeIO sees to it: it knows when an order has arrived).
2. Mail between bricks of this node, the oldest whose port is open.
3. A suspend that was asked for, once no request is inside; a suspended node takes no mail.
4. What the device has for its brick (requests for the Client, what the Watchdog senses).
5. Mail from other nodes at an open port, then deadlines that have passed.

Mail for a closed port stays in its channel, which outlives this node.
"""

from collections import deque
from collections.abc import Callable
from operator import length_hint
from typing import Final, Generic, NoReturn, Protocol, TypeVar, assert_never

from aftbed.core.brick import CONTROL, Brick, Effect, Halt, Note, Order, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import AnyMessage, Message, Rebound, Reply, Watch
from aftbed.inject.agent import FaultAgent
from aftbed.inject.shared_state import look
from aftbed.runtime import control
from aftbed.runtime.devices import Device, Sensor

WATCHDOG: Final = "{}/watchdog"

In = TypeVar("In")  # the reading end of a channel
Out = TypeVar("Out")  # the writing end of a channel
Deliver = Callable[[Message], None]


class HostedBrick(Generic[In, Out]):
    """A brick, the channels that it reads by port, and where its outputs lead: to a channel or a function."""

    __slots__ = ("brick", "index", "inputs", "name", "outputs", "performed", "timed")

    def __init__(self, name: str, brick: Brick, index: int) -> None:
        self.name, self.brick, self.index = name, brick, index
        self.inputs: dict[str, In] = {}
        self.outputs: dict[str, Out | Deliver] = {}
        self.timed = type(brick).deadline_ns is not Brick.deadline_ns
        self.performed = 0  # effects so far, but for those of the fast loop of unix


class Recorder(Protocol):
    """Appends a record to a journal."""

    def __call__(
        self, now_ns: int, event: Event, request_id: int, detail: int, brick: int = 0, /
    ) -> None: ...


class NodeIO(Protocol[In, Out]):
    """What a node needs of its runtime. A class that names this contract as its base gets the defaults of a
    NodeIO without channels to other nodes and without faults; one whose writes wait for room, and whose node
    never stops between two effects.
    """

    output: type[Out]

    def join(self, node: "Node[In, Out]") -> None:
        """Work for `node`. Called once."""
        ...

    # -- time, records, the executive

    @property
    def now_ns(self) -> Callable[[], int]:
        """The clock: monotonic."""
        ...

    @property
    def record(self) -> Recorder:
        """What appends to the journal."""
        ...

    def report(self, report: control.FromNode) -> None:
        """Send to the executive."""
        ...

    def rehearse(self, kinds: tuple[str, ...]) -> None:
        """Do once in private what bricks of these kinds do in a failover. By default nothing: only in a
        process is the first time slower than the next.
        """
        return

    def memory(self, number: int) -> memoryview:
        """The shared memory that came with an order as `number`."""
        raise AssertionError(f"no memory {number}")

    def put_state(self, number: int, state: bytes) -> bytes:
        """Put `state` into the file that came with an order, if it is too large for the answer to hold it.

        The data of the answer.
        """
        raise AssertionError(f"no file {number}")

    def state_in(self, number: int) -> bytes:
        """The state in the file that came with an order. Raises PeerError."""
        raise AssertionError(f"no file {number}")

    # -- channels

    def open_input(self, hosted: HostedBrick[In, Out], port: str, number: int) -> In:
        """The reading end that came with an order as `number`."""
        raise AssertionError(f"no channel {number}")

    def close_input(self, end: In) -> None:
        """Let go of it."""
        raise AssertionError(f"no channel {end}")

    def open_output(self, number: int) -> Out:
        """The writing end that came with an order as `number`."""
        raise AssertionError(f"no channel {number}")

    def close_output(self, end: Out) -> None:
        """Let go of it."""
        raise AssertionError(f"no channel {end}")

    def rewired(self) -> None:
        """The inputs, or what the device has to poll, have changed."""
        ...

    def receive(self) -> bool:
        """Handle the next mail at an open port, or wake what is due. False if there is nothing; unix waits
        for it.
        """
        ...

    def mail_waits(self) -> bool:
        """Whether there is mail at an open port."""
        ...

    def wait_for_order(self) -> bool:
        """The node is suspended: wait for an order and carry it out. False if an order comes by itself."""
        ...

    def write(
        self, hosted: HostedBrick[In, Out], port: str, end: Out, message: Message, raw: bytes | None
    ) -> bool:
        """Send `message`, whose bytes are `raw` if known. False if there is no room now: see `hold`."""
        raise AssertionError(f"no channel {end}")

    def has_room(self, end: Out) -> bool:
        """Whether a write can succeed now."""
        return True

    def write_in_turn(self, hosted: HostedBrick[In, Out], port: str, end: Out, message: Message) -> None:
        """Send `message`, behind what waits for room at this end; wait, or keep it until there is room."""
        self.write(hosted, port, end, message, None)

    def write_or_drop(self, end: Out, message: Message) -> None:
        """Send `message` if there is room: the end is about to be closed."""
        raise AssertionError(f"no channel {end}")

    # -- stopping between two effects

    def stops(self, hosted: HostedBrick[In, Out]) -> bool:
        """Whether the next effect has to wait: a fault is being applied, or the step is slow."""
        return False

    def hold(
        self, hosted: HostedBrick[In, Out], effects: list[Effect], at: int, end: Out | None, *, filtered: bool
    ) -> None:
        """Perform `effects` from `at` on later: there was no room at `end`, or `stops` was true (None)."""
        raise AssertionError(f"{type(self).__name__} waits for room")

    def step_done(self, hosted: HostedBrick[In, Out]) -> None:
        """All effects of a step are performed. Called where they are performed one by one."""
        return

    # -- faults

    def kill(self) -> None:
        """Die at once."""
        raise AssertionError("no fault waits here")

    def stop_detected(self, brick: str, reason: str) -> NoReturn:
        """A detected stop: end at once."""
        ...

    def wait_until_applied(self, fault: int) -> None:
        """Perform no further effect until the executive has acknowledged `fault`."""
        raise AssertionError(f"no fault {fault} waits here")

    def delay(self, by_ns: int) -> None:
        """Take that much longer over this step."""
        raise AssertionError("no fault waits here")

    def begin_throttle(self) -> None:
        """CPU time counts for `throttle` from now on."""
        raise AssertionError("no fault waits here")

    def throttle(self, stretch_ns: Callable[[int], int]) -> None:
        """Take longer by `stretch_ns` of the CPU time that was used since the last call."""
        raise AssertionError("no fault waits here")


def nowhere(message: Message) -> None:
    """An output that is not bound."""


class Node(Generic[In, Out]):
    """One node of the graph."""

    def __init__(self, name: str, io: NodeIO[In, Out]) -> None:
        self.name, self.io = name, io
        self._now_ns, self._record, self._write, self._receive = io.now_ns, io.record, io.write, io.receive
        self._output = io.output
        self.bricks: dict[str, HostedBrick[In, Out]] = {}
        self.timed: list[HostedBrick[In, Out]] = []  # bricks with deadlines
        self.only: HostedBrick[In, Out] | None = None  # the brick of a node that hosts one
        self.agent = FaultAgent(self)
        self.careful = False  # set by a NodeIO that may have to stop between two effects, without a fault
        self.device: Device | None = None
        self._device_brick: HostedBrick[In, Out] | None = None
        self.mail: deque[tuple[HostedBrick[In, Out], str, Message]] = deque()  # from brick to brick
        self.suspended = False
        self.suspend_token = 0  # not 0: suspend as soon as no request is inside,
        self._draining = False  # and nothing waits at the open ports
        io.join(self)

    # -- building -----------------------------------------------------------------------------

    def add(self, name: str, brick: Brick) -> HostedBrick[In, Out]:
        """Host `brick`."""
        hosted: HostedBrick[In, Out] = HostedBrick(name, brick, len(self.bricks))
        self.bricks[name] = hosted
        hosted.outputs[CONTROL] = lambda message: self._report_message(name, message)
        self.timed = [h for h in self.bricks.values() if h.timed]
        self.only = hosted if len(self.bricks) == 1 else None
        self.io.rewired()
        return hosted

    def _report_message(self, brick: str, message: Message) -> None:
        assert isinstance(message, control.FromBrick)
        self.io.report(control.BrickReport(brick, message))

    def link_inside(self, local: control.Local, epoch: int) -> None:
        """A channel between two bricks of this node; the source gets a Rebound, as for any other."""
        source, sink = self.bricks[local.brick], self.bricks[local.sink]
        source.outputs[local.port] = lambda message: self.mail.append((sink, local.sink_port, message))
        self.step(source, CONTROL, Rebound(local.port, True, epoch))

    def post(self, brick: str, port: str, message: Message) -> None:
        """Put `message` into the mail between the bricks of this node."""
        self.mail.append((self.bricks[brick], port, message))

    def attach(self, device: Device, brick: str) -> None:
        """Join `device` to `brick`."""
        self.device, self._device_brick = device, self.bricks[brick]
        self._device_brick.outputs["deliver"] = self._deliver
        self.io.rewired()

    def _deliver(self, message: Message) -> None:
        assert isinstance(message, Reply) and self.device is not None
        self.device.accept(message, self._now_ns())

    def bind_input(self, brick: str, port: str, number: int | None) -> None:
        """Read `port` from the channel with that end from now on, or from nowhere."""
        hosted = self.bricks[brick]
        old = hosted.inputs.pop(port, None)
        if number is not None:
            hosted.inputs[port] = self.io.open_input(hosted, port, number)
        if old is not None:
            self.io.close_input(old)
        self.io.rewired()

    def bind_output(self, brick: str, port: str, number: int | None, epoch: int) -> None:
        """Write `port` to the channel with that end from now on, or to nowhere, and inform the brick.

        What a fault of the old channel holds back goes there first; the fault then lies on the new one.
        """
        hosted = self.bricks[brick]
        old = hosted.outputs.get(port)
        found = self.agent.filters.get((brick, port))
        if old is not None and found is not None:
            for message in found.flush(self._now_ns()):
                if isinstance(old, self._output):
                    self.io.write_or_drop(old, message)
                else:
                    old(message)  # type: ignore[operator]
            self.agent.settle()
        hosted.outputs[port] = nowhere if number is None else self.io.open_output(number)
        if isinstance(old, self._output):
            self.io.close_output(old)
        self.step(hosted, CONTROL, Rebound(port, number is not None, epoch))

    # -- turns --------------------------------------------------------------------------------

    def turn(self) -> bool:
        """Handle what is first in the order above; False if nothing is left."""
        if self.mail and self._step_inside():
            return True
        if self.suspend_token or self.suspended:
            if self.suspend_token and self._is_quiescent():
                self.suspended = True
                self.ack(self.suspend_token)
                self.suspend_token = 0
            if self.suspended:
                return self.io.wait_for_order()
        if self.device is not None and self.step_device(self.device):
            return True
        return self._receive()

    def _step_inside(self) -> bool:
        hosted, port, message = self.mail[0]
        if port in hosted.brick.open_ports():  # nearly always
            self.mail.popleft()
            self.step(hosted, port, message)
            return True
        for index, (hosted, port, message) in enumerate(self.mail):
            if port in hosted.brick.open_ports():
                del self.mail[index]
                self.step(hosted, port, message)
                return True
        return False

    def _is_quiescent(self) -> bool:
        if self.mail or not all(hosted.brick.quiescent() for hosted in self.bricks.values()):
            return False
        return not (self._draining and self.io.mail_waits())

    def step_device(self, device: Device) -> bool:
        """Hand the brick what the device has for it; False if that is nothing, or its port is closed."""
        hosted = self._device_brick
        assert hosted is not None
        if device.port not in hosted.brick.open_ports():
            device.wait(self._now_ns())
            return False
        message = device.take(self._now_ns())
        if message is None:
            return False
        self.step(hosted, device.port, message)
        return True

    def deadline_ns(self) -> int | None:
        """When something is due: in a brick, in the device, in a channel fault."""
        due = self.device.deadline_ns() if self.device is not None else None
        for hosted in self.timed:
            wanted = hosted.brick.deadline_ns()
            if wanted is not None and (due is None or wanted < due):
                due = wanted
        for found in self.agent.filters.values():
            wanted = found.due_ns()
            if wanted is not None and (due is None or wanted < due):
                due = wanted
        return due

    def wake_due(self, now_ns: int) -> bool:
        """Wake the first brick whose deadline has passed; False if there is none."""
        for hosted in self.timed:
            due = hosted.brick.deadline_ns()
            if due is not None and due <= now_ns:
                effects = hosted.brick.wake(now_ns)
                if self.agent.active or self.careful:
                    self.perform_from(hosted, effects, 0)
                else:
                    self._perform(hosted, effects, now_ns)
                return True
        return False

    def release_due(self, now_ns: int) -> None:
        """Send what channel faults have held back long enough. The NodeIO calls it when it wakes up."""
        for (name, port), found in list(self.agent.filters.items()):
            due = found.due_ns()
            if due is not None and due <= now_ns:
                self._put_in_turn(self.bricks[name], port, found.release(now_ns))
        self.agent.settle()

    # -- steps and effects --------------------------------------------------------------------

    def step(
        self,
        hosted: HostedBrick[In, Out],
        port: str,
        message: AnyMessage | Message,
        raw: bytes | None = None,
    ) -> None:
        """Have the brick handle `message`, which came as the bytes `raw`, and perform what it asks for."""
        if self.agent.active or self.careful:
            self._step_carefully(hosted, port, message)
            return
        now_ns = self._now_ns()
        try:
            effects = hosted.brick.step(port, message, now_ns)  # type: ignore[arg-type]
        except PeerError:
            self._record(now_ns, Event.PEER_REFUSED, getattr(message, "request_id", 0), 0)
            return
        if effects:
            self._perform(hosted, effects, now_ns, message, raw)

    def _step_carefully(self, hosted: HostedBrick[In, Out], port: str, message: AnyMessage | Message) -> None:
        """The same with the fault agent around it, effects one by one."""
        agent = self.agent
        slowed = agent.slowed and port != CONTROL
        if slowed:
            self.io.delay(agent.delay_ns())
        now_ns = self._now_ns()
        try:
            effects = agent.step(hosted.name, hosted.brick, port, message, now_ns)
        except PeerError:
            self._record(now_ns, Event.PEER_REFUSED, getattr(message, "request_id", 0), 0)
            return
        if slowed:
            self.io.throttle(agent.stretch_ns)
        if effects:
            self.perform_from(hosted, effects, 0)

    def _perform(
        self,
        hosted: HostedBrick[In, Out],
        effects: list[Effect],
        now_ns: int,
        message: object = None,
        raw: bytes | None = None,
    ) -> None:
        """The effects of a step at `now_ns`, in their order. `message`, passed on as it is, is not encoded
        again.
        """
        hosted.performed += len(effects)
        outputs, output, left = hosted.outputs, self._output, iter(effects)
        for effect in left:
            kind = type(effect)
            if kind is Send:
                out = outputs[effect.port]  # type: ignore[union-attr]
                sent: Message = effect.message  # type: ignore[union-attr]
                if not isinstance(out, output):
                    out(sent)  # type: ignore[operator]
                elif not self._write(hosted, effect.port, out, sent, raw if sent is message else None):  # type: ignore[union-attr]
                    at = len(effects) - length_hint(left) - 1
                    hosted.performed -= len(effects) - at
                    self.io.hold(hosted, effects, at, out, filtered=False)
                    return
            elif kind is Note:
                self._record(now_ns, effect.event, effect.request_id, effect.detail, hosted.index)  # type: ignore[union-attr]
            else:
                self.order_or_halt(hosted, effect)

    def perform_from(self, hosted: HostedBrick[In, Out], effects: list[Effect], start: int) -> None:
        """The effects from `start` on, one by one: with the fault agent, and where the node may stop in
        between.
        """
        agent = self.agent
        for at in range(start, len(effects)):
            if self.io.stops(hosted):
                self.io.hold(hosted, effects, at, None, filtered=False)
                return
            effect = effects[at]
            if isinstance(effect, Send):
                filtered = (hosted.name, effect.port) in agent.filters
                if not self.send(hosted, effect.port, effect.message):
                    end = hosted.outputs[effect.port]
                    assert isinstance(end, self._output)
                    self.io.hold(hosted, effects, at, end, filtered=filtered)
                    return
            elif isinstance(effect, Note):
                self._record(self._now_ns(), effect.event, effect.request_id, effect.detail, hosted.index)
                if agent.active:
                    agent.noted(hosted.name, hosted.brick, effects, at)
            else:
                self.order_or_halt(hosted, effect)
            hosted.performed += 1
        self.io.step_done(hosted)

    def send(self, hosted: HostedBrick[In, Out], port: str, message: Message) -> bool:
        """Send `message`, through the filter on its channel if there is one. False if there is no room."""
        out = hosted.outputs[port]
        found = self.agent.filters.get((hosted.name, port))
        if found is None:
            if isinstance(out, self._output):
                return self._write(hosted, port, out, message, None)
            out(message)  # type: ignore[operator]
            return True
        if isinstance(out, self._output) and not self.io.has_room(out):
            return False
        self._put_in_turn(hosted, port, found.take(message, self._now_ns()))
        self.agent.settle()
        return True

    def _put_in_turn(self, hosted: HostedBrick[In, Out], port: str, messages: list[Message]) -> None:
        """Send what has come out of a filter, which may be lifted while there is no room."""
        out = hosted.outputs[port]
        for message in messages:
            if hosted.outputs[port] != out:
                return  # bound elsewhere meanwhile: the brick got a Rebound, and has asked again
            if isinstance(out, self._output):
                self.io.write_in_turn(hosted, port, out, message)
            else:
                out(message)  # type: ignore[operator]

    def order_or_halt(self, hosted: HostedBrick[In, Out], effect: Effect) -> None:
        """The rare effects: a script for the executive, or the end of this node."""
        if isinstance(effect, Order):
            self.io.report(control.Ordered(hosted.name, effect.script, effect.phase, effect.number))
            return
        assert isinstance(effect, Halt)
        self.io.stop_detected(hosted.name, effect.reason)

    # -- what the fault agent asks for: see `inject.agent.AgentHost` ------------------------------------

    def brick(self, name: str) -> Brick:
        """The brick of that name. Raises KeyError."""
        return self.bricks[name].brick

    def record(self, event: Event, request_id: int, detail: int) -> None:
        self._record(self._now_ns(), event, request_id, detail)

    def report_fired(self, fault: int) -> None:
        """Report that `fault` is due, or has struck."""
        self.io.report(control.Fired(fault))

    def wait_until_applied(self, fault: int) -> None:
        """Perform no further effect until the executive has acknowledged `fault`."""
        self.io.wait_until_applied(fault)

    def kill(self) -> None:
        self.io.kill()

    def stop_detected(self, brick: str, reason: str) -> None:
        """A detected stop: end this node at once."""
        self.io.stop_detected(brick, reason)

    # -- orders of the executive --------------------------------------------------------------

    def obey(self, order: control.ToNode, fds: list[int]) -> None:
        """Carry out `order`, and answer it unless its answer comes later."""
        try:
            data = self.carry_out(order, fds)
        except PeerError as error:
            self.ack(order.token, error=str(error))
        else:
            if data is not None:
                self.ack(order.token, data)

    def ack(self, token: int, data: bytes = b"", error: str = "") -> None:
        """Answer an order."""
        if token != control.UNANSWERED:
            self.io.report(control.Ack(token, data, error))

    def carry_out(  # noqa: PLR0912 - a case for each order
        self, order: control.ToNode, fds: list[int]
    ) -> bytes | None:
        """Do what `order` says; the data of its Ack, or None where the Ack comes later.

        `fds` are the numbers of the ends that came with it. Raises PeerError where a brick refuses, or where
        the order is not for a node.
        """
        match order:
            case control.BindInput(_, brick, port):
                self.bind_input(brick, port, fds.pop() if fds else None)
            case control.BindOutput(_, brick, port, epoch):
                self.bind_output(brick, port, fds.pop() if fds else None, epoch)
            case control.Follow(_, brick, port, output, epoch):
                read, write = fds
                self.bind_input(brick, port, read)
                self.bind_output(brick, output, write, epoch)
            case control.Rewire(token, inputs, outputs, epoch, suspend):
                numbers = dict(enumerate(fds))
                for end in inputs:
                    self.bind_input(end.brick, end.port, numbers.get(end.index))  # NOWHERE is none of them
                for end in outputs:
                    self.bind_output(end.brick, end.port, numbers.get(end.index), epoch)
                if suspend:
                    self.suspend_token, self._draining = token, False
                    return None  # answered when quiescent
            case control.SuspendNode(token, drain):
                self.suspend_token, self._draining = token, drain
                return None  # answered when quiescent
            case control.ResumeNode():
                self.suspended, self.suspend_token = False, 0
            case control.Capture(_, brick, looks):
                found = self.bricks[brick].brick
                captured = look(found) if looks else found.capture()
                return self.io.put_state(fds.pop(), captured) if fds else captured
            case control.Restore(_, brick, state, migrate):
                taker = self.bricks[brick].brick
                take = getattr(taker, "migrate", taker.restore) if migrate else taker.restore
                take(self.io.state_in(fds.pop()) if fds else state)
            case control.Deliver(_, brick, message):
                self.step(self.bricks[brick], CONTROL, message)
            case control.WatchNodes(_, replica, generation, nodes):
                assert isinstance(self.device, Sensor)
                self.device.watch(order, fds)
                self.io.rewired()
                watchdog = self.bricks[WATCHDOG.format(replica)]
                self.step(watchdog, CONTROL, Watch(replica, generation, nodes))
            case control.Arm(_, event, faults) if event:
                self.agent.arm(event, faults)
            case control.Arm(_, _, faults):
                for fault in faults:
                    self.agent.disturb(fault)
            case control.SlowDown(_, number, by_ns, share):
                if not self.agent.slowed:
                    self.io.begin_throttle()
                self.agent.slow_down(number, by_ns, share)
            case control.ShareState(_, brick, number):
                return self.agent.share_state(brick, number, self.io.memory(fds.pop()))
            case control.Stats():
                return self.device.stats() if self.device is not None else b""
            case control.Rehearse(_, kinds):
                self.io.rehearse(kinds)
            case control.StopRequests():
                assert self.device is not None
                self.device.quiet()
            case (
                control.Park()
                | control.JoinRun()
                | control.Assign()
                | control.Serve()
                | control.DisturbBus()
                | control.DisturbRadar()
                | control.WatchCar()
                | control.Stop()
                | control.Ack()
            ):
                raise PeerError(f"{type(order).__name__} to a node")
            case _:
                assert_never(order)
        return b""


class MemoryIO(NodeIO[int, int]):
    """The NodeIO of bricks in memory, for self-tests and rehearsals: all channels are links within the node,
    no fault waits in it, time stands still. `stop_detected` raises `Stopped`.
    """

    output = int

    def join(self, node: Node[int, int]) -> None:
        """Nothing to set up."""

    @property
    def now_ns(self) -> Callable[[], int]:
        return lambda: 0

    @property
    def record(self) -> Recorder:
        """Nothing is kept."""
        return lambda now_ns, event, request_id, detail, brick=0: None

    def report(self, report: control.FromNode) -> None:
        """No executive reads it."""

    def rewired(self) -> None:
        """Nothing to wait for."""

    def receive(self) -> bool:
        """All mail is mail between bricks."""
        return False

    def mail_waits(self) -> bool:
        """All mail is mail between bricks."""
        return False

    def wait_for_order(self) -> bool:
        """No order ever comes."""
        return False

    def stop_detected(self, brick: str, reason: str) -> NoReturn:
        """Raises Stopped."""
        raise Stopped(brick, reason)


class Stopped(Exception):  # noqa: N818 - what happened, not an error
    """A detected stop of a brick in memory."""

    def __init__(self, brick: str, reason: str) -> None:
        super().__init__(f"{brick} stops: {reason}")
        self.brick, self.reason = brick, reason
