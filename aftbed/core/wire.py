"""Messages to bytes and back: msgspec MessagePack, tagged, typed, limited in size; never pickle.

The unchecked halves are for the hot path of a host, which checks the size and the errors itself.
A packet is one message. What is over the limit, truncated, of an unknown tag or of a wrong type
raises PeerError; nothing is half decoded.
"""

from collections.abc import Callable
from typing import Final

import msgspec

from aftbed.core.errors import PeerError
from aftbed.core.message import Message, WireMessage

PACKET_BYTES_MAX: Final = 64 * 1024
UNREADABLE: Final = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)  # all that a decoder raises

encode_unchecked: Callable[[Message], bytes] = msgspec.msgpack.Encoder().encode
decode_unchecked: Callable[[bytes], WireMessage] = msgspec.msgpack.Decoder(WireMessage).decode


def encode(message: Message) -> bytes:
    """The packet of `message`; asserts that it keeps the limit (ours to keep, not the peer's)."""
    data = encode_unchecked(message)
    assert len(data) <= PACKET_BYTES_MAX, f"{type(message).__name__} of {len(data)} bytes"
    return data


def decode(data: bytes) -> WireMessage:
    """The message in `data`. Raises PeerError."""
    if len(data) > PACKET_BYTES_MAX:
        raise PeerError(f"packet of {len(data)} bytes, at most {PACKET_BYTES_MAX} are allowed")
    try:
        return decode_unchecked(data)
    except UNREADABLE as error:
        raise PeerError(f"not a message ({len(data)} bytes): {error}") from error
