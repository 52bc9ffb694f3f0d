"""Faults in a real node: of a channel that is full when the fault comes or goes; of a share of a CPU.

Orders lie in the control line before the node reads it. One of them has the brick hand out its state, and the
brick of the test then empties its channel: so what happens while there is no room happens in a known order.
"""

import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from aftbed.core import messages
from aftbed.core.brick import Brick, Effect, Send
from aftbed.core.events import Event
from aftbed.core.journal import FLAG_OFFSET, records
from aftbed.core.messages import AnyMessage, Request
from aftbed.inject import model
from aftbed.inject.channel import ChannelFault, Disturbance
from aftbed.inject.grammar import Permanent
from aftbed.inject.receipts import fault_and_bits
from aftbed.runtime import control
from aftbed.runtime.node import Node
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.node_io import UnixIO
from aftbed.runtime.unix.transport import Line, decode_order, decode_report

FILLER: Final = Request(1, 0, bytes(2000))
BRICK, PORT = "a/after", "aft2aft"
FAULT: Final = 7
WORK_NS: Final = 3_000_000  # of CPU time, in a step


class Passing(Brick):
    """Sends on what it gets. Its state is what has come out of the channel, which it reads empty for that."""

    def __init__(self, reader: socket.socket) -> None:
        self.reader, self.got, self.works_ns = reader, list[int](), 0

    def open_ports(self) -> tuple[str, ...]:
        return ("in",)

    def quiescent(self) -> bool:
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        until_ns = time.thread_time_ns() + self.works_ns
        while time.thread_time_ns() < until_ns:
            pass
        return [Send(PORT, msg)] if isinstance(msg, Request) else []

    def capture(self) -> bytes:
        while True:
            try:
                message = messages.decode(self.reader.recv(messages.PACKET_BYTES_MAX))
            except BlockingIOError:
                return bytes(self.got)
            assert isinstance(message, Request)
            self.got += [message.request_id] if message.request_id else []

    def restore(self, state: bytes) -> None:
        raise AssertionError("it has none")


class Host:
    """A node with such a brick; `order` lays an order into its control line, `out` is what has come out."""

    def __init__(self, path: Path) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.line, self.path = Line(ours, decode_report), path
        ours.setblocking(False)
        writer, self.reader = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (writer, self.reader):
            end.setblocking(False)
        self.brick = Passing(self.reader)
        self.io = UnixIO(Line(theirs, decode_order), JournalFile(path, "a"))
        self.node = Node("a", self.io)
        self.node.add(BRICK, self.brick)
        self.writer = writer.detach()
        self.node.bind_output(BRICK, PORT, self.writer, 1)

    def fill(self) -> None:
        data = messages.encode(FILLER)
        try:
            while True:
                os.write(self.writer, data)
        except BlockingIOError:
            return

    def order(self, order: control.ToNode) -> None:
        self.line.send(order)
        self.io.journal.mapping[FLAG_OFFSET] = 1

    def drain(self) -> None:
        """Once the node looks at its orders, there is room."""
        self.order(control.Capture(control.UNANSWERED, BRICK))

    def disturb(self, how: Disturbance, nth: int = 1, *, permanent: bool = False) -> control.Arm:
        blow = model.ArmedFault(FAULT, BRICK, nth, ChannelFault(how, PORT), False)
        if permanent:
            blow = model.ArmedFault(
                FAULT, BRICK, nth, ChannelFault(how, PORT), False, persistence=Permanent()
            )
        return control.Arm(control.UNANSWERED, "", (blow,))

    def send(self, request_id: int) -> None:
        self.node.step(self.node.bricks[BRICK], "in", Request(1, request_id, b""))

    def out(self) -> list[int]:
        return list(self.brick.capture())

    def direct(self) -> bool:
        """Whether the port leads to its channel, with nothing in between."""
        return (BRICK, PORT) not in self.node.agent.filters

    def close(self) -> None:
        for end in (self.line, self.io.line, self.reader):
            end.close()
        os.close(self.writer)


@pytest.fixture
def host(tmp_path: Path) -> Iterator[Host]:
    made = Host(tmp_path / "a.journal")
    yield made
    made.close()


# -- full channels --------------------------------------------------------------------------------


