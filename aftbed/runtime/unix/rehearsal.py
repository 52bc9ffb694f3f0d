"""The rehearsal: requests through a whole chain in memory, before there are real ones.

In the zygote it warms up the interpreter (specialised code, filled caches), which its children inherit.
In a child it makes the child's own copies of the pages that a step writes to: without it the first
request after a failover pays some hundred page faults in each process of the new leader (0.5 ms).
"""

import select
import socket
from typing import Final

from aftbed.core import wire
from aftbed.core.brick import CONTROL, Brick, Send
from aftbed.core.message import ChannelEnded, Message, Promote, Rebound, Request, Submit
from aftbed.ftm.before import PassBefore
from aftbed.ftm.catalog import Setting, make
from aftbed.ftm.mechanism import CHAIN_PARTS, build
from aftbed.runtime.unix import control
from aftbed.runtime.unix.journal import Journal
from aftbed.runtime.unix.node import NUDGE, Node
from aftbed.vehicle.function import default_application, sample_requests

ROUNDS_WARM: Final = 16
ROUNDS_ONCE: Final = 4
REHEARSED: Final = 8
PATIENCE_MS: Final = 20.0  # of waiting for the first mail; the whole graph is there by then

_done = False


def once() -> None:
    """Rehearse, unless this process has done so."""
    global _done  # noqa: PLW0603 - one process, one rehearsal
    if not _done:
        _done = True
        rehearse(ROUNDS_ONCE)
        rehearse_host()


def rehearse(rounds: int) -> None:
    """`rounds` requests through both replicas, then the backup takes over and serves as many."""
    graph = build("pbr", "replica")
    names = ["client", "proxy", *(f"{r}/{part}" for r in "ab" for part in CHAIN_PARTS)]
    bricks: dict[str, Brick] = {}
    for name in names:
        leads = not name.startswith("b/")
        bricks[name] = make(graph.brick(name).kind, Setting(1, 1, leads, default_application))
    ways = {(k.source, k.source_port): (k.sink, k.sink_port) for k in graph.links if not k.standby}
    requests = sample_requests(0, rounds)
    bricks["proxy"].step(CONTROL, Rebound("pxy2pro", True, 1), 0)
    bricks["a/after"].step(CONTROL, Rebound("aft2aft", True, 1), 0)
    _serve(bricks, ways, requests)
    mail = [("b/after", CONTROL, Promote(2)), ("b/after", "aft2aft", ChannelEnded())]
    for name, port, message in mail:
        _deliver(bricks, ways, [(name, port, message)])
    ways |= {("proxy", "pxy2pro"): ("b/protocol", "pxy2pro"), ("b/protocol", "pro2pxy"): ("proxy", "pro2pxy")}
    bricks["proxy"].step(CONTROL, Rebound("pxy2pro", True, 2), 0)
    _serve(bricks, ways, requests)


def before_mail(node: Node) -> None:
    """Rehearse before the node's first mail, or when it is there."""
    poll = select.poll()
    poll.register(node.line.fileno(), select.POLLIN)
    for hosted in node.wiring.hosted.values():
        for inlet in hosted.inlets.values():
            poll.register(inlet.fd, select.POLLIN)
    poll.poll(PATIENCE_MS)
    once()


def rehearse_host() -> None:
    """The tight loop of a host, on a scratch node of one brick."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    into, inlet = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    outlet, out = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    node = Node("rehearsal", control.Line(theirs, control.decode_order), Journal(None, "rehearsal"))
    node.add("before", PassBefore())
    node.wiring.bind_input("before", "pro2bfr", inlet.detach())
    node.bind_output("before", "bfr2prd", outlet.detach(), 1)
    for request_id in range(1, REHEARSED + 1):
        into.send(wire.encode(Request(1, request_id, b"")))
    into.send(NUDGE)
    node.turn()
    node.serve_hot(node.wiring.hosted["before"])
    node.wiring.bind_input("before", "pro2bfr", None)
    node.bind_output("before", "bfr2prd", None, 1)
    for end in (ours, theirs, into, out):
        end.close()


Ways = dict[tuple[str, str], tuple[str, str]]


def _serve(bricks: dict[str, Brick], ways: Ways, requests: list[bytes]) -> None:
    for payload in requests:
        _deliver(bricks, ways, [("client", "submit", Submit(payload))])


def _deliver(bricks: dict[str, Brick], ways: Ways, mail: list[tuple[str, str, Message]]) -> None:
    while mail:
        name, port, message = mail.pop(0)
        for effect in bricks[name].step(port, message, 0):  # type: ignore[arg-type]
            if isinstance(effect, Send) and (name, effect.port) in ways:
                sink, sink_port = ways[name, effect.port]
                mail.append((sink, sink_port, wire.decode(wire.encode(effect.message))))
