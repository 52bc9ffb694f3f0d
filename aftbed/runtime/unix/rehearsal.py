"""What a zygote and its nodes do once in private, so that a node's first request is as fast as the others.

*In a zygote* (`warm_up`) requests are sent through a whole chain in memory, until the interpreter has
specialised the code on the path and filled its caches: all forks inherit that.

*In a node* (`rehearse_node`). A child of a fork shares each page with its parent until it writes there; then
the kernel stops it and copies the page. In its first request a node takes some 300 such page faults: half a
millisecond in each process of a new leader. A node that will have nothing to do until a failover or a commit
takes them before it is joined to others: it does what it will do then, between ends of channels of its own.
"""

import gc
import os
import socket
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from typing import Final

from aftbed.core import messages
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
from aftbed.ftm.registry import Setting, last_word, make
from aftbed.ftm.server import Server
from aftbed.runtime import control
from aftbed.runtime.node import MemoryIO, Node, nowhere
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.node_io import UnixIO
from aftbed.runtime.unix.transport import (
    NUDGE,
    ORDER_SECONDS,
    WRITE_SECONDS_MAX,
    Line,
    decode_order,
    decode_report,
)
from aftbed.vehicle.aeb.function import default_application, sample_requests

ROUNDS: Final = 16  # until the interpreter has specialised all code on the path
MAIL_ROUNDS: Final = 4  # in each of them
MAIL_BATCH: Final = 8

Ends = dict[tuple[str, str], tuple[str, str]]  # brick and port that send -> brick and port that receive


def warm_up() -> None:
    """Rehearse all that nodes do; then see `settle`."""
    rehearse()
    settle()


def rehearse() -> None:
    """Until the interpreter has specialised the code on the path, here and for all forks."""
    _rehearse_chain()
    for _ in range(ROUNDS):
        _rehearse_mail(MAIL_ROUNDS)
        _rehearse_commit()
        for work in _FAILOVER.values():
            work()


def settle() -> None:
    """What is in memory by now stays, and no garbage collection visits it: in a fork that would copy it."""
    gc.collect()
    linux.trim()
    gc.freeze()


def rehearse_node(kinds: Iterable[str], *, commits: bool = False) -> None:
    """In the process that will be a node with bricks of these kinds: mail, and their parts of a failover; if
    it `commits`, the orders of a commit.
    """
    _rehearse_mail(1)
    if commits:
        _rehearse_commit()
    for part in {last_word(kind) for kind in kinds} & _FAILOVER.keys():
        _FAILOVER[part]()
    gc.collect()  # nodes refer to themselves


def _rehearse_chain() -> None:
    """Send requests through both replicas; then the backup takes over and serves as many."""
    kinds, links, requests = _scene()
    node = Node("rehearsal", MemoryIO())

    def link(source: tuple[str, str], sink: tuple[str, str], epoch: int) -> None:
        """A channel in memory, whose messages are encoded and decoded as on a socket."""
        hosted = node.bricks[source[0]]
        hosted.outputs[source[1]] = lambda message: node.post(
            *sink, messages.decode(messages.encode(message))
        )
        node.step(hosted, CONTROL, Rebound(source[1], True, epoch))

    def serve() -> None:
        for payload in requests:
            node.post("client", "submit", Submit(payload))
            while node.turn():
                pass

    for name, kind in kinds.items():
        hosted = node.add(name, make(kind, Setting(1, 1, not name.startswith("b/"), default_application)))
        hosted.outputs = defaultdict(lambda: nowhere, hosted.outputs)
    for source, sink in links.items():
        link(source, sink, epoch=1)
    serve()
    after = node.bricks["b/after"]
    node.step(after, CONTROL, Promotion(2))
    node.step(after, "aft2aft", ChannelEnded())
    link(("b/protocol", "pro2pxy"), ("proxy", "pro2pxy"), epoch=2)
    link(("proxy", "pxy2pro"), ("b/protocol", "pxy2pro"), epoch=2)
    serve()


@lru_cache(maxsize=1)
def _scene() -> tuple[dict[str, str], Ends, list[bytes]]:
    """Kinds by name, links, requests. Made once: no node makes anything like it."""
    graph = build("pbr", "replica")
    names = ["client", "proxy", *(name for replica in REPLICAS for name in chain(graph, replica))]
    links = {
        (k.source, k.source_port): (k.sink, k.sink_port)
        for k in graph.links
        if not k.standby and {k.source, k.sink} <= set(names)
    }
    return {name: graph.brick(name).kind for name in names}, links, sample_requests(0, ROUNDS)


