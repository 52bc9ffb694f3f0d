"""Delta checkpoints: of a large state, only the pages that changed travel to the backup.

A checkpoint has the number of its request. The leader's Server keeps the last one that it gave to its After,
the backup's Server the last one that it restored. The next one is what differs between the two states, page
by page: it names its *base*, and the receiver must have that very base.

Nothing is acknowledged. The channel to a backup is reliable and ordered, so the backup has, or will have by
then, what was sent there before. After knows what that was (`PbrAfter.base`), and asks for the whole state
where there is nothing: with a new backup, and under a new leader. The Server gives the whole state where it
has another base, or none: when it is new, after an adaptation at its After, after its state was replaced. A
backup that lacks the base, or finds the checksum wrong, refuses the checkpoint as it does a state that is
none: it is dropped, and a new one is made.

| the state is                   | what travels                                             |
|--------------------------------|----------------------------------------------------------|
| shorter than `PAGES_MIN` pages | bytes, always whole, and nothing is kept                 |
| longer, with the base at hand  | its changed pages, unless they are more than half of all |
| longer, without the base       | the whole; the same once in `WHOLE_EVERY` checkpoints    |

What is kept is one copy of the state. A function that knows its changes (`core.application.KnowsChanges`)
needs none, and is not captured: its backup patches what it has.
"""

from collections.abc import Mapping, Sequence
from typing import Final
from zlib import crc32

import msgspec

from aftbed.core.application import STATE_BYTES_MAX, Application, KnowsChanges, knows_changes
from aftbed.core.errors import PeerError
from aftbed.core.messages import Pages, State

PAGE_BYTES: Final = 4096
PAGES_MIN: Final = 4  # of a state of which only pages travel: below that it costs more than it saves
BLOCK_PAGES: Final = 16  # compared at once: most of them are equal
WHOLE_EVERY: Final = 256  # checkpoints: what went wrong unnoticed in a backup lasts no longer

NONE: Final = 0  # the number of no checkpoint
Spans = list[tuple[int, int]]  # bytes of a state: from, to


class CheckpointBase:
    """The checkpoint that a Server gave or took last, on which the next one may be based.

    `_state`: None where the function itself knows what has changed since.
    """

    def __init__(self, page_bytes: int = PAGE_BYTES, whole_every: int = WHOLE_EVERY) -> None:
        self._page_bytes, self._whole_every = page_bytes, whole_every
        self._bytes_min = PAGES_MIN * page_bytes
        self._number = NONE
        self._state: bytes | None = None
        self._state_bytes = 0
        self._left = 0  # checkpoints that a leader gives up to the next whole one; 0 in a backup

    def forget(self) -> None:
        """The next checkpoint is whole."""
        self._number, self._state, self._left = NONE, None, 0

    def replaced(self) -> None:
        """The function's state is another one, which came in no checkpoint.

        A backup keeps its base: that was copied, and the next checkpoint replaces the state. Without a copy,
        the state itself was the base.
        """
        if self._left or self._state is None:
            self.forget()

    # -- the leader ---------------------------------------------------------------------------

    def capture(self, application: Application, number: int, base: int) -> State:
        """The state of `application` as checkpoint `number`, for a backup that has checkpoint `base`."""
        if self._left and base and base == self._number:
            if self._state is not None:
                return self._compared(application.capture(), self._state, application, number)
            if knows_changes(application):
                return self._told(application, number)
        state = application.capture()
        if self._left or len(state) >= self._bytes_min:
            return self._whole(application, number, state)
        return state  # the rule on the hot path

    def _compared(self, new: bytes, old: bytes, application: Application, number: int) -> State:
        page_bytes = self._page_bytes
        numbers = changed_pages(old, new, page_bytes)
        if self._too_many(numbers, len(new)):
            return self._whole(application, number, new)
        view = memoryview(new)
        self._state, self._state_bytes = new, len(new)
        return self._delta(numbers, [view[n * page_bytes : (n + 1) * page_bytes] for n in numbers], number)

    def _told(self, application: KnowsChanges, number: int) -> State:
        pages = application.changes(self._page_bytes)
        numbers = sorted(pages)
        if self._too_many(numbers, self._state_bytes):
            return self._whole(application, number, application.capture())
        return self._delta(numbers, [pages[n] for n in numbers], number)

    def _delta(self, numbers: list[int], pages: Sequence[bytes | memoryview], number: int) -> State:
        base, self._number = self._number, number
        self._left -= 1
        data = b"".join(pages)
        return sealed(Pages(self._state_bytes, base, self._page_bytes, tuple(numbers), data, 0))

    def _too_many(self, numbers: list[int], state_bytes: int) -> bool:
        """Whether the whole state is cheaper than these pages of it, or it has become a small one."""
        return state_bytes < self._bytes_min or 2 * len(numbers) * self._page_bytes > state_bytes

    def _whole(self, application: Application, number: int, state: bytes) -> State:
        if len(state) < self._bytes_min:
            self.forget()
            return state
        self._keep(application, number, state)
        if knows_changes(application):
            application.changes(self._page_bytes)  # those up to here are in `state`
        self._left = self._whole_every - 1
        return sealed(Pages(len(state), 0, self._page_bytes, (), state, 0))

    # -- the backup ---------------------------------------------------------------------------

    def restore(self, application: Application, number: int, state: State) -> None:
        """Have `application` take the state of checkpoint `number`. Raises PeerError, nothing changed."""
        if isinstance(state, bytes):
            application.restore(state)
            if self._number:
                self.forget()
            return
        if state.check != _check(state):
            raise PeerError(f"{len(state.data)} bytes of it do not have their checksum")
        if not state.base:
            spans(state)
            application.restore(state.data)
            self._keep(application, number, state.data)
        elif state.base != self._number:
            raise PeerError(f"it is based on checkpoint {state.base}, found is {self._number or 'none'}")
        elif self._state is not None:
            whole = patched(self._state, state)
            application.restore(whole)
            self._number, self._state = number, whole
        elif knows_changes(application):
            application.patch(state.page_bytes, pages_in(state))
            self._number = number
        else:
            raise PeerError(f"it is based on checkpoint {state.base}, of which nothing was kept")
        self._left = 0

    def _keep(self, application: Application, number: int, state: bytes) -> None:
        self._number, self._state_bytes = number, len(state)
        self._state = None if knows_changes(application) else state


