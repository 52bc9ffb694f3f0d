"""The car in virtual time, inside one process: no socket, no clock, no thread. The bus is a function call.

The body, the frames with their E2E and the gateway are those of a real run, and so are the rules of the bus
(`can.bus_model`). What differs: a frame reaches all nodes in the instant in which it is sent, and the caller
sets the time.

    car.advance(now_ns)          the requests that the gateway hands to the client, up to now
    car.deliver(reply, now_ns)   a reply that the client has received: it leaves as AEB_REQ
    car.due_ns()                 when to advance next: no request is made before

Time goes on, whether a reply comes, comes late or never, as in a paced run: a request without an answer
is a gap for the brake ECU to bridge. In a step the ECUs send first, then what has arrived in this very
instant is received, then the plant moves. So a reply that is delivered at the time of its request brakes in
the same step, as in lockstep: then frames and result are those of `drive` at pace "max", to the last
bit. What arrives between two steps is received by the next one; bus time is whole microseconds, rounded up.

How often `advance` is called makes no difference: the plant is moved when it is asked for, so that the
caller has one event for each radar cycle and not twenty.

*Faults of the bus* (`disturb`) act between sender and receivers, as in the hub. A frame that is held back
comes in the step that finds it due, like everything on this bus. Those of the radar (`disturb_radar`) act in
its ECU.

Limits: except for its faults the bus is ideal. It takes no time, loses nothing, and has no other node on it.
"""

from collections import deque
from collections.abc import Callable, Sequence

from aftbed.vehicle.aeb.messages import EncodeRequest, encode_request
from aftbed.vehicle.can.bus_model import NODES, BusDisturber, BusModel, BusNode
from aftbed.vehicle.can.dbc_file import Codec, own_dbc
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.condition import Condition
from aftbed.vehicle.ecus import BrakePolicy, CarBody, End
from aftbed.vehicle.gateway import Gateway, GatewayCounts
from aftbed.vehicle.plant import STEP_US, VehicleResult
from aftbed.vehicle.radar import RadarDisturber
from aftbed.vehicle.scenarios.scenario import Scenario

RADAR, BRAKE, GATEWAY = NODES


class VirtualBus(BusModel[BusNode]):
    """The car's bus: the two ECUs and the gateway."""

    def __init__(
        self, codec: Codec, body: CarBody, on_frame: Callable[[Frame], None] | None, encode: EncodeRequest
    ) -> None:
        super().__init__()
        self.gateway = Gateway(codec, encode)
        self.requests: list[bytes] = []  # that the gateway has made, and that were not fetched yet
        self._body = body
        self._on_frame = on_frame
        self._arriving: deque[tuple[Frame, bool]] = deque()  # at the brake ECU, and whether it receives them
        self.radar_node = BusNode(RADAR)
        self.brake_node = BusNode(BRAKE, frozenset({codec.can_id("AEB_REQ")}))
        self.gateway_node = BusNode(GATEWAY, frozenset(self.gateway.uses))
        self.add_receiver(self.gateway_node)
        self.add_receiver(self.brake_node)  # the radar follows no frame

    def deliver(self, frame: Frame, sender: str, receivers: Sequence[BusNode]) -> None:
        """Frames of the gateway wait for the brake ECU's next step; the gateway takes the others at once."""
        if sender == GATEWAY:
            self._arriving.append((frame, self.brake_node in receivers))
            return
        if self._on_frame is not None:
            self._on_frame(frame)
        if self.gateway_node in receivers:
            payload = self.gateway.on_frame(frame)
            if payload is not None:
                self.requests.append(payload)
            if self.disturber is not None:
                for notice in self.gateway.noticed():
                    self.disturber.noticed(GATEWAY, notice)

    def receive_until(self, t_us: int) -> None:
        """The brake ECU takes what has arrived at `t_us` or before."""
        while self._arriving and self._arriving[0][0].t_us <= t_us:
            frame, receives = self._arriving.popleft()
            if self._on_frame is not None:
                self._on_frame(frame)
            if receives:
                self._body.receive(frame)


