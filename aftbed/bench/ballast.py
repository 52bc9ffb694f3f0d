"""A protected function whose state has any size, for the sweep over it.

It computes almost nothing, and the same for each size: it counts its requests in the first bytes of its
state, and answers with a digest of the count and the request. The rest of the state is ballast, which is
captured, compared and restored with it. The name of a class has its size: `Ballast1000v2` is version 2 of
the class whose state has 1000 bytes; an update of the function brings it into a run (`source_of`). Two
versions of one size are equal: they exist to be exchanged for each other. `TrackedBallast1000v2` is the same,
and knows its changes (`core.application.KnowsChanges`).

The nodes import this module, so it imports nothing heavy. No field is declared, so the state is in no shared
memory.
"""

import re
from collections.abc import Mapping
from hashlib import blake2b
from typing import Final

from aftbed.core.application import Characteristics
from aftbed.core.errors import PeerError

COUNT_BYTES: Final = 8
REPLY_BYTES: Final = 8
SIZE_BYTES_MIN: Final = COUNT_BYTES
SIZE_BYTES_MAX: Final = 32 << 20
VERSIONS: Final = (1, 2)

_NAME: Final = re.compile(r"(Tracked)?Ballast([1-9][0-9]{0,8})v([12])")


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
        memoryview(self._state)[:] = state  # a slice of the bytearray itself would copy twice

    def migrate(self, old_state: bytes) -> None:
        """Take the state of a version of the same size; after any other function, start with zeros."""
        fits = len(old_state) == self.size_bytes
        memoryview(self._state)[:] = old_state if fits else bytes(self.size_bytes)

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        """Whether the reply has the size of one."""
        return len(reply) == REPLY_BYTES


class TrackedBallast(Ballast):
    """The same; it knows what has changed."""

    def __init__(self) -> None:
        super().__init__()
        self._counted, self._replaced = False, True  # since the last call of `changes`

    def execute(self, request: bytes) -> bytes:
        self._counted = True
        return super().execute(request)

    def restore(self, state: bytes) -> None:
        super().restore(state)
        self._replaced = True

    def migrate(self, old_state: bytes) -> None:
        super().migrate(old_state)
        self._replaced = True

    def changes(self, page_bytes: int) -> Mapping[int, bytes]:
        """The pages of the count after requests; all of them after another state."""
        changed_bytes = self.size_bytes if self._replaced else COUNT_BYTES * self._counted
        self._counted = self._replaced = False
        pages = range(-(-changed_bytes // page_bytes))
        return {n: bytes(self._state[n * page_bytes : (n + 1) * page_bytes]) for n in pages}

    def patch(self, page_bytes: int, pages: Mapping[int, bytes]) -> None:
        """Raises PeerError, state unchanged, where they are not pages of it."""
        for number, page in pages.items():
            begin = number * page_bytes
            if not 0 <= begin < self.size_bytes or len(page) != min(page_bytes, self.size_bytes - begin):
                raise PeerError(f"page {number} of {len(page)} bytes, of a state of {self.size_bytes}")
        for number, page in pages.items():
            self._state[number * page_bytes : number * page_bytes + len(page)] = page
        self._replaced = True


def source_of(size_bytes: int, version: int, *, tracked: bool = False) -> str:
    """The argument of `aftbed adapt update app --to`; the size is within the limits above."""
    assert SIZE_BYTES_MIN <= size_bytes <= SIZE_BYTES_MAX, size_bytes
    assert version in VERSIONS, version
    return f"{__name__}:{'Tracked' * tracked}Ballast{size_bytes}v{version}"


def __getattr__(name: str) -> type[Ballast]:
    """The class of a size and version, by its name (PEP 562)."""
    found = _NAME.fullmatch(name)
    size_bytes = int(found[2]) if found else 0
    if not SIZE_BYTES_MIN <= size_bytes <= SIZE_BYTES_MAX:
        raise AttributeError(
            f"{__name__} has no {name}: Ballast(BYTES)v1 or v2, {SIZE_BYTES_MIN} to {SIZE_BYTES_MAX} bytes;"
            " the same with Tracked before it"
        )
    base = TrackedBallast if found and found[1] else Ballast
    return type(name, (base,), {"size_bytes": size_bytes, "__module__": __name__})
