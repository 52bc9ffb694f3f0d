"""Functions of users: a good one, and others with one planted weakness each."""

import os
import random
from struct import pack, unpack
from typing import Final

from aftbed.core.application import NONE, Characteristics
from aftbed.core.errors import PeerError

FATAL: Final = 17  # the request on which `Fatal` fails
hidden = 0


class Counter:
    """Adds up what it is sent; a reply is the sum, and how many requests there were."""

    characteristics = Characteristics()

    def __init__(self) -> None:
        self.sum = self.count = 0

    def execute(self, request: bytes) -> bytes:
        if len(request) != 4:
            raise PeerError(f"a request of {len(request)} bytes, 4 are required")
        self.sum = (self.sum + unpack("<I", request)[0]) % 2**32
        self.count += 1
        return pack("<II", self.sum, self.count)

    def capture(self) -> bytes:
        return pack("<II", self.sum, self.count)

    def restore(self, state: bytes) -> None:
        if len(state) != 8:
            raise PeerError(f"a state of {len(state)} bytes, 8 are required")
        self.sum, self.count = unpack("<II", state)


class Forgetful(Counter):
    """Its state lacks the number of requests."""

    def capture(self) -> bytes:
        return pack("<I", self.sum)

    def restore(self, state: bytes) -> None:
        if len(state) != 4:
            raise PeerError(f"a state of {len(state)} bytes, 4 are required")
        (self.sum,) = unpack("<I", state)


class Hidden(Counter):
    """A part of its state is a global of the module."""

    def __init__(self) -> None:
        global hidden  # noqa: PLW0603
        super().__init__()
        hidden = 0

    def execute(self, request: bytes) -> bytes:
        global hidden  # noqa: PLW0603
        hidden += 1
        return super().execute(request)[:4] + pack("<I", hidden)


class Chance(Counter):
    """Declared deterministic, and is not."""

    def execute(self, request: bytes) -> bytes:
        return super().execute(request) + random.randbytes(1)


class Address(Counter):
    """A reply depends on where the object lies."""

    def execute(self, request: bytes) -> bytes:
        return super().execute(request) + pack("<Q", id(self))


class Fatal(Counter):
    """Fails on one request."""

    def execute(self, request: bytes) -> bytes:
        reply = super().execute(request)
        if self.count == FATAL:
            raise ZeroDivisionError("the distance is 0")
        return reply


class Fragile(Counter):
    """Its process ends, as one of native code may, behind a wrong bit in its state."""

    check = 0

    def execute(self, request: bytes) -> bytes:
        if self.check != self.sum ^ self.count:
            os._exit(9)
        reply = super().execute(request)
        self.check = self.sum ^ self.count
        return reply

    def capture(self) -> bytes:
        return super().capture() + pack("<I", self.check)

    def restore(self, state: bytes) -> None:
        super().restore(state[:8])
        (self.check,) = unpack("<I", state[8:])


class Closed(Counter):
    """Gives no state."""

    characteristics = Characteristics(state_access=NONE)

    def capture(self) -> bytes:
        return b""

    def restore(self, state: bytes) -> None:
        if state:
            raise PeerError("there is no access to the state")


class Random(Chance):
    """Not deterministic, and says so."""

    characteristics = Characteristics(deterministic=False)


class Stateless(Closed):
    """Squares what it is sent."""

    characteristics = Characteristics()

    def execute(self, request: bytes) -> bytes:
        return pack("<Q", unpack("<I", request)[0] ** 2)
