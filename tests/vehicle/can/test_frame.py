"""A frame that cannot stand on a classic CAN bus does not come into being."""

import msgspec
import pytest

from aftbed.core.errors import PeerError
from aftbed.vehicle.can.frame import Frame


def test_the_edges_are_allowed() -> None:
    assert Frame(0, 0, b"").data == b""
    assert len(Frame(0, 0x7FF, bytes(8)).data) == 8


@pytest.mark.parametrize(
    ("t_us", "can_id", "data", "reason"),
    [
        (0, 0x800, b"", "CAN id 0x800, allowed is 0 to 0x7ff"),
        (0, -1, b"", "CAN id -0x1, allowed is 0 to 0x7ff"),
        (0, 0x130, bytes(9), "CAN frame 0x130 of 9 bytes, allowed are 0 to 8"),
        (-1, 0x130, b"", "CAN frame 0x130 at -1 us, before the run began"),
    ],
)
def test_one_beyond_the_edges_is_refused(t_us: int, can_id: int, data: bytes, reason: str) -> None:
    with pytest.raises(PeerError, match=f"^{reason}$"):
        Frame(t_us, can_id, data)


def test_a_decoded_frame_is_checked_too() -> None:
    frame = Frame(7, 0x130, b"\x01\x02")
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(frame), type=Frame) == frame
    with pytest.raises(PeerError):
        msgspec.msgpack.decode(msgspec.msgpack.encode({"t_us": 0, "can_id": 4096, "data": b""}), type=Frame)
