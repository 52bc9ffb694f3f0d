"""A protected function whose state has any size, for the sweep over it.

It computes almost nothing, and the same for each size: it counts its requests in the first bytes of its
state, and answers with a digest of the count and the request. The rest of the state is ballast, which is
captured, sent and restored with it. The name of a class has its size: `Ballast1000v2` is version 2 of the
class whose state has 1000 bytes; an update of the function brings it into a run (`source_of`). Two versions
of one size are equal: they exist to be exchanged for each other.

The nodes import this module, so it imports nothing heavy. No field is declared, so the state is in no shared
memory.
"""

import re
from hashlib import blake2b
from typing import Final

from aftbed.core.application import Characteristics
from aftbed.core.errors import PeerError

COUNT_BYTES: Final = 8
REPLY_BYTES: Final = 8
SIZE_BYTES_MIN: Final = COUNT_BYTES
SIZE_BYTES_MAX: Final = 32 << 20
VERSIONS: Final = (1, 2)

_NAME: Final = re.compile(r"Ballast([1-9][0-9]{0,8})v([12])")


class Ballast:
    """The application; `size_bytes` is that of what `capture` returns."""

    characteristics = Characteristics()
    size_bytes = SIZE_BYTES_MIN

    def __init__(self) -> None:
        self._state = bytearray(self.size_bytes)

    def execute(self, request: bytes) -> bytes:
        """A digest of how many requests there were, and of this one."""
        count = (int.from_bytes(self._state[:COUNT_BYTES], "little") + 1) % (1 << 8 * COUNT_BYTES)
        self._state[:COUNT_BYTES] = count.to_bytes(COUNT_BYTES, "little")
        return blake2b(self._state[:COUNT_BYTES] + request, digest_size=REPLY_BYTES).digest()

    def capture(self) -> bytes:
        """The whole state."""
        return bytes(self._state)

    def restore(self, state: bytes) -> None:
        """Replace the whole state. Raises PeerError, state unchanged, on another size."""
        if len(state) != self.size_bytes:
            raise PeerError(f"state of {len(state)} bytes, expected {self.size_bytes}")
        self._state[:] = state

    def migrate(self, old_state: bytes) -> None:
        """Take the state of a version of the same size; after any other function, start with zeros."""
        self._state[:] = old_state if len(old_state) == self.size_bytes else bytes(self.size_bytes)

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        """Whether the reply has the size of one."""
        return len(reply) == REPLY_BYTES


def source_of(size_bytes: int, version: int) -> str:
    """The argument of `aftbed adapt update app --to`; the size is within the limits above."""
    assert SIZE_BYTES_MIN <= size_bytes <= SIZE_BYTES_MAX, size_bytes
    assert version in VERSIONS, version
    return f"{__name__}:Ballast{size_bytes}v{version}"


def __getattr__(name: str) -> type[Ballast]:
    """The class of a size and version, by its name (PEP 562)."""
    found = _NAME.fullmatch(name)
    size_bytes = int(found[1]) if found else 0
    if not SIZE_BYTES_MIN <= size_bytes <= SIZE_BYTES_MAX:
        raise AttributeError(
            f"{__name__} has no {name}: Ballast(BYTES)v1 or v2, {SIZE_BYTES_MIN} to {SIZE_BYTES_MAX} bytes"
        )
    return type(name, (Ballast,), {"size_bytes": size_bytes, "__module__": __name__})
