"""What the host of a Server does when a fault is due: one execution is hit, and the journal says how.

The brick here is what a host sees of a Server: an execution is a Note and, behind it, what carries the
result away.
"""

import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from msgspec import structs

from aftbed.core.brick import Brick, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.journal import Record, records
from aftbed.core.messages import AnyMessage, CaptureState, Message, Reply, Request, StateCaptured, Tried
from aftbed.inject import model
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Bit, with_flipped
from aftbed.inject.hang import Hang
from aftbed.inject.receipts import fault_and_bits, record_detail
from aftbed.inject.value import EXECUTED, ValueFlip, ValuePlace
from aftbed.runtime import control
from aftbed.runtime.node import Node
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.node_io import UnixIO
from aftbed.runtime.unix.transport import Line, decode_order, decode_report

STATE: Final = b"\x00\x01\x02\x03"
REFUSED: Final = 0x80  # in the last byte of a state: no state has it
IGNORED: Final = 1  # byte of a state that means nothing
EXIT: Final = Event.SERVER_EXIT.label
CAPTURED: Final = Event.STATE_CAPTURED.label


class Executing(Brick):
    """Answers with the request's bytes reversed; `tries`: in a Tried, with the state after it."""

    def __init__(self, *, tries: bool = False, secret: bool = False) -> None:
        self.tries, self.secret = tries, secret
        self.state = STATE

    def open_ports(self) -> tuple[str, ...]:
        return ("prd2srv",)

    def quiescent(self) -> bool:
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        if isinstance(msg, CaptureState):
            captured = StateCaptured(1, msg.request_id, self.capture())
            return [Note(Event.STATE_CAPTURED, msg.request_id), Send("out", captured)]
        assert isinstance(msg, Request)
        self.state = bytes((msg.request_id, *self.state[1:]))
        payload = msg.payload[::-1]
        answer: Message = Reply(1, msg.request_id, 1, payload)
        if self.tries:
            answer = Tried(1, msg.request_id, 1, payload, self.capture())
        notes: list[Effect] = [
            Note(Event.SERVER_ENTER, msg.request_id),
            Note(Event.SERVER_EXIT, msg.request_id),
        ]
        return [*notes, Send("out", answer)]

    def capture(self) -> bytes:
        if self.secret:
            raise PeerError("no state access")
        return self.state

    def restore(self, state: bytes) -> None:
        if state[-1] & REFUSED:
            raise PeerError("no such state")
        self.state = bytes((state[0], STATE[IGNORED], *state[2:]))


class Host:
    """A node with such a brick, and what came out of it."""

    def __init__(self, path: Path, brick: Executing) -> None:
        self.brick, self.path, self.out = brick, path, list[Message]()
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.line = Line(ours, decode_report)
        ours.setblocking(False)
        self.io = UnixIO(Line(theirs, decode_order), JournalFile(path, "a"))
        self.node = Node("a", self.io)
        for name in ("a/server", "b/server"):  # as in placement `single`
            self.node.add(name, brick).outputs["out"] = self.out.append

    def arm(self, *blows: model.ArmedFault, event: str = EXIT) -> None:
        assert self.node.carry_out(control.Arm(1, event, blows), []) == b""

    def execute(self, request_id: int, name: str = "a/server") -> Message:
        """The answer to one request."""
        self.node.step(self.node.bricks[name], "prd2srv", Request(1, request_id, b"\x02\x01"))
        return self.out[-1]

    def told(self) -> list[Record]:
        """What the journal says of faults."""
        wanted = (Event.FAULT_APPLIED, Event.PEER_REFUSED)
        return [r for r in records(self.path.read_bytes()) if r.event in wanted]

    def fired(self) -> list[int]:
        """The faults that the supervisor is told of."""
        found = []
        while True:
            try:
                got = self.line.recv()
            except BlockingIOError:
                return found
            assert got is not None and isinstance(got[0], control.Fired)
            found.append(got[0].fault)

    def close(self) -> None:
        self.line.close()
        self.io.line.close()


@pytest.fixture
def host(tmp_path: Path) -> Iterator[Host]:
    made = Host(tmp_path / "a.journal", Executing())
    yield made
    made.close()


