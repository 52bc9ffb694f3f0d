"""How a process of aftbed attaches to the CAN bus: `Bus` for frames, `HubLine` for what goes beside them.

`Bus` is python-can's socketcand client with types, and with its quirks (of python-can 4.6) handled:

1. One read of its socket may yield several frames; it keeps the rest in a buffer of its own. Waiting on
   the descriptor alone misses them. `drain` empties that buffer, so the rule for a node is: drain first,
   then wait on `fileno()`.
2. It does not notice that the hub is gone: it reads end of file again and again. `Bus` raises
   HarnessError, because without a bus there is no run.
3. It has no `fileno` and hides its socket. `open_bus` takes the socket by its private name, checks it, and
   uses it only to wait, to see the end of file, and to send lines beside the frames.

Measured: python-can costs 7 us to send a frame and 3 us to take one out of a full socket, and adds 11 us
to the 59 us of a frame from one process through the hub to another (53 us for bare bytes over the same
sockets). A client of our own would not be worth it.

*Lockstep.* One connection of the hub sets the virtual time. Lines and frames of one connection keep their
order, those of two do not: a node that sends all frames itself uses `Bus.set_time`, which waits for no
answer; where several nodes send, a `HubLine` sets the time from a connection of its own and waits until
the hub has taken it. `AnswerWatch` is the other half: time stands still until the protected function has
answered. In real time, `Schedule` waits until a step is due.
"""

import logging
import re
import select
import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final, cast

import msgspec

from aftbed.core.errors import ConfigError, HarnessError
from aftbed.vehicle.can.bus_model import CHANNEL, HOST, Notice
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.can.python_can import can
from aftbed.vehicle.condition import Condition, Quantity

ATTACH_S_MAX: Final = 5.0
HUB_ANSWER_S_MAX: Final = 3.0
FIRST_ANSWER_S_MAX: Final = 3.0  # a failover takes a millisecond, a paused laptop seconds
NEXT_ANSWER_S_MAX: Final = 0.005  # of a function that has just missed one
GOODBYE_S_MAX: Final = 0.5
STOP_CHECK_S: Final = 0.05
OUTSTANDING_MAX: Final = 16
READ_BYTES_MAX: Final = 4096
_SOCKET_NAME: Final = "_SocketCanDaemonBus__socket"
_OK: Final = re.compile(r"< ok (?:(-|[0-9]+) )?>")
_WATCH: Final = re.compile(r"< watch ([0-9]+) (ttc|gap|speed) (below|above) (-?[0-9.]+) >")
_CHANGE: Final = re.compile(r"< change ([0-9A-F]{3}) ([+-][0-9]+) >")


class BusOptions(msgspec.Struct, frozen=True):
    """The hub to attach to. `node` is the name by which a fault can cut this node off, and `uses` are the
    identifiers of the frames that it evaluates; both are sent to the hub. `secret` is that of the run;
    without it this is a stranger, and has no name.
    """

    channel: str = CHANNEL
    port: int = 0
    secret: str = ""
    node: str = ""
    uses: tuple[int, ...] = ()

    @property
    def opens(self) -> str:
        """What follows `open`."""
        return f"{self.channel} {self.secret}" if self.secret else self.channel


