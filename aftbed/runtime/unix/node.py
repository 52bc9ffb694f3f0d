"""The host of bricks in a process: mail in, `step`, effects out. This is the hot path.

Blocking, never spinning. A node whose bricks have one open port, which is the rule on the request path,
blocks in a plain read of that port: a poll before each read costs 1.4 us a hop (measured, 20 % of a hop). So
the control socket is not polled there; the supervisor raises a flag in the header of the node's journal and
puts a *nudge*, a packet of one byte, into the node's inputs. A node looks at the flag after each wake-up,
before it looks at the mail: control is served before data.

The pulse is an interval timer's signal: its handler writes the time into the header, but only if it
interrupted the host and not a brick, or if the journal has grown since: so a brick that loops for ever stops
the pulse. (A receive timeout on the sockets would do too; it costs 0.3 us a hop.)

What is read from a channel is handled before anything else is read, so mail is either in the kernel,
where it outlives this process, or inside a request that the client will ask again.
"""

import os
import signal
import sys
import time
import traceback
from types import FrameType
from typing import Final, NoReturn

from aftbed.core import messages
from aftbed.core.brick import CONTROL, Brick, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.journal import FLAG_OFFSET, PULSE_OFFSET, RECORD
from aftbed.core.messages import AnyMessage, ChannelEnded, Message, Rebound, Reply
from aftbed.runtime import control
from aftbed.runtime.blows import fire
from aftbed.runtime.orders import order_or_halt
from aftbed.runtime.unix import hindrance, obedience, packets
from aftbed.runtime.unix.devices import Device, Sensor
from aftbed.runtime.unix.journal import Journal
from aftbed.runtime.unix.lifeline import Held
from aftbed.runtime.unix.line import Line
from aftbed.runtime.unix.obedience import Obedience
from aftbed.runtime.unix.packets import READ_BYTES_MAX
from aftbed.runtime.unix.wiring import Hosted, Inlet, Plan, Wiring

PULSE_SECONDS: Final = 0.02
WRITE_SECONDS_MAX: Final = 2.0
NUDGE: Final = b"\0"
HOST_FILES: Final = (  # waiting, in no brick
    __file__,
    Line.recv.__code__.co_filename,
    hindrance.__file__,
    obedience.__file__,
    packets.__file__,
)
EXIT_FENCED: Final = 3
REFUSED: Final = (PeerError, *messages.UNREADABLE)
EXIT_ASSERT: Final = 70

_now, _read, _write = time.monotonic_ns, os.read, os.write
_encode, _decode = messages.encode_unchecked, messages.decode_unchecked
_put, _LARGE = packets.put, messages.PACKET_BYTES_MAX
_pack = RECORD.pack_into
RECORD_BYTES: Final = RECORD.size


