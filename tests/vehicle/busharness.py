"""What the bus tests share: a hub in a thread or a process, a raw client, a gateway that answers."""

import os
import queue
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from aftbed.core.errors import HarnessError
from aftbed.inject.bus import BusFault
from aftbed.inject.bus_disturber import Disturber
from aftbed.inject.receipts import BusReport
from aftbed.vehicle.aeb.function import default_application
from aftbed.vehicle.can.bus import Bus, BusOptions, open_bus
from aftbed.vehicle.can.dbc_file import Codec
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.can.hub import Hub, HubCounts, HubOptions, serve
from aftbed.vehicle.ecus import Sender
from aftbed.vehicle.gateway import Gateway

DEADLINE_S = 5.0
SECRET = "0123456789abcdef" * 2


class TestSupervisorLink:
    """The supervisor of a hub in a thread: a byte on its life descriptor is an order in the queue."""

    __test__ = False

    def __init__(self, life: int) -> None:
        self._life = life
        self.orders: queue.SimpleQueue[Callable[[Hub], None]] = queue.SimpleQueue()
        self.faults = Disturber()
        self.receipts: list[str] = []  # of the first fault, each time that it changed
        self.conditions_met: list[tuple[int, int, int]] = []
        self.strangers: list[str] = []

    def attend(self, hub: Hub) -> bool:
        for _ in (got := os.read(self._life, 4096)):
            self.orders.get()(hub)
        return bool(got)

    def faults_acted(self) -> None:
        receipt = self.faults.reports()[0].receipt.state.value
        if self.receipts[-1:] != [receipt]:
            self.receipts.append(receipt)

    def met(self, fault_number: int, t_us: int, since_ns: int) -> None:
        self.conditions_met.append((fault_number, t_us, since_ns))

    def stranger(self, text: str) -> None:
        self.strangers.append(text)


class RunningHub:
    """A hub in a thread of the test; `stop` ends it and gives its counts."""

    def __init__(
        self, log: Path, options: HubOptions, send_buffer_bytes: int = 0, secret: str = SECRET
    ) -> None:
        self.log = log
        self.counts = HubCounts()
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=128)
        if send_buffer_bytes:  # inherited by the connections
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, send_buffer_bytes)
        self.port = self._listener.getsockname()[1]
        self.options = BusOptions(port=self.port, secret=secret)
        self._log_fd = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        self._life_read, self._life_write = os.pipe()
        self._error: BaseException | None = None
        self.link = TestSupervisorLink(self._life_read)
        options = msgspec.structs.replace(options, secret=secret)
        self._thread = threading.Thread(target=self._run, args=(options,), daemon=True)
        self._thread.start()

    def _run(self, options: HubOptions) -> None:
        try:
            self.counts = serve(self._listener, self._log_fd, options, self._life_read, self.link)
        except BaseException as error:  # noqa: BLE001 - raised again in the test's thread
            self._error = error

    def order(self, what: Callable[[Hub], object]) -> None:
        """Return when the hub has done it, in its own thread."""
        done = threading.Event()

        def carry_out(hub: Hub) -> None:
            what(hub)
            done.set()

        self.link.orders.put(carry_out)
        os.write(self._life_write, b".")
        assert done.wait(DEADLINE_S), "the hub does not take orders"

    def arm(self, number: int, fault: BusFault, draw: int = 0) -> None:
        def carry_out(hub: Hub) -> None:
            self.link.faults.arm(number, fault, draw, hub.now_us())
            hub.disturb(self.link.faults)

        self.order(carry_out)

    def forget(self, number: int) -> None:
        self.order(lambda hub: self.link.faults.forget(number, hub.now_us()))

    def struck(self) -> list[BusReport]:
        found: list[BusReport] = []
        self.order(lambda _: found.extend(self.link.faults.reports()))
        return found

    def stop(self) -> HubCounts:
        if self._life_write >= 0:
            os.close(self._life_write)
            self._life_write = -1
            self._thread.join(DEADLINE_S)
            assert not self._thread.is_alive(), "the hub did not end with its life descriptor"
            os.close(self._life_read)
            os.close(self._log_fd)
            self._listener.close()
            if self._error is not None:
                raise self._error
        return self.counts


@contextmanager
def running_hub(
    log: Path, options: HubOptions | None = None, send_buffer_bytes: int = 0, secret: str = SECRET
) -> Iterator[RunningHub]:
    hub = RunningHub(log, options or HubOptions(), send_buffer_bytes, secret)
    try:
        yield hub
    finally:
        hub.stop()


_HUB_PROCESS = """
import os, socket, sys
from aftbed.vehicle.can.hub import serve
from aftbed.vehicle.can.hub import HubOptions
listener = socket.socket(fileno=int(sys.argv[1]))
log = os.open(sys.argv[2], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
serve(listener, log, HubOptions(secret=sys.argv[3]), 0)
"""


