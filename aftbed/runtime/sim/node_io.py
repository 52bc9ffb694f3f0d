"""The NodeIO of a simulated node: channels and journal in memory, virtual time, and its life.

All that a step asks for happens in its instant; what takes time is the way to the next node, in which the
step of the reader is counted. A node can die between any two effects (`die_before`), can be stopped, can be
held up by a full channel, by a fault that the executive has to see applied, or by a slow step. Then the
effects that are left are performed later, before anything but orders is handled, or never.

What a step takes of a CPU is the time of a hop, in which there is little else: with a share of a CPU, a step
takes so many times that.
"""

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from heapq import heappush
from operator import attrgetter
from typing import Final, NamedTuple, NoReturn

from aftbed.core.brick import Effect, Send
from aftbed.core.errors import FunctionFailedError, function_failed
from aftbed.core.events import Event
from aftbed.core.graph import Link
from aftbed.core.journal import Record
from aftbed.core.messages import ChannelEnded, Message
from aftbed.inject.shared_state import SHARED_BYTES
from aftbed.runtime import control
from aftbed.runtime.devices import LOOK_NS
from aftbed.runtime.latencies import COLD_PENALTY_NS, HOP_QUANTILES_NS, IDLE_BEFORE_COLD_NS
from aftbed.runtime.node import HostedBrick, Node, NodeIO, Recorder
from aftbed.runtime.sim.clock import Clock

