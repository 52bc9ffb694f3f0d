"""The allotment of the function's slots to a radar's objects."""

from hypothesis import given
from hypothesis import strategies as st

from aftbed.vehicle.aeb.messages import SLOTS, AebInput, AebTarget, decode_request, encode_request
from aftbed.vehicle.replay.mapped_gateway import SlotBook


def seen(*numbers: int, start_m: float = 10.0) -> dict[int, AebTarget]:
    """Objects one metre after the other, in this order."""
    return {number: AebTarget(0, start_m + place, -1.0) for place, number in enumerate(numbers)}


def slots(targets: tuple[AebTarget, ...]) -> dict[int, bool]:
    return {target.slot: target.new for target in targets}


def test_an_object_is_new_once_and_keeps_its_slot() -> None:
    book = SlotBook()
    assert slots(book.assign(seen(70, 40))) == {0: True, 1: True}
    assert slots(book.assign(seen(40, 70))) == {0: False, 1: False}
    assert book.assign(seen(40)) == (AebTarget(1, 10.0, -1.0),)


def test_an_object_that_is_missed_for_a_while_keeps_its_slot() -> None:
    book = SlotBook()
    book.assign(seen(1, 2, 3))
    for _ in range(50):
        assert slots(book.assign(seen(1, 3))) == {0: False, 2: False}
    assert slots(book.assign(seen(1, 2, 3))) == {0: False, 1: False, 2: False}


def test_what_the_radar_calls_new_is_new() -> None:
    book = SlotBook()
    book.assign(seen(1))
    assert book.assign({1: AebTarget(0, 9.0, -1.0, True)}) == (AebTarget(0, 9.0, -1.0, True),)


def test_of_more_objects_than_slots_the_nearest_have_one() -> None:
    book = SlotBook()
    found = book.assign(seen(*range(100, 100 + 3 * SLOTS)))
    assert [target.range_m for target in found] == [10.0 + place for place in range(SLOTS)]
    assert [target.slot for target in found] == list(range(SLOTS))


def test_the_object_not_seen_for_longest_gives_way() -> None:
    book = SlotBook()
    book.assign(seen(*range(SLOTS)))
    book.assign(seen(*(number for number in range(SLOTS) if number != 5)))
    found = book.assign(seen(*(number for number in range(SLOTS) if number not in (5, 9)), 99))
    assert [target.slot for target in found if target.new] == [5]
    assert slots(book.assign(seen(5)))[9] is True  # its own slot is another's, and the next to go is 9's


def test_a_nearer_object_takes_the_place_of_the_farthest() -> None:
    book = SlotBook()
    book.assign(seen(*range(SLOTS)))
    found = book.assign(seen(*range(SLOTS)) | {77: AebTarget(0, 1.0, -9.0)})
    assert [target for target in found if target.new] == [AebTarget(SLOTS - 1, 1.0, -9.0, True)]
    assert len(found) == SLOTS


numbers = st.integers(0, 255)
targets = st.builds(AebTarget, st.just(0), st.floats(0, 1000), st.floats(-150, 150), st.booleans())


@given(st.lists(st.dictionaries(numbers, targets, max_size=40), max_size=12))
def test_whatever_is_seen_makes_a_request(cycles: list[dict[int, AebTarget]]) -> None:
    book, kept = SlotBook(), dict[int, int]()
    for cycle in cycles:
        found = book.assign(cycle)
        assert decode_request(encode_request(AebInput(0, 0.0, True, True, found))).targets == found
        assert sorted(target.range_m for target in found) == sorted(t.range_m for t in cycle.values())[:SLOTS]
        slots_now = {number: slot for number, slot in book._slots.items() if number in cycle}
        assert len(set(book._slots.values())) == len(book._slots) <= SLOTS
        new = {target.slot for target in found if target.new}
        for number, slot in slots_now.items():
            assert kept.get(number) == slot or slot in new
        kept = dict(book._slots)