@contextmanager
def hub_process(log: Path) -> Iterator[tuple["subprocess.Popen[bytes]", int]]:
    """A hub that can be killed, and its port."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        command = [sys.executable, "-c", _HUB_PROCESS, str(listener.fileno()), str(log), SECRET]
        with subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=[listener.fileno()]) as process:
            try:
                yield process, listener.getsockname()[1]
            finally:
                process.kill()


class RawClient:
    """A client that says what the test says, byte for byte; every read has a deadline.

    `ours`: a node of the run, which has the secret; else it is a stranger.
    """

    def __init__(
        self, port: int, *, raw: bool = True, ours: bool = False, receive_buffer_bytes: int = 0
    ) -> None:
        self.sock = socket.socket()
        if receive_buffer_bytes:
            self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer_bytes)
        self.sock.settimeout(DEADLINE_S)
        self.sock.connect(("127.0.0.1", port))
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffer = b""
        assert self.read() == "< hi >"
        if raw or ours:
            assert self.ask(f"< open can0 {SECRET} >" if ours else "< open can0 >") == "< ok >"
        if raw:
            assert self.ask("< rawmode >") == "< ok >"

    def __enter__(self) -> "RawClient":
        return self

    def __exit__(self, *_: object) -> None:
        self.sock.close()

    def write(self, text: str | bytes) -> None:
        self.sock.sendall(text.encode("ascii") if isinstance(text, str) else text)

    def read(self) -> str:
        """The next element; "" when the hub has hung up."""
        while b">" not in self._buffer:
            try:
                data = self.sock.recv(4096)
            except ConnectionResetError:
                return ""
            if not data:
                return ""
            self._buffer += data
        element, _, self._buffer = self._buffer.partition(b">")
        return (element.lstrip() + b">").decode("ascii")

    def ask(self, text: str) -> str:
        self.write(text)
        return self.read()

    def fence(self) -> None:
        """Return when the hub has taken all that this client wrote."""
        self.write("< echo >")
        while self.read() not in ("< echo >", ""):
            pass


class Listener:
    """A node of the bus in a thread: it hears every frame, until its test is over or the hub has gone."""

    def __init__(self, options: BusOptions, hear: Callable[[Bus, Frame], None]) -> None:
        self._hear = hear
        self._bus = open_bus(options)
        self._over = threading.Event()
        self._idle = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def rest(self) -> None:
        """Return when it has heard all that was on the bus by now."""
        self._idle.clear()
        assert self._idle.wait(DEADLINE_S), "the bus does not fall silent"

    def close(self) -> None:
        self._over.set()
        self._thread.join(DEADLINE_S)
        assert not self._thread.is_alive()
        self._bus.close()

    def _run(self) -> None:
        while not self._over.is_set():
            try:
                frame = self._bus.recv(0.02)
                if frame is not None:
                    self._hear(self._bus, frame)
                else:
                    self._idle.set()
            except HarnessError:  # the hub went first
                return


class TestGateway:
    """A stand-in for the client process: answers each RADAR_TRACK, with a heartbeat before some.

    `decide` gives (stage, deceleration) for a decoded RADAR_TRACK; None is no answer at all.
    """

    __test__ = False

    def __init__(
        self,
        options: BusOptions,
        codec: Codec,
        decide: Callable[[dict[str, float]], tuple[int, float] | None],
        track_id: int | None = None,
    ) -> None:
        self._codec = codec
        self._decide = decide
        self._track_id = codec.can_id("RADAR_TRACK") if track_id is None else track_id
        self._own_track = track_id is None
        self._sender = Sender(codec, "AEB_REQ")
        self.answers = 0
        self._listener = Listener(options, self._answer)

    def __enter__(self) -> "TestGateway":
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()

    def _answer(self, bus: Bus, frame: Frame) -> None:
        if frame.can_id != self._track_id:
            return
        decision = self._decide(self._codec.decode("RADAR_TRACK", frame.data) if self._own_track else {})
        if decision is None:
            return
        self.answers += 1
        if self.answers % 3 == 0:
            bus.send(Frame(frame.t_us, 0x701, bytes([1, 0, 0, *self.answers.to_bytes(4, "little"), 0])))
        stage, deceleration_ms2 = decision
        signals = {"STAGE": stage, "DECELERATION": deceleration_ms2, "TTC_VALID": 0, "TTC": 0, "TARGET": 0}
        bus.send(self._sender.frame(frame.t_us, {**signals, "SEQUENCE": self.answers % 0x10000}))


class FunctionGateway:
    """The client process, as `runtime.unix.devices` is: the gateway, with the bare function as its server.

    `named`: it gives the bus its name, what it uses, and what it notices; else it is an unnamed client.
    """

    def __init__(self, options: BusOptions, codec: Codec, *, named: bool = False) -> None:
        self.gateway = Gateway(codec)
        self._function = default_application()
        self._named = named
        if named:
            options = msgspec.structs.replace(options, node="gateway", uses=self.gateway.uses)
        self._listener = Listener(options, self._hear)

    def __enter__(self) -> "FunctionGateway":
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()

    def rest(self) -> None:
        """Return when it has heard all that was on the bus by now."""
        self._listener.rest()

    def _hear(self, bus: Bus, frame: Frame) -> None:
        payload = self.gateway.on_frame(frame)
        if payload is not None:
            for answer in self.gateway.on_reply(self._function.execute(payload), 1, 1):
                bus.send(answer)
        elif self._named and frame.can_id == self.gateway.request_id:
            bus.unasked(frame.can_id)
        for notice in self.gateway.noticed() if self._named else ():
            bus.notice(notice)


def brake_late(track: dict[str, float]) -> tuple[int, float]:
    """Full braking below two seconds to contact, or below five metres."""
    if not track["VALID"]:
        return (0, 0.0)
    closing_ms = -track["RELATIVE_SPEED"]
    near = track["RANGE"] < 5.0 or (closing_ms > 1.0 and track["RANGE"] / closing_ms < 2.0)
    return (3, 9.0) if near else (0, 0.0)