# -- pages ----------------------------------------------------------------------------------------


def changed_pages(old: bytes, new: bytes, page_bytes: int) -> list[int]:
    """The pages of `new` that `old` does not have, or has otherwise; ascending."""
    common = len(new)
    if len(old) != common:  # a page that is cut in one of them counts as changed
        common = min(len(old), common) // page_bytes * page_bytes
    view, block_bytes = memoryview(old)[:common], BLOCK_PAGES * page_bytes
    found: list[int] = []
    # `bytes.startswith` compares with a part of a buffer without copying either.
    for block in range(0, common, block_bytes):
        if new.startswith(view[block : block + block_bytes], block):
            continue
        for at in range(block, min(block + block_bytes, common), page_bytes):
            if not new.startswith(view[at : at + page_bytes], at):
                found.append(at // page_bytes)
    if len(old) != len(new):
        found += range(common // page_bytes, -(-len(new) // page_bytes))
    return found


def sealed(pages: Pages) -> Pages:
    """With its checksum."""
    return msgspec.structs.replace(pages, check=_check(pages))


def _check(pages: Pages) -> int:
    head = (pages.state_bytes, pages.base, pages.page_bytes, pages.numbers)
    return crc32(pages.data, crc32(msgspec.msgpack.encode(head)))


def spans(pages: Pages) -> Spans:
    """Where each part of `data` begins and ends in the state. Raises PeerError if they are no parts of it."""
    size, page_bytes = pages.state_bytes, pages.page_bytes
    if not (0 <= size <= STATE_BYTES_MAX and page_bytes > 0):
        raise PeerError(f"pages of {page_bytes} bytes, of a state of {size}")
    found = [(n * page_bytes, min((n + 1) * page_bytes, size)) for n in pages.numbers]
    if not pages.base:
        found = [(0, size)]
    at = 0
    for begin, end in found:
        if not at <= begin < end:
            raise PeerError(f"pages {pages.numbers[:8]} of a state of {size} bytes")
        at = end
    if sum(end - begin for begin, end in found) != len(pages.data):
        raise PeerError(f"{len(pages.data)} bytes, of {len(found)} pages of a state of {size}")
    return found


def patched(old: bytes, pages: Pages) -> bytes:
    """The state that `pages` were taken from; `old` is that of their base. Raises PeerError."""
    view, data, parts, at, used = memoryview(old), memoryview(pages.data), [], 0, 0
    for begin, end in spans(pages):
        parts += [view[at:begin], data[used : used + end - begin]]
        at, used = end, used + end - begin
    new = b"".join([*parts, view[at : pages.state_bytes]])
    if len(new) != pages.state_bytes:
        raise PeerError(f"a state of {pages.state_bytes} bytes on a base of {len(old)}")
    return new


def pages_in(pages: Pages) -> Mapping[int, bytes]:
    """The pages by number. Raises PeerError."""
    used, found = 0, {}
    for number, (begin, end) in zip(pages.numbers, spans(pages), strict=True):
        found[number] = pages.data[used : used + end - begin]
        used += end - begin
    return found
