"""The bare ring: the limit below which no mechanism over processes and sockets can come.

As many hops as a request takes through the mechanism, over the same kind of sockets, pinned alike, in
the same language: a plain read and a plain write per hop, no bricks, no decoding, no journal.
"""

import os
import socket
import time
from typing import Final

from aftbed.core.messages import PACKET_BYTES_MAX
from aftbed.runtime.unix import linux

WARM_UP: Final = 200
READ_BYTES_MAX: Final = 4096
assert READ_BYTES_MAX <= PACKET_BYTES_MAX


def ring_us(hops: int, packet_bytes: int, count: int, cpu: int | None) -> list[float]:
    """The times of `count` rounds (us) of a packet through `hops` channels, after a warm-up."""
    before = os.sched_getaffinity(0)
    if cpu is not None:
        os.sched_setaffinity(0, {cpu})
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(hops)]
    parent = os.getpid()
    children = [_node(parent, pairs, i) for i in range(hops - 1)]
    try:
        return _rounds(pairs[0][0].fileno(), pairs[-1][1].fileno(), packet_bytes, count)
    finally:
        for write, read in pairs:
            write.close()
            read.close()
        for child in children:
            os.waitpid(child, 0)
        os.sched_setaffinity(0, before)


def _node(parent: int, pairs: list[tuple[socket.socket, socket.socket]], index: int) -> int:
    """A process that passes on what it reads, until there is nothing more."""
    child = os.fork()
    if child:
        return child
    try:
        linux.die_with(parent)
        source, sink = pairs[index][1].fileno(), pairs[index + 1][0].fileno()
        for write, read in pairs:
            for end in (write, read):
                if end.fileno() not in (source, sink):
                    end.close()
        while True:
            packet = os.read(source, READ_BYTES_MAX)
            if not packet:
                break
            os.write(sink, packet)
    finally:
        os._exit(0)


def _rounds(write: int, read: int, packet_bytes: int, count: int) -> list[float]:
    packet, times = bytes(packet_bytes), []
    for _ in range(WARM_UP + count):
        began_ns = time.perf_counter_ns()
        os.write(write, packet)
        os.read(read, READ_BYTES_MAX)
        times.append((time.perf_counter_ns() - began_ns) / 1e3)
    return times[WARM_UP:]