class Bus:
    """One attachment. Not for use from two threads."""

    def __init__(self, bus: can.BusABC, sock: socket.socket) -> None:
        self.refused = 0  # frames that cannot be ours: extended, remote, FD
        self.errors = 0  # error frames: the hub refused what we sent
        self._bus = bus
        self._socket = sock
        self._ready: deque[Frame] = deque()
        self._poll = select.poll()
        self._poll.register(sock, select.POLLIN)

    def fileno(self) -> int:
        """What to wait on, once `drain` has been called."""
        return self._socket.fileno()

    def send(self, frame: Frame) -> None:
        """Hand `frame` to the bus; its `t_us` stays here, the bus stamps it."""
        message = can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)
        try:
            self._bus.send(message)
        except (OSError, can.CanError) as error:
            raise HarnessError(f"the CAN bus took no frame: {error}") from error

    def recv(self, timeout_s: float) -> Frame | None:
        """The next frame, or None when `timeout_s` has passed without one."""
        end_s = time.monotonic() + timeout_s
        while not self._ready:
            rest_s = end_s - time.monotonic()
            if self._poll.poll(max(0.0, rest_s) * 1000):
                self._fill()
            if rest_s <= 0:
                break
        return self._ready.popleft() if self._ready else None

    def drain(self) -> list[Frame]:
        """All frames that have arrived; none is left in python-can's buffer."""
        if self._poll.poll(0):
            self._fill()
        frames = list(self._ready)
        self._ready.clear()
        return frames

    def set_time(self, t_us: int) -> None:
        """Set the virtual time of the hub, for the frames that this node sends from here on."""
        self._socket.sendall(f"< aftbed time {t_us} >".encode("ascii"))

    def notice(self, notice: Notice) -> None:
        """Report beside the bus what is wrong with frames, or that they are used again, as of now."""
        now_ns = time.monotonic_ns()
        self._send_beside(f"noticed {notice.can_id:03X} {notice.word} {notice.t_us} {now_ns}")

    def unasked(self, can_id: int) -> None:
        """Report beside the bus that no request was made of a frame of which one is expected."""
        self._send_beside(f"unasked {can_id:03X}")

    def _send_beside(self, words: str) -> None:
        try:
            self._socket.sendall(f"< aftbed {words} >".encode("ascii"))
        except OSError as error:
            raise HarnessError(f"the CAN bus took no word: {error}") from error

    def close(self) -> None:
        """Leave the bus, once the hub has taken all that was sent.

        To close on unread data is a reset, which discards what the hub has not read yet: so our direction
        ends first, and the other is read to its end.
        """
        end_s = time.monotonic() + GOODBYE_S_MAX
        with suppress(OSError):  # gone already, or too slow
            self._socket.shutdown(socket.SHUT_WR)
            self._socket.settimeout(GOODBYE_S_MAX)
            while time.monotonic() < end_s and self._socket.recv(65536):
                pass
        self._bus.shutdown()

    def _fill(self) -> None:
        """Move what python-can has or can read at once to `_ready`."""
        found = False
        while self._take_next():
            found = True
        if found:
            return
        try:
            ended = not self._socket.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except OSError:
            ended = True
        if ended:
            raise HarnessError("the CAN bus hung up: the hub is gone, or found this node too slow")

    def _take_next(self) -> bool:
        """Take one message from python-can; False if there was none."""
        try:
            message = self._bus.recv(0.0)
        except can.CanError as error:
            raise HarnessError(f"the CAN bus gave no frame: {error}") from error
        if message is None:
            return False
        if message.is_error_frame:
            self.errors += 1
        elif message.is_extended_id or message.is_remote_frame or message.is_fd:
            self.refused += 1
        else:
            t_us = round(message.timestamp * 1e6)
            self._ready.append(Frame(t_us, message.arbitration_id, bytes(message.data)))
        return True


def open_bus(options: BusOptions) -> Bus:
    """Attach. When this returns, every frame that the bus carries from here on arrives."""
    _connect(options, ATTACH_S_MAX).close()  # python-can would retry for ten seconds, without a pause
    # What it logs is either harmless (a frame cut by the end of a read) or raised as well.
    logging.getLogger("can.interfaces.socketcand.socketcand").setLevel(logging.CRITICAL)
    before_s = socket.getdefaulttimeout()
    socket.setdefaulttimeout(ATTACH_S_MAX)  # its handshake has no other deadline
    try:
        bus = can.Bus(
            interface="socketcand", host=HOST, port=options.port, channel=options.opens, tcp_tune=True
        )
    except (OSError, can.CanError) as error:
        raise HarnessError(f"cannot attach to the CAN hub at {HOST}:{options.port}: {error}") from error
    finally:
        socket.setdefaulttimeout(before_s)
    sock: object = vars(bus).get(_SOCKET_NAME)
    if not isinstance(sock, socket.socket):
        raise HarnessError(f"python-can {can.__version__} keeps its socket elsewhere; 4.6 is known to work")
    sock.settimeout(None)
    if options.node:
        uses = "".join(f" {can_id:03X}" for can_id in options.uses)
        sock.sendall(f"< aftbed node {options.node}{uses} >".encode("ascii"))
    return Bus(bus, sock)