class _Scratch:
    """A host of one brick, with the other ends of its channels and of its control line."""

    def __init__(self, brick: Brick, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> None:
        self._ends: list[socket.socket] = []
        self._outputs = outputs
        ours, theirs = self.pair()
        linux.set_timeouts(theirs, ORDER_SECONDS, WRITE_SECONDS_MAX)
        self.line = Line(ours, decode_report)
        self.io = UnixIO(Line(theirs, decode_order), JournalFile(None, "rehearsal"))
        self.node = Node("rehearsal", self.io)
        self.node.add("brick", brick)
        self.into: dict[str, socket.socket] = {}
        for port in inputs:
            self.into[port], read = self.pair()
            self.node.bind_input("brick", port, os.dup(read.fileno()))
        for port in outputs:
            write, _ = self.pair()
            self.node.bind_output("brick", port, os.dup(write.fileno()), 1)

    def pair(self) -> tuple[socket.socket, socket.socket]:
        """A writing and a reading end, closed with this host."""
        ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._ends += ends
        return ends

    def send(self, port: str, message: Message) -> None:
        """Put `message` into the channel to `port`."""
        self.into[port].send(messages.encode(message))

    def order(self, order: control.ToNode, fds: tuple[int, ...] = ()) -> None:
        """Send an order as the supervisor does: with the flag and a nudge."""
        self.line.send(order, fds)
        self.io.journal.mapping[FLAG_OFFSET] = 1
        for write in self.into.values():
            write.send(NUDGE, socket.MSG_DONTWAIT)

    def close(self) -> None:
        """Close everything."""
        for port in self.into:
            self.node.bind_input("brick", port, None)
        for port in self._outputs:
            self.node.bind_output("brick", port, None, 1)
        for end in self._ends:
            end.close()


def _rehearse_mail(rounds: int) -> None:
    """Mail, and orders between it."""
    scratch = _Scratch(PassBefore(), ("pro2bfr",), ("bfr2prd",))
    request_id = 0
    for _ in range(rounds):
        for _ in range(MAIL_BATCH):
            request_id += 1
            scratch.send("pro2bfr", Request(1, request_id, b""))
        scratch.order(control.ResumeNode(request_id))
        scratch.io.turn()  # the order, then the first request
        scratch.io.serve_fast()  # until it meets the nudge
        assert scratch.io.journal.at == HEADER_BYTES + request_id * RECORD.size, "a rehearsal went wrong"
        scratch.line.recv()
    scratch.close()


def _rehearse_commit() -> None:
    """Be drained, bound to other channels, and resumed."""
    scratch = _Scratch(PassBefore(), ("pro2bfr",), ("bfr2prd",))
    scratch.order(control.SuspendNode(1, drain=True))
    scratch.io.turn()  # the nudge, and the order with it
    (into, read), (write, _) = scratch.pair(), scratch.pair()
    ends = control.Port("brick", "pro2bfr", 0), control.Port("brick", "bfr2prd", 1)
    rewire = control.Rewire(2, ends[:1], ends[1:], 1, suspend=False)
    scratch.line.send(rewire, (read.fileno(), write.fileno()))
    scratch.io.turn()  # it is quiescent, and waits for an order
    scratch.into["pro2bfr"] = into
    scratch.line.send(control.ResumeNode(3))
    scratch.io.turn()
    for token in range(1, 4):
        got = scratch.line.recv()
        assert got is not None and got[0] == control.Ack(token, b"", ""), "a rehearsal went wrong"
    scratch.close()


def _promote() -> None:
    scratch = _Scratch(PbrAfter(1, leads=False), ("aft2aft", "srv2aft"), ("aft2srv", "aft2pro", "aft2aft"))
    scratch.order(control.Deliver(control.UNANSWERED, "brick", Promotion(2)))
    scratch.into["aft2aft"].shutdown(socket.SHUT_WR)
    scratch.io.turn()  # the nudge and the order with it
    scratch.io.turn()  # the end of the channel
    scratch.close()


def _follow() -> None:
    scratch = _Scratch(Proxy(), ("clt2pxy", "pro2pxy"), ("pxy2pro", "pxy2clt"))
    scratch.send("clt2pxy", Request(0, 1, b""))
    scratch.io.turn()
    (write, _), (_, read) = scratch.pair(), scratch.pair()
    fds = os.dup(read.fileno()), os.dup(write.fileno())
    scratch.order(control.Follow(control.UNANSWERED, "brick", "pro2pxy", "pxy2pro", 2), fds)
    scratch.io.turn()  # the nudge of the old channel, and the order with it
    for fd in fds:
        os.close(fd)
    scratch.close()


def _take_over() -> None:
    _step(
        Protocol(2, 1, leads=False),
        (("aft2pro", TakeOver(2)), ("pxy2pro", Request(2, 1, b"")), ("aft2pro", Reply(2, 1, 2, b""))),
        ("pro2bfr", "pro2pxy"),
    )


def _compute() -> None:
    _step(
        Compute(),
        (("bfr2prd", Request(2, 1, b"")), ("srv2prd", Reply(2, 1, 2, b""))),
        ("prd2srv", "prd2aft"),
    )


def _serve() -> None:
    _, _, (payload, *_) = _scene()
    _step(
        Server(default_application(), 2),
        (("prd2srv", Request(2, 1, payload)), ("aft2srv", CaptureState(2, 1))),
        ("srv2prd", "srv2aft"),
        (control.Capture(1, "brick"),),
    )


def _step(
    brick: Brick,
    mail: tuple[tuple[str, Message], ...],
    outputs: tuple[str, ...],
    orders: tuple[control.ToNode, ...] = (),
) -> None:
    scratch = _Scratch(brick, tuple({port: None for port, _ in mail}), outputs)
    for port, message in mail:
        scratch.send(port, message)
        scratch.io.turn()
    for order in orders:
        scratch.order(order)
        scratch.io.turn()
    scratch.close()


_FAILOVER: Final[Mapping[str, Callable[[], None]]] = {  # by the part that a brick is
    "protocol": _take_over,
    "proceed": _compute,
    "after": _promote,
    "server": _serve,
    "proxy": _follow,
}
