"""The orders that a node takes from the supervisor, and the faults that it was told to wait for."""

import os
import signal
import time
from typing import TYPE_CHECKING, Final, assert_never

import msgspec

from aftbed.core.brick import CONTROL
from aftbed.core.errors import PeerError
from aftbed.core.event import Event, event_named
from aftbed.core.fault import Act
from aftbed.core.message import Watch
from aftbed.runtime.unix import control
from aftbed.runtime.unix.devices import Sensor

if TYPE_CHECKING:
    from aftbed.runtime.unix.node import Node

FAULT_SECONDS_MAX: Final = 5.0


def carry_out(node: "Node", order: control.ToNode, fds: list[int]) -> bytes | None:
    """Do what `order` says; the data of its Ack, or None where the Ack comes later.

    Raises PeerError where a brick refuses, or the order is not for a node.
    """
    wiring = node.wiring
    match order:
        case control.BindInput(_, brick, port):
            wiring.bind_input(brick, port, fds.pop() if fds else None)
        case control.BindOutput(_, brick, port, epoch):
            node.bind_output(brick, port, fds.pop() if fds else None, epoch)
        case control.Follow(_, brick, port, output, epoch):
            read, write = fds
            wiring.bind_input(brick, port, read)
            node.bind_output(brick, output, write, epoch)
        case control.Suspend(token):
            node.suspend_token = token
            return None  # answered when quiescent
        case control.Resume():
            node.suspended, node.suspend_token = False, 0
        case control.Capture(_, brick):
            return wiring.hosted[brick].brick.capture()
        case control.Restore(_, brick, state):
            wiring.hosted[brick].brick.restore(state)
        case control.Tell(_, brick, message):
            node.step(wiring.hosted[brick], CONTROL, message)
        case control.WatchNodes():
            _watch(node, order, fds)
        case control.Arm():
            node.armed[event_named(order.event)] = order
        case control.Stats():
            return node.device.stats() if node.device is not None else b""
        case control.Quiet():
            assert node.device is not None
            node.device.quiet()
        case control.Park() | control.Assign() | control.Serve() | control.Stop() | control.Ack():
            raise PeerError(f"{type(order).__name__} to a node")
        case _:
            assert_never(order)
    return b""


def _watch(node: "Node", order: control.WatchNodes, fds: list[int]) -> None:
    assert isinstance(node.device, Sensor) and node.device_brick is not None
    node.device.watch(order.nodes, order.journals, order.pids, fds)
    node.wiring.forget_plans()
    node.step(node.device_brick, CONTROL, Watch(order.replica, order.generation, order.nodes))


def fire(node: "Node", event: Event) -> None:
    """`event` has happened here: if a fault waits for it, and this is the time, act or ask for it."""
    arm = node.armed.get(event)
    if arm is None:
        return
    if arm.nth > 1:
        node.armed[event] = msgspec.structs.replace(arm, nth=arm.nth - 1)
        return
    del node.armed[event]
    node.journal.write(time.monotonic_ns(), Event.FAULT_APPLIED, 0, arm.fault)
    if arm.itself:
        os.kill(os.getpid(), signal.SIGKILL if arm.act is Act.CRASH else signal.SIGSTOP)
        return
    node.line.send(control.Fired(arm.fault))
    limit = time.monotonic() + FAULT_SECONDS_MAX
    while time.monotonic() < limit:
        if node.serve_control(wait=True, until=arm.fault):
            return
    raise AssertionError(f"fault {arm.fault} was not applied within {FAULT_SECONDS_MAX} s")
