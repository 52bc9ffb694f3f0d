"""The control line over a real socket pair: messages, descriptors, large states, and garbage."""

import functools
import os
import random
import socket
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any, Final, Literal, Self, get_args, get_origin

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core import script
from aftbed.core.errors import PeerError
from aftbed.core.messages import PACKET_BYTES_MAX
from aftbed.inject.bus import BusFault, read_bus_fault
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault, parse
from aftbed.inject.radar import RadarFault
from aftbed.runtime import control
from aftbed.runtime.unix.transport import FDS_MAX, STATE_BYTES_MAX, Line, decode_order, decode_report
from aftbed.vehicle.condition import Condition

ORDERS: Final[tuple[type[msgspec.Struct], ...]] = get_args(control.ToNode)
REPORTS: Final[tuple[type[msgspec.Struct], ...]] = get_args(control.FromNode)

PLAIN: Final = {
    int: st.integers(0, 2**63 - 1),
    str: st.text(max_size=20),
    float: st.floats(allow_nan=False),
    bytes: st.binary(max_size=99),
    bool: st.booleans(),
    type(None): st.none(),
}


FLAT_VERBS: Final = tuple(kind for kind in get_args(script.Step) if kind is not script.Together)


@functools.cache  # to build one takes longer than to draw from it
def any_of(kind: Any) -> st.SearchStrategy[Any]:
    """Any value of a type that a control message is made of."""
    if kind in PLAIN:
        return PLAIN[kind]
    if kind is script.Together:  # verbs may hold verbs; one level is enough
        return st.lists(st.one_of(map(any_of, FLAT_VERBS)), max_size=3).map(
            lambda verbs: script.Together(tuple(verbs))
        )
    if kind is BusFault:  # its parts do not go with each other at will
        return st.sampled_from(BUS_FAULTS)
    if kind is RadarFault:
        return st.sampled_from(RADAR_FAULTS)
    if kind is Fault:
        return st.builds(Fault, st.sampled_from((Crash(), Hang())), st.text(max_size=9), any_of(Trigger))
    if kind is Trigger:  # after a time, or on a condition
        event, nth = PLAIN[str], PLAIN[int]
        return st.builds(Trigger, event, nth, PLAIN[float]) | st.builds(
            Trigger, event, nth, when=any_of(Condition)
        )
    if get_origin(kind) is Literal:
        return st.sampled_from(get_args(kind))
    if isinstance(kind, type) and issubclass(kind, Enum):
        return st.sampled_from(kind)
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return st.builds(kind, *(any_of(field.type) for field in msgspec.structs.fields(kind)))
    parts = [any_of(part) for part in get_args(kind) if part is not ...]
    if get_origin(kind) is tuple and ... in get_args(kind):
        return st.lists(parts[0], max_size=3).map(tuple)
    if get_origin(kind) is tuple:
        return st.tuples(*parts)
    if get_origin(kind) is dict:
        return st.dictionaries(*parts, max_size=3)
    return st.one_of(parts)


BUS_FAULTS: Final = tuple(
    map(
        read_bus_fault,
        (
            "omission bus A nth 5",
            "corrupt bus from radar signal B=-1.5 crc good when ttc < 1.2 for 3ms",
            "partition a,b|c after 2s",
            "reorder bus A intermittent p 0.25",
        ),
    )
)


RADAR_FAULTS: Final = tuple(
    fault.action
    for fault in map(
        parse,
        (
            "radar ghost range 30 speed -2.5 when ttc < 1.2 for 3ms",
            "radar fov range 40 angle 20 after 2s",
            "radar latency by 100ms intermittent p 0.25",
        ),
    )
    if isinstance(fault.action, RadarFault)
)


