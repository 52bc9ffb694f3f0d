"""Delta checkpoints: what travels is what changed, and no backup puts it on the state of another time."""

from collections.abc import Mapping
from typing import Final

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.bench.ballast import Ballast, TrackedBallast
from aftbed.core.application import STATE_BYTES_MAX, Characteristics
from aftbed.core.errors import PeerError
from aftbed.core.messages import Pages, State
from aftbed.ftm.pages import PAGES_MIN, CheckpointBase, changed_pages, patched, sealed, spans

PAGE: Final = 16
SMALL: Final = PAGES_MIN * PAGE - 1  # bytes: one more is a large state
LARGE: Final = 20 * PAGE


class Memory:
    """A function that is nothing but its state. It refuses an empty one."""

    characteristics = Characteristics()

    def __init__(self, state: bytes = b"") -> None:
        self.state, self.captured = state, 0

    def execute(self, request: bytes) -> bytes:
        self.state = request
        return b""

    def capture(self) -> bytes:
        self.captured += 1
        return self.state

    def restore(self, state: bytes) -> None:
        if not state:
            raise PeerError("an empty state")
        self.state = state

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        return True


class Tracked(Memory):
    """The same; it knows its changes."""

    known, asked = b"", 0

    def changes(self, page_bytes: int) -> Mapping[int, bytes]:
        self.asked += 1
        numbers = changed_pages(self.known, self.state, page_bytes)
        self.known = self.state
        return {n: self.state[n * page_bytes : (n + 1) * page_bytes] for n in numbers}

    def patch(self, page_bytes: int, pages: Mapping[int, bytes]) -> None:
        state = bytearray(self.state)
        for number, page in pages.items():
            state[number * page_bytes : number * page_bytes + len(page)] = page
        self.state = bytes(state)


class Duplex:
    """A leader and its backup: each `send` is a checkpoint of the leader's state, which arrives."""

    def __init__(self, leader: Memory, backup: Memory, whole_every: int = 1000) -> None:
        self.leader, self.backup = leader, backup
        self.given, self.taken = CheckpointBase(PAGE, whole_every), CheckpointBase(PAGE)
        self.number = 0

    def capture(self) -> State:
        self.number += 1
        return self.given.capture(self.leader, self.number, self.number - 1)

    def send(self, state: bytes | None = None) -> State:
        self.leader.state = self.leader.state if state is None else state
        sent = self.capture()
        self.taken.restore(self.backup, self.number, sent)
        return sent


def duplex(state: bytes = bytes(LARGE), whole_every: int = 1000) -> Duplex:
    """With the first checkpoint in place."""
    pair = Duplex(Memory(state), Memory(), whole_every)
    pair.send()
    return pair


def with_byte(state: bytes, at: int) -> bytes:
    return state[:at] + bytes([state[at] ^ 1]) + state[at + 1 :]


def pages_of(state: State) -> Pages:
    assert isinstance(state, Pages)
    return state


# -- what travels


def test_the_first_checkpoint_is_whole_and_the_next_one_has_the_pages_that_changed() -> None:
    pair = Duplex(Memory(bytes(LARGE)), Memory())
    first = pages_of(pair.send())
    assert (first.base, first.data, first.state_bytes) == (0, bytes(LARGE), LARGE)
    changed = with_byte(with_byte(bytes(LARGE), 0), 3 * PAGE + 1)
    second = pages_of(pair.send(changed))
    assert (second.base, second.numbers, second.state_bytes) == (1, (0, 3), LARGE)
    assert second.data == changed[:PAGE] + changed[3 * PAGE : 4 * PAGE]
    assert pair.backup.state == changed


def test_where_nothing_changed_no_page_travels() -> None:
    pair = duplex()
    assert pages_of(pair.send()).data == b"" and pair.backup.state == bytes(LARGE)


