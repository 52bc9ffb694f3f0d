"""Functions that are what they declare, and such as are not: each differs from `Sum` in one thing.

`Sum` adds up the bytes of its requests and counts them. A request is any bytes; a reply is the sum and the
count, a state the same. One test executes them in its own process, another in processes of their own.
"""

import ctypes
import os
import random
import struct
import time
from collections.abc import Iterator
from typing import Any, ClassVar

from aftbed.core.application import NONE, Characteristics, Field, approximate
from aftbed.core.errors import PeerError

LAYOUT = struct.Struct("<QQ")
SUM_FIELDS = (Field("sum", "u64", 0), Field("count", "u64", 8))
COUNTS: dict[str, int] = {"executed": 0}
SEEN: list[bytes] = []
WORDS = frozenset(f"word {number}" for number in range(40))


def requests(seed: int) -> Iterator[bytes]:
    """Of the length of 1 to 9 bytes, without end."""
    draw = random.Random(seed)
    while True:
        yield draw.randbytes(draw.randrange(1, 10))


class Sum:
    characteristics = Characteristics()
    fields: ClassVar[tuple[Field, ...]] = SUM_FIELDS

    def __init__(self) -> None:
        self.sum = self.count = 0

    def execute(self, request: bytes) -> bytes:
        self.sum += sum(request)
        self.count += 1
        return LAYOUT.pack(self.sum, self.count)

    def capture(self) -> bytes:
        return LAYOUT.pack(self.sum, self.count)

    def restore(self, state: bytes) -> None:
        if len(state) != LAYOUT.size:
            raise PeerError(f"state of {len(state)} bytes")
        self.sum, self.count = LAYOUT.unpack(state)


# -- not deterministic ----------------------------------------------------------------------------


class Chance(Sum):
    def execute(self, request: bytes) -> bytes:
        return super().execute(request + random.randbytes(2))


class HashOrder(Sum):
    def execute(self, request: bytes) -> bytes:
        return super().execute(request) + next(iter(WORDS)).encode()


class HashOrderInState(Sum):
    fields: ClassVar[tuple[Field, ...]] = ()

    def capture(self) -> bytes:
        return super().capture() + ",".join(WORDS).encode()

    def restore(self, state: bytes) -> None:
        super().restore(state[: LAYOUT.size])


class Second(Sum):
    """Of the clock."""

    def execute(self, request: bytes) -> bytes:
        self.sum = int(time.time())
        return super().execute(b"")


class Address(Sum):
    def execute(self, request: bytes) -> bytes:
        return super().execute(request) + id(self).to_bytes(8, "little")


class Environment(Sum):
    def execute(self, request: bytes) -> bytes:
        place = f"{os.environ.get('TZ')} {os.environ.get('LANG')}"
        return super().execute(request) + place.encode()


class Folder(Sum):
    def execute(self, request: bytes) -> bytes:
        return super().execute(request) + os.getcwd().encode()  # noqa: PTH109


class DeclaredChance(Chance):
    characteristics = Characteristics(deterministic=False)


# -- with states that are not theirs --------------------------------------------------------------


class HiddenGlobal(Sum):
    """Counts in the module, where no restore reaches."""

    def execute(self, request: bytes) -> bytes:
        COUNTS["executed"] += 1
        self.count = COUNTS["executed"]
        return super().execute(request)


class ForgetsField(Sum):
    """Its state has no count."""

    def capture(self) -> bytes:
        return LAYOUT.pack(self.sum, 0)


class ForgetsNumber(ForgetsField):
    """Its replies have fields."""

    reply_fields: ClassVar[tuple[Field, ...]] = SUM_FIELDS


class RestoresLess(Sum):
    """Its state is whole, and restore leaves the count out."""

    def restore(self, state: bytes) -> None:
        count = self.count
        super().restore(state)
        self.count = count


class KeepsRemains(Sum):
    """Adds what is restored to what is there."""

    def restore(self, state: bytes) -> None:
        count = self.count
        super().restore(state)
        self.count += count


class CaptureCounts(Sum):
    """Counts captures as if they were requests."""

    def capture(self) -> bytes:
        self.count += 1
        return super().capture()


class CaptureNumbers(Sum):
    """Numbers its captures; no reply shows it."""

    fields: ClassVar[tuple[Field, ...]] = ()

    def __init__(self) -> None:
        super().__init__()
        self.captured = 0

    def capture(self) -> bytes:
        self.captured += 1
        return super().capture() + bytes((self.captured % 256,))

    def restore(self, state: bytes) -> None:
        super().restore(state[: LAYOUT.size])
        self.captured = state[LAYOUT.size] - 1