class Pair:
    """Both ends of a control line; `ours` reads reports, `theirs` orders; neither blocks."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (ours, theirs):
            end.setblocking(False)
        self.ours = Line(ours, decode_report)
        self.theirs = Line(theirs, decode_order)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.ours.close()
        self.theirs.close()


@pytest.fixture
def pair() -> Iterator[Pair]:
    with Pair() as found:
        yield found


def open_descriptors() -> set[str]:
    return set(os.listdir("/proc/self/fd"))  # noqa: PTH208 - names are enough


@pytest.fixture(autouse=True)
def _no_descriptor_is_left_behind(request: pytest.FixtureRequest) -> Iterator[None]:
    before = open_descriptors()
    if "pair" in request.fixturenames:
        request.getfixturevalue("pair")
        before = open_descriptors()
    yield
    assert open_descriptors() <= before


@pytest.mark.parametrize("kind", ORDERS)
@given(st.data())
def test_every_order_arrives(kind: type[msgspec.Struct], data: st.DataObject) -> None:
    with Pair() as pair:
        order = data.draw(any_of(kind))
        pair.ours.send(order)
        assert pair.theirs.recv() == (order, [])


@pytest.mark.parametrize("kind", REPORTS)
@given(st.data())
def test_every_report_arrives(kind: type[msgspec.Struct], data: st.DataObject) -> None:
    with Pair() as pair:
        report = data.draw(any_of(kind))
        pair.theirs.send(report)
        assert pair.ours.recv() == (report, [])


def test_messages_keep_their_order(pair: Pair) -> None:
    for token in range(20):
        pair.ours.send(control.SuspendNode(token))
    assert [got[0].token for _ in range(20) if (got := pair.theirs.recv())] == list(range(20))


def test_where_there_is_none_it_says_so(pair: Pair) -> None:
    with pytest.raises(BlockingIOError):
        pair.theirs.recv()


def test_the_end_is_none(pair: Pair) -> None:
    pair.ours.send(control.SuspendNode(1))
    pair.ours.close()
    assert pair.theirs.recv() == (control.SuspendNode(1), []), "what was sent stays readable"
    assert pair.theirs.recv() is None


def test_who_sends_to_a_closed_line_is_told(pair: Pair) -> None:
    pair.theirs.close()
    with pytest.raises(BrokenPipeError):
        pair.ours.send(control.SuspendNode(1))


# -- descriptors


def test_descriptors_travel_in_their_order_and_do_not_leak_into_programs(pair: Pair, tmp_path: Path) -> None:
    fds = []
    for name in ("one", "two"):
        (tmp_path / name).write_text(name)
        fds.append(os.open(tmp_path / name, os.O_RDONLY))
    pair.ours.send(control.BindInput(1, "proxy", "pro2pxy"), tuple(fds))
    for fd in fds:
        os.close(fd)
    got = pair.theirs.recv()
    assert got is not None and len(got[1]) == 2
    assert [os.read(fd, 9) for fd in got[1]] == [b"one", b"two"]
    assert not any(os.get_inheritable(fd) for fd in got[1])
    for fd in got[1]:
        os.close(fd)


def test_as_many_descriptors_as_allowed_travel(pair: Pair) -> None:
    pair.ours.send(control.Park(1), (0,) * FDS_MAX)
    got = pair.theirs.recv()
    assert got is not None and len(got[1]) == FDS_MAX
    for fd in got[1]:
        os.close(fd)
    with pytest.raises(AssertionError, match=f"{FDS_MAX + 1} descriptors"):
        pair.ours.send(control.Park(1), (0,) * (FDS_MAX + 1))


def test_more_descriptors_than_allowed_are_refused_and_closed(pair: Pair) -> None:
    socket.send_fds(pair.ours.sock, [msgspec.msgpack.encode(control.Park(1))], [0] * (FDS_MAX + 9))
    with pytest.raises(PeerError, match="truncated control message"):
        pair.theirs.recv()


# -- sizes


def state_of(size: int) -> control.Restore:
    return control.Restore(1, "a/server", random.Random(size).randbytes(size))


def around() -> int:
    return (
        len(msgspec.msgpack.encode(control.Restore(1, "a/server", bytes(PACKET_BYTES_MAX))))
        - PACKET_BYTES_MAX
    )


@pytest.mark.parametrize("more", [-1, 0, 1, PACKET_BYTES_MAX, 3 << 20])
def test_a_state_of_any_size_travels(pair: Pair, more: int) -> None:
    order = state_of(PACKET_BYTES_MAX - around() + more)
    pair.ours.send(order)
    assert pair.theirs.recv() == (order, [])


def test_a_state_that_travels_as_a_file_has_no_descriptors_with_it(pair: Pair) -> None:
    with pytest.raises(AssertionError):
        pair.ours.send(state_of(PACKET_BYTES_MAX), (0,))


def test_a_packet_over_the_limit_is_refused(pair: Pair) -> None:
    pair.ours.sock.send(msgspec.msgpack.encode(state_of(PACKET_BYTES_MAX)))
    with pytest.raises(PeerError, match="truncated control message"):
        pair.theirs.recv()


def test_a_file_over_the_limit_is_refused_unread(pair: Pair) -> None:
    fd = os.memfd_create("test")
    os.ftruncate(fd, STATE_BYTES_MAX + 1)
    socket.send_fds(pair.ours.sock, [b"\xc1"], [fd])
    os.close(fd)
    with pytest.raises(PeerError, match=f"at most {STATE_BYTES_MAX} are allowed"):
        pair.theirs.recv()


# -- garbage

SUSPEND_AND_MORE: Final = b"\x83\xa4type\xa7Suspend\xa5token\x01\xa1x"


@pytest.mark.parametrize(
    "packet",
    [
        b"\xc1",  # a file is announced, and none comes
        b"\x00",
        b"\xff" * 100,
        msgspec.msgpack.encode({"type": "Reboot", "token": 1}),
        msgspec.msgpack.encode({"type": "Suspend"}),
        msgspec.msgpack.encode({"type": "Suspend", "token": "one"}),
        msgspec.msgpack.encode(control.Hello(1)),  # a report is no order
        msgspec.msgpack.encode(control.SuspendNode(1)) + b"\x00",
        msgspec.msgpack.encode(
            {"type": "Arm", "token": 1, "fault": 1, "event": "", "nth": 1, "act": "x", "itself": True}
        ),
        msgspec.msgpack.encode(control.Capture(1, "node")).replace(b"node", b"\xff\xff\xff\xff"),
        pytest.param(SUSPEND_AND_MORE + b"\x91" * 50_000 + b"\x01", id="nested too deep"),
    ],
)
@pytest.mark.parametrize("fds", [0, 2])
def test_what_is_no_order_is_refused_and_its_descriptors_are_closed(
    pair: Pair, packet: bytes, fds: int
) -> None:
    socket.send_fds(pair.ours.sock, [packet], [0] * fds)
    with pytest.raises(PeerError, match="not a control message"):
        pair.theirs.recv()
    pair.ours.send(control.SuspendNode(1))
    assert pair.theirs.recv() == (control.SuspendNode(1), []), "the line goes on"


def test_a_file_with_garbage_is_refused(pair: Pair) -> None:
    fd = os.memfd_create("test")
    os.write(fd, b"\xff" * 100)
    socket.send_fds(pair.ours.sock, [b"\xc1"], [fd])
    os.close(fd)
    with pytest.raises(PeerError, match="not a control message"):
        pair.theirs.recv()


def test_a_socket_is_no_file(pair: Pair) -> None:
    socket.send_fds(pair.ours.sock, [b"\xc1"], [pair.ours.fileno()])
    with pytest.raises(PeerError, match="not a control message"):
        pair.theirs.recv()


def test_an_empty_packet_is_the_end_and_its_descriptors_are_closed(pair: Pair) -> None:
    socket.send_fds(pair.ours.sock, [b""], [0])
    assert pair.theirs.recv() is None


@given(st.lists(st.binary(min_size=1, max_size=80), min_size=1, max_size=5), st.integers(0, 3))
def test_random_packets_are_orders_or_refused_and_leave_no_descriptor(packets: list[bytes], fds: int) -> None:
    with Pair() as pair:
        before = open_descriptors()
        for packet in packets:
            socket.send_fds(pair.ours.sock, [packet], [pair.ours.fileno()] * fds)
            try:
                got = pair.theirs.recv()
            except PeerError:
                continue
            assert got is not None and isinstance(got[0], ORDERS)
            for fd in got[1]:
                os.close(fd)
        assert open_descriptors() <= before


@given(any_of(control.ToNode), st.data())
def test_a_flipped_bit_gives_an_order_or_a_peer_error(order: msgspec.Struct, data: st.DataObject) -> None:
    packet = bytearray(msgspec.msgpack.encode(order))
    bit = data.draw(st.integers(0, 8 * len(packet) - 1))
    packet[bit // 8] ^= 1 << bit % 8
    with Pair() as pair:
        pair.ours.sock.send(packet)
        try:
            got = pair.theirs.recv()
        except PeerError:
            return
        assert got is not None and isinstance(got[0], ORDERS)


@given(st.data())
def test_an_order_cut_short_is_refused_and_its_descriptors_are_closed(data: st.DataObject) -> None:
    packet = msgspec.msgpack.encode(data.draw(any_of(control.ToNode)))
    with Pair() as pair:
        socket.send_fds(pair.ours.sock, [packet[: data.draw(st.integers(1, len(packet) - 1))]], [0])
        with pytest.raises(PeerError, match="not a control message"):
            pair.theirs.recv()