def test_a_small_state_travels_as_it_is_and_nothing_is_kept() -> None:
    pair = Duplex(Memory(bytes(SMALL)), Memory())
    assert [pair.send(), pair.send()] == [bytes(SMALL), bytes(SMALL)]
    assert pages_of(pair.send(bytes(SMALL + 1))).base == 0
    assert pair.send(bytes(SMALL)) == bytes(SMALL)
    assert pages_of(pair.send(bytes(SMALL + 1))).base == 0, "what was large before counts no more"


def test_more_than_half_of_the_pages_are_not_worth_it() -> None:
    pair = duplex()
    half = b"".join(bytes([1]) + bytes(PAGE - 1) for _ in range(10)) + bytes(10 * PAGE)
    assert len(pages_of(pair.send(half)).numbers) == 10
    assert pages_of(pair.send(b"".join(bytes([2]) + bytes(PAGE - 1) for _ in range(11)) + half[11 * PAGE :]))
    assert pages_of(pair.send(bytes([3] * LARGE))).base == 0
    assert pair.backup.state == bytes([3] * LARGE)


def test_once_in_a_while_it_is_whole_again() -> None:
    pair = duplex(whole_every=3)
    assert [pages_of(pair.send()).base == 0 for _ in range(7)] == [
        False,
        False,
        True,
        False,
        False,
        True,
        False,
    ]


