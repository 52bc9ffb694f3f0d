"""A node in virtual time: bricks, mail in, effects out. It answers to the same orders as a real one.

A turn handles one thing: an order of the executive before anything else, then mail between its own bricks,
then its device, then the oldest mail at an open port. All that a step asks for happens in its instant; what
takes time is the way to the next node, in which the step of the reader is counted.

A node can die between any two effects (`doom`), can be stopped, can be held up by a full channel or by a
fault that the executive has to see applied: the effects that are left are performed later, or never.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

from aftbed.core.brick import CONTROL, Brick
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.journal import Record
from aftbed.core.messages import AnyMessage, ChannelEnded, Message, Rebound, Reply
from aftbed.runtime import control
from aftbed.runtime.diversion import Diversion
from aftbed.runtime.orders import carry_out
from aftbed.runtime.sim.cells import Cell
from aftbed.runtime.sim.channels import Channel
from aftbed.runtime.sim.clock import Clock
from aftbed.runtime.sim.devices import Device, Sensor
from aftbed.runtime.sim.effects import Died, Hosted, Performer
from aftbed.runtime.sim.hindrance import Hindrance

NEVER: Final = 1 << 62
PULSE_NS: Final = 20_000_000  # an idle node looks up so often

Say = Callable[[control.FromNode], None]
Ends = Callable[[int], Channel]


def _nowhere(message: Message) -> None:
    """An unbound output."""


class Node:
    """`records`: its journal; `say` reaches the executive; `on_end` is called when it dies, with why."""

    def __init__(
        self,
        name: str,
        clock: Clock,
        records: list[Record],
        ends: Ends,
        say: Say,
        on_end: Callable[[str], None],
    ) -> None:
        self.name, self._clock, self.records, self._ends = name, clock, records, ends
        self._say, self._on_end = say, on_end
        self.bricks: dict[str, Hosted] = {}
        self.armed: dict[Event, control.Arm] = {}
        self.slowed: dict[int, control.SlowDown] = {}
        self.diverted: dict[tuple[str, str], Diversion] = {}
        self._hindrance = Hindrance(self, clock)
        self.cells: Sequence[Cell] = ()  # those of the run
        self.device: Device | None = None
        self.device_brick: Hosted | None = None
        self.alive, self.frozen_ns, self._pulse_ns = True, 0, 0
        self.suspended = False
        self._suspend_token, self._draining = 0, False
        self._orders: deque[tuple[control.ToNode, tuple[int, ...]]] = deque()
        self._inside: deque[tuple[Hosted, str, Message]] = deque()
        self.performer = Performer(self, clock)
        self._timer_ns = NEVER
        self._running = False
        self.ran_ns = 0  # when it last did anything
        self._timed: list[Hosted] = []
        self._only: Hosted | None = None  # the brick of a node that hosts one, and has no device

    # -- building -----------------------------------------------------------------------------

    def add(self, name: str, brick: Brick) -> None:
        """Host `brick`."""
        hosted = self.bricks[name] = Hosted(name, brick, len(self.bricks))
        hosted.outs[CONTROL] = lambda message: self._speak(name, message)
        self._timed = [h for h in self.bricks.values() if h.timed]
        self._only = hosted if len(self.bricks) == 1 else None

    def _speak(self, brick: str, message: Message) -> None:
        assert isinstance(message, control.Spoken)
        self._say(control.Said(brick, message))

    def link_inside(self, local: control.Local, epoch: int) -> None:
        """A channel between two bricks of this node; the source is told."""
        source, sink = self.bricks[local.brick], self.bricks[local.sink]
        source.outs[local.port] = lambda message: self._inside.append((sink, local.sink_port, message))
        self.step(source, CONTROL, Rebound(local.port, True, epoch))

    def attach(self, device: Device, brick: str) -> None:
        """Join `device` to `brick`."""
        self.device, self.device_brick, self._only = device, self.bricks[brick], None
        self.device_brick.outs["deliver"] = self._deliver

    def _deliver(self, message: Message) -> None:
        assert isinstance(message, Reply) and self.device is not None
        self.device.accept(message, self._clock.ns)

    # -- what orders and faults do to it: see `orders.Host` ------------------------------------

    def hosted(self, brick: str) -> Hosted:
        """The brick of that name."""
        return self.bricks[brick]

    def bind_input(self, brick: str, port: str, end: int | None) -> None:
        """Read `port` from the channel with that end from now on."""
        hosted = self.bricks[brick]
        old = hosted.inlets.pop(port, None)
        if end is not None:
            channel = hosted.inlets[port] = self._ends(end)
            channel.readers.append(self)
        if old is not None:
            old.leave(self)

    def bind_output(self, brick: str, port: str, end: int | None, epoch: int) -> None:
        """Write `port` to the channel with that end from now on, and tell the brick."""
        self._hindrance.lift(brick, port)
        hosted = self.bricks[brick]
        old = hosted.outs.get(port)
        hosted.outs[port] = _nowhere
        if end is not None:
            channel = hosted.outs[port] = self._ends(end)
            channel.writers.append(self)
        if isinstance(old, Channel):
            old.leave(self)
        self._hindrance.lay(brick, port)
        self.step(hosted, CONTROL, Rebound(port, end is not None, epoch))

    def suspend(self, token: int, *, drain: bool) -> None:
        """Answer `token` as soon as no request is inside (`drain`: nor waits)."""
        self._suspend_token, self._draining = token, drain

    def resume(self) -> None:
        """Undo `suspend`."""
        self.suspended, self._suspend_token = False, 0

    def memory(self, end: int) -> memoryview:
        """The memory of the cell with that number."""
        return self.cells[end].memory

    def tell(self, brick: str, message: control.Told) -> None:
        """Have `brick` step with `message`."""
        self.step(self.bricks[brick], CONTROL, message)

    def watch(self, order: control.WatchNodes, fds: list[int]) -> None:
        """Have the Watchdog watch these."""
        assert isinstance(self.device, Sensor)
        self.device.watch(order.nodes, fds)

    def stats(self) -> bytes:
        """What its device counts."""
        return self.device.stats() if self.device is not None else b""

    def quiet(self) -> None:
        """Its device hands in nothing more."""
        assert self.device is not None
        self.device.quiet()

    def record(self, event: Event, request_id: int, detail: int) -> None:
        """Write a record, now."""
        self.records.append(Record(self._clock.ns, event, request_id, detail, self.name))

    def say(self, report: control.FromNode) -> None:
        """To the executive."""
        self._say(report)

    def die_here(self) -> None:
        """Be killed, here and now."""
        raise Died

    def wait_until_hit(self, fault: int) -> None:
        """Go no further until the executive has answered for `fault`."""
        self.performer.held_by = fault

    def slow(self) -> None:
        """Go by `slowed` from the next step on."""
        self._hindrance.slow()

    def divert(self, brick: str, port: str) -> None:
        """Go by `diverted`, which has changed for this port."""
        self._hindrance.divert(brick, port)

    def stop_detected(self, brick: str, reason: str) -> None:
        """A detected stop: end here and now."""
        raise Died(f"{brick}: detected stop: {reason}")

    # -- its life -----------------------------------------------------------------------------

    def freeze(self) -> None:
        """Stopped wherever it is; its pulse was shown some time before."""
        if not self.frozen_ns:
            self.frozen_ns = self._clock.ns
            self._pulse_ns = self._clock.ns - self._clock.between_ns(0, PULSE_NS)

    def thaw(self) -> None:
        """It goes on from there."""
        self.frozen_ns = 0
        self.run()

    def pulse_ns(self, now_ns: int) -> int:
        """When it was last seen running."""
        return self._pulse_ns if self.frozen_ns else now_ns

    def die(self, reason: str = "") -> None:
        """Dead; its ends of channels are the kernel's to close."""
        if not self.alive:
            return
        self.alive = False
        for hosted in self.bricks.values():
            for channel in (*hosted.inlets.values(), *hosted.outs.values()):
                if isinstance(channel, Channel):
                    channel.leave(self)
        self._on_end(reason)

    def order(self, order: control.ToNode, fds: tuple[int, ...]) -> None:
        """An order has arrived."""
        self._orders.append((order, fds))
        self.run()

    def ack(self, token: int, data: bytes = b"", error: str = "") -> None:
        """Answer an order."""
        if token != control.UNANSWERED:
            self._say(control.Ack(token, data, error))

    # -- turns --------------------------------------------------------------------------------

    def run(self) -> None:
        """Handle all that can be handled now."""
        if self._running or not self.alive or self.frozen_ns:
            return
        self._running = True
        self.ran_ns = self._clock.ns
        try:
            while self.alive and not self.frozen_ns and self._turn():
                pass
        except Died as death:
            self.die(str(death))
        except AssertionError as error:
            self.die(f"assertion failed: {error}")
        finally:
            self._running = False
        if self.alive:
            self._set_timer()

    def _turn(self) -> bool:
        """One thing; False if there is none."""
        performer = self.performer
        if self._orders:
            self._serve(*self._orders.popleft())
            return True
        if performer.held_by or (performer.left and not performer.go_on()):
            return False
        if self._inside and self._step_inside():
            return True
        if self._suspend_token or self.suspended:
            if self._suspend_token and self._is_quiet():
                self.suspended = True
                self.ack(self._suspend_token)
                self._suspend_token = 0
            if self.suspended:
                return False
        only = self._only
        if only is not None:
            return self._read(only) or (only.timed and self._wake(only))
        return self._from_device() or self._read_any() or any(self._wake(h) for h in self._timed)

    def _is_quiet(self) -> bool:
        if self._inside or not all(h.brick.quiescent() for h in self.bricks.values()):
            return False
        return not (self._draining and self._oldest() is not None)

    def _read(self, hosted: Hosted) -> bool:
        """The hot path: mail at an open port of the only brick."""
        ports = hosted.brick.open_ports()
        if len(ports) != 1:
            return self._read_any()
        channel = hosted.inlets.get(ports[0])
        if channel is None:
            return False
        if channel.mail:
            if channel.mail[0][0] > self._clock.ns:
                return False
            self.step(hosted, ports[0], channel.take())
            return True
        if channel.ended and channel.over():
            self._end(hosted, ports[0])
            return True
        return False

    def _read_any(self) -> bool:
        found = self._oldest()
        if found is not None:
            hosted, port = found
            self.step(hosted, port, hosted.inlets[port].take())
            return True
        for hosted in self.bricks.values():
            for port in hosted.brick.open_ports():
                channel = hosted.inlets.get(port)
                if channel is not None and channel.over():
                    self._end(hosted, port)
                    return True
        return False

    def _oldest(self) -> tuple[Hosted, str] | None:
        """The open port with the mail that came first."""
        best_ns, best = self._clock.ns + 1, None
        for hosted in self.bricks.values():
            if not hosted.inlets:
                continue
            for port in hosted.brick.open_ports():
                channel = hosted.inlets.get(port)
                if channel is not None and channel.mail and channel.mail[0][0] < best_ns:
                    best_ns, best = channel.mail[0][0], (hosted, port)
        return best

    def _end(self, hosted: Hosted, port: str) -> None:
        """The channel is drained to its end."""
        hosted.inlets.pop(port).leave(self)
        self.step(hosted, port, ChannelEnded())

    def _step_inside(self) -> bool:
        for index, (hosted, port, message) in enumerate(self._inside):
            if port in hosted.brick.open_ports():
                del self._inside[index]
                self.step(hosted, port, message)
                return True
        return False

    def _from_device(self) -> bool:
        device, hosted = self.device, self.device_brick
        if device is None or hosted is None:
            return False
        if device.port not in hosted.brick.open_ports():
            device.wait(self._clock.ns)
            return False
        message = device.take(self._clock.ns)
        if message is None:
            return False
        self.step(hosted, device.port, message)
        return True

    def _wake(self, hosted: Hosted) -> bool:
        due = hosted.brick.deadline_ns()
        if due is None or due > self._clock.ns:
            return False
        self.performer.perform(hosted, hosted.brick.wake(self._clock.ns), 0)
        return True

    def _set_timer(self) -> None:
        """Be woken when something is due."""
        due = self.device.deadline_ns() if self.device is not None else None
        for hosted in self._timed:
            wanted = hosted.brick.deadline_ns()
            if wanted is not None and (due is None or wanted < due):
                due = wanted
        if due is not None and due < self._timer_ns and due > self._clock.ns:
            self._timer_ns = due
            self._clock.at(due, self._on_timer)

    def _on_timer(self) -> None:
        self._timer_ns = NEVER
        self.run()

    # -- steps and effects --------------------------------------------------------------------

    def step(self, hosted: Hosted, port: str, message: AnyMessage | Message) -> None:
        """Have the brick handle `message`, and perform what it asks for."""
        try:
            effects = hosted.brick.step(port, message, self._clock.ns)  # type: ignore[arg-type]
        except PeerError:
            self.record(Event.PEER_REFUSED, getattr(message, "request_id", 0), 0)
            return
        if effects:
            self.performer.perform(hosted, effects, 0)

    def _serve(self, order: control.ToNode, fds: tuple[int, ...]) -> None:
        """Carry out an order."""
        if isinstance(order, control.Ack):
            performer = self.performer
            performer.held_by = 0 if order.token == performer.held_by else performer.held_by
            return
        try:
            data = carry_out(self, order, list(fds))
        except PeerError as error:
            self.ack(order.token, error=str(error))
        else:
            if data is not None:
                self.ack(order.token, data)
