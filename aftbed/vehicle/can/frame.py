"""One classic CAN frame on the bus, with its bus time, whatever clock the run is paced by.

No CAN FD, no extended or remote frames.
"""

from typing import Final

import msgspec

from aftbed.core.errors import PeerError

CAN_ID_MAX: Final = 0x7FF
DATA_LENGTH_MAX: Final = 8


class Frame(msgspec.Struct, frozen=True):
    """Bus time in microseconds since the start of the run, 11-bit id, 0 to 8 bytes. PeerError otherwise."""

    t_us: int
    can_id: int
    data: bytes

    def __post_init__(self) -> None:
        if not 0 <= self.can_id <= CAN_ID_MAX:
            raise PeerError(f"CAN id {self.can_id:#x}, allowed is 0 to {CAN_ID_MAX:#x}")
        if len(self.data) > DATA_LENGTH_MAX:
            raise PeerError(f"CAN frame {self.can_id:#05x} of {len(self.data)} bytes, allowed are 0 to 8")
        if self.t_us < 0:
            raise PeerError(f"CAN frame {self.can_id:#05x} at {self.t_us} us, before the run began")
