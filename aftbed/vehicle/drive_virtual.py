"""The car in virtual time, inside one process: no socket, no clock, no thread. The bus is a call.

The body, the frames with their E2E and the gateway are those of a real run. Only what carries them is
another: here a frame is seen by all in the instant in which it is sent, and time is what the caller says.

    car.advance(now_ns)          the requests that the gateway hands to the client, up to now
    car.deliver(reply, now_ns)   a reply that the client was given: out it goes as AEB_REQ
    car.due_ns()                 when to advance next: no request is made before

Time goes on, whether a reply comes, comes late or never, as in a paced run: a request that nobody answers
is a gap for the brake ECU to bridge. In a step the ECUs send first, then what has arrived in this very
instant is heard, then the plant moves. So a reply that is delivered at the time of its request brakes in
the same step, as in lockstep: then frames and result are those of `drive` at pace "max", to the last
bit. What arrives between two steps is heard by the next one; bus time is whole microseconds, rounded up.

How often `advance` is called makes no difference: the plant is moved when it is asked for, so that the
caller has one event for each radar cycle and not twenty.

*Faults of the bus* (`disturb`) strike between the one who sends and those who hear, as in the hub. A frame
that is held back comes in the step that finds it due, like everything on this bus.

Limits: but for its faults the bus is ideal. It takes no time, loses nothing, and has no other node on it.
"""

from collections import deque
from collections.abc import Callable

import msgspec

from aftbed.core.busfault import NODES, BusFault, Condition, Struck
from aftbed.vehicle.aim import aimed
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.disturbance import Disturber, Sent
from aftbed.vehicle.ecus import BrakePolicy, CarBody, End
from aftbed.vehicle.gateway import ClientGateway, Gateway, GatewayCounts
from aftbed.vehicle.plant import STEP_US, VehicleResult
from aftbed.vehicle.scenarios.scenario import Scenario

RADAR, BRAKE, GATEWAY = NODES


class _Arriving(msgspec.Struct, frozen=True):
    """A frame on its way to the brake ECU, which hears it if it is not cut off."""

    frame: Frame
    heard: bool = True
    by: tuple[int, ...] = ()


