"""The processes beside the graph: the hub, the car, the player of logs. Each ends with its control line."""

import os
import select
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from aftbed.core.errors import HarnessError
from aftbed.inject.receipts import BusReport, ReceiptState
from aftbed.runtime import control
from aftbed.runtime.unix.options import PlayerOptions, VehicleOptions
from aftbed.runtime.unix.transport import Line
from aftbed.vehicle.can.hub import Hub, HubOptions
from aftbed.vehicle.can.hub import serve as serve_hub

if TYPE_CHECKING:
    from aftbed.inject.bus_disturber import Disturber


def serve(line: Line[control.ToNode], order: control.Serve, fds: list[int]) -> None:
    """Run the service that `order` names, until it is done or its line ends."""
    if order.service == "hub":
        _hub(line, order, fds)
    elif order.service == "vehicle":
        _vehicle(line, msgspec.msgpack.decode(order.options, type=VehicleOptions))
    else:
        assert order.service == "player", order.service
        _player(line, msgspec.msgpack.decode(order.options, type=PlayerOptions))


class _Desk:
    """The hub's link to the supervisor, and the faults of its bus (see `vehicle.can.hub.Desk`)."""

    def __init__(self, line: Line[control.ToNode]) -> None:
        self._line = line
        self._faults: Disturber | None = None
        self._reported: dict[int, ReceiptState] = {}  # by the number of the fault

    def attend(self, hub: Hub) -> bool:
        """Carry out the next order; False when the line has ended."""
        got = self._line.recv()
        if got is None:
            return False
        order = got[0]
        if isinstance(order, control.DisturbBus):
            self._disturb(hub, order)
            self._line.send(control.Report(control.BUS_FAULT_ARMED, str(order.token).encode()))
        elif isinstance(order, control.WatchCar):
            hub.watch(order.token, order.condition)
            self._line.send(control.Report(control.CONDITION_WATCHED, str(order.token).encode()))
        elif isinstance(order, control.Ack):
            hub.go_on(order.token)
        elif isinstance(order, control.Stats):
            self._line.send(control.Report(control.BUS_FAULTS_ASKED, msgspec.msgpack.encode(self._reports())))
        return True

    def faults_acted(self) -> None:
        """Report the faults whose receipt is another one than before."""
        armed = ReceiptState.ARMED
        found = self._reports()
        news = [one for one in found if self._reported.get(one.number, armed) is not one.receipt.state]
        if news:
            self._reported |= {one.number: one.receipt.state for one in news}
            self._line.send(control.Report(control.BUS_FAULTS_CHANGED, msgspec.msgpack.encode(news)))

    def met(self, fault_number: int, t_us: int, since_ns: int) -> None:
        """To the supervisor."""
        self._line.send(
            control.Report(control.CONDITION_MET, msgspec.msgpack.encode((fault_number, t_us, since_ns)))
        )

    def _disturb(self, hub: Hub, order: control.DisturbBus) -> None:
        from aftbed.inject.bus_disturber import Disturber  # noqa: PLC0415 - it needs the CRC, and few runs it

        if self._faults is None:
            self._faults = Disturber()
        self._faults.arm(order.token, order.fault, order.draw, hub.now_us())
        hub.disturb(self._faults)

    def _reports(self) -> list[BusReport]:
        return [] if self._faults is None else self._faults.reports()


def _hub(line: Line[control.ToNode], order: control.Serve, fds: list[int]) -> None:
    import socket  # noqa: PLC0415 - imported by all others already

    listener, log = fds
    line.send(control.Report("ready", b""))
    counts = serve_hub(
        socket.socket(fileno=listener),
        log,
        msgspec.msgpack.decode(order.options, type=HubOptions),
        line.fileno(),
        _Desk(line),
    )
    os.close(log)
    line.send(control.Report("result", msgspec.json.encode(counts)))


def _stopper(line: Line[control.ToNode]) -> Callable[[], bool]:
    """Becomes true when the supervisor says Stop, or is gone."""
    poll = select.poll()
    poll.register(line.fileno(), select.POLLIN)
    stopped = False

    def stop() -> bool:
        nonlocal stopped
        stopped = stopped or bool(poll.poll(0))
        return stopped

    return stop


def _wait_for_go(line: Line[control.ToNode]) -> bool:
    """Attached: wait for Resume; False if it is a Stop, or the end."""
    line.send(control.Report("ready", b""))
    got = line.recv()
    return got is not None and isinstance(got[0], control.Resume)


def _vehicle(line: Line[control.ToNode], options: VehicleOptions) -> None:
    from aftbed.vehicle.can.bus import BusOptions  # noqa: PLC0415
    from aftbed.vehicle.can.dbc_file import load_dbc  # noqa: PLC0415
    from aftbed.vehicle.drive_real import CarBuses, DriveOptions, drive  # noqa: PLC0415
    from aftbed.vehicle.scenarios.library import load_scenario  # noqa: PLC0415

    scenario, codec = load_scenario(options.scenario), load_dbc()
    follows = (codec.can_id("AEB_REQ"),)
    buses = CarBuses(BusOptions(port=options.port), lockstep=options.pace is None, follows=follows)
    if not _wait_for_go(line):
        return
    try:
        result = drive(
            scenario,
            codec,
            buses,
            msgspec.convert(
                {"pace": options.pace, "brake_policy": options.brake_policy, "seed": options.seed},
                DriveOptions,
            ),
            report=lambda telemetry: line.send(
                control.Report("telemetry", msgspec.msgpack.encode(telemetry))
            ),
            stop=_stopper(line),
        )
    except HarnessError as error:
        line.send(control.Report("trouble", str(error).encode()))
        return
    line.send(control.Report("result", msgspec.json.encode(result)))


def _player(line: Line[control.ToNode], options: PlayerOptions) -> None:
    from aftbed.vehicle.can.bus import BusOptions, open_bus  # noqa: PLC0415
    from aftbed.vehicle.can.candump import read_log  # noqa: PLC0415
    from aftbed.vehicle.can.dbc_file import load_dbc  # noqa: PLC0415
    from aftbed.vehicle.replay.map_file import find_map  # noqa: PLC0415
    from aftbed.vehicle.replay.mapped_gateway import MappedGateway  # noqa: PLC0415
    from aftbed.vehicle.replay.player import play  # noqa: PLC0415

    gateway = MappedGateway(load_dbc(), Path(options.dbc), find_map(options.map))
    frames, counts = read_log(Path(options.log))
    attached = open_bus(BusOptions(port=options.port, node="player"))
    if not _wait_for_go(line):
        return
    try:
        result = play(
            frames,
            load_dbc(),
            attached,
            options.pace,
            ends_cycle=lambda frame: gateway.on_frame(frame) is not None,
            stop=_stopper(line),
        )
    except HarnessError as error:
        line.send(control.Report("trouble", str(error).encode()))
        return
    line.send(
        control.Report(
            "result",
            msgspec.json.encode({"played": result, "log": counts, "gateway": gateway.counts}),
        )
    )
