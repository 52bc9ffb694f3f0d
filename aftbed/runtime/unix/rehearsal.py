"""The rehearsal: requests through a whole chain in memory, before there are real ones.

In the zygote it warms up the interpreter (specialised code, filled caches), which its children inherit. Then
a child that is thrown away shows which pages a step writes to: those that the other children make their own
at birth.
"""

import gc
import os
import socket
from collections import defaultdict
from functools import lru_cache
from typing import Final

from aftbed.core import messages
from aftbed.core import messages as core_messages
from aftbed.core.brick import CONTROL, Brick
from aftbed.core.journal import FLAG_OFFSET, HEADER_BYTES, RECORD
from aftbed.core.messages import (
    CaptureState,
    ChannelEnded,
    Message,
    Promotion,
    Rebound,
    Reply,
    Request,
    Submit,
    TakeOver,
)
from aftbed.ftm.chain import Compute, PassBefore, Protocol
from aftbed.ftm.client import Proxy
from aftbed.ftm.compose import REPLICAS, build, chain
from aftbed.ftm.pbr import PbrAfter
from aftbed.ftm.registry import Setting, make
from aftbed.ftm.server import Server
from aftbed.runtime import control
from aftbed.runtime.node import MemoryIO, Node, nowhere
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.node_io import UnixIO
from aftbed.runtime.unix.prefault import Area, written_by
from aftbed.runtime.unix.transport import NUDGE, Line, decode_order, decode_report
from aftbed.vehicle.aeb.function import default_application, sample_requests

ROUNDS_WARM: Final = 16
ROUNDS_ONCE: Final = 4
REHEARSED: Final = 8

Ways = dict[tuple[str, str], tuple[str, str]]


def warm_up() -> tuple[Area, ...]:
    """As often as it takes until the interpreter has seen it all; then, where a child will write to.

    What is here stays: no collection looks at it from here on, which would be to write to it.
    """
    rehearse(ROUNDS_WARM)
    for _ in range(ROUNDS_WARM):
        rehearse_host()
    gc.collect()
    linux.trim()
    gc.freeze()
    return written_by(_once)


def _once() -> None:
    rehearse(ROUNDS_ONCE)
    rehearse_host()


def rehearse(rounds: int) -> None:
    """`rounds` requests through both replicas, then the backup takes over and serves as many."""
    kinds, ways, requests = _scene()
    node = Node("rehearsal", MemoryIO())
    for name, kind in kinds.items():
        hosted = node.add(name, make(kind, Setting(1, 1, not name.startswith("b/"), default_application)))
        hosted.outputs = defaultdict(lambda: nowhere, hosted.outputs)
    for way in ways.items():
        _link(node, *way, epoch=1)
    _serve(node, requests[:rounds])
    after = node.bricks["b/after"]
    node.step(after, CONTROL, Promotion(2))
    node.step(after, "aft2aft", ChannelEnded())
    _link(node, ("b/protocol", "pro2pxy"), ("proxy", "pro2pxy"), epoch=2)
    _link(node, ("proxy", "pxy2pro"), ("b/protocol", "pxy2pro"), epoch=2)
    _serve(node, requests[:rounds])


def _link(node: Node[int, int], source: tuple[str, str], sink: tuple[str, str], epoch: int) -> None:
    """A channel in memory, whose messages are encoded and decoded as on a socket."""
    hosted = node.bricks[source[0]]
    hosted.outputs[source[1]] = lambda message: node.post(
        *sink, core_messages.decode(core_messages.encode(message))
    )
    node.step(hosted, CONTROL, Rebound(source[1], True, epoch))


def _serve(node: Node[int, int], requests: list[bytes]) -> None:
    for payload in requests:
        node.post("client", "submit", Submit(payload))
        while node.turn():
            pass


@lru_cache(maxsize=1)
def _scene() -> tuple[dict[str, str], Ways, list[bytes]]:
    """Kinds by name, ways of their mail, requests; made once: a node makes nothing like it."""
    graph = build("pbr", "replica")
    names = ["client", "proxy", *(name for replica in REPLICAS for name in chain(graph, replica))]
    ways = {
        (k.source, k.source_port): (k.sink, k.sink_port)
        for k in graph.links
        if not k.standby and {k.source, k.sink} <= set(names)
    }
    return {name: graph.brick(name).kind for name in names}, ways, sample_requests(0, ROUNDS_WARM)