class Node:
    """One process of the graph. `run` never returns."""

    def __init__(self, name: str, line: Line[control.ToNode], journal: Journal) -> None:
        self.name, self.line, self.journal = name, line, journal
        self.wiring = Wiring()
        self.device: Device | None = None
        self.device_brick: Hosted | None = None
        self._pulse_at = 0  # where the journal was at the last pulse
        self.lifeline: Held | None = None  # kept, not used: it is for the kernel to read when we die
        self._hot: Hosted | None = None  # served by the tight loop
        self.suspend_token = 0  # not 0: suspend as soon as quiescent
        self.suspended = False
        self.draining = False  # suspend only when nothing waits at the open ports
        self.armed: dict[Event, control.Arm] = {}
        self._announced: Inlet | None = None  # the next packet there is a large one
        self._refused = 0
        self.host = Obedience(self)

    # -- building -----------------------------------------------------------------------------

    def link_inside(self, local: control.Local, epoch: int) -> None:
        """A channel between two bricks of this node; the source is told, as of any other."""
        self.wiring.link_inside(local)
        self.step(self.wiring.hosted[local.brick], CONTROL, Rebound(local.port, True, epoch))

    def add(self, name: str, brick: Brick) -> None:
        """Host `brick`."""
        hosted = self.wiring.add(name, brick)
        hosted.outs[CONTROL] = lambda message: self._say(name, message)
        self._hot = hosted if len(self.wiring.hosted) == 1 and not self.wiring.timed else None

    def bind_output(self, brick: str, port: str, descriptor: int | None, epoch: int) -> None:
        """Write `port` to `descriptor` from now on, and tell the brick."""
        hosted = self.wiring.bind_output(brick, port, descriptor)
        self.step(hosted, CONTROL, Rebound(port, descriptor is not None, epoch))

    def attach(self, device: Device, brick: str) -> None:
        """Join `device` to `brick`."""
        self.device, self.device_brick = device, self.wiring.hosted[brick]
        polled = device.fds() or device.deadline_ns() is not None or isinstance(device, Sensor)
        self._hot = None if polled else self._hot
        self.device_brick.outs["deliver"] = self._deliver

    def _deliver(self, message: Message) -> None:
        assert isinstance(message, Reply) and self.device is not None
        self.device.accept(message, _now())

    def _say(self, brick: str, message: Message) -> None:
        assert isinstance(message, control.Spoken)
        self.line.send(control.Said(brick, message))

    # -- the pulse ----------------------------------------------------------------------------

    def start_pulse(self) -> None:
        """From now on, show that the host runs. A blocked read goes on after the signal (PEP 475)."""
        signal.signal(signal.SIGALRM, self._on_timer)
        signal.setitimer(signal.ITIMER_REAL, PULSE_SECONDS, PULSE_SECONDS)
        self._pulse(_now())

    def _on_timer(self, signum: int, frame: FrameType | None) -> None:
        at = self.journal.at
        if at != self._pulse_at or (frame is not None and frame.f_code.co_filename in HOST_FILES):
            self._pulse_at = at
            self._pulse(_now())

    def _pulse(self, now_ns: int) -> None:
        self.journal.mapping[PULSE_OFFSET : PULSE_OFFSET + 8] = now_ns.to_bytes(8, "little")

    # -- the loop -----------------------------------------------------------------------------

    def run(self) -> NoReturn:
        """Serve until told to stop; a failed assert ends the process (fail-silence)."""
        try:
            while True:
                self.turn()
                if self._hot is not None and self._announced is None:
                    self.serve_hot(self._hot)
        except BrokenPipeError:
            os._exit(EXIT_FENCED)
        except BaseException:  # noqa: BLE001 - the last frame of this process: nothing may leak out of it
            print(f"{self.name} (pid {os.getpid()}):", file=sys.stderr)
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(EXIT_ASSERT)

    def turn(self) -> None:
        """Handle one thing, or wait for one."""
        if self._announced is not None:
            self._take_announced(self._announced)
            return
        inside = self.wiring.inside() if self.wiring.mail else None
        if inside is not None:
            self.step(*inside)
            return
        if self.suspend_token or self.suspended:
            if self.suspend_token and self.wiring.quiescent() and not (self.draining and self._waits()):
                self.suspended = True
                self.host.ack(self.suspend_token)
                self.suspend_token = 0
            if self.suspended:
                self.host.serve_control(wait=True)
                return
        if self.device is not None and self._from_device(self.device):
            return
        fds = self.device.fds() if self.device is not None else ()
        due = self.device.deadline_ns() if self.device is not None else None
        may_block = not (self.wiring.timed or fds or due is not None)
        plan = self.wiring.plan((self.line.fileno(), *fds), may_block=may_block)
        if plan.single is not None:
            self._wait_for(plan.single)
        else:
            self._poll(plan)

    def _waits(self) -> bool:
        """Whether there is mail at an open port."""
        return bool(self.wiring.plan((), may_block=False).poll.poll(0))

    def serve_hot(self, hosted: Hosted) -> None:
        """The same as `turn`, with all at hand, for a node that hosts one brick and polls nothing.

        Returns for whatever is not mail on the one open port: `turn` knows what to do.
        """
        brick, outs, inlets, device = hosted.brick, hosted.outs, self.wiring.hot_inlets, self.device
        step, open_ports, journal = brick.step, brick.open_ports, self.journal
        mapping = journal.mapping
        while not (self.suspend_token or self.suspended or self.armed):
            inlet = inlets.get(open_ports())
            if inlet is None or (device is not None and self._from_device(device)):
                return
            raw = _read(inlet.fd, READ_BYTES_MAX)
            at = journal.at
            if not 2 <= len(raw) < READ_BYTES_MAX or mapping[FLAG_OFFSET] or at > journal.end:
                self._packet(inlet, raw)
                return
            try:
                message = _decode(raw)
                now_ns = _now()
                effects = step(inlet.port, message, now_ns)
            except REFUSED:
                self._refuse(0)
                continue
            for effect in effects:
                if type(effect) is Send:
                    out = outs[effect.port]
                    if type(out) is not int:
                        out(effect.message)  # type: ignore[operator]
                        continue
                    data = raw if effect.message is message else _encode(effect.message)
                    try:
                        (_write if len(data) <= _LARGE else _put)(out, data)
                    except OSError:
                        journal.at = at  # control mail that is served meanwhile may write records
                        self.write_hard(hosted, effect.port, data)
                        at = journal.at
                elif type(effect) is Note:
                    _pack(mapping, at, now_ns, effect.request_id, effect.detail, 0, effect.event.code)
                    at += RECORD_BYTES
                else:
                    journal.at = at
                    order_or_halt(self.host, hosted, effect)
            journal.at = at

    def _wait_for(self, inlet: Inlet) -> None:
        """Wait for one packet of `inlet` and handle it."""
        self._packet(inlet, _read(inlet.fd, READ_BYTES_MAX))

    def _packet(self, inlet: Inlet, raw: bytes) -> None:
        """Control first."""
        if self.journal.mapping[FLAG_OFFSET]:
            self.host.serve_control()
        if raw == b"":
            self._ended(inlet)
        elif raw == packets.ANNOUNCED:
            self._announced = inlet
        elif raw != NUDGE:
            try:
                message = _decode(raw)
            except messages.UNREADABLE:
                self._refuse(0)
                return
            self.step(inlet.hosted, inlet.port, message, raw)

    def _take_announced(self, inlet: Inlet) -> None:
        """Read the large packet that is next, or what has come in between."""
        try:
            raw = packets.take(inlet.fd)
        except PeerError:
            self._announced = None
            self._refuse(0)
            return
        if raw != NUDGE:
            self._announced = None
        self._packet(inlet, raw)
        if self._announced is not None and inlet.hosted.inlets.get(inlet.port) is not inlet:
            self._announced = None  # the order that has just been served has taken the channel away

    def _ended(self, inlet: Inlet) -> None:
        """The channel is drained to its end: nothing more will come from it."""
        if inlet.hosted.inlets.get(inlet.port) is inlet:
            self.wiring.bind_input(inlet.hosted.name, inlet.port, None)
            self.step(inlet.hosted, inlet.port, ChannelEnded())

    def _poll(self, plan: Plan) -> None:
        """Wait for several things; the control line goes first."""
        ready = plan.poll.poll(self.patience_ms())
        now_ns = _now()
        fds = [fd for fd, _ in ready]
        if self.journal.mapping[FLAG_OFFSET] or self.line.fileno() in fds:
            self.host.serve_control()
            return  # what is open may be another set now
        for fd in fds:
            inlet = plan.by_fd.get(fd)
            if inlet is not None:
                self._wait_for(inlet)
                return  # one step may close the other ports
            if self.device is not None:
                self.device.ready(fd, now_ns)
        self._wake(now_ns)

    def patience_ms(self) -> float:
        """How long to wait at most."""
        due = [h.brick.deadline_ns() for h in self.wiring.hosted.values()] if self.wiring.timed else []
        if self.device is not None:
            due.append(self.device.deadline_ns())
        wanted = min((ns for ns in due if ns is not None), default=None)
        limit = PULSE_SECONDS * 1e3
        if wanted is None:
            return limit
        return min(limit, max(0.0, (wanted - _now()) / 1e6 + 0.999))

    def _wake(self, now_ns: int) -> None:
        if not self.wiring.timed:
            return
        for hosted in list(self.wiring.hosted.values()):
            due = hosted.brick.deadline_ns()
            if due is not None and now_ns >= due:
                self.perform(hosted, hosted.brick.wake(now_ns), now_ns, None, None)

    def _from_device(self, device: Device) -> bool:
        """Let the brick have what the device holds for it; False if that is nothing."""
        hosted = self.device_brick
        assert hosted is not None
        if device.port not in hosted.brick.open_ports():
            return False
        message = device.take(_now())
        if message is None:
            return False
        self.step(hosted, device.port, message)
        return True

    # -- steps and effects --------------------------------------------------------------------

    def step(
        self, hosted: Hosted, port: str, message: AnyMessage | Message, raw: bytes | None = None
    ) -> None:
        """Have the brick handle `message`, and perform what it asks for."""
        now_ns = _now()
        try:
            effects = hosted.brick.step(port, message, now_ns)  # type: ignore[arg-type]
        except PeerError:
            self._refuse(getattr(message, "request_id", 0))
            return
        self.perform(hosted, effects, now_ns, message, raw)

    def perform(
        self,
        hosted: Hosted,
        effects: list[Effect],
        now_ns: int,
        message: object,
        raw: bytes | None,
    ) -> None:
        """The effects in their order. What is passed on unchanged is not encoded again."""
        outs = hosted.outs
        for effect in effects:
            kind = type(effect)
            if kind is Send:
                out = outs[effect.port]  # type: ignore[union-attr]
                if type(out) is int:
                    same = raw is not None and effect.message is message  # type: ignore[union-attr]
                    data: bytes = raw if same else _encode(effect.message)  # type: ignore[union-attr,assignment]
                    try:
                        (_write if len(data) <= _LARGE else _put)(out, data)
                    except OSError:
                        self.write_hard(hosted, effect.port, data)  # type: ignore[union-attr]
                else:
                    out(effect.message)  # type: ignore[operator,union-attr]
            elif kind is Note:
                assert isinstance(effect, Note)
                self.journal.write(now_ns, effect.event, effect.request_id, effect.detail, hosted.index)
                if self.armed:
                    fire(self.host, hosted, effects, effect)
            else:
                order_or_halt(self.host, hosted, effect)

    def write_hard(self, hosted: Hosted, port: str, data: bytes) -> None:
        """The channel is full or shut: serve control meanwhile, since that may be about this channel.

        A fault that is armed at it meanwhile strikes what is sent later. Where it is bound elsewhere, the
        brick has heard of it and has asked again what it wants asked. Raises BrokenPipeError where this node
        is fenced, or nobody reads.
        """
        failed = self.host.beneath(hosted, port)
        limit = _now() + int(WRITE_SECONDS_MAX * 1e9)
        while _now() < limit:
            out = self.host.beneath(hosted, port)
            if not isinstance(out, int) or out is not failed:
                return
            try:
                _put(out, data)
            except BlockingIOError:
                self.host.serve_control()
            except BrokenPipeError:
                if not self.host.serve_control(wait=True):
                    continue
            else:
                return
        raise BrokenPipeError(f"{hosted.name}: {port} is shut or nobody reads it")

    def _refuse(self, request_id: int) -> None:
        self._refused += 1
        self.journal.write(_now(), Event.PEER_REFUSED, request_id, 0)
