"""What a wrong reply says, told in the words of the brakes."""

from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.application import Field
from aftbed.core.journal import Entry, EntryKind, History
from aftbed.inject.grammar import with_flipped
from aftbed.inject.model import FaultReport
from aftbed.inject.receipts import ReceiptState
from aftbed.judge.bare_server import ReferenceRun, ReplyRule
from aftbed.judge.checks import (
    REASONS_MAX,
    Check,
    Evidence,
    check_value,
    corruptions,
    wrong_replies,
)
from aftbed.judge.record import RunRecord
from aftbed.judge.reference import reference_run
from aftbed.runtime.unix.options import LoadRun, RunOptions
from aftbed.vehicle.aeb.function import default_application, sample_requests
from aftbed.vehicle.aeb.messages import AebOutput, encode_reply

FLIPPED: Final = [FaultReport("bitflip result in primary", ReceiptState.APPLIED)]
COUNT: Final = 8


def history(wrong: dict[int, bytes]) -> History:
    """`COUNT` requests with the bare server's replies, but for those of `wrong`; `b""` is a reply too."""
    bare, dialogue = default_application(), list[Entry]()
    for request_id, payload in enumerate(sample_requests(3, COUNT), 1):
        reply = bare.execute(payload)
        dialogue += [
            Entry(request_id, request_id, 0, EntryKind.SENT, payload),
            Entry(request_id, request_id, 1, EntryKind.ANSWERED, wrong.get(request_id, reply)),
        ]
    return History({}, dialogue)


def reference(history: History) -> ReferenceRun:
    return reference_run(history, default_application())


def corruptions_of(history: History) -> list[str]:
    return corruptions(history, reference(history))


def value(history: History, receipts: list[dict[str, str]]) -> Check | None:
    """The check of G4 over a run of this history and these faults."""
    options = RunOptions("", "", "", "pbr", "process", 0, LoadRun(COUNT, 0.0))
    record = RunRecord(options, history, None, tuple(receipts))
    return check_value(Evidence(record, reference(history)))


def right(request_id: int) -> bytes:
    bare = default_application()
    return [bare.execute(payload) for payload in sample_requests(3, COUNT)][request_id - 1]


def test_a_history_without_a_wrong_reply_has_no_corruption() -> None:
    assert corruptions_of(history({})) == []


def test_what_differs_is_named() -> None:
    braking = encode_reply(AebOutput(3, 9.0, 0.5, 0, 0))
    (found,) = corruptions_of(history({1: braking}))
    assert found == (
        "request 1: sdc: stage 3 instead of 0, deceleration_ms2 9.0 instead of 0.0,"
        " ttc_s 0.5 instead of None, slot 0 instead of None"
    )


@pytest.mark.parametrize(
    ("reply", "words"),
    [
        (b"", "what is no demand (empty) instead of stage 0 at 0.0 m/s2"),
        (b"\xc1", "what is no demand (c1) instead of stage 0 at 0.0 m/s2"),
    ],
)
def test_what_is_no_demand_is_named(reply: bytes, words: str) -> None:
    assert corruptions_of(history({3: reply})) == [f"request 3: sdc: {words}"]


def test_a_reply_of_a_function_of_the_user_is_told_in_its_own_fields() -> None:
    asked = [Entry(1, 1, 0, EntryKind.SENT, b""), Entry(1, 1, 1, EntryKind.ANSWERED, b"\x01\x05")]
    for fields, words in [((Field("level", "u8", 1),), "level is 5 instead of 3"), ((), "byte 1 is 0x05")]:
        bare = ReferenceRun(((1, b"\x01\x03"),), b"", rules=(ReplyRule(fields=fields),))
        (found,) = corruptions(History({}, asked), bare)
        assert found.startswith(f"request 1: sdc: the reply is wrong: {words}")
        assert found.endswith("(0105 instead of 0103)")


def test_the_same_demand_in_other_bytes_is_wrong_too() -> None:
    longer = right(3).replace(b"\x95\x00", b"\x95\xcc\x00", 1)  # the stage as an uint8 of two bytes
    (found,) = corruptions_of(history({3: longer}))
    assert found == f"request 3: sdc: the same demand in other bytes ({longer.hex()})"


def test_a_second_answer_that_is_wrong_counts() -> None:
    tale = history({})
    tale.dialogue.append(Entry(99, 3, 1, EntryKind.ANSWERED, b""))
    assert len(corruptions_of(tale)) == 1


def test_a_request_that_waits_is_not_wrong() -> None:
    tale = history({})
    assert corruptions_of(History({}, tale.dialogue[:-1])) == []


@given(st.dictionaries(st.integers(1, COUNT), st.integers(0, 8 * 12 - 1), max_size=COUNT))
def test_as_many_as_the_checker_of_one_history_counts(bits: dict[int, int]) -> None:
    tale = history({i: with_flipped(right(i), [bit]) for i, bit in bits.items()})
    found = corruptions_of(tale)
    assert [line.split(":")[0] for line in found] == [f"request {i}" for i in sorted(bits)]
    assert list(wrong_replies(tale, reference(tale))) == sorted(bits)
    check = value(tale, FLIPPED)
    assert check is not None and (check.finding == "fail") == bool(bits)
    assert len(check.reasons) == min(len(bits), REASONS_MAX)


@pytest.mark.parametrize(
    ("receipts", "finding"),
    [
        ([], None),
        ([FaultReport("crash primary", ReceiptState.APPLIED)], None),
        (FLIPPED, "pass"),
        ([FaultReport("bitflip state in b", ReceiptState.NOT_ACTIVATED)], "unknown"),
        ([FaultReport("bitflip state in b", ReceiptState.NOT_ACTIVATED), *FLIPPED], "pass"),
    ],
)
def test_no_bit_flipped_proves_nothing(receipts: list[dict[str, str]], finding: str | None) -> None:
    check = value(history({}), receipts)
    assert (check.finding if check is not None else None) == finding
