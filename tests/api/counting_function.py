"""Functions for the tests of the API, in a module that other processes find by its file."""

import struct

import aftbed

REQUESTS = [number.to_bytes(4, "little") for number in range(1, 31)]


class Sum:
    """Replies with the sum of all requests so far (u32)."""

    characteristics = aftbed.Characteristics(deterministic=True)
    fields = (aftbed.Field("sum", "u32", 0),)

    def __init__(self) -> None:
        self._sum = 0

    def execute(self, request: bytes) -> bytes:
        if len(request) != 4:
            raise aftbed.PeerError(f"{len(request)} bytes")
        self._sum = (self._sum + int.from_bytes(request, "little")) % 2**32
        return struct.pack("<I", self._sum)

    def capture(self) -> bytes:
        return struct.pack("<I", self._sum)

    def restore(self, state: bytes) -> None:
        if len(state) != 4:
            raise aftbed.PeerError("no state")
        (self._sum,) = struct.unpack("<I", state)

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        return len(reply) == 4


class Forgetful(Sum):
    """Its checkpoint lacks the state: a backup goes on from 0."""

    def capture(self) -> bytes:
        return bytes(4)


class Drawn(Sum):
    characteristics = aftbed.Characteristics(deterministic=False)


class Raises(Sum):
    """Breaks at the seventh request, in either replica."""

    def execute(self, request: bytes) -> bytes:
        if request == REQUESTS[6]:
            raise ZeroDivisionError("the seventh request")
        return super().execute(request)


class Worn(Sum):
    """Breaks at the fortieth request that any of its instances executes."""

    executed = 0

    def execute(self, request: bytes) -> bytes:
        Worn.executed += 1
        if Worn.executed >= 40:
            raise ValueError("worn out")
        return super().execute(request)


REPLIES = [Sum.execute(one, request) for one in [Sum()] for request in REQUESTS]
