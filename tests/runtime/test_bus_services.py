"""Services beside the graph, over a control line."""

import socket

import msgspec

from aftbed.runtime import control
from aftbed.runtime.unix.bus_services import serve
from aftbed.runtime.unix.options import CarRun, SourceOptions
from aftbed.runtime.unix.transport import Line, decode_order, decode_report
from aftbed.runtime.unix.workload import VEHICLE
from aftbed.vehicle.scenarios.library import load_scenario


def test_a_vehicle_that_does_not_reach_the_bus_reports_why() -> None:
    """Its supervisor ends the run with this reason, not with the bare death of a process."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs, socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))  # and does not listen
        drive = msgspec.msgpack.encode(load_scenario("ccrs-50"))
        port = bound.getsockname()[1]
        options = SourceOptions(CarRun("ccrs-50", 1.0, "latch"), 0, port, "", drive=drive)
        order = control.Serve(control.UNANSWERED, VEHICLE, msgspec.msgpack.encode(options))
        serve(Line(theirs, decode_order), order, [])
        ours.settimeout(5.0)
        got = Line(ours, decode_report).recv()
    assert got is not None and isinstance(got[0], control.Report)
    assert got[0].kind == "trouble"
    assert b"no CAN hub at" in got[0].data, got[0].data
