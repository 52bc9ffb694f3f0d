"""The fast loop of a node that is a process does what the general one does: same mail, same effects, same
records.

Both loops read from real sockets. The brick answers, passes on, notes, and refuses; mail that is no message,
nudges, large packets and orders come in between. An order is laid into the control line by the step before
it, so that it comes at the same place in both.
"""

import contextlib
import os
import socket
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core import messages
from aftbed.core.brick import Brick, Effect, Note, Order, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.graph import Link
from aftbed.core.journal import ACTIVITY_OFFSET, FLAG_OFFSET, records
from aftbed.core.messages import AnyMessage, Rebound, Reply, Request
from aftbed.core.script import Script
from aftbed.inject import model
from aftbed.inject.channel import ChannelFault, Disturbance
from aftbed.inject.grammar import Bit
from aftbed.inject.value import ValueFlip, ValuePlace
from aftbed.runtime import control
from aftbed.runtime.node import Node
from aftbed.runtime.unix import node_io, transport
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.node_io import UnixIO, UnixNode
from aftbed.runtime.unix.transport import NUDGE, Line, UnixChannel, decode_order, decode_report

FLIP: Final = model.ArmedFault(7, "brick", 1, ValueFlip(ValuePlace.RESULT, Bit(0)), False)
OMISSION: Final = model.ArmedFault(8, "brick", 1, ChannelFault(Disturbance.OMISSION, "out"), False)
KINDS: Final = ("answer", "pass on", "hand in", "hand in twice", "note", "order", "refuse", "nothing")
ORDERS: Final[dict[str, tuple[control.ToNode, ...]]] = {
    "capture": (control.Capture(1, "brick"),),
    "suspend": (control.SuspendNode(2), control.ResumeNode(3)),
    "flip": (control.Arm(4, Event.SERVER_EXIT.label, (FLIP,)),),
    "omit": (control.Arm(5, "", (OMISSION,)),),
}
LAST: Final = messages.encode(Request(1, 0, b"last"))

Loop = Callable[[UnixIO], None]


class Done(BaseException):
    """The last message has been read."""


class Scripted(Brick):
    """Does what the payload of a request says. It has two inputs, of which one is open at a time, in turn."""

    def __init__(self, give: Callable[[str], None]) -> None:
        self._give, self.seen = give, list[str]()

    def open_ports(self) -> tuple[str, ...]:
        return ("in", "other")[len(self.seen) % 2 :][:1]

    def quiescent(self) -> bool:
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        if isinstance(msg, Rebound):
            return []
        what = msg.payload.rstrip(b"\0").decode() if isinstance(msg, Request) else "ended"
        if what == "refuse":
            raise PeerError("not now")
        if what == "last":
            raise Done
        self.seen.append(f"{port} {what}")
        if what in ORDERS:
            self._give(what)
        number = len(self.seen)
        match what:
            case "answer":
                return [Note(Event.SERVER_EXIT, number, 5), Send("out", Reply(1, number, 1, b"ab"))]
            case "pass on":
                assert isinstance(msg, Request)
                return [Send("out", msg), Note(Event.REPLY_STORED, number)]
            case "hand in":
                return [Send("inner", Request(1, number, b"given"))]
            case "hand in twice":
                given = Send("inner", Request(1, number, b"given"))
                return [given, Note(Event.REPLY_STORED, number), given]
            case "note":
                notes = [Note(Event.SERVER_ENTER, number), Note(Event.SERVER_EXIT, number)]
                return [*notes, Send("out", Reply(1, number, 1, b"c"))]
            case "answer at length":
                return [Send("out", Reply(1, number, 1, bytes(messages.PACKET_BYTES_MAX)))]
            case "order":
                return [Order(Script("nothing", "", (), ()))]
            case _:
                return []

    def capture(self) -> bytes:
        return repr(self.seen).encode()


class Inner(Brick):
    """Hosted beside it. Sends each request on as it is, but for every third, which it refuses, and itself a
    word, for which it closes its other port until that has come.
    """

    def __init__(self) -> None:
        self.seen, self._awaited = list[str](), False

    def open_ports(self) -> tuple[str, ...]:
        return ("again",) if self._awaited else ("mail", "again")

    def quiescent(self) -> bool:
        return not self._awaited

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        if isinstance(msg, Rebound):
            return []
        assert isinstance(msg, Request) and port in self.open_ports()
        self.seen.append(f"{port} {msg.request_id}")
        self._awaited = port == "mail" and len(self.seen) % 3 == 1
        if len(self.seen) % 3 == 0:
            raise PeerError("every third")
        again = [Send("again", Request(1, msg.request_id, b"again"))] if self._awaited else []
        return [Note(Event.BEFORE_EXIT, msg.request_id), Send("out", msg), *again]