def flip(
    place: ValuePlace,
    bit: int | None,
    nth: int = 1,
    *,
    fault: int = 7,
    brick: str = "a/server",
    draw: int = 0,
) -> model.ArmedFault:
    return model.ArmedFault(fault, brick, nth, ValueFlip(place, Bit(bit)), False, draw)


def test_a_bit_of_the_result_is_flipped_in_one_execution(host: Host) -> None:
    host.arm(flip(ValuePlace.RESULT, 9, nth=2))
    assert [host.execute(i) for i in (1, 2, 3)] == [
        Reply(1, 1, 1, b"\x01\x02"),
        Reply(1, 2, 1, b"\x01\x00"),
        Reply(1, 3, 1, b"\x01\x02"),
    ]
    (record,) = host.told()
    assert (record.event, record.request_id, fault_and_bits(record.detail)) == (
        Event.FAULT_APPLIED,
        2,
        (7, 9),
    )
    assert host.fired() == [7]
    assert not host.node.agent.active, "the host is on its fast way again"


def test_the_state_is_not_what_a_flip_of_the_result_hits(host: Host) -> None:
    host.arm(flip(ValuePlace.RESULT, 0))
    host.execute(1)
    assert host.brick.state == b"\x01\x01\x02\x03"


def test_a_bit_of_the_state_is_flipped_after_the_execution(host: Host) -> None:
    host.arm(flip(ValuePlace.STATE, 17))
    assert host.execute(5) == Reply(1, 5, 1, b"\x01\x02"), "the reply was there before"
    assert host.brick.state == b"\x05\x01\x00\x03"
    (record,) = host.told()
    assert (record.event, record.request_id, fault_and_bits(record.detail)) == (
        Event.FAULT_APPLIED,
        5,
        (7, 17),
    )


def test_a_trial_carries_the_state_that_was_hit(host: Host) -> None:
    host.brick.tries = True
    host.arm(flip(ValuePlace.STATE, 17, nth=2))
    assert host.execute(5) == Tried(1, 5, 1, b"\x01\x02", b"\x05\x01\x02\x03")
    assert host.execute(5) == Tried(1, 5, 1, b"\x01\x02", b"\x05\x01\x00\x03")
    assert host.brick.state == b"\x05\x01\x00\x03"


def test_a_trial_carries_the_result_that_was_hit(host: Host) -> None:
    host.brick.tries = True
    host.arm(flip(ValuePlace.RESULT, 0))
    assert host.execute(5) == Tried(1, 5, 1, b"\x00\x02", b"\x05\x01\x02\x03")


def test_a_captured_state_shows_the_hit(host: Host) -> None:
    host.arm(flip(ValuePlace.STATE, 16), event=CAPTURED)
    host.execute(1)
    host.node.step(host.node.bricks["a/server"], "aft2srv", CaptureState(1, 1))
    assert host.out[-1] == StateCaptured(1, 1, b"\x01\x01\x03\x03")
    assert host.brick.state == b"\x01\x01\x03\x03"


# -- what does not come to be


@pytest.mark.parametrize("place", EXECUTED)
def test_a_bit_beyond_the_end_is_not_flipped(host: Host, place: ValuePlace) -> None:
    host.arm(flip(place, 8 * len(STATE)))
    assert host.execute(1) == Reply(1, 1, 1, b"\x01\x02")
    assert host.brick.state == b"\x01\x01\x02\x03"
    (record,) = host.told()
    bits = 16 if place is ValuePlace.RESULT else 32
    assert (record.event, record.request_id, fault_and_bits(record.detail)) == (
        Event.PEER_REFUSED,
        1,
        (7, bits),
    )
    assert host.fired() == [7] and not host.node.agent.active


@pytest.mark.parametrize("bit", [31, 8 * IGNORED], ids=["no state", "without a meaning"])
def test_a_state_that_the_function_does_not_take_is_not_flipped(host: Host, bit: int) -> None:
    host.brick.tries = True
    host.arm(flip(ValuePlace.STATE, bit))
    assert host.execute(1) == Tried(1, 1, 1, b"\x01\x02", b"\x01\x01\x02\x03")
    (record,) = host.told()
    assert (record.event, fault_and_bits(record.detail)) == (Event.PEER_REFUSED, (7, 32))


