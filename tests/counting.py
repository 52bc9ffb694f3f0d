"""A tiny protected function: each reply depends on every request so far, so no slip goes unnoticed."""

import re
import zlib
from typing import Final

import msgspec

from aftbed.core.application import Characteristics
from aftbed.core.errors import PeerError

_REPLY: Final = re.compile(rb"[1-9][0-9]*:[0-9a-f]{8}")


class Counting:
    """The reply to a request is `number of requests so far : checksum of all of them, in order`.

    It refuses an empty one. What is acceptable is a matter of form: bit 6 of a digit makes it none, bit 0
    may make it another.
    """

    characteristics = Characteristics()

    def __init__(self) -> None:
        self.count, self.sum = 0, 0

    def execute(self, request: bytes) -> bytes:
        if not request:
            raise PeerError("an empty request")
        self.count, self.sum = self.count + 1, zlib.crc32(request, self.sum)
        return b"%d:%08x" % (self.count, self.sum)

    def capture(self) -> bytes:
        return msgspec.msgpack.encode((self.count, self.sum))

    def restore(self, state: bytes) -> None:
        try:
            self.count, self.sum = msgspec.msgpack.decode(state, type=tuple[int, int])
        except msgspec.DecodeError as error:
            raise PeerError(f"not a state of Counting: {error}") from error

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        return bool(request) and _REPLY.fullmatch(reply) is not None