QUEUE_MAX: Final = 128  # messages; a socket pair holds about as many small ones
NEVER: Final = 1 << 62
WRITE_NS_MAX: Final = 2_000_000_000  # a node that cannot write for so long takes itself for fenced
STEP_NS: Final = HOP_QUANTILES_NS[len(HOP_QUANTILES_NS) // 2]  # of CPU time
FULL_NS: Final = 100_000  # between two looks whether a full channel has room


class SimulatedMemory:
    """Memory shared by the executive and a node (see `runtime.interface.SharedMemory`); orders carry its
    number.
    """

    def __init__(self, number: int) -> None:
        self._number = number
        self.memory = memoryview(bytearray(SHARED_BYTES))

    def fileno(self) -> int:
        return self._number

    def seal(self) -> None: ...

    def close(self) -> None: ...


class SimEnd:
    __slots__ = ("channel", "number")

    def __init__(self, channel: "SimChannel", number: int) -> None:
        self.channel, self.number = channel, number

    def fileno(self) -> int:
        return self.number


class SimChannel:
    """A channel, with the semantics of a pair of sockets (see `runtime.unix.transport`).

    Order is kept; what is queued survives both nodes; a fence lets through what was sent and then ends; a
    node that writes behind a fence, or where no node will ever read, dies (EPIPE); a full channel holds its
    writer up. The executive has a hold on both ends until it closes them, the nodes at the ends have theirs.

    `mail`: times of arrival and messages; `readers` and `writers`: the nodes that have an end.
    """

    def __init__(self, link: Link, clock: Clock, first_number: int) -> None:
        self.link, self._clock = link, clock
        self.write, self.read = SimEnd(self, first_number), SimEnd(self, first_number + 1)
        self.mail: deque[tuple[int, Message]] = deque()
        self.readers: list[SimIO] = []
        self.writers: list[SimIO] = []
        self.ended = self.refused = self.closed = False
        self._last_ns = 0  # of an arrival

    @property
    def number(self) -> int:
        return self.write.number

    def reader_names(self) -> frozenset[str]:
        return frozenset([node.name for node in self.readers])

    def has_room(self) -> bool:
        return not (self.ended or self.refused or len(self.mail) >= QUEUE_MAX)

    def put(self, message: Message) -> bool:
        """Send. False if there is no room now, or no node will ever read it: the writer waits for orders."""
        mail = self.mail
        if self.ended or self.refused or len(mail) >= QUEUE_MAX:
            return False
        clock = self._clock
        t_ns = clock.ns + clock.hop_ns()
        if self.readers and t_ns - self.readers[0].ran_ns > IDLE_BEFORE_COLD_NS:
            t_ns += clock.between_ns(*COLD_PENALTY_NS)
        if t_ns <= self._last_ns:
            t_ns = self._last_ns + 1
        self._last_ns = t_ns
        mail.append((t_ns, message))
        clock.count += 1
        heappush(clock.heap, (t_ns, clock.count, self.arrive))
        return True

    def arrive(self) -> None:
        """Wake the readers: a message has arrived, or may be read now."""
        readers = self.readers
        if len(readers) == 1:
            readers[0].run()
            return
        for node in list(readers):
            node.run()

    def take(self) -> Message:
        """Remove and return the oldest message that has arrived."""
        if len(self.mail) == QUEUE_MAX:
            for node in list(self.writers):
                self._clock.at(self._clock.ns, node.run)  # there is room again
        return self.mail.popleft()[1]

    def fence(self) -> None:
        """Refuse further mail. The reader reaches the end behind what was sent."""
        if self.ended:
            return
        self.ended = True
        self._last_ns = max(self._last_ns + 1, self._clock.ns + self._clock.hop_ns())
        self._clock.message(self._last_ns, self, self._end_comes)
        for node in list(self.writers):
            self._clock.at(self._clock.ns, node.run)

    def _end_comes(self) -> None:
        self._last_ns = self._clock.ns
        self.arrive()

    def over(self) -> bool:
        """Whether the reader has reached the end."""
        return self.ended and not self.mail and self._clock.ns >= self._last_ns

    def refuse(self) -> None:
        """End a writer that waits for room."""
        self.refused = True
        for node in list(self.writers):
            self._clock.at(self._clock.ns, node.run)

    def nudge(self) -> None:
        """Do nothing: orders arrive without it."""

    def mail_waits(self) -> bool:
        """Whether a message has arrived."""
        return bool(self.mail) and self.mail[0][0] <= self._clock.ns

    def close(self) -> None:
        self.closed = True
        self._look()

    def leave(self, node: "SimIO") -> None:
        """Remove `node` from the readers and writers."""
        if node in self.readers:
            self.readers.remove(node)
        if node in self.writers:
            self.writers.remove(node)
        self._look()

    def _look(self) -> None:
        if self.closed and not self.writers:
            self.fence()
        if self.closed and not self.readers:
            self.refuse()


SimBrick = HostedBrick[SimChannel, SimChannel]
SimNode = Node[SimChannel, SimChannel]


class Died(BaseException):
    """The node has died in the middle of a step. Not an Exception: nothing may take it for an error."""


class _Held(NamedTuple):
    """Effects from `at` on that wait: for room at `end` until `limit_ns`, or, without an end, for leave to go
    on.

    `filtered`: the message there goes through the fault on its channel; else a fault that came later does not
    see it.
    """

    hosted: SimBrick
    effects: list[Effect]
    at: int
    end: SimChannel | None
    filtered: bool
    limit_ns: int


class SimIO(NodeIO[SimChannel, SimChannel]):
    """Of one node. `ends` finds a channel by the number of an end; `on_end` is called when the node dies,
    with why.
    """

    output = SimChannel
    node: SimNode

    def __init__(
        self,
        name: str,
        clock: Clock,
        records: list[Record],
        ends: Callable[[int], SimChannel],
        report: Callable[[control.FromNode], None],
        on_end: Callable[[str], None],
        cells: Sequence[SimulatedMemory],
    ) -> None:
        self.name, self._clock, self._records, self._ends = name, clock, records, ends
        self._report, self._on_end, self._cells = report, on_end, cells
        self.alive, self.frozen_ns, self._seen_ns = True, 0, 0
        self.ran_ns = 0  # when it last did anything
        self._doom: tuple[str, int] | None = None  # a brick, and before which of its effects the node dies
        self._orders: deque[tuple[control.ToNode, tuple[int, ...]]] = deque()
        self._held: list[_Held] = []  # the last one is gone on with first: its step came in between
        self._held_up = False  # one of the three below
        self._awaited = 0  # the fault that has to be applied before the node goes on, or 0
        self._slow_until_ns = 0
        self._backlog: dict[
            SimChannel, deque[Message]
        ] = {}  # came out of a channel fault, and waits for room
        self._only: SimBrick | None = None  # the brick of a node that hosts one, without a device
        self._fronts: list[SimBrick] = []  # bricks with inputs
        self._has_deadlines = False
        self._timer_ns = NEVER
        self._running = False

    def join(self, node: SimNode) -> None:
        self.node = node

    @property
    def now_ns(self) -> Callable[[], int]:
        return partial(attrgetter("ns"), self._clock)

    @property
    def record(self) -> Recorder:
        append, name = self._records.append, self.name

        def record(now_ns: int, event: Event, request_id: int, detail: int, brick: int = 0, /) -> None:
            append(Record(now_ns, event, request_id, detail, name, brick))

        return record

    def report(self, report: control.FromNode) -> None:
        self._report(report)

    def memory(self, number: int) -> memoryview:
        return self._cells[number].memory

    # -- its life -----------------------------------------------------------------------------

    def freeze(self) -> None:
        """Stop the node wherever it is; it was last seen alive some time before."""
        if not self.frozen_ns:
            self.frozen_ns = self._clock.ns
            self._seen_ns = self._clock.ns - self._clock.between_ns(0, LOOK_NS)

    def thaw(self) -> None:
        self.frozen_ns = 0
        self.run()

    def seen_ns(self, now_ns: int) -> int:
        return self._seen_ns if self.frozen_ns else now_ns

    def die_before(self, brick: str, effect: int) -> None:
        """Have the node die before that effect of `brick`, counted from 0."""
        self._doom, self.node.careful = (brick, effect), True

    def die(self, reason: str = "") -> None:
        """End it; its ends of channels are the kernel's to close."""
        if not self.alive:
            return
        self.alive = False
        for hosted in self.node.bricks.values():
            for channel in (*hosted.inputs.values(), *hosted.outputs.values()):
                if isinstance(channel, SimChannel):
                    channel.leave(self)
        self._on_end(reason)

    def order(self, order: control.ToNode, fds: tuple[int, ...]) -> None:
        self._orders.append((order, fds))
        self.run()

    def run(self) -> None:
        if self._running or not self.alive or self.frozen_ns:
            return
        self._running = True
        node = self.node
        self.ran_ns, turn, filters = self._clock.ns, node.turn, node.agent.filters
        try:
            if filters:
                node.release_due(self._clock.ns)
            while self.alive and not self.frozen_ns:
                if self._orders:  # before anything else
                    self._serve(*self._orders.popleft())
                elif (self._held_up and not self._go_on()) or not turn():
                    break
        except Died as death:
            self.die(str(death))
        except FunctionFailedError as error:
            self.die(f"{node.name}: detected stop: {function_failed(error)}")
        except AssertionError as error:
            self.die(f"assertion failed: {error}")
        finally:
            self._running = False
        if self.alive and (self._has_deadlines or filters):
            self._set_timer()

    def _serve(self, order: control.ToNode, fds: tuple[int, ...]) -> None:
        if not isinstance(order, control.Ack):
            self.node.obey(order, list(fds))
        elif order.token == self._awaited:
            self._awaited = 0

    def _set_timer(self) -> None:
        """Have `run` called when something is due."""
        due = self.node.deadline_ns()
        if due is not None and due < self._timer_ns and due > self._clock.ns:
            self._timer_ns = due
            self._clock.at(due, self._on_timer)

    def _on_timer(self) -> None:
        self._timer_ns = NEVER
        self.run()

    # -- reading ------------------------------------------------------------------------------

    def open_input(self, hosted: SimBrick, port: str, number: int) -> SimChannel:
        channel = self._ends(number)
        channel.readers.append(self)
        return channel

    def close_input(self, end: SimChannel) -> None:
        end.leave(self)

    def rewired(self) -> None:
        """See whether the node hosts one brick, without a device, and whether there are deadlines."""
        self._only = self.node.only if self.node.device is None else None
        self._fronts = [hosted for hosted in self.node.bricks.values() if hosted.inputs]
        device = self.node.device
        self._has_deadlines = bool(self.node.timed) or (device is not None and device.polled)

    def receive(self) -> bool:
        """Handle the mail that came first, or the end of a channel, or what is due; False if nothing is left.

        On the hot path, which is one open port of the only brick, all mail that has arrived is handled, one
        after the other, as long as no order and no hold comes in between.
        """
        only, node = self._only, self.node
        if only is None:
            return self._read_any() or node.wake_due(self._clock.ns)
        now_ns, open_ports, inputs = self._clock.ns, only.brick.open_ports, only.inputs
        drained = False
        while not (self._orders or self._held_up):
            ports = open_ports()
            if len(ports) != 1:
                return self._read_any() or node.wake_due(now_ns)
            port = ports[0]
            channel = inputs.get(port)
            if channel is not None and channel.mail and channel.mail[0][0] <= now_ns:
                node.step(only, port, channel.take())
                drained = node.suspend_token != 0  # the last one: the next turn suspends
            elif channel is not None and channel.ended and channel.over():
                self._handle_end(only, port)
            else:
                return drained or (only.timed and node.wake_due(now_ns))
        return True

    def _read_any(self) -> bool:
        """Handle the mail that came first; where there is none, the end of a channel."""
        first_ns, first, ended = self._clock.ns + 1, None, None
        for hosted in self._fronts:
            for port in hosted.brick.open_ports():
                channel = hosted.inputs.get(port)
                if channel is None:
                    continue
                if channel.mail:
                    if channel.mail[0][0] < first_ns:
                        first_ns, first = channel.mail[0][0], (hosted, port, channel)
                elif channel.ended and ended is None and channel.over():
                    ended = hosted, port
        if first is not None:
            hosted, port, channel = first
            self.node.step(hosted, port, channel.take())
        elif ended is not None:
            self._handle_end(*ended)
        return first is not None or ended is not None

    def _handle_end(self, hosted: SimBrick, port: str) -> None:
        """Close the input: the channel is drained to its end."""
        self.node.bind_input(hosted.name, port, None)
        self.node.step(hosted, port, ChannelEnded())

    def mail_waits(self) -> bool:
        return any(
            channel.mail_waits()
            for hosted in self._fronts
            for channel in map(hosted.inputs.get, hosted.brick.open_ports())
            if channel is not None
        )

    def wait_for_order(self) -> bool:
        return False

    # -- writing ------------------------------------------------------------------------------

    def open_output(self, number: int) -> SimChannel:
        channel = self._ends(number)
        channel.writers.append(self)
        return channel

    def close_output(self, end: SimChannel) -> None:
        self._backlog.pop(end, None)
        end.leave(self)

    def has_room(self, end: SimChannel) -> bool:
        return end not in self._backlog and end.has_room()

    def write(
        self, hosted: SimBrick, port: str, end: SimChannel, message: Message, raw: bytes | None
    ) -> bool:
        return not (self._backlog and end in self._backlog) and end.put(message)

    def write_in_turn(self, hosted: SimBrick, port: str, end: SimChannel, message: Message) -> None:
        if not self.write(hosted, port, end, message, None):
            if end not in self._backlog:
                self._backlog[end] = deque()
                self._clock.at(self._clock.ns + FULL_NS, lambda: self._write_backlog(end))
            self._backlog[end].append(message)

    def _write_backlog(self, end: SimChannel) -> None:
        """Write the backlog as far as there is room; try again later with the rest."""
        backlog = self._backlog.get(end)
        if backlog is None or not self.alive:
            return
        while backlog and not self.frozen_ns and end.put(backlog[0]):
            backlog.popleft()
        if backlog:
            self._clock.at(self._clock.ns + FULL_NS, lambda: self._write_backlog(end))
        else:
            del self._backlog[end]
            self.run()

    def write_or_drop(self, end: SimChannel, message: Message) -> None:
        if self.has_room(end):
            end.put(message)

    # -- stopping between two effects ---------------------------------------------------------

    def stops(self, hosted: SimBrick) -> bool:
        """Whether the next effect has to wait. Raises Died where the node was to die before it."""
        if self._awaited or self.frozen_ns or self._slow_until_ns > self._clock.ns:
            return True
        self.step_done(hosted)
        return False

    def step_done(self, hosted: SimBrick) -> None:
        """Die if the node was to die after its last effect."""
        if self._doom == (hosted.name, hosted.performed):
            raise Died

    def hold(
        self, hosted: SimBrick, effects: list[Effect], at: int, end: SimChannel | None, *, filtered: bool
    ) -> None:
        """Continue with the effects from `at` later. A write that is held up too long ends the node."""
        limit_ns = self._clock.ns + WRITE_NS_MAX if end is not None else NEVER
        self._held.append(_Held(hosted, effects, at, end, filtered, limit_ns))
        self._held_up = True
        if end is not None:
            self._clock.at(limit_ns, self.run)

    def _go_on(self) -> bool:
        """Perform the held effects, unless the node is still held. True if none is left."""
        if self._awaited or self._slow_until_ns > self._clock.ns:
            return False
        self._held_up = False
        while self._held:
            held = self._held[-1]
            at = held.at
            if held.end is not None:
                if not self._write_held(held, held.end):
                    if self._clock.ns >= held.limit_ns:
                        raise Died("fenced")
                    self._held_up = True
                    return False
                at += 1
                held.hosted.performed += 1
            self._held.pop()
            before = len(self._held)
            self.node.perform_from(held.hosted, held.effects, at)
            if len(self._held) > before:
                return False
        return True

    def _write_held(self, held: _Held, end: SimChannel) -> bool:
        """Send what waited for room. What is bound elsewhere is not sent: the brick got a Rebound, and has
        asked again.
        """
        effect = held.effects[held.at]
        assert isinstance(effect, Send)
        if held.hosted.outputs[effect.port] is not end:
            return True
        if held.filtered:
            return self.node.send(held.hosted, effect.port, effect.message)
        return self.write(held.hosted, effect.port, end, effect.message, None)

    # -- faults and ends ----------------------------------------------------------------------

    def kill(self) -> None:
        raise Died

    def stop_detected(self, brick: str, reason: str) -> NoReturn:
        raise Died(f"{brick}: detected stop: {reason}")

    def wait_until_applied(self, fault: int) -> None:
        """Hold the effects that are left until the executive has acknowledged `fault`."""
        self._awaited, self._held_up = fault, True

    def delay(self, by_ns: int) -> None:
        """Hold the effects of this step for that long."""
        if by_ns:
            self._slow_until_ns, self._held_up = max(self._slow_until_ns, self._clock.ns) + by_ns, True
            self._clock.at(self._slow_until_ns, self.run)

    def begin_throttle(self) -> None: ...

    def throttle(self, stretch_ns: Callable[[int], int]) -> None:
        """Hold the effects of this step for as long as its share of a CPU makes it longer."""
        self.delay(stretch_ns(STEP_NS))
