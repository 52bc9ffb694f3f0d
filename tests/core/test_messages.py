"""The wire: what is sent arrives, and whatever else arrives is a PeerError."""

from typing import Final, get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core import messages
from aftbed.core.errors import PeerError
from aftbed.core.messages import (
    AnyMessage,
    Checkpoint,
    Loss,
    Message,
    Pages,
    Reply,
    Request,
    State,
    Suspect,
    Tried,
    WireMessage,
)

KINDS: Final[tuple[type[Message], ...]] = get_args(WireMessage)

numbers = st.integers(0, 2**64 - 1)
some_pages = st.builds(
    Pages,
    numbers,
    numbers,
    numbers,
    st.lists(numbers, max_size=4).map(tuple),
    st.binary(max_size=99),
    numbers,
)
BY_TYPE: Final = {
    int: numbers,
    bytes: st.binary(max_size=300),
    State: st.one_of(st.binary(max_size=300), some_pages),
    str: st.text(max_size=40),
    bool: st.booleans(),
    Loss: st.sampled_from(Loss),
    tuple[Tried, ...]: st.lists(
        st.builds(Tried, numbers, numbers, numbers, st.binary(max_size=99), st.binary(max_size=99)),
        max_size=3,
    ).map(tuple),
}
some_message = st.one_of(
    *(st.builds(kind, *(BY_TYPE[f.type] for f in msgspec.structs.fields(kind))) for kind in KINDS)
)


@given(some_message)
def test_what_is_sent_arrives(message: Message) -> None:
    assert messages.decode(messages.encode(message)) == message


@given(st.binary(max_size=200))
def test_random_bytes_are_a_message_or_a_peer_error(data: bytes) -> None:
    try:
        message = messages.decode(data)
    except PeerError:
        return
    assert isinstance(message, KINDS)


@given(some_message, st.data())
def test_a_flipped_bit_gives_a_message_of_the_union_or_a_peer_error(
    message: Message, data: st.DataObject
) -> None:
    packet = bytearray(messages.encode(message))
    bit = data.draw(st.integers(0, 8 * len(packet) - 1))
    packet[bit // 8] ^= 1 << bit % 8
    try:
        found = messages.decode(bytes(packet))
    except PeerError:
        return
    assert isinstance(found, KINDS)


@given(some_message, st.data())
def test_a_truncated_packet_is_refused(message: Message, data: st.DataObject) -> None:
    packet = messages.encode(message)
    with pytest.raises(PeerError, match="not a message"):
        messages.decode(packet[: data.draw(st.integers(0, len(packet) - 1))])


@given(some_message, st.binary(min_size=1, max_size=9))
def test_a_packet_is_one_message(message: Message, more: bytes) -> None:
    with pytest.raises(PeerError, match="trailing"):
        messages.decode(messages.encode(message) + more)


def test_the_limit_is_kept_at_its_edge() -> None:
    tried = messages.PACKET_BYTES_MAX - 100
    around = len(msgspec.msgpack.encode(Request(1, 1, bytes(tried)))) - tried
    largest = Request(1, 1, bytes(messages.PACKET_BYTES_MAX - around))
    packet = messages.encode(largest)
    assert len(packet) == messages.PACKET_BYTES_MAX
    assert messages.decode(packet) == largest
    with pytest.raises(AssertionError, match="Request of"):
        messages.encode(Request(1, 1, largest.payload + b"x"))


def test_a_packet_over_the_limit_is_refused_unread() -> None:
    packet = msgspec.msgpack.encode(Request(1, 1, bytes(messages.PACKET_BYTES_MAX)))
    with pytest.raises(PeerError, match=f"at most {messages.PACKET_BYTES_MAX} are allowed"):
        messages.decode(packet)


def test_the_sender_of_a_packet_over_the_limit_is_us() -> None:
    with pytest.raises(AssertionError, match="Checkpoint of"):
        messages.encode(Checkpoint(1, 1, b"", bytes(messages.PACKET_BYTES_MAX)))


@pytest.mark.parametrize(
    "value",
    [
        [99, 1, 1],  # no such tag
        [20, 2],  # Promotion: between the runtime and a brick, never on a channel
        [1, 1, "one", b""],  # a wrong type
        [1, 1],  # too short
        {"epoch": 1},  # not an array
        [10, "a", 1, "n", "c", -1.5],
    ],
)
def test_a_well_formed_value_that_is_no_message_is_refused(value: object) -> None:
    with pytest.raises(PeerError, match="not a message"):
        messages.decode(msgspec.msgpack.encode(value))


def test_text_that_is_no_text_is_refused() -> None:
    packet = messages.encode(Suspect("a", 1, "node", Loss.CRASH, 5)).replace(b"node", b"\xff\xff\xff\xff")
    with pytest.raises(PeerError, match="not a message"):
        messages.decode(packet)


def test_a_value_that_is_nested_too_deep_is_refused() -> None:
    take_over_and_one_field_more = b"\x93\x09\x01" + b"\x91" * 50_000 + b"\x01"
    with pytest.raises(PeerError, match="not a message"):
        messages.decode(take_over_and_one_field_more)


def test_tags_are_unique_and_what_travels_is_part_of_the_union() -> None:
    kinds = get_args(AnyMessage)
    tags = [kind.__struct_config__.tag for kind in kinds]
    assert len(set(tags)) == len(tags)
    assert set(KINDS) <= set(kinds)


def test_messages_are_frozen() -> None:
    for kind in get_args(AnyMessage):
        assert kind.__struct_config__.frozen and kind.__struct_config__.array_like


def test_epoch_zero_and_large_ids_travel() -> None:
    assert messages.decode(messages.encode(Reply(0, 2**63, 2, b""))) == Reply(0, 2**63, 2, b"")
