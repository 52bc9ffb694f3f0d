"""The orders that a node takes from the executive. Written once for all runtimes."""

from typing import Final, assert_never

from aftbed.core.brick import Effect, Halt, Order
from aftbed.core.errors import PeerError
from aftbed.core.messages import Watch
from aftbed.runtime import blows, control
from aftbed.runtime.cell import look, move_in
from aftbed.runtime.host import Fds, Host, Hosted

WATCHDOG: Final = "{}/watchdog"


def carry_out(node: Host, order: control.ToNode, fds: Fds) -> bytes | None:
    """Do what `order` says; the data of its Ack, or None where the Ack comes later.

    Raises PeerError where a brick refuses, or the order is not for a node.
    """
    match order:
        case control.BindInput(_, brick, port):
            node.bind_input(brick, port, fds.pop() if fds else None)
        case control.BindOutput(_, brick, port, epoch):
            node.bind_output(brick, port, fds.pop() if fds else None, epoch)
        case control.Follow(_, brick, port, output, epoch):
            read, write = fds
            node.bind_input(brick, port, read)
            node.bind_output(brick, output, write, epoch)
        case control.Rewire():
            return _rewire(node, order, fds)
        case control.Suspend(token, drain):
            node.suspend(token, drain=drain)
            return None  # answered when quiescent
        case control.Resume():
            node.resume()
        case control.Capture(_, brick, looks):
            found = node.hosted(brick).brick
            return look(found) if looks else found.capture()
        case control.Restore(_, brick, state, migrate):
            taker = node.hosted(brick).brick
            take = getattr(taker, "migrate", taker.restore) if migrate else taker.restore
            take(state)
        case control.Tell(_, brick, message):
            node.tell(brick, message)
        case control.WatchNodes():
            node.watch(order, fds)
            node.tell(WATCHDOG.format(order.replica), Watch(order.replica, order.generation, order.nodes))
        case control.Arm() | control.Interfere() | control.SlowDown():
            blows.take(node, order)
        case control.KeepInCell():
            return move_in(node, order, node.memory(fds.pop()))
        case control.Stats():
            return node.stats()
        case control.Quiet():
            node.quiet()
        case (
            control.Park()
            | control.Assign()
            | control.Serve()
            | control.DisturbBus()
            | control.WatchCar()
            | control.Stop()
            | control.Ack()
        ):
            raise PeerError(f"{type(order).__name__} to a node")
        case _:
            assert_never(order)
    return b""


def _rewire(node: Host, order: control.Rewire, fds: Fds) -> bytes | None:
    for port in order.inputs:
        found = None if port.index == control.NOWHERE else fds[port.index]
        node.bind_input(port.brick, port.port, found)
    for port in order.outputs:
        found = None if port.index == control.NOWHERE else fds[port.index]
        node.bind_output(port.brick, port.port, found, order.epoch)
    if not order.suspend:
        return b""
    node.suspend(order.token, drain=False)
    return None  # answered when quiescent


def order_or_halt(node: Host, hosted: Hosted, effect: Effect) -> None:
    """The rare effects: a script for the runtime, or the end of this node."""
    if isinstance(effect, Order):
        node.say(control.Ordered(hosted.name, effect.script, effect.phase, effect.number))
        return
    assert isinstance(effect, Halt)
    node.stop_detected(hosted.name, effect.reason)
