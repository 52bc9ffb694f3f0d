"""Packets over the limit: whole at the other end, in their order, as many at a time as a channel bears."""

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import PeerError
from aftbed.core.messages import PACKET_BYTES_MAX
from aftbed.runtime.unix import transport
from aftbed.runtime.unix.transport import ANNOUNCED, NUDGE, READ_BYTES_MAX, put, take

Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        yield ours, theirs


def read(sink: socket.socket) -> bytes:
    """As a node does: a plain read, and what an announcement asks for."""
    data = os.read(sink.fileno(), READ_BYTES_MAX)
    while data == ANNOUNCED:
        data = take(sink.fileno())
    return data


@given(st.lists(st.sampled_from((2, 1000, PACKET_BYTES_MAX, PACKET_BYTES_MAX + 1, 300_000)), max_size=8))
def test_packets_of_all_sizes_keep_their_order(sizes: list[int]) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        for number, size in enumerate(sizes):
            sent = bytes([number]) * size
            put(ours.fileno(), sent)
            assert read(theirs) == sent


def test_a_large_packet_weighs_in_the_channel(pair: Pair) -> None:
    """Else hundreds of them could wait, and who writes would never be held back."""
    source, sink = pair
    source.setblocking(False)
    put_whole = 0
    with pytest.raises(BlockingIOError):
        for _ in range(100):
            put(source.fileno(), b"x" * 100_000)
            put_whole += 1
    assert 1 <= put_whole < 8
    for _ in range(put_whole):
        assert read(sink) == b"x" * 100_000
    put(source.fileno(), b"y" * 100_000)  # what did not fit is sent again, as a whole
    assert read(sink) == b"y" * 100_000


def test_what_comes_between_is_given_as_it_is(pair: Pair) -> None:
    source, sink = pair
    for packet in (NUDGE, b"small"):
        source.send(packet)
        assert take(sink.fileno()) == packet
    source.close()
    assert take(sink.fileno()) == b""


def descriptors_of(fd: int) -> int:
    """How many this process has of the same file or socket; others come and go meanwhile."""
    found = os.fstat(fd)
    count = 0
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # the one that the loop itself had
            count += os.path.samestat(entry.stat(), found)
    return count


def test_a_descriptor_that_is_no_file_is_refused_and_closed(pair: Pair) -> None:
    source, sink = pair
    socket.send_fds(source, [ANNOUNCED], [source.fileno()])
    with pytest.raises(PeerError, match="not a memfd"):
        take(sink.fileno())
    assert descriptors_of(source.fileno()) == 1
    with open(os.memfd_create("large"), "wb") as file:
        file.truncate(transport.STATE_BYTES_MAX + 1)
        socket.send_fds(source, [ANNOUNCED], [file.fileno()])
        with pytest.raises(PeerError, match="at most 67108864 are allowed"):
            take(sink.fileno())
        assert descriptors_of(file.fileno()) == 1


@pytest.mark.parametrize("size", [0, 1, PACKET_BYTES_MAX, PACKET_BYTES_MAX + 1, 300_000])
def test_a_state_is_in_the_answer_or_in_the_file_that_came_with_the_order(size: int) -> None:
    state, file = os.urandom(size), transport.MemfdState()
    answered = transport.put_state(os.dup(file.fileno()), state)
    assert file.used() == (size > PACKET_BYTES_MAX)
    found = transport.read_file(os.dup(file.fileno())) if file.used() else answered
    assert found == state and not (answered and file.used())
    assert descriptors_of(file.fileno()) == 1
    file.close()
