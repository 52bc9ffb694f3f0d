"""Each injector on real processes: it bit, it healed, and its receipt says so. The matrix is simulated."""

import itertools
from statistics import median
from typing import Final

import pytest
from liveruns import ENDLESS, Home, Outcome, Started, adapted, aftbed, under_load

from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.inject.model import parse
from aftbed.inject.receipts import fault_and_bits
from aftbed.runtime.unix.options import LoadRun

pytestmark = pytest.mark.process

CAUTIOUS: Final = "aftbed.vehicle.aeb.variants:Cautious"
COUNT: Final = 240
RATE_HZ: Final = 50.0
BEHIND: Final = 60  # requests: each fault here is over by then, or strikes a few of those behind it
CLASS: Final = 4.0  # by how much medians of the same class differ at most, on a machine that others use too


def ran(home: Home, ftm: str, *texts: str, placement: str = "process") -> Outcome:
    """In a closed loop: if the machine holds up a request, none queues behind it, and it is one of many."""
    faults = tuple(map(parse, texts))
    with Started(home, LoadRun(COUNT, 0.0), ftm=ftm, placement=placement, faults=faults) as run:
        return run.finish()


def latencies_ms(outcome: Outcome) -> dict[int, float]:
    """Of the first reply to each request."""
    dialogue = outcome.record.history.dialogue
    sent = {e.request_id: e.t_ns for e in dialogue if e.kind is EntryKind.SENT}
    found: dict[int, float] = {}
    for entry in dialogue:
        if entry.kind is EntryKind.ANSWERED:
            found.setdefault(entry.request_id, (entry.t_ns - sent[entry.request_id]) / 1e6)
    return found


def receipts(outcome: Outcome) -> list[str]:
    return [fault.receipt.value for fault in outcome.verdict.faults]


def struck(outcome: Outcome) -> list[int]:
    return [r.request_id for r in outcome.record.history.events(Event.FAULT_APPLIED) if r.request_id]


def assert_healed(outcome: Outcome, until: int) -> None:
    """Behind the fault all are answered, and as soon as before it, which was up to request `until`."""
    took = latencies_ms(outcome)
    assert set(range(BEHIND, COUNT + 1)) <= set(took)
    before = median(took[n] for n in range(1, until))
    after = median(took[n] for n in range(BEHIND, COUNT + 1))
    assert after < CLASS * before, (before, after)


@pytest.mark.parametrize("placement", ["process", "replica"])
def test_a_slow_replica_takes_longer_for_so_long(home: Home, placement: str) -> None:
    fault = "slow primary by 1ms for 200ms at request.received nth 10"
    outcome = ran(home, "pbr", fault, placement=placement)
    took = latencies_ms(outcome)
    ended_ms = itertools.accumulate(took[n] for n in range(10, COUNT + 1))  # since the request with the fault
    held = [took[n] for n, t_ms in zip(range(10, COUNT + 1), ended_ms, strict=True) if n == 10 or t_ms < 200]
    assert min(held) > 5.0, "five bricks, some of them more than once"
    assert_healed(outcome, 10)
    assert receipts(outcome) == ["activated"]
    assert outcome.verdict.verdict == "pass" and outcome.verdict.failovers == []


def test_a_slow_node_is_not_a_hung_one(home: Home) -> None:
    """One step takes longer than any deadline of a Watchdog."""
    outcome = ran(home, "pbr", "slow a/server by 400ms for 300ms at server.enter nth 10")
    assert max(latencies_ms(outcome).values()) > 400
    assert outcome.verdict.failovers == [] and outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert not outcome.record.history.events(Event.WATCHDOG_SUSPECT)


@pytest.mark.parametrize(
    ("channel", "placement"),
    [("clt2pxy", "process"), ("pxy2pro", "process"), ("bfr2prd", "replica"), ("pro2pxy", "replica")],
)
def test_a_delay_holds_back_what_is_sent(home: Home, channel: str, placement: str) -> None:
    """Of the last request as well, behind which no message comes that would wake its sender."""
    delayed = (10, 50, 90, 130, 170, 210, COUNT)
    outcome = ran(
        home, "pbr", *(f"delay {channel} by 12ms nth {nth}" for nth in delayed), placement=placement
    )
    took = latencies_ms(outcome)
    assert set(delayed) <= set(took), "a process that is stuck in a read waits for ever"
    held = [took[nth] for nth in delayed]
    assert min(held) > 12 and median(held) < 32, held
    assert_healed(outcome, 10)
    assert receipts(outcome) == ["activated"] * len(delayed)
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons


def test_an_omission_loses_one_reply_and_no_other(home: Home) -> None:
    """A load waits for a lost reply for ever: so it sends at a rate, and is told to stop."""
    fault = parse("omission pxy2clt nth 10")
    with Started(home, LoadRun(COUNT, RATE_HZ), faults=(fault,)) as run:
        run.wait_for_answers(COUNT - 1)
        outcome = run.stop()
    assert set(range(1, COUNT + 1)) - set(latencies_ms(outcome)) == {10}
    assert_healed(outcome, 10)
    assert receipts(outcome) == ["activated"]
    assert outcome.verdict.requests.lost == 1 and outcome.verdict.verdict == "fail"


def test_a_duplicate_is_answered_out_of_the_log(home: Home) -> None:
    outcome = ran(home, "pbr", "duplicate pxy2pro nth 10")
    assert [r.request_id for r in outcome.record.history.events(Event.DEDUPE_HIT)] == [10]
    assert_healed(outcome, 10)
    assert receipts(outcome) == ["activated"] and outcome.verdict.requests.wrong == 0