class VirtualCar:
    """A drive of `scenario`. All times are nanoseconds since its start, and never go back."""

    def __init__(
        self,
        scenario: Scenario,
        *,
        brake_policy: BrakePolicy = "latch",
        seed: int = 0,
        codec: Codec | None = None,
        on_frame: Callable[[Frame], None] | None = None,
        encode: EncodeRequest = encode_request,
    ) -> None:
        """`codec` is aftbed's own DBC where none is given.

        `on_frame` is called with every frame, in the order of the bus; `encode` writes the requests.
        """
        codec = codec or own_dbc()
        self._body = CarBody(scenario, codec, brake_policy, seed)
        self._bus = VirtualBus(codec, self._body, on_frame, encode)
        self._end = self._body.ended()
        self._step_us = 0  # the step whose frames are to be sent next
        self._now_ns = 0
        self._on_met: dict[int, Callable[[int], None]] = {}  # by the number of the fault that waits
        self._holds = 0  # conditions that have to be dealt with before the step goes on

    @property
    def end(self) -> End | None:
        return self._end

    @property
    def t_us(self) -> int:
        """How far the drive has come, in microseconds of bus time."""
        return self._body.plant.t_us

    @property
    def counts(self) -> GatewayCounts:
        """The frames that the gateway has accepted and refused."""
        return self._bus.gateway.counts

    def result(self) -> VehicleResult:
        return self._body.result()

    def due_ns(self) -> int | None:
        """When the next request can be made, or the scenario ends; None when the drive is over."""
        if self._end is not None:
            return None
        if self._bus.requests:
            return self._now_ns
        due_us = min(self._body.radar.track.next_us(self._step_us), self._body.duration_us)
        released_us = self._bus.disturber.due_us() if self._bus.disturber is not None else None
        if released_us is not None:  # it comes with a step that has not begun
            due_us = min(due_us, max(self._step_us, -(-released_us // STEP_US) * STEP_US))
        return due_us * 1000

    def advance(self, now_ns: int) -> list[bytes]:
        """Drive up to and including `now_ns`. The payloads of the requests that were made, in order."""
        self.pass_time(now_ns)
        payloads, self._bus.requests = self._bus.requests, []
        return payloads

    def pass_time(self, now_ns: int) -> None:
        """Drive up to and including `now_ns`; the requests that are made wait to be fetched."""
        self._set_now(now_ns)
        self._drive(now_ns)

    def deliver(self, payload: bytes, now_ns: int, *, replica: int = 1, epoch: int = 1) -> None:
        """A reply has come to the gateway, from `replica` (1 or 2) of `epoch`: it sends its frames.

        A payload that is no reply to the brakes is counted, and sends nothing.
        """
        self._set_now(now_ns)
        if self._bus.disturber is not None:  # what comes before this reply is disturbed before it
            self._drive(now_ns)
        t_us = -(-now_ns // 1000)
        for answer in self._bus.gateway.on_reply(payload, replica, epoch):
            if self._end is None:
                self._bus.transmit(self._bus.gateway_node, Frame(t_us, answer.can_id, answer.data))

    # -- conditions and faults ------------------------------------------------------------------

    @property
    def watched(self) -> bool:
        """Whether the car has to be driven step by step, so that a condition is found to hold in time."""
        return bool(self._bus.watched) and self._end is None

    def watch(self, number: int, condition: Condition, met: Callable[[int], None]) -> None:
        """For fault `number`: call `met` once, at the start of the first step at which `condition` holds.

        It is given the bus time. Nothing of that step happens before `go_on`.
        """
        self._on_met[number] = met
        self._bus.watch(number, condition)

    def go_on(self, now_ns: int) -> None:
        """All actions at one of the conditions are done: the step goes on when this is true of all."""
        self._holds -= 1
        self.pass_time(now_ns)

    def before(self, now_ns: int) -> int:
        """Drive up to `now_ns`, without anything that happens at that time. The bus time of `now_ns`."""
        self._set_now(now_ns)
        self._drive(now_ns - 1)
        return -(-now_ns // 1000)

    def disturb(self, disturber: BusDisturber) -> None:
        """A fault of the bus was armed or ended in `disturber`, the only one of this car, after `before`."""
        self._bus.gateway.noticed()  # what it has noticed before, no fault has caused
        self._bus.disturb(disturber)

    def disturb_radar(self, disturber: RadarDisturber) -> None:
        """A fault of the radar was armed in `disturber`, the only one of this car, after `before`."""
        self._body.radar.disturber = disturber

    # -- steps ----------------------------------------------------------------------------------

    def _set_now(self, now_ns: int) -> None:
        assert now_ns >= self._now_ns, f"time goes back from {self._now_ns} to {now_ns} ns"
        self._now_ns = now_ns

    def _drive(self, until_ns: int) -> None:
        """Take the steps up to and including that time."""
        plant = self._body.plant
        while self._end is None and not self._holds and self._step_us * 1000 <= until_ns:
            if self._step_us > plant.t_us:
                self._finish_step()
            else:
                self._begin_step(plant.t_us)

    def _begin_step(self, t_us: int) -> None:
        """The ECUs send the frames that are due, unless a condition holds whose actions come first."""
        bus, body = self._bus, self._body
        bus.receive_until(t_us - 1)
        if bus.disturbed or bus.watched:
            for number, condition in bus.conditions():
                if body.plant.holds(condition) and bus.met(number, t_us):
                    self._holds += 1
                    self._on_met.pop(number)(t_us)
            if self._holds:
                return
        self._step_us = t_us + STEP_US
        if bus.disturbed:
            bus.release(t_us)
        for frame in body.brake_frames():
            bus.transmit(bus.brake_node, frame)
        for frame in body.radar_frames():
            bus.transmit(bus.radar_node, frame)

    def _finish_step(self) -> None:
        """The brake ECU receives what has come in this instant, and the plant moves."""
        self._bus.receive_until(self._body.plant.t_us)
        self._body.step()
        if self._bus.disturber is not None:
            for notice in self._body.noticed():
                self._bus.noticed(BRAKE, notice)
        self._end = self._body.ended()