@pytest.mark.parametrize("how", Disturbance)
def test_a_fault_that_is_armed_while_its_sender_waits_for_room_strikes_what_comes_later(
    host: Host, how: Disturbance
) -> None:
    host.fill()
    host.order(host.disturb(how))
    host.drain()
    host.send(1)
    assert host.out() == [1], "it was sent before the fault was there"
    host.send(2)
    host.send(3)
    expected = {
        Disturbance.OMISSION: [1, 3],
        Disturbance.DELAY: [1],  # the rest is held back
        Disturbance.DUPLICATE: [1, 2, 2, 3],
        Disturbance.REORDER: [1, 3, 2],
    }
    assert host.out() == expected[how]


def test_a_fault_that_is_lifted_while_what_it_let_through_waits_for_room_loses_none_of_it(host: Host) -> None:
    host.node.carry_out(host.disturb(Disturbance.DUPLICATE, permanent=True), [])
    host.fill()
    host.order(host.disturb(Disturbance.DUPLICATE, nth=0))
    host.drain()
    host.send(1)
    host.send(2)
    assert host.out() == [1, 1, 2] and host.direct()


def test_what_is_disturbed_waits_for_room_as_anything_does(host: Host) -> None:
    host.node.carry_out(host.disturb(Disturbance.OMISSION, nth=2), [])
    host.fill()
    host.drain()
    for request_id in (1, 2, 3):
        host.send(request_id)
    assert host.out() == [1, 3] and host.direct()


def test_where_the_port_is_bound_elsewhere_meanwhile_it_is_not_sent(host: Host) -> None:
    """As without a fault: the brick has heard of it, and asks again for what it wants."""
    host.node.carry_out(host.disturb(Disturbance.DUPLICATE), [])
    host.fill()
    other, reader = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    bind = control.BindOutput(control.UNANSWERED, BRICK, PORT, 2)
    host.line.send(bind, (other.fileno(),))
    other.close()
    host.send(1)
    reader.setblocking(False)
    with pytest.raises(BlockingIOError):
        reader.recv(1)
    host.send(2)
    assert messages.decode(reader.recv(messages.PACKET_BYTES_MAX)) == Request(1, 2, b"")
    reader.close()
    host.writer = host.node.bricks[BRICK].outputs[PORT]  # type: ignore[assignment]


# -- a share of a CPU -----------------------------------------------------------------------------


def slowed(host: Host, share: float, by_ns: int = 0) -> None:
    order = control.SlowDown(control.UNANSWERED, FAULT, by_ns, share)
    assert host.node.carry_out(order, []) == b""


def took_ns(host: Host, steps: int) -> tuple[int, int]:
    """So many steps: by the clock, and of a CPU."""
    began_ns, used_ns = time.monotonic_ns(), time.thread_time_ns()
    for request_id in range(1, steps + 1):
        host.send(request_id)
    return time.monotonic_ns() - began_ns, time.thread_time_ns() - used_ns


@pytest.mark.parametrize("share", [0.5, 0.25, 0.1])
def test_a_node_has_its_share_of_a_cpu_and_no_more(host: Host, share: float) -> None:
    """The other way round cannot be told on a machine that others use: there, it may get less."""
    host.brick.works_ns = WORK_NS
    slowed(host, share)
    clock_ns, used_ns = took_ns(host, 5)
    assert used_ns >= 5 * WORK_NS and used_ns / clock_ns < share * 1.1
    assert host.out() == [1, 2, 3, 4, 5]


def test_the_effects_come_after_the_wait(host: Host) -> None:
    host.brick.works_ns = WORK_NS
    slowed(host, 0.25)
    began_ns = time.monotonic_ns()
    host.send(1)
    assert time.monotonic_ns() - began_ns >= 0.9 * WORK_NS / 0.25 and host.out() == [1]


def test_when_it_is_over_nothing_is_left_of_it(host: Host) -> None:
    slowed(host, 0.25)
    host.send(1)
    slowed(host, control.WHOLE)
    assert not host.node.agent.active, "the node may use its fast loop again"


def test_it_is_written_down_when_it_is_felt_and_once(host: Host) -> None:
    slowed(host, 0.25)
    words = [r for r in records(host.path.read_bytes()) if r.event is Event.FAULT_APPLIED]
    assert words == [], "no step yet"
    for request_id in (1, 2):
        host.send(request_id)
    (word,) = [r for r in records(host.path.read_bytes()) if r.event is Event.FAULT_APPLIED]
    assert fault_and_bits(word.detail)[0] == FAULT