class _Scratch:
    """A host of one brick, with all its ends here."""

    def __init__(self, brick: Brick, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.line = Line(ours, decode_report)
        self.io = UnixIO(Line(theirs, decode_order), JournalFile(None, "rehearsal"))
        self.node = Node("rehearsal", self.io)
        self.node.add("brick", brick)
        self._ends = [ours, theirs]
        self.into = {port: self.channel() for port in inputs}
        self._outputs = {port: self.channel() for port in outputs}
        for port, (_, read) in self.into.items():
            self.node.bind_input("brick", port, os.dup(read.fileno()))
        for port, (write, _) in self._outputs.items():
            self.node.bind_output("brick", port, os.dup(write.fileno()), 1)

    def channel(self) -> tuple[socket.socket, socket.socket]:
        """A writing and a reading end."""
        ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._ends += ends
        return ends

    def order(self, order: control.ToNode, fds: tuple[int, ...] = ()) -> None:
        """What the supervisor does to be heard."""
        self.line.send(order, fds)
        self.io.journal.mapping[FLAG_OFFSET] = 1
        for write, _ in self.into.values():
            write.send(NUDGE, socket.MSG_DONTWAIT)

    def turns(self, count: int) -> None:
        """Let the host work off what has come, as `Node.run` does."""
        for _ in range(count):
            self.io.turn()

    def close(self) -> None:
        """Close everything."""
        for port in self.into:
            self.node.bind_input("brick", port, None)
        for port in self._outputs:
            self.node.bind_output("brick", port, None, 1)
        for end in self._ends:
            end.close()


def rehearse_host() -> None:
    """A host at work: mail, control mail between it, and the part of each brick in a failover."""
    _rehearse_mail()
    _rehearse_promotion()
    _rehearse_following()
    request, (payload,) = Request(2, 1, b""), sample_requests(0, 1)
    _rehearse_part(
        Protocol(2, 1, leads=False),
        (("aft2pro", TakeOver(2)), ("pxy2pro", request), ("aft2pro", Reply(2, 1, 2, b""))),
        ("pro2bfr", "pro2pxy"),
    )
    _rehearse_part(
        Compute(), (("bfr2prd", request), ("srv2prd", Reply(2, 1, 2, b""))), ("prd2srv", "prd2aft")
    )
    _rehearse_part(
        Server(default_application(), 2),
        (("prd2srv", Request(2, 1, payload)), ("aft2srv", CaptureState(2, 1))),
        ("srv2prd", "srv2aft"),
    )


def _rehearse_mail() -> None:
    scratch = _Scratch(PassBefore(), ("pro2bfr",), ("bfr2prd",))
    into, _ = scratch.into["pro2bfr"]
    request_id = 0
    for _ in range(ROUNDS_ONCE):
        for _ in range(REHEARSED):
            request_id += 1
            into.send(messages.encode(Request(1, request_id, b"")))
        scratch.order(control.Resume(request_id))
        scratch.turns(1)  # the order, then the first request
        scratch.io.serve_fast(scratch.node.bricks["brick"])  # until it meets the nudge
        assert scratch.io.journal.at == HEADER_BYTES + request_id * RECORD.size, "a rehearsal went wrong"
        scratch.line.recv()
    scratch.close()


def _rehearse_promotion() -> None:
    scratch = _Scratch(PbrAfter(1, leads=False), ("aft2aft", "srv2aft"), ("aft2srv", "aft2pro", "aft2aft"))
    into, _ = scratch.into["aft2aft"]
    scratch.order(control.Tell(control.UNANSWERED, "brick", Promotion(2)))
    into.shutdown(socket.SHUT_WR)
    scratch.turns(2)  # the nudge and the order with it, then the end
    scratch.close()


def _rehearse_part(brick: Brick, mail: tuple[tuple[str, Message], ...], outputs: tuple[str, ...]) -> None:
    scratch = _Scratch(brick, tuple({port: None for port, _ in mail}), outputs)
    for port, message in mail:
        scratch.into[port][0].send(messages.encode(message))
        scratch.turns(1)
    scratch.close()


def _rehearse_following() -> None:
    scratch = _Scratch(Proxy(), ("clt2pxy", "pro2pxy"), ("pxy2pro", "pxy2clt"))
    into, _ = scratch.into["clt2pxy"]
    into.send(messages.encode(Request(0, 1, b"")))
    scratch.turns(1)
    write, _ = scratch.channel()
    _, read = scratch.channel()
    fds = os.dup(read.fileno()), os.dup(write.fileno())
    scratch.order(control.Follow(control.UNANSWERED, "brick", "pro2pxy", "pxy2pro", 2), fds)
    scratch.turns(1)  # the old channel's nudge, and the order with it
    for fd in fds:
        os.close(fd)
    scratch.close()
