"""The processes beside the graph: the hub, the vehicle, the player of logs. Each ends with its control
line."""

import os
import select
import socket
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from aftbed.core.errors import HarnessError
from aftbed.inject.receipts import BusReport, ReceiptState
from aftbed.runtime import control
from aftbed.runtime.unix.options import PLAYER, CarRun, ReplayRun, SourceOptions
from aftbed.runtime.unix.transport import Line
from aftbed.vehicle.can.hub import Hub, HubOptions
from aftbed.vehicle.can.hub import serve as serve_hub

if TYPE_CHECKING:
    from aftbed.inject.bus_disturber import Disturber
    from aftbed.vehicle.can.frame import Frame
    from aftbed.vehicle.gateway import BusGateway

SIGHT_MS: Final = 50  # between two reports of what the function sees, in bus time


def preload() -> None:
    """Import what a drive needs, and read its DBC, for all forks of this process.

    The processes of a replay import the rest themselves.
    """
    import aftbed.vehicle.drive_real  # noqa: PLC0415
    import aftbed.vehicle.gateway  # noqa: PLC0415, F401
    from aftbed.vehicle.can.dbc_file import own_dbc  # noqa: PLC0415

    own_dbc()
    "localhost".encode("idna")  # a table that python-can's connection would load in each process


def serve(line: Line[control.ToNode], order: control.Serve, fds: list[int]) -> None:
    """Run the service that `order` names, until it has finished or its line ends."""
    try:
        if order.service == control.HUB:
            _serve_hub(line, order, fds)
            return
        source = msgspec.msgpack.decode(order.options, type=SourceOptions)
        if order.service == PLAYER:
            _play(line, source, fds[0])
        else:
            _drive(line, source)
    except (HarnessError, OSError) as error:
        _report(line, "trouble", str(error).encode())


def _report(line: Line[control.ToNode], kind: str, data: bytes = b"") -> None:
    line.send(control.Report(kind, data))


# -- the hub --------------------------------------------------------------------------------------


class _SupervisorLink:
    """The hub's link to the supervisor, and the faults of its bus (see `vehicle.can.hub.SupervisorLink`)."""

    def __init__(self, line: Line[control.ToNode]) -> None:
        self._line = line
        self._faults: Disturber | None = None
        self._reported: dict[int, ReceiptState] = {}  # by the number of the fault

    def attend(self, hub: Hub) -> bool:
        """Carry out the next order; False when it is a Stop, or the line has ended."""
        got = self._line.recv()
        match got[0] if got is not None else None:
            case None | control.Stop():
                return False
            case control.DisturbBus(number, fault, draw):
                from aftbed.inject.bus_disturber import Disturber  # noqa: PLC0415 - few runs need it

                self._faults = self._faults or Disturber()
                self._faults.arm(number, fault, draw, hub.now_us())
                hub.disturb(self._faults)
                _report(self._line, control.BUS_FAULT_ARMED, str(number).encode())
            case control.WatchCar(number, condition):
                hub.watch(number, condition)
                _report(self._line, control.CONDITION_WATCHED, str(number).encode())
            case control.Ack(number):
                hub.go_on(number)
            case control.Stats():
                _report(self._line, control.BUS_COUNTS, msgspec.msgpack.encode(hub.counts()))
                _report(self._line, control.BUS_FAULTS_ASKED, msgspec.msgpack.encode(self._receipts()))
        return True

    def faults_acted(self) -> None:
        """Report the faults whose receipt has another state than before."""
        news = [
            one
            for one in self._receipts()
            if self._reported.get(one.number, ReceiptState.ARMED) is not one.receipt.state
        ]
        if news:
            self._reported |= {one.number: one.receipt.state for one in news}
            _report(self._line, control.BUS_FAULTS_CHANGED, msgspec.msgpack.encode(news))

    def met(self, fault_number: int, t_us: int, since_ns: int) -> None:
        """Report that the condition of a fault holds."""
        data = msgspec.msgpack.encode((fault_number, t_us, since_ns))
        _report(self._line, control.CONDITION_MET, data)

    def stranger(self, text: str) -> None:
        """Report what a stranger does."""
        _report(self._line, control.BUS_STRANGER, text.encode())

    def _receipts(self) -> list[BusReport]:
        return [] if self._faults is None else self._faults.reports()


def _serve_hub(line: Line[control.ToNode], order: control.Serve, fds: list[int]) -> None:
    listener, log = fds
    _report(line, "ready")
    options = msgspec.msgpack.decode(order.options, type=HubOptions)
    serve_hub(socket.socket(fileno=listener), log, options, line.fileno(), _SupervisorLink(line))
    os.close(log)


# -- the vehicle and the player -------------------------------------------------------------------