def _connect(options: BusOptions, seconds_max: float) -> socket.socket:
    try:
        return socket.create_connection((HOST, options.port), seconds_max)
    except OSError as error:
        raise HarnessError(f"no CAN hub at {HOST}:{options.port}: {error}") from error


class HubLine:
    """The car's line to the hub: it receives no frames, only what is sent beside the bus.

    In lockstep it sets the hub's virtual time. In real time, too, the car looks for the conditions at which
    faults open (`when ttc < 1.2`), since only the car knows its true state: the hub sends the conditions,
    the car reports when one holds. The dialogue is described in `hub`.

    What the hub sends of its own accord comes before the answer that it concerns: after the answer to
    `await`, all changes for those frames are known.
    """

    def __init__(self, options: BusOptions) -> None:
        self.conditions: dict[int, Condition] = {}  # still to be met, by the number of their faults
        self.disturbed = False  # by the latest from the hub
        self.due_us: int | None = None  # when something comes of a fault by itself
        self._changes: deque[tuple[int, int]] = deque()
        self._buffer = b""
        self._elements: deque[str] = deque()
        self._socket = _connect(options, HUB_ANSWER_S_MAX)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)
        try:
            self._expect("< hi >")
            self._ask(f"< open {options.opens} >")
        except HarnessError:
            self.close()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def request_conditions(self) -> None:
        """Ask the hub for conditions to look for."""
        self._ask("< aftbed plant >")

    def set_time(self, t_us: int) -> None:
        """Return when the hub has taken `t_us` as its time. HarnessError if it does not."""
        self._ask(f"< aftbed time {t_us} >")

    def carried(self, node: str, frames: int) -> None:
        """Return when that many frames of `node` have been over the wire since it came."""
        self._ask(f"< aftbed await {node} {frames} >")

    def met(self, number: int, t_us: int) -> None:
        """The condition of that fault holds at `t_us` of the drive: return when the hub knows.

        In lockstep, when what begins with it has begun.
        """
        self.conditions.pop(number, None)
        self._ask(f"< aftbed met {number} {t_us} {time.monotonic_ns()} >")

    def settle(self) -> None:
        """Return when all that the hub has sent by now is here."""
        self._send("< echo >")
        self._expect("< echo >")

    def changes(self) -> list[tuple[int, int]]:
        """By how many more or fewer nodes a frame was received, by its identifier, as far as it is known."""
        while self._poll.poll(0):
            self._read()
        while self._elements:
            element = self._elements.popleft()
            if not self._take_aside(element):
                raise HarnessError(f"the CAN hub sent {element!r}, unasked")
        found = list(self._changes)
        self._changes.clear()
        return found

    def close(self) -> None:
        """Disconnect; the time of the hub then stays as it is."""
        self._socket.close()

    def _ask(self, line: str) -> None:
        self._send(line)
        self._expect("< ok >")

    def _send(self, line: str) -> None:
        try:
            self._socket.sendall(line.encode("ascii"))
        except OSError as error:
            raise HarnessError(f"the CAN hub took no word: {error}") from error

    def _expect(self, line: str) -> None:
        while True:
            while not self._elements:
                self._read()
            element = self._elements.popleft()
            if self._take_aside(element):
                continue
            answer = _OK.fullmatch(element) if line == "< ok >" else None
            if answer is None and element != line:
                raise HarnessError(f"the CAN hub answered {element!r}, expected {line!r}")
            if answer is not None:
                self.disturbed = answer[1] is not None
                self.due_us = int(answer[1]) if answer[1] not in (None, "-") else None
            return

    def _read(self) -> None:
        try:
            data = self._socket.recv(READ_BYTES_MAX)
        except OSError as error:
            raise HarnessError(f"the CAN hub gave no answer: {error}") from error
        if not data:
            raise HarnessError("the CAN hub hung up")
        *elements, self._buffer = (self._buffer + data).split(b">")
        self._elements += [element.decode("ascii", "replace").lstrip() + ">" for element in elements]

    def _take_aside(self, element: str) -> bool:
        """Take what the hub sends of its own accord; False if `element` is an answer."""
        if (found := _WATCH.fullmatch(element)) is not None:
            quantity = cast("Quantity", found[2])
            self.conditions[int(found[1])] = Condition(quantity, found[3] == "below", float(found[4]))
        elif (found := _CHANGE.fullmatch(element)) is not None:
            self._changes.append((int(found[1], 16), int(found[2])))
        else:
            return False
        self.disturbed = True
        return True


