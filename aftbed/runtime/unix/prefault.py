"""Warm-up of a zygote, so that the first request of a node is as fast as the others.

*The rehearsal* sends requests through a whole chain in memory. It warms up the interpreter (specialised code,
filled caches), which all children of the zygote inherit.

*Pre-faulting.* A child of a fork shares each page with its parent until it writes there; then the kernel
stops it and copies the page. In its first request a new node would take some hundred page faults: half a
millisecond in each process of a new leader. `written_by` finds out, in a child that is thrown away, which
pages some work writes to (pagemap in proc(5), bit 56: mapped by this process alone); `linux.populate` has
the kernel copy the same pages in another child of the same parent, in one call.

That is speed and nothing else: where the kernel does not show the pages, or does not take the advice, they
are copied one by one at the first write.
"""

import gc
import os
import socket
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
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
from aftbed.ftm.registry import Setting, make
from aftbed.ftm.server import Server
from aftbed.runtime import control
from aftbed.runtime.node import MemoryIO, Node, nowhere
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.linux import Area
from aftbed.runtime.unix.node_io import UnixIO
from aftbed.runtime.unix.transport import NUDGE, Line, decode_order, decode_report
from aftbed.vehicle.aeb.function import default_application, sample_requests

ROUNDS_WARM: Final = 16  # until the interpreter has specialised all code on the path
ROUNDS_ONCE: Final = 4
MAIL_BATCH: Final = 8

PAGE: Final = os.sysconf("SC_PAGE_SIZE")
ENTRY: Final = struct.Struct("=Q")  # of pagemap
PRESENT: Final = 1 << 63
OF_A_FILE: Final = 1 << 61
EXCLUSIVE: Final = 1 << 56
CHUNK_BYTES: Final = 1 << 15

Ends = dict[tuple[str, str], tuple[str, str]]  # brick and port that send -> brick and port that receive


def warm_up() -> tuple[Area, ...]:
    """Rehearse; then see `areas_of_a_child`."""
    rehearse()
    return areas_of_a_child()


def rehearse() -> None:
    """Until the interpreter has specialised the code on the path, here and for all forks."""
    rehearse_chain(ROUNDS_WARM)
    for _ in range(ROUNDS_WARM):
        rehearse_host()


def areas_of_a_child() -> tuple[Area, ...]:
    """Where a child of this process, which has rehearsed, will write to.

    What is in memory by then stays there, and no garbage collection visits it: that would write to it.
    """
    gc.collect()
    linux.trim()
    gc.freeze()

    def once() -> None:
        rehearse_chain(ROUNDS_ONCE)
        rehearse_host()

    return written_by(once)


# -- pages ----------------------------------------------------------------------------------------


def written_by(work: Callable[[], None]) -> tuple[Area, ...]:
    """The memory of this process that `work`, done in a child, writes to; empty if that cannot be known."""
    private = tuple(_private_areas())
    reader, writer = os.pipe()
    parent, child = os.getpid(), os.fork()
    if child == 0:
        try:
            linux.die_with(parent)
            work()
            _dump_pagemap(private, writer)  # raw: to evaluate it here would write to more pages
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        pagemap = pipe.read()
    os.waitpid(child, 0)
    if len(pagemap) != sum(size for _, size in private) // PAGE * ENTRY.size:
        return ()
    return tuple(_exclusive_areas(private, pagemap))


def _private_areas() -> Iterator[Area]:
    """The writable memory of this process alone."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        span, permissions, *_ = line.split()
        if permissions.startswith("rw-p"):
            low, high = (int(end, 16) for end in span.split("-"))
            yield low, high - low


def _dump_pagemap(areas: tuple[Area, ...], writer: int) -> None:
    pagemap = os.open("/proc/self/pagemap", os.O_RDONLY)
    for address, size in areas:
        at, end = address // PAGE * ENTRY.size, (address + size) // PAGE * ENTRY.size
        while at < end:
            at += os.write(writer, os.pread(pagemap, min(CHUNK_BYTES, end - at), at))


def _exclusive_areas(areas: tuple[Area, ...], pagemap: bytes) -> Iterator[Area]:
    """The pages that the child had for itself; adjacent ones of an area are joined."""
    entries = ENTRY.iter_unpack(pagemap)
    for address, size in areas:
        first = last = 0
        for page, (entry,) in zip(range(address, address + size, PAGE), entries, strict=False):
            if entry & (PRESENT | OF_A_FILE | EXCLUSIVE) != PRESENT | EXCLUSIVE:
                continue
            if page != last:
                if last:
                    yield first, last - first
                first = page
            last = page + PAGE
        if last:
            yield first, last - first


# -- the rehearsal --------------------------------------------------------------------------------


def rehearse_chain(rounds: int) -> None:
    """Send `rounds` requests through both replicas; then the backup takes over and serves as many."""
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
        for payload in requests[:rounds]:
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
    return {name: graph.brick(name).kind for name in names}, links, sample_requests(0, ROUNDS_WARM)


class _Scratch:
    """A host of one brick, with the other ends of its channels and of its control line."""

    def __init__(self, brick: Brick, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> None:
        self._ends: list[socket.socket] = []
        self._outputs = outputs
        ours, theirs = self.pair()
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


def rehearse_host() -> None:
    """A host at work: mail, orders between it, and what each brick does in a failover."""
    _rehearse_mail()
    _rehearse_promotion()
    _rehearse_follow()
    request, (payload,) = Request(2, 1, b""), sample_requests(0, 1)
    _rehearse_steps(
        Protocol(2, 1, leads=False),
        (("aft2pro", TakeOver(2)), ("pxy2pro", request), ("aft2pro", Reply(2, 1, 2, b""))),
        ("pro2bfr", "pro2pxy"),
    )
    _rehearse_steps(
        Compute(), (("bfr2prd", request), ("srv2prd", Reply(2, 1, 2, b""))), ("prd2srv", "prd2aft")
    )
    _rehearse_steps(
        Server(default_application(), 2),
        (("prd2srv", Request(2, 1, payload)), ("aft2srv", CaptureState(2, 1))),
        ("srv2prd", "srv2aft"),
    )


def _rehearse_mail() -> None:
    scratch = _Scratch(PassBefore(), ("pro2bfr",), ("bfr2prd",))
    request_id = 0
    for _ in range(ROUNDS_ONCE):
        for _ in range(MAIL_BATCH):
            request_id += 1
            scratch.send("pro2bfr", Request(1, request_id, b""))
        scratch.order(control.ResumeNode(request_id))
        scratch.io.turn()  # the order, then the first request
        scratch.io.serve_fast()  # until it meets the nudge
        assert scratch.io.journal.at == HEADER_BYTES + request_id * RECORD.size, "a rehearsal went wrong"
        scratch.line.recv()
    scratch.close()


def _rehearse_promotion() -> None:
    scratch = _Scratch(PbrAfter(1, leads=False), ("aft2aft", "srv2aft"), ("aft2srv", "aft2pro", "aft2aft"))
    scratch.order(control.Deliver(control.UNANSWERED, "brick", Promotion(2)))
    scratch.into["aft2aft"].shutdown(socket.SHUT_WR)
    scratch.io.turn()  # the nudge and the order with it
    scratch.io.turn()  # the end of the channel
    scratch.close()


def _rehearse_follow() -> None:
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


def _rehearse_steps(brick: Brick, mail: tuple[tuple[str, Message], ...], outputs: tuple[str, ...]) -> None:
    scratch = _Scratch(brick, tuple({port: None for port, _ in mail}), outputs)
    for port, message in mail:
        scratch.send(port, message)
        scratch.io.turn()
    scratch.close()