@given(st.integers(1, 40), st.data())
def test_changed_pages_are_those_that_differ(page_bytes: int, data: st.DataObject) -> None:
    old = data.draw(st.binary(max_size=1500))
    new = bytearray(data.draw(st.sampled_from([old, old[:-3], old + b"more", data.draw(st.binary())])))
    for at in data.draw(st.lists(st.integers(0, max(0, len(new) - 1)), max_size=4)) if new else ():
        new[at] ^= 0xFF
    pages = range(-(-len(new) // page_bytes))

    def page(state: bytes, number: int) -> bytes:
        return state[number * page_bytes : (number + 1) * page_bytes]

    wanted = {n for n in pages if page(old, n) != page(bytes(new), n)}
    found = changed_pages(old, bytes(new), page_bytes)
    assert wanted <= set(found) and found == sorted(set(found))
    assert len(old) != len(new) or wanted == set(found)


STATES: Final = st.lists(
    st.tuples(st.integers(0, 30 * PAGE), st.lists(st.integers(0, 30 * PAGE), max_size=5)), max_size=8
)


@given(STATES, st.booleans())
def test_the_backup_has_the_leaders_state_after_each_checkpoint(
    steps: list[tuple[int, list[int]]], fresh: bool
) -> None:
    pair = duplex(whole_every=4)
    for size, places in steps:
        if fresh:  # a new backup: After has sent it nothing
            pair.backup, pair.taken, pair.number = Memory(), CheckpointBase(PAGE), 0
        state = (pair.leader.state + bytes(30 * PAGE))[: size + 1]
        for at in places:
            state = with_byte(state, at % len(state))
        pair.send(state)
        assert pair.backup.state == pair.leader.state == state


# -- what a backup refuses: nothing is changed


@pytest.mark.parametrize("backup", [Memory, Tracked])
def test_a_base_that_the_backup_does_not_have_is_refused(backup: type[Memory]) -> None:
    pair = Duplex(Memory(bytes(LARGE)), backup())
    pair.send()
    pair.leader.state = with_byte(pair.leader.state, 1)
    pair.capture()  # it is lost
    pair.leader.state = with_byte(pair.leader.state, 5 * PAGE)
    sent = pair.capture()
    with pytest.raises(PeerError, match="it is based on checkpoint 2, found is 1"):
        pair.taken.restore(pair.backup, 3, sent)
    with pytest.raises(PeerError, match="it is based on checkpoint 2, found is none"):
        CheckpointBase(PAGE).restore(pair.backup, 3, sent)
    assert pair.backup.state == bytes(LARGE)


@given(st.integers(0, 8 * PAGE - 1))
def test_a_flipped_bit_does_not_have_the_checksum(bit: int) -> None:
    for pair in (duplex(), Duplex(Memory(bytes(LARGE)), Memory(b"before"))):
        before = pair.backup.state
        pair.leader.state = with_byte(pair.leader.state, 7)
        sent = pages_of(pair.capture())
        data = bytearray(sent.data)
        data[bit // 8] ^= 1 << bit % 8
        with pytest.raises(PeerError, match=f"{len(data)} bytes of it do not have their checksum"):
            pair.taken.restore(pair.backup, pair.number, msgspec.structs.replace(sent, data=bytes(data)))
        assert pair.backup.state == before


@pytest.mark.parametrize("field", ["state_bytes", "base", "page_bytes", "numbers"])
def test_the_checksum_is_that_of_all_of_it(field: str) -> None:
    pair = duplex()
    sent = pages_of(pair.send(with_byte(pair.leader.state, 7)))
    other = (1,) if field == "numbers" else getattr(sent, field) + 1
    with pytest.raises(PeerError, match="checksum"):
        pair.taken.restore(pair.backup, 3, msgspec.structs.replace(sent, **{field: other}))


numbers = st.integers(-3, 40)


@given(
    numbers, st.integers(0, 2), numbers, st.lists(numbers, max_size=4), st.binary(max_size=70), st.booleans()
)
def test_whatever_has_its_checksum_is_a_state_of_that_length_or_refused(
    size: int, base: int, page: int, pages: list[int], data: bytes, tracked: bool
) -> None:
    pair = Duplex(Memory(bytes(LARGE)), Tracked() if tracked else Memory())
    pair.send()
    try:
        pair.taken.restore(pair.backup, 2, sealed(Pages(size, base, page, tuple(pages), data, 0)))
    except PeerError:
        assert pair.backup.state == bytes(LARGE)
    else:
        assert len(pair.backup.state) == (LARGE if tracked and base else size)


def test_a_state_of_any_length_is_not_believed() -> None:
    with pytest.raises(PeerError, match="pages of 16 bytes, of a state of"):
        spans(Pages(STATE_BYTES_MAX + 1, 1, 16, (), b"", 0))
    with pytest.raises(PeerError, match="a state of 100 bytes on a base of 50"):
        patched(bytes(50), Pages(100, 1, 16, (), b"", 0))


def test_a_state_that_the_function_refuses_is_no_base() -> None:
    pair = Duplex(Memory(), Memory(b"before"))
    with pytest.raises(PeerError, match="an empty state"):
        pair.taken.restore(pair.backup, 1, b"")
    assert pair.backup.state == b"before"


# -- when the base counts no more


def test_after_an_adaptation_at_its_after_the_next_checkpoint_is_whole() -> None:
    pair = duplex()
    pair.given.forget()
    assert pages_of(pair.send()).base == 0


def test_a_replaced_state_of_the_leader_travels_whole() -> None:
    pair = duplex()
    pair.given.replaced()
    assert pages_of(pair.send(with_byte(pair.leader.state, 3))).base == 0


def test_what_was_replaced_in_the_backup_is_overwritten_by_the_next_checkpoint() -> None:
    pair = duplex()
    pair.backup.state = with_byte(pair.backup.state, 9 * PAGE)
    pair.taken.replaced()
    assert pages_of(pair.send(with_byte(pair.leader.state, 3))).base == 1
    assert pair.backup.state == pair.leader.state


def test_a_backup_that_takes_over_gives_its_first_checkpoint_whole() -> None:
    pair = duplex()
    pair.send(with_byte(pair.leader.state, 3))
    assert pages_of(pair.taken.capture(pair.backup, 3, 2)).data == pair.backup.state
    pair.taken.restore(pair.backup, 4, sealed(Pages(LARGE, 0, PAGE, (), bytes(LARGE), 0)))
    assert pages_of(pair.taken.capture(pair.backup, 5, 4)).data == bytes(LARGE), "though it led before"


# -- a function that knows its changes


@given(STATES, st.booleans(), st.booleans())
def test_the_backup_has_the_state_whichever_end_knows_its_changes(
    steps: list[tuple[int, list[int]]], leader: bool, backup: bool
) -> None:
    pair = Duplex((Tracked if leader else Memory)(bytes(LARGE)), (Tracked if backup else Memory)(), 5)
    for _, places in steps:
        state = pair.leader.state
        for at in places:
            state = with_byte(state, at % LARGE)
        pair.send(state)
        assert pair.backup.state == state


def test_it_is_captured_for_a_whole_checkpoint_only() -> None:
    pair = Duplex(Tracked(bytes(LARGE)), Tracked())
    for at in range(5):
        sent = pages_of(pair.send(with_byte(pair.leader.state, at * PAGE)))
        assert len(sent.data) == (PAGE if at else LARGE)
    assert (pair.leader.captured, pair.backup.captured) == (1, 0)


def test_a_backup_does_not_ask_for_changes() -> None:
    """Behind a whole state these would be all of it, and it gives a whole one first when it leads."""
    pair = Duplex(Tracked(bytes(LARGE)), Tracked(), 3)
    for number in range(5):
        pair.send(bytes([number]) * PAGE + bytes(LARGE - PAGE))
    assert isinstance(pair.leader, Tracked) and isinstance(pair.backup, Tracked)
    assert (pair.leader.asked, pair.backup.asked) == (5, 0)


def test_its_backup_refuses_pages_for_a_state_that_was_replaced() -> None:
    pair = Duplex(Tracked(bytes(LARGE)), Tracked())
    pair.send()
    pair.taken.replaced()
    with pytest.raises(PeerError, match="it is based on checkpoint 1, found is none"):
        pair.send(with_byte(pair.leader.state, 3))


def test_pages_for_a_function_that_knows_no_changes_any_more_are_refused() -> None:
    pair = Duplex(Tracked(bytes(LARGE)), Tracked())
    pair.send()
    sent = pair.capture()
    with pytest.raises(PeerError, match="checkpoint 1, of which nothing was kept"):
        pair.taken.restore(Memory(bytes(LARGE)), 2, sent)


Call = tuple[str, bytes]
CALLS: Final = st.lists(
    st.tuples(st.sampled_from(["execute", "restore", "checkpoint"]), st.binary(min_size=1, max_size=8)),
    max_size=12,
)


@given(CALLS)
def test_tracked_ballast_is_plain_ballast(calls: list[Call]) -> None:
    """The differential test of the optional methods: another pair of plain ones has the same dialogue."""
    size = LARGE + 3

    def ballast(base: type[Ballast]) -> Ballast:
        return type("Sized", (base,), {"size_bytes": size})()

    leaders, backups = ([ballast(Ballast), ballast(TrackedBallast)] for _ in range(2))
    given, taken = ([CheckpointBase(PAGE), CheckpointBase(PAGE)] for _ in range(2))
    for number, (call, data) in enumerate(calls, 1):
        for at, leader in enumerate(leaders):
            if call == "execute":
                leader.execute(data)
            elif call == "restore":
                leader.restore((data * size)[:size])
            sent = given[at].capture(leader, number, number - 1)
            taken[at].restore(backups[at], number, sent)
        states = {function.capture() for function in (*leaders, *backups)}
        assert len(states) == 1, call


@pytest.mark.parametrize("pages", [{-1: bytes(PAGE)}, {21: bytes(PAGE)}, {0: b"short"}, {20: bytes(PAGE)}])
def test_ballast_refuses_pages_that_it_does_not_have(pages: dict[int, bytes]) -> None:
    function = type("Sized", (TrackedBallast,), {"size_bytes": LARGE + 3})()
    before = function.capture()
    with pytest.raises(PeerError, match=r"page -?[0-9]+ of [0-9]+ bytes, of a state of 323"):
        function.patch(PAGE, {1: bytes([1] * PAGE), **pages})
    assert function.capture() == before