def test_where_there_is_no_state_access_there_are_no_bits(host: Host) -> None:
    host.brick.secret = True
    host.arm(flip(ValuePlace.STATE, None, draw=3))
    assert host.execute(1) == Reply(1, 1, 1, b"\x01\x02")
    (record,) = host.told()
    assert (record.event, fault_and_bits(record.detail)) == (Event.PEER_REFUSED, (7, 0))


# -- which bit, where, and when


@pytest.mark.parametrize("draw", [0, 5, 16, 2**63 - 1])
def test_a_bit_that_is_not_named_is_drawn(host: Host, draw: int) -> None:
    host.arm(flip(ValuePlace.RESULT, None, draw=draw))
    answer = host.execute(1)
    assert isinstance(answer, Reply) and answer.payload == with_flipped(b"\x01\x02", [draw % 16])
    assert [fault_and_bits(r.detail) for r in host.told()] == [(7, draw % 16)]


def test_the_other_replica_in_this_node_is_not_hit_and_does_not_count(host: Host) -> None:
    host.arm(flip(ValuePlace.RESULT, 0, nth=2, brick="b/server"))
    for _ in range(3):
        assert host.execute(1, "a/server") == Reply(1, 1, 1, b"\x01\x02")
    assert host.execute(1, "b/server") == Reply(1, 1, 1, b"\x01\x02")
    assert host.execute(2, "b/server") == Reply(1, 2, 1, b"\x00\x02")


def test_several_faults_wait_for_the_same_event(host: Host) -> None:
    host.arm(flip(ValuePlace.RESULT, 0, nth=2, fault=7), flip(ValuePlace.RESULT, 1, nth=3, fault=8))
    host.execute(1)
    host.arm(flip(ValuePlace.RESULT, 2, nth=3, fault=9))  # counts from now, and the others go on
    answers = [host.execute(i) for i in (2, 3, 4)]
    assert [a.payload for a in answers if isinstance(a, Reply)] == [b"\x00\x02", b"\x03\x02", b"\x05\x02"]
    assert [fault_and_bits(r.detail) for r in host.told()] == [(7, 0), (8, 1), (9, 2)]
    assert host.fired() == [7, 8, 9]


def test_two_bits_of_one_execution(host: Host) -> None:
    host.arm(flip(ValuePlace.RESULT, 0, fault=7), flip(ValuePlace.RESULT, 1, fault=8))
    assert host.execute(1) == Reply(1, 1, 1, b"\x02\x02")


def test_what_is_told_not_to_wait_any_more_does_not_strike(host: Host) -> None:
    host.arm(flip(ValuePlace.RESULT, 0, fault=7), flip(ValuePlace.RESULT, 1, fault=8))
    host.arm(structs.replace(flip(ValuePlace.RESULT, 0, fault=7), nth=0))
    assert host.execute(1) == Reply(1, 1, 1, b"\x03\x02")
    host.arm(flip(ValuePlace.RESULT, 0, nth=0))
    assert not host.node.agent.active


def test_a_fault_that_is_told_of_again_begins_anew(host: Host) -> None:
    host.arm(flip(ValuePlace.RESULT, 0, nth=2))
    host.execute(1)
    host.arm(flip(ValuePlace.RESULT, 0, nth=2))
    assert host.execute(2) == Reply(1, 2, 1, b"\x01\x02")
    assert host.execute(3) == Reply(1, 3, 1, b"\x00\x02")


def test_what_is_not_done_here_is_waited_for(host: Host) -> None:
    host.arm(model.ArmedFault(7, "a/server", 1, Hang(), by_itself=False))
    host.line.send(control.Ack(7))
    assert host.execute(1) == Reply(1, 1, 1, b"\x01\x02")
    assert [(r.event, r.detail) for r in host.told()] == [(Event.FAULT_APPLIED, record_detail(7))]
    assert host.fired() == [7]


def test_a_node_kills_itself_behind_the_note_and_before_the_reply(host: Host) -> None:
    host.arm(model.ArmedFault(7, "a/server", 2, Crash(), by_itself=True))
    host.execute(1)
    pid = os.fork()
    if pid == 0:
        host.execute(2)
        os._exit(0)
    _, status = os.waitpid(pid, 0)
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == 9
    exits = [r.request_id for r in records(host.path.read_bytes()) if r.event is Event.SERVER_EXIT]
    assert exits == [1, 2] and [r.detail for r in host.told()] == [record_detail(7)]