class Harness:
    """A node with both bricks, all its ends, and what came out of it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.line = Line(ours, decode_report)
        self._journal = JournalFile(path, "node")
        self.io = UnixIO(Line(theirs, decode_order), self._journal)
        self.node: UnixNode = Node("node", self.io)
        self.brick = Scripted(self._order)
        self.node.add("brick", self.brick)
        self.inner = Inner()
        self.node.add("inner", self.inner)
        self.node.link_inside(control.Local("brick", "inner", "inner", "mail"), 1)
        self.node.link_inside(control.Local("inner", "again", "inner", "again"), 1)
        self._ends = [ours, theirs]
        self._writers = {port: self._input(port) for port in ("in", "other")}
        write, self._out = self._pair()
        for brick in ("brick", "inner"):
            self.node.bind_output(brick, "out", os.dup(write.fileno()), 1)
        self._out.setblocking(False)
        ours.setblocking(False)

    def _pair(self) -> tuple[socket.socket, socket.socket]:
        pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._ends += pair
        return pair

    def _input(self, port: str) -> socket.socket:
        write, read = self._pair()
        self.node.bind_input("brick", port, os.dup(read.fileno()))
        return write

    def _order(self, name: str) -> None:
        for order in ORDERS[name]:
            self.line.send(order)
        self._journal.mapping[FLAG_OFFSET] = 1

    def run(self, mail: list[bytes], loop: Loop) -> tuple[object, ...]:
        """What came of `mail`: what was sent, noted, reported, and what the brick saw."""
        for writer in self._writers.values():
            for packet in (*mail, LAST):
                transport.put(writer.fileno(), packet)
        with pytest.raises(Done):
            while True:
                loop(self.io)
        noted = [(r.event, r.request_id, r.detail, r.brick) for r in records(self._path.read_bytes())]
        return self._sent(), self.inner.seen, noted, self._reported(), self.brick.seen

    def _sent(self) -> list[bytes]:
        found = []
        while True:
            try:
                found.append(self._out.recv(messages.PACKET_BYTES_MAX))
            except BlockingIOError:
                return found

    def _reported(self) -> list[control.FromNode]:
        found = []
        while True:
            try:
                got = self.line.recv()
            except BlockingIOError:
                return found
            assert got is not None
            found.append(got[0])

    def close(self) -> None:
        for port in self._writers:
            self.node.bind_input("brick", port, None)
        for brick in ("brick", "inner"):
            self.node.bind_output(brick, "out", None, 1)
        for end in self._ends:
            end.close()


def outcome(mail: list[str], loop: Loop) -> tuple[object, ...]:
    with TemporaryDirectory() as directory:
        harness = Harness(Path(directory) / "journal")
        try:
            return harness.run([packet(what) for what in mail], loop)
        finally:
            harness.close()


PACKETS: Final = (*KINDS, *ORDERS, "nudge", "no message", "unasked", "large")


def packet(what: str) -> bytes:
    match what:
        case "nudge":
            return NUDGE
        case "no message":
            return b"\xc0nothing"
        case "unasked":
            return messages.encode(Reply(1, 1, 1, b"unasked"))
        case "large":
            return messages.encode_unchecked(Request(1, 1, b"answer".ljust(messages.PACKET_BYTES_MAX, b"\0")))
        case _:
            return messages.encode(Request(1, 1, what.encode()))


@given(st.lists(st.sampled_from(PACKETS), max_size=12).filter(lambda mail: mail.count("large") < 2))
def test_both_loops_do_the_same(mail: list[str]) -> None:
    assert outcome(mail, UnixIO.loop) == outcome(mail, UnixIO.turn)


def test_the_fast_loop_is_the_one_that_is_tested() -> None:
    """All mail but the first on either set of open ports, by which the general loop finds out about it."""
    mail = ["answer", "pass on", "note", "hand in"] * 3
    with mock.patch.object(Node, "turn", autospec=True, side_effect=Node.turn) as turn:
        outcome(mail, UnixIO.loop)
    assert turn.call_count == 2


def test_a_fault_that_is_armed_leaves_the_fast_loop_until_it_has_struck() -> None:
    sent, _, noted, *_ = outcome(["flip", "answer", "answer"], UnixIO.loop)
    assert isinstance(sent, list) and isinstance(noted, list)
    replies = [messages.decode(packet) for packet in sent]
    assert [r.payload for r in replies if isinstance(r, Reply)][:2] == [b"`b", b"ab"]
    assert [event for event, *_ in noted].count(Event.FAULT_APPLIED) == 1, "given twice, it began anew"


@pytest.mark.parametrize("loop", [UnixIO.loop, UnixIO.turn])
def test_a_node_that_writes_a_large_packet_executes_no_brick_meanwhile(loop: Loop, tmp_path: Path) -> None:
    """As watchers see it: what it takes to write ten megabytes is not added to the time of the step.

    No wait has the value of the one before it, so two looks tell whether the node went on.
    """
    harness, activities = Harness(tmp_path / "journal"), list[int]()

    def put(end: int, data: bytes | memoryview) -> None:
        activities.append(harness.io.journal.mapping[ACTIVITY_OFFSET])
        transport.put(end, data)

    with mock.patch.object(node_io, "_put", put):
        harness.run([packet(what) for what in ("nothing", "answer at length")], loop)
    first, second = activities
    assert not first & 1 and second == first + 4  # between them: the read of the second packet
    assert harness.io.journal.mapping[ACTIVITY_OFFSET] & 1
    harness.close()


@pytest.mark.parametrize("loop", [UnixIO.loop, UnixIO.turn])
def test_a_node_that_is_suspended_while_it_waits_for_room_takes_no_mail(loop: Loop, tmp_path: Path) -> None:
    """The order comes by the control line alone, within a write; the fast loop would read on behind it."""
    harness, channel = Harness(tmp_path / "journal"), UnixChannel(Link("node", "out", "other", "in"))
    harness.node.bind_output("brick", "out", os.dup(channel.write.fileno()), 1)
    with contextlib.suppress(BlockingIOError):
        while True:
            channel.write.send(NUDGE, socket.MSG_DONTWAIT)
    serve_orders = harness.io.serve_orders

    def order_comes(*, wait: bool = False) -> None:
        if wait:
            raise Done  # it is suspended, and waits for an order
        harness.line.send(control.SuspendNode(2))
        serve_orders()
        assert channel.read.recv(messages.PACKET_BYTES_MAX) == NUDGE  # there is room again

    with mock.patch.object(harness.io, "serve_orders", order_comes):
        *_, reported, seen = harness.run([packet("nothing"), packet("answer"), packet("note")], loop)
    assert harness.node.suspended and reported == [control.Ack(2)]
    assert seen == ["in nothing", "other nothing", "in answer"]
    harness.close()
    channel.close()


def test_a_reader_that_ends_with_unread_mail_has_ended(tmp_path: Path) -> None:
    """The kernel says so by another error, also behind a write that was told of the end (EPIPE)."""
    harness, channel = Harness(tmp_path / "journal"), UnixChannel(Link("node", "out", "other", "in"))
    harness.node.bind_output("brick", "out", os.dup(channel.write.fileno()), 1)
    hosted, served = harness.node.bricks["brick"], []
    channel.write.send(b"mail")
    channel.read.close()

    def serve_orders(*, wait: bool) -> None:
        served.append(wait)
        harness.node.bind_output("brick", "out", None, 1)

    with mock.patch.object(harness.io, "serve_orders", serve_orders):
        end = hosted.outputs["out"]
        assert isinstance(end, int)
        harness.io._write_hard(hosted, "out", end, b"reply")
    assert served == [True]
    harness.close()
    channel.close()


def test_a_node_whose_mail_nobody_reads_takes_itself_for_fenced(tmp_path: Path) -> None:
    """It ends, by an error that `serve` takes for a fence: what it wants to say must not be lost silently."""
    harness, channel = Harness(tmp_path / "journal"), UnixChannel(Link("node", "out", "other", "in"))
    harness.node.bind_output("brick", "out", os.dup(channel.write.fileno()), 1)
    hosted = harness.node.bricks["brick"]
    end = hosted.outputs["out"]
    assert isinstance(end, int)
    with contextlib.suppress(BlockingIOError):
        while True:
            channel.write.send(b"mail", socket.MSG_DONTWAIT)
    with (
        mock.patch.object(node_io, "WRITE_SECONDS_MAX", 2 * transport.WRITE_PATIENCE_SECONDS),
        pytest.raises(BrokenPipeError, match="brick: out is shut or has no reader"),
    ):
        harness.io.write(hosted, "out", end, Reply(1, 1, 1, b""), None)
    harness.close()
    channel.close()
