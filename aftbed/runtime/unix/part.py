"""What a spare becomes: a node of the graph, or a service beside it (the hub, the vehicle)."""

import gc
import importlib
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Final, NoReturn

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.ftm.client import Client
from aftbed.runtime import control
from aftbed.runtime.assembly import Assembler
from aftbed.runtime.devices import Device, Sensor
from aftbed.runtime.node import Node
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.death_notice import Held
from aftbed.runtime.unix.devices import LoadOptions, ProcessSenses, make_load
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.node_io import EXIT_ASSERT, UnixIO, UnixNode
from aftbed.runtime.unix.options import GatewayOptions
from aftbed.runtime.unix.transport import PULSE_SECONDS, Line
from aftbed.vehicle.aeb.function import default_application, sample_requests

LOAD_REQUESTS: Final = 512


def become(line: Line[control.ToNode], order: control.Assign | control.Serve, fds: list[int]) -> NoReturn:
    """Be what `order` says. Never returns."""
    try:
        if isinstance(order, control.Serve):
            from aftbed.runtime.unix.bus_services import serve  # noqa: PLC0415 - the bus costs 150 ms to import

            linux.set_name(f"aftbed-{order.service}")
            serve(line, order, fds)
            os._exit(0)
        io = _build(line, order, fds)
    except BaseException as error:  # noqa: BLE001 - the last frame of this process
        known = isinstance(error, ConfigError)
        reason = str(error) if known else f"{type(error).__name__}: {error}"
        line.send(control.Ack(order.token, error=reason))
        if known:
            os._exit(0)
        sys.excepthook(type(error), error, error.__traceback__)
        os._exit(EXIT_ASSERT)
    io.serve()


def _build(line: Line[control.ToNode], order: control.Assign, fds: list[int]) -> UnixIO:
    linux.set_name(order.node)
    if order.staged and order.aside is not None:
        os.sched_setaffinity(0, {order.aside})  # requests are served on the other one
    if order.cpu is not None:
        os.sched_setaffinity(0, {order.cpu})
    if order.bricks[0].kind in ("watchdog", "recovery"):
        linux.answer_soon()
    else:
        linux.hand_over()
    linux.set_timeouts(line.sock, PULSE_SECONDS, 2.0)
    io = UnixIO(line, JournalFile(Path(order.journal), order.node))
    node = Node(order.node, io)
    io.start_pulse()
    io.lifeline = Held(Path(order.journal))
    if order.bricks[0].kind == "engine":
        gc.enable()  # a plan leaves cycles behind, and nobody waits for the Engine on the request path
    Assembler(default_application, load_module).build(node, order, fds, lambda: _device(order, node))
    return io


def load_module(place: str) -> ModuleType:
    """The module called `place`, or in that file if it ends in `.py`. Raises ConfigError without the file."""
    if not place.endswith(".py"):
        return importlib.import_module(place)
    spec = importlib.util.spec_from_file_location(Path(place).stem, place)
    if spec is None or spec.loader is None or not Path(place).is_file():
        raise ConfigError(f"{place}: no such file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _device(order: control.Assign, node: UnixNode) -> Device:
    if order.device == "sensor":
        return Sensor(ProcessSenses())
    client = node.brick(order.bricks[0].name)
    assert isinstance(client, Client)
    if order.device == "load":
        options = msgspec.msgpack.decode(order.options, type=LoadOptions)
        return make_load(client, options, sample_requests(options.seed, LOAD_REQUESTS))
    assert order.device == "gateway", order.device
    from aftbed.runtime.unix.gateway import make_car  # noqa: PLC0415 - see above

    return make_car(client, msgspec.msgpack.decode(order.options, type=GatewayOptions))