def test_reordered_messages_change_places(home: Home) -> None:
    outcome = ran(home, "pbr", "reorder aft2aft nth 10 by 100ms")
    restored = [r.request_id for r in outcome.record.history.events(Event.STATE_RESTORED)]
    at = restored.index(10)
    assert restored[at - 2 : at + 1] == [9, 11, 10]
    assert receipts(outcome) == ["activated"]
    assert_healed(outcome, 10)


def test_a_fault_of_a_channel_comes_again_and_dies_with_its_sender(home: Home) -> None:
    crash = "crash primary at reply.sent nth 20"
    outcome = ran(home, "pbr", "delay aft2pro by 5ms nth 5 intermittent every 5", crash)
    took = latencies_ms(outcome)
    assert [n for n in range(1, 20) if took[n] > 5.0][:3] == [5, 10, 15] or min(took[5], took[10]) > 5.0
    assert set(struck(outcome)) == {5, 10, 15, 20}, "the After of the new leader is sound"
    assert_healed(outcome, 5)
    assert receipts(outcome) == ["activated", "activated"]


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("bitflip request byte 4 nth 10", 1),
        ("bitflip result bits 3 nth 10", 1),
        ("bitflip result burst 6 bit 8 nth 10 intermittent every 10", COUNT // 10),
        ("bitflip checkpoint bit 8 nth 10", 0),
    ],
)
def test_a_value_that_was_hit(home: Home, text: str, wrong: int) -> None:
    outcome = ran(home, "pbr", text)
    assert receipts(outcome) == ["activated"], outcome.verdict.faults
    assert outcome.verdict.requests.wrong >= wrong and (outcome.verdict.requests.wrong == 0) is (wrong == 0)
    assert struck(outcome)[0] == 10 and len(set(struck(outcome))) == max(1, wrong)
    assert outcome.verdict.requests.answered == COUNT
    assert_healed(outcome, 10)


def test_a_bit_that_lasts_is_of_the_process_that_it_hit(home: Home) -> None:
    crash = "crash primary at reply.sent nth 20"
    outcome = ran(home, "pbr", "bitflip result nth 5 permanent", crash)
    assert struck(outcome) == list(range(5, 21)) and outcome.verdict.requests.wrong == 16
    bits = [
        fault_and_bits(r.detail) for r in outcome.record.history.events(Event.FAULT_APPLIED) if r.request_id
    ]
    assert len(set(bits)) == 1
    assert receipts(outcome) == ["activated", "activated"] and len(outcome.verdict.failovers) == 1
    assert_healed(outcome, 5)


def test_a_kept_reply_that_was_hit_is_answered_once_more(home: Home) -> None:
    flip, crash = (
        "bitflip log bit 8 in backup at checkpoint.applied nth 10",
        "crash primary at checkpoint.sent nth 10",
    )
    outcome = ran(home, "pbr", flip, crash)
    assert receipts(outcome) == ["activated", "activated"], outcome.verdict.faults
    assert outcome.verdict.requests.wrong == 1


# -- from a second terminal


def test_a_live_run_is_struck_from_a_second_command(home: Home) -> None:
    faults = {
        "slow a/server by 1ms for 50ms": ("slow", "a/server", "--by", "1ms", "--for", "50ms"),
        "delay pxy2pro by 5ms in primary nth 3": ("delay", "pxy2pro", "--by", "5ms", "--nth", "3"),
        "omission aft2aft in primary nth 1 intermittent every 20": ("omission", "aft2aft", "--every", "20"),
        "duplicate pxy2pro in primary nth 1": ("duplicate", "pxy2pro"),
        "reorder pxy2clt by 4ms in primary nth 1": ("reorder", "pxy2clt", "--by", "4ms"),
    }
    with under_load(home, ENDLESS) as run:
        for fault, arguments in faults.items():
            done = aftbed("inject", *arguments)
            assert done.code == 0 and f": {fault}" in done.err, done.err
        run.wait_for_answers(run.answered() + 100)
        outcome = run.stop()
    assert [report.fault for report in outcome.verdict.faults] == list(faults)
    assert set(receipts(outcome)) <= {"activated", "applied"}
    assert outcome.verdict.requests.lost == 0


def test_what_cannot_be_is_refused(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        for arguments, words in (
            (("slow", "hub"), "unknown target 'hub'"),
            (("slow", "primary", "--by", "1s"), "a step can be slower by 500ms at most"),
            (("omission", "pxy2prro"), "unknown channel 'pxy2prro'; did you mean 'pxy2pro'?"),
            (("delay", "aft2aft", "--replica", "backup"), "backup sends nothing on aft2aft"),
            (("bitflip", "log", "--stuck", "3"), "stuck '3': a bit and its value are allowed"),
            (("bitflip", "result", "--permanent", "--every", "3"), "one of them is allowed"),
            (("bitflip", "checkpoint", "--replica", "backup"), "backup has none"),
        ):
            done = aftbed("inject", *arguments)
            assert done.code == 2 and words in done.err, done.err
        assert run.stop().verdict.verdict == "pass"


def test_a_live_fault_that_the_function_refuses_is_none_of_the_run(home: Home) -> None:
    """Only the node knows its fields. The refused fault had a number; the next fault is told by its own."""
    with under_load(home, ENDLESS) as run:
        done = adapted("update", "app", "--to", CAUTIOUS)
        assert done.code == 0, done.err
        done = aftbed("inject", "bitflip", "state.speed_limit")
        assert done.code == 2 and "speed_limit" in done.err, done.err
        assert aftbed("inject", "crash", "primary").code == 0
        run.wait_for("script.done", "new backup")
        verdict = run.stop().verdict
    assert (verdict.verdict, [fault.fault for fault in verdict.faults]) == ("pass", ["crash primary"])
    assert [found.fault for found in verdict.failovers] == ["crash primary"]
    assert [found.fault for found in verdict.intervals if found.of_fault] == ["crash primary"]