class VirtualCar:
    """A drive of `scenario`. All times are nanoseconds since its start, and never go back."""

    def __init__(
        self,
        scenario: Scenario,
        *,
        brake_policy: BrakePolicy = "latch",
        seed: int = 0,
        codec: Codec | None = None,
        witness: Callable[[Frame], None] | None = None,
    ) -> None:
        """`codec` is aftbed's own DBC, loaded where none is given: that takes 3 ms.

        `witness` sees every frame of the bus, in the order of the bus, as a log does.
        """
        codec = codec or load_dbc()
        self._codec = codec
        self._body = CarBody(scenario, codec, brake_policy, seed)
        self._gateway = ClientGateway(Gateway(codec))
        self._witness = witness
        self._end = self._body.ended()
        self._step_us = 0  # the step whose frames are to be sent next
        self._now_ns = 0
        self._arriving: deque[_Arriving] = deque()  # not heard yet
        self._disturber: Disturber | None = None
        self._watched: list[tuple[Condition, Callable[[int], None]]] = []
        self._held = 0  # by so many, before the step that has begun
        self._asked: list[bytes] = []  # requests that were made before anybody came for them
        self._answer_id = codec.can_id("AEB_REQ")

    @property
    def end(self) -> End | None:
        """Why the drive is over; None while it is not."""
        return self._end

    @property
    def t_us(self) -> int:
        """How far the drive has come, in microseconds of bus time."""
        return self._body.t_us

    @property
    def counts(self) -> GatewayCounts:
        """The frames that the gateway has believed and refused."""
        return self._gateway.counts

    def due_ns(self) -> int | None:
        """When the next request can be made, or the scenario ends; None when the drive is over."""
        if self._end is not None:
            return None
        if self._asked:
            return self._now_ns
        due_us = min(self._body.track_due_us(self._step_us), self._body.duration_us)
        released_us = self._disturber.due_us() if self._disturber is not None else None
        if released_us is not None:  # it comes with a step that has not begun
            due_us = min(due_us, max(self._step_us, -(-released_us // STEP_US) * STEP_US))
        return due_us * 1000

    def advance(self, now_ns: int) -> list[bytes]:
        """Drive up to and including `now_ns`. The payloads of the requests that were made, in order."""
        self._pass_to(now_ns)
        payloads, self._asked = self._asked, []
        return payloads + self._drive(now_ns)

    def _drive(self, until_ns: int) -> list[bytes]:
        """Take the steps up to and including that time. The requests that they make."""
        payloads: list[bytes] = []
        while self._end is None and not self._held and self._step_us * 1000 <= until_ns:
            if self._step_us > self._body.t_us:
                self._finish_step()
            if self._watched:
                self._look()
            if self._end is None and not self._held:
                payloads += self._begin_step()
        return payloads

    def deliver(self, payload: bytes, now_ns: int, *, replica: int = 1, epoch: int = 1) -> None:
        """A reply has come to the gateway, from `replica` (1 or 2) of `epoch`: out go its frames.

        What is no reply to the brakes is counted, and sends nothing.
        """
        self._pass_to(now_ns)
        if self._disturber is not None:  # what comes before this reply is disturbed before it
            self._asked += self._drive(now_ns)
        t_us = -(-now_ns // 1000)
        for answer in self._gateway.on_reply(payload, replica, epoch):
            frame = Frame(t_us, answer.can_id, answer.data)
            if self._disturber is None or self._end is not None:
                self._arriving.append(_Arriving(frame))
            else:
                self._put(self._disturber, self._disturber.carry(frame, GATEWAY))

    # -- conditions --------------------------------------------------------------------------------

    @property
    def watched(self) -> bool:
        """Whether the car has to be driven step by step, so that a condition is found to hold in time."""
        return bool(self._watched) and self._end is None

    def watch(self, condition: Condition, met: Callable[[int], None]) -> None:
        """Call `met`, once, at the begin of the first step at which `condition` holds: with its bus time.

        Nothing of that step happens before `go_on`.
        """
        self._watched.append((condition, met))

    def go_on(self, now_ns: int) -> None:
        """The step of a condition can be taken, as far as that one is concerned."""
        self._held -= 1
        self.pass_time(now_ns)

    def pass_time(self, now_ns: int) -> None:
        """Drive up to and including `now_ns`; the requests that are made wait to be fetched."""
        self._pass_to(now_ns)
        self._asked += self._drive(now_ns)

    def _look(self) -> None:
        holds = [one for one in self._watched if self._body.is_so(one[0])]
        self._watched = [one for one in self._watched if one not in holds]
        self._held += len(holds)
        for _, met in holds:
            met(self._body.t_us)

    # -- faults of the bus ----------------------------------------------------------------------

    def disturb(self, number: int, fault: BusFault, draw: int, now_ns: int) -> None:
        """Arm `fault` before anything of `now_ns` happens.

        Raises ConfigError where it is not aimed yet, and names what does not exist.
        """
        fault = fault if fault.aim is not None else aimed(fault, [self._codec])
        self._pass_to(now_ns)
        self._asked += self._drive(now_ns - 1)
        self._disturber = self._disturber or Disturber()
        self._disturber.arm(number, fault, draw, -(-now_ns // 1000))

    def forget(self, number: int, now_ns: int) -> None:
        """End the fault before anything of `now_ns` happens."""
        self._pass_to(now_ns)
        self._asked += self._drive(now_ns - 1)
        if self._disturber is not None:
            self._disturber.forget(number, -(-now_ns // 1000))

    def struck(self) -> list[Struck]:
        """What has become of each fault."""
        return self._disturber.struck() if self._disturber is not None else []

    def struck_by(self, number: int) -> Struck | None:
        """What has become of one."""
        return next((struck for struck in self.struck() if struck.number == number), None)

    def _disturbed(self, disturber: Disturber) -> list[bytes]:
        """The begin of a step: what the car is in by now, and what is due. The requests that it makes."""
        t_us = self._body.t_us
        for number, condition in disturber.conditions():
            if self._body.is_so(condition):
                disturber.met(number, t_us)
        return self._put(disturber, disturber.release(t_us))

    def _put(self, disturber: Disturber, sent: list[Sent]) -> list[bytes]:
        """Have these frames heard by who hears them. The requests that are made."""
        payloads = []
        for one in sent:
            frame, sender = one.frame, one.sender
            if sender != GATEWAY:
                self._show(frame)
                if not disturber.deaf(sender, GATEWAY, frame.t_us):
                    payload = self._gateway.on_frame(frame)
                    payloads += [payload] if payload is not None else []
                    if frame.can_id in self._gateway.uses():
                        disturber.reached(one.by, GATEWAY)
            else:
                heard = not disturber.deaf(sender, BRAKE, frame.t_us)
                self._arriving.append(_Arriving(frame, heard, one.by))
        for can_id, word in self._gateway.noticed():
            disturber.noticed(GATEWAY, can_id, word)
        return payloads

    def result(self) -> VehicleResult:
        """What the drive came to, so far."""
        return self._body.result()

    def _pass_to(self, now_ns: int) -> None:
        assert now_ns >= self._now_ns, f"time goes back from {self._now_ns} to {now_ns} ns"
        self._now_ns = now_ns

    def _begin_step(self) -> list[bytes]:
        """The ECUs send what is due. The request that this makes, if any."""
        self._hear_until(self._body.t_us - 1)
        self._step_us = self._body.t_us + STEP_US
        disturber = self._disturber
        if disturber is not None:
            payloads = self._disturbed(disturber)
            for frames, node in ((self._body.brake_frames(), BRAKE), (self._body.radar_frames(), RADAR)):
                for frame in frames:
                    payloads += self._put(disturber, disturber.carry(frame, node))
            return payloads
        payloads = []
        for frame in self._body.brake_frames() + self._body.radar_frames():
            self._show(frame)
            payload = self._gateway.on_frame(frame)
            if payload is not None:
                payloads.append(payload)
        return payloads

    def _finish_step(self) -> None:
        """The brake ECU hears what has come in this instant, and the plant moves."""
        self._hear_until(self._body.t_us)
        self._body.step()
        if self._disturber is not None:
            for can_id, word in self._body.noticed():
                self._disturber.noticed(BRAKE, can_id, word)
        self._end = self._body.ended()

    def _hear_until(self, t_us: int) -> None:
        """The brake ECU takes what has arrived at `t_us` or before."""
        while self._arriving and self._arriving[0].frame.t_us <= t_us:
            one = self._arriving.popleft()
            self._show(one.frame)
            if one.heard:
                self._body.hear(one.frame)
                if one.by and one.frame.can_id == self._answer_id and self._disturber is not None:
                    self._disturber.reached(one.by, BRAKE)

    def _show(self, frame: Frame) -> None:
        if self._witness is not None:
            self._witness(frame)
