"""Channels on real sockets: what a fence lets through, and what it does not."""

import errno
import os
import socket
from collections.abc import Iterator
from typing import Final

import pytest

from aftbed.core.graph import Link
from aftbed.runtime.deployment import Channels
from aftbed.runtime.unix.transport import NUDGE, UnixChannel

LINK: Final = Link("a/after", "aft2aft", "b/after", "aft2aft")


@pytest.fixture
def channel() -> Iterator[UnixChannel]:
    found = UnixChannel(LINK)
    yield found
    found.close()


def at_once(channel: UnixChannel) -> UnixChannel:
    """Neither end waits."""
    channel.write.setblocking(False)
    channel.read.setblocking(False)
    return channel


def filled(channel: UnixChannel) -> int:
    """Fill the queue; how many packets it took."""
    count = 0
    while True:
        try:
            channel.write.send(b"mail", socket.MSG_DONTWAIT)
        except BlockingIOError:
            return count
        count += 1


def test_packets_stay_whole_and_in_order(channel: UnixChannel) -> None:
    for packet in (b"one", b"the second", b"3"):
        channel.write.send(packet)
    assert [channel.read.recv(100) for _ in range(3)] == [b"one", b"the second", b"3"]


def test_what_was_sent_before_a_fence_stays_readable_and_then_ends(channel: UnixChannel) -> None:
    channel.write.send(b"one")
    channel.write.send(b"two")
    channel.fence()
    assert [channel.read.recv(100) for _ in range(4)] == [b"one", b"two", b"", b""]


def test_mail_waits_until_the_sink_takes_it(channel: UnixChannel) -> None:
    assert not channel.mail_waits()
    channel.write.send(b"one")
    channel.write.send(b"two")
    assert channel.mail_waits()
    channel.read.recv(100)
    assert channel.mail_waits()
    channel.read.recv(100)
    assert not channel.mail_waits()


def test_who_writes_after_a_fence_gets_epipe_through_whichever_descriptor(channel: UnixChannel) -> None:
    of_a_node = os.dup(channel.write.fileno())  # what a node was handed refers to the same socket
    channel.fence()
    for descriptor in (of_a_node, channel.write.fileno()):
        with pytest.raises(BrokenPipeError):
            os.write(descriptor, b"late")
    os.close(of_a_node)
    assert channel.read.recv(100) == b"", "nothing of it arrived"


def test_a_fence_holds_for_a_writer_in_another_process(channel: UnixChannel) -> None:
    """The child has its own descriptor; it tells what became of its write after the fence."""
    told, tell = os.pipe()
    go, start = os.pipe()
    child = os.fork()
    if child == 0:
        os.read(go, 1)
        try:
            os.write(channel.write.fileno(), b"late")
        except OSError as error:
            os.write(tell, str(error.errno).encode())
        os._exit(0)
    channel.fence()
    os.write(start, b"!")
    os.waitpid(child, 0)
    assert os.read(told, 9) == str(errno.EPIPE).encode()
    for descriptor in (told, tell, go, start):
        os.close(descriptor)


def test_a_fence_may_come_twice_and_after_the_end(channel: UnixChannel) -> None:
    channel.fence()
    channel.fence()
    channel.close()
    channel.fence()
    channel.refuse()
    channel.nudge()


def test_mail_outlives_its_writer_and_its_reader(channel: UnixChannel) -> None:
    """Whatever ends a node had are closed; the runtime's keep the queue."""
    of_writer, of_reader = os.dup(channel.write.fileno()), os.dup(channel.read.fileno())
    os.write(of_writer, b"mail")
    os.close(of_writer)
    os.close(of_reader)
    assert channel.read.recv(100) == b"mail"


def test_a_writer_that_no_process_will_read_gets_epipe(channel: UnixChannel) -> None:
    at_once(channel)
    assert filled(channel) > 0
    channel.refuse()
    with pytest.raises(BrokenPipeError):
        channel.write.send(b"more")


def test_a_nudge_wakes_the_reader_and_is_no_message(channel: UnixChannel) -> None:
    channel.nudge()
    assert channel.read.recv(100) == NUDGE
    assert len(NUDGE) == 1, "a message has at least two bytes"


@pytest.mark.timeout(5)
def test_a_nudge_into_a_full_queue_does_not_wait(channel: UnixChannel) -> None:
    channel.write.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, bytes(16))  # a send waits for ever
    count = filled(channel)
    channel.nudge()
    at_once(channel)
    for _ in range(count):
        assert channel.read.recv(100) == b"mail"
    with pytest.raises(BlockingIOError):
        channel.read.recv(100)


def test_a_nudge_behind_a_fence_is_not_missed(channel: UnixChannel) -> None:
    channel.fence()
    channel.nudge()
    assert channel.read.recv(100) == b"", "the end wakes the reader as well"


# -- all of them


@pytest.fixture
def channels() -> Iterator[Channels]:
    found = Channels(UnixChannel)
    for link in (
        LINK,
        Link("a/after", "aft2pro", "a/protocol", "aft2pro"),
        Link("proxy", "pxy2pro", "a/protocol", "pxy2pro"),
    ):
        found.renew(link)
    yield found
    for channel in found.touching(frozenset({"a/after", "a/protocol"})):
        found.drop(channel)
    assert len(found) == 0


def test_channels_are_found_by_their_ends(channels: Channels) -> None:
    assert len(channels) == 3
    found = channels.get("a/after", "aft2pro", "a/protocol")
    assert found is not None and found.link.name == "aft2pro"
    assert channels.get("a/after", "aft2pro", "b/protocol") is None
    assert {c.link.name for c in channels.touching(frozenset({"a/after"}))} == {"aft2aft", "aft2pro"}
    assert {c.link.name for c in channels.into("a/protocol")} == {"aft2pro", "pxy2pro"}
    assert channels.touching(frozenset({"client"})) == channels.into("a/after") == []


def test_a_renewed_channel_is_another_one_and_the_old_is_let_go(channels: Channels) -> None:
    old = channels.get("a/after", "aft2aft", "b/after")
    assert old is not None
    of_reader = socket.socket(fileno=os.dup(old.read.fileno()))
    old.write.send(b"of the old one")
    new = channels.renew(LINK)
    assert channels.get("a/after", "aft2aft", "b/after") is new and len(channels) == 3
    assert old.write.fileno() == old.read.fileno() == -1
    assert of_reader.recv(100) == b"of the old one" and of_reader.recv(100) == b""
    of_reader.close()
    at_once(new)
    with pytest.raises(BlockingIOError):
        new.read.recv(100)


def test_a_dropped_channel_is_gone(channels: Channels) -> None:
    channel = channels.get("a/after", "aft2aft", "b/after")
    assert channel is not None
    channels.drop(channel)
    assert channels.get("a/after", "aft2aft", "b/after") is None
    assert channel.write.fileno() == -1