class _Orders:
    """What the supervisor orders a source to do; and the faults of the radar, where it is a vehicle."""

    def __init__(self, line: Line[control.ToNode]) -> None:
        from aftbed.inject.radar import RadarFaults  # noqa: PLC0415

        self.faults = RadarFaults()
        self._line = line
        self._poll = select.poll()
        self._poll.register(line.fileno(), select.POLLIN)
        self._armed = self._stopped = False
        self._reported: dict[int, ReceiptState] = {}  # by the number of the fault

    def until_go(self) -> bool:
        """Attached: wait for Resume; False if it is a Stop, or the end."""
        _report(self._line, "ready")
        while not self._stopped:
            if self._next():
                return True
        return False

    def stop(self) -> bool:
        """Whether the drive has to end; called in each step."""
        while not self._stopped and self._poll.poll(0):
            self._next()
        if self._armed:
            self.report_faults(lambda state: state.fired)
        return self._stopped

    def report_faults(self, worth: Callable[[ReceiptState], bool]) -> None:
        """Report the faults whose receipt has another state than before, one that is `worth` it."""
        news = [
            one
            for one in self.faults.reports()
            if worth(one.receipt.state) and self._reported.get(one.number) is not one.receipt.state
        ]
        if news:
            self._reported |= {one.number: one.receipt.state for one in news}
            _report(self._line, control.RADAR_FAULTS_CHANGED, msgspec.msgpack.encode(news))

    def end(self) -> None:
        """Report what became of all faults."""
        self._reported.clear()
        self.report_faults(lambda state: True)

    def _next(self) -> bool:
        """Carry out the next order; True if it is Resume."""
        got = self._line.recv()
        match got[0] if got is not None else None:
            case control.ResumeNode():
                return True
            case control.DisturbRadar(number, fault, draw):
                self.faults.arm(number, fault, draw)
                self._armed = True
                _report(self._line, control.RADAR_FAULT_ARMED, str(number).encode())
            case _:
                self._stopped = True
        return False


def _drive(line: Line[control.ToNode], source: SourceOptions) -> None:
    from aftbed.vehicle.can.bus import BusOptions  # noqa: PLC0415
    from aftbed.vehicle.can.dbc_file import own_dbc  # noqa: PLC0415
    from aftbed.vehicle.drive_real import CarBuses, DriveOptions, drive  # noqa: PLC0415
    from aftbed.vehicle.scenarios.scenario import Scenario  # noqa: PLC0415

    work = source.work
    assert isinstance(work, CarRun), work
    scenario, codec = msgspec.msgpack.decode(source.drive, type=Scenario), own_dbc()
    given = {"pace": work.pace, "brake_policy": work.brake_policy, "seed": source.seed}
    options = msgspec.convert(given, DriveOptions)
    follows = (codec.can_id("AEB_REQ"),)
    buses = CarBuses(BusOptions(port=source.port, secret=source.secret), follows)
    orders = _Orders(line)
    if orders.until_go():
        result = drive(
            scenario,
            codec,
            buses,
            options,
            report=lambda telemetry: _report(line, control.TELEMETRY, msgspec.msgpack.encode(telemetry)),
            stop=orders.stop,
            radar=orders.faults,
        )
        orders.end()
        _report(line, "result", msgspec.json.encode(result))


class _ViewOfFunction:
    """Reports what the function sees in a replay, for people: at most each SIGHT_MS of bus time."""

    def __init__(self, line: Line[control.ToNode], gateway: "BusGateway") -> None:
        self._line, self._gateway = line, gateway
        self._request = b""  # of the last cycle
        self._next_ms = 0

    def ends_cycle(self, frame: "Frame") -> bool:
        request = self._gateway.on_frame(frame)
        if request is not None:
            self._request = request
        return request is not None

    def answered(self, stage: int, deceleration_ms2: float) -> None:
        from aftbed.vehicle.aeb.messages import decode_request, sight_of  # noqa: PLC0415

        if not self._request:
            return  # an answer to what was sent before
        sight = sight_of(decode_request(self._request), stage, deceleration_ms2)
        if sight.t_ms >= self._next_ms:
            self._next_ms = sight.t_ms + SIGHT_MS
            _report(self._line, control.SIGHT, msgspec.msgpack.encode(sight))


def _play(line: Line[control.ToNode], source: SourceOptions, log: int) -> None:
    from aftbed.vehicle.can.bus import BusOptions, open_bus  # noqa: PLC0415
    from aftbed.vehicle.can.dbc_file import own_dbc  # noqa: PLC0415
    from aftbed.vehicle.replay.map_file import bind, find_map  # noqa: PLC0415
    from aftbed.vehicle.replay.mapped_gateway import MappedGateway  # noqa: PLC0415
    from aftbed.vehicle.replay.player import PlayedLog, play  # noqa: PLC0415

    work = source.work
    assert isinstance(work, ReplayRun), work
    bound = bind(find_map(work.map), Path(work.dbc))
    gateway = MappedGateway(own_dbc(), bound)
    with open(log, "rb") as file:
        played = msgspec.msgpack.decode(file.read(), type=PlayedLog)
    bus = open_bus(BusOptions(port=source.port, secret=source.secret, node=PLAYER))
    orders, view = _Orders(line), _ViewOfFunction(line, gateway)
    if orders.until_go():
        result = play(
            played.frames,
            own_dbc(),
            bus,
            work.pace,
            ends_cycle=view.ends_cycle,
            stop=orders.stop,
            answered=view.answered,
            pause_us=bound.map.cycle_ms * 1000 if work.loop else None,
            until_us=work.duration_ms * 1000 if work.duration_ms is not None else None,
        )
        report = {"played": result, "log": played.report, "gateway": gateway.counts}
        _report(line, "result", msgspec.json.encode(report))
