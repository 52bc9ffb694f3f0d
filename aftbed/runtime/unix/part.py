"""What a spare becomes: a node of the graph, or a service beside it (the hub, the vehicle)."""

import os
import sys
from pathlib import Path
from typing import Final, NoReturn

import msgspec

from aftbed.ftm.catalog import Setting, make
from aftbed.ftm.client import Client
from aftbed.runtime.unix import control, linux, rehearsal
from aftbed.runtime.unix.devices import Device, Load, LoadOptions, Sensor
from aftbed.runtime.unix.journal import Journal
from aftbed.runtime.unix.lifeline import Held
from aftbed.runtime.unix.node import EXIT_ASSERT, PULSE_SECONDS, Node
from aftbed.runtime.unix.options import GatewayOptions
from aftbed.vehicle.function import default_application, sample_requests

LOAD_REQUESTS: Final = 512


def become(
    line: control.Line[control.ToNode], order: control.Assign | control.Serve, fds: list[int]
) -> NoReturn:
    """Be what `order` says. Never returns."""
    try:
        if isinstance(order, control.Serve):
            from aftbed.runtime.unix.services import serve  # noqa: PLC0415 - the bus costs 150 ms to import

            linux.set_name(f"aftbed-{order.service}")
            serve(line, order, fds)
            os._exit(0)
        node = _build(line, order, fds)
        rehearsal.before_mail(node)
    except BaseException as error:  # noqa: BLE001 - the last frame of this process
        line.send(control.Ack(order.token, error=f"{type(error).__name__}: {error}"))
        sys.excepthook(type(error), error, error.__traceback__)
        os._exit(EXIT_ASSERT)
    node.run()


def _build(line: control.Line[control.ToNode], order: control.Assign, fds: list[int]) -> Node:
    linux.set_name(order.node)
    if order.cpu is not None:
        os.sched_setaffinity(0, {order.cpu})
    if order.bricks[0][1] in ("watchdog", "recovery"):
        linux.answer_soon()
    else:
        linux.hand_over()
    linux.set_timeouts(line.sock, PULSE_SECONDS, 2.0)
    node = Node(order.node, line, Journal(Path(order.journal), order.node))
    node.start_pulse()
    node.lifeline = Held(Path(order.journal))
    setting = Setting(order.replica, order.epoch, order.leads, default_application)
    for name, kind in order.bricks:
        node.add(name, make(kind, setting))
    for local in order.locals:
        node.wiring.link_inside(local)
    if order.device:
        name = order.bricks[0][0]
        node.attach(_device(order, node), name)
    for port in order.inputs:
        node.wiring.bind_input(port.brick, port.port, fds[port.index])
    line.send(control.Ack(order.token))
    for port in order.outputs:
        node.bind_output(port.brick, port.port, fds[port.index], order.epoch)
    return node


def _device(order: control.Assign, node: Node) -> Device:
    if order.device == "sensor":
        return Sensor()
    client = node.wiring.hosted[order.bricks[0][0]].brick
    assert isinstance(client, Client)
    if order.device == "load":
        options = msgspec.msgpack.decode(order.options, type=LoadOptions)
        return Load(client, options, sample_requests(options.seed, LOAD_REQUESTS))
    assert order.device == "gateway", order.device
    from aftbed.runtime.unix.gateway import GatewayDevice  # noqa: PLC0415 - see above

    return GatewayDevice(client, msgspec.msgpack.decode(order.options, type=GatewayOptions))