class CaptureSpoils(Sum):
    """A capture changes what the next request finds, but not what the next capture does."""

    def __init__(self) -> None:
        super().__init__()
        self.spoilt = False

    def execute(self, request: bytes) -> bytes:
        reply = super().execute(request)
        return reply[:-1] + bytes((self.spoilt,))

    def capture(self) -> bytes:
        self.spoilt = True
        return super().capture()


class OfItsProcess(Sum):
    """Its state is a place in a list of its process."""

    fields: ClassVar[tuple[Field, ...]] = ()

    def capture(self) -> bytes:
        state = super().capture()
        if state not in SEEN:
            SEEN.append(state)
        return SEEN.index(state).to_bytes(4, "little")

    def restore(self, state: bytes) -> None:
        super().restore(SEEN[int.from_bytes(state, "little")])


class OtherBytes(Sum):
    """A byte of its state says whether it was restored; no reply depends on it."""

    fields: ClassVar[tuple[Field, ...]] = ()

    def __init__(self) -> None:
        super().__init__()
        self.fresh = True

    def capture(self) -> bytes:
        return super().capture() + bytes((self.fresh,))

    def restore(self, state: bytes) -> None:
        super().restore(state[: LAYOUT.size])
        self.fresh = False


class RefusesOwnState(Sum):
    def restore(self, state: bytes) -> None:
        raise PeerError("never again")


class NoAccess(Sum):
    characteristics = Characteristics(state_access=NONE)

    def capture(self) -> bytes:
        return b""

    def restore(self, state: bytes) -> None:
        if state:
            raise PeerError("there is no access to the state")


class UndeclaredNoAccess(NoAccess):
    characteristics = Characteristics()


class Understated(Sum):
    characteristics = Characteristics(deterministic=False, state_access=NONE)


# -- approximate ----------------------------------------------------------------------------------


class Mean:
    """The mean of all bytes, as f64, and their count, as u64; of its state the mean is an f32."""

    characteristics = Characteristics(state_access=approximate(1e-3))
    reply_fields: ClassVar[tuple[Field, ...]] = (Field("mean", "f64", 0), Field("count", "u64", 8))

    def __init__(self) -> None:
        self.mean, self.count = 0.0, 0

    def execute(self, request: bytes) -> bytes:
        for byte in request:
            self.count += 1
            self.mean += (byte - self.mean) / self.count
        return struct.pack("<dQ", self.mean, self.count)

    def capture(self) -> bytes:
        return struct.pack("<fQ", self.mean, self.count)

    def restore(self, state: bytes) -> None:
        self.mean, self.count = struct.unpack("<fQ", state)


class MeanTooGood(Mean):
    """Declares what it does not reach."""

    characteristics = Characteristics(state_access=approximate(1e-12))


class MeanDeclaredExact(Mean):
    characteristics = Characteristics()


class MeanWithoutFields(Mean):
    reply_fields: ClassVar[tuple[Field, ...]] = ()


class MeanOfOtherCount(Mean):
    """A count is a number, too."""

    def restore(self, state: bytes) -> None:
        super().restore(state)
        self.count += 1


# -- that cannot be measured ----------------------------------------------------------------------


class RaisesInExecute(Sum):
    def execute(self, request: bytes) -> bytes:
        if self.count == 6:
            raise ZeroDivisionError("no more")
        return super().execute(request)


class RaisesInCapture(Sum):
    def capture(self) -> bytes:
        raise ValueError("nothing to see")


class RaisesInRestore(Sum):
    def restore(self, state: bytes) -> None:
        raise KeyError("sum")


class NoBytes(Sum):
    def execute(self, request: bytes) -> Any:
        return "a text"


class Refuses(Sum):
    def execute(self, request: bytes) -> bytes:
        raise PeerError("no such request")


class RefusesSome(Sum):
    def execute(self, request: bytes) -> bytes:
        if len(request) == 1:
            raise PeerError("too short")
        return super().execute(request)


class Hangs(Sum):
    def execute(self, request: bytes) -> bytes:
        while self.count == 6:
            pass
        return super().execute(request)


class Crashes(Sum):
    """By SIGSEGV, as a library."""

    def execute(self, request: bytes) -> bytes:
        if self.count == 6:
            ctypes.string_at(0)
        return super().execute(request)


class CrashesElsewhere(Sum):
    """Where its state comes from another process: a pointer."""

    fields: ClassVar[tuple[Field, ...]] = ()

    def capture(self) -> bytes:
        return super().capture() + os.getpid().to_bytes(8, "little")

    def restore(self, state: bytes) -> None:
        if state[LAYOUT.size :] != os.getpid().to_bytes(8, "little"):
            ctypes.string_at(0)
        super().restore(state[: LAYOUT.size])


class Leaves(Sum):
    def execute(self, request: bytes) -> bytes:
        os._exit(7)


class OddCharacteristics(Sum):
    characteristics: ClassVar[Any] = {"deterministic": True}


class OddFields(Sum):
    fields: ClassVar[Any] = ("sum", "count")