class AnswerWatch:
    """Waits until the protected function has answered all requests, and counts answers and misses.

    The first missing answer is waited for `FIRST_ANSWER_S_MAX`. From then on the function is taken to be dead
    and costs `NEXT_ANSWER_S_MAX` per request, until it answers again; then it gets the same short time to
    answer what is outstanding, so that later answers are matched to the right requests.

    Where the bus has faults, `line` reports requests and answers that were lost or came more than once.
    """

    def __init__(
        self,
        bus: Bus,
        answer_id: int,
        on_frame: Callable[[Frame], None],
        question_id: int = -1,
        line: HubLine | None = None,
    ) -> None:
        self.answered = 0
        self.missing = 0
        self._bus = bus
        self._answer_id = answer_id
        self._on_frame = on_frame
        self._ids = (question_id, answer_id)
        self._line = line
        self._outstanding = 0
        self._mute = False

    def asked(self) -> None:
        """A request is about to be sent: take what arrived before it."""
        for frame in self._bus.drain():
            self.take(frame)
        self._outstanding = min(self._outstanding + 1, OUTSTANDING_MAX)

    def wait(self, stop: Callable[[], bool]) -> None:
        """Return when no answer is outstanding, when the deadline has passed, or when `stop()` is true."""
        before, mute = self.answered, self._mute
        end_s = time.monotonic() + (NEXT_ANSWER_S_MAX if mute else FIRST_ANSWER_S_MAX)
        while self._owed() and not stop():
            rest_s = end_s - time.monotonic()
            if rest_s <= 0:
                break
            frame = self._next(min(rest_s, STOP_CHECK_S))
            if frame is not None and self.take(frame) and mute:
                end_s = time.monotonic() + NEXT_ANSWER_S_MAX
        if self._outstanding == 0 or self.answered > before:
            self._outstanding = 0  # older answers of a function that answers again are lost
            self._mute = False
        elif time.monotonic() >= end_s:  # not stopped before
            self.missing += 1
            self._mute = True

    def take(self, frame: Frame) -> bool:
        """Hand on a frame that was received on the bus; True if it is an answer."""
        self._on_frame(frame)
        if frame.can_id != self._answer_id:
            return False
        self.answered += 1
        self._outstanding = max(0, self._outstanding - 1)
        return True

    def _owed(self) -> bool:
        """Whether an answer is outstanding, by all that is known about the bus."""
        if self._line is not None:
            self._apply_changes(self._line)
            if self._outstanding == 0 and self._line.disturbed:  # more may come than was sent
                self._line.settle()
                self._apply_changes(self._line)
        return self._outstanding > 0

    def _apply_changes(self, line: HubLine) -> None:
        change = sum(change for can_id, change in line.changes() if can_id in self._ids)
        self._outstanding = max(0, min(self._outstanding + change, OUTSTANDING_MAX))

    def _next(self, rest_s: float) -> Frame | None:
        """The next frame; None after `rest_s`, or when the hub has reported a change."""
        if self._line is None or not self._line.disturbed:
            return self._bus.recv(rest_s)
        frame = self._bus.recv(0.0)
        if frame is None:
            select.select([self._bus.fileno(), self._line.fileno()], [], [], rest_s)
        return frame


class Schedule:
    """A fixed schedule on the wall clock. Late steps are made up for, none is skipped."""

    def __init__(self, pace: float) -> None:
        if not pace > 0:
            raise ConfigError(f"pace {pace}, allowed is more than 0")
        self.lag_ms_max = 0.0  # the greatest delay of a step, by the wall clock
        self._ns_per_us = 1000 / pace
        self._start_ns = time.monotonic_ns()

    def wait_until(self, t_us: int, stop: Callable[[], bool]) -> None:
        """Return when `t_us` of bus time have passed since the start, or when `stop()` is true."""
        due_ns = self._start_ns + int(t_us * self._ns_per_us)
        while (rest_ns := due_ns - time.monotonic_ns()) > 0:
            if stop():
                return
            time.sleep(min(rest_ns / 1e9, STOP_CHECK_S))
        self.lag_ms_max = max(self.lag_ms_max, -rest_ns / 1e6)
