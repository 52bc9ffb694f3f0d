"""Each injector in virtual time: it bit, it healed, and its receipt says so.

The load is so light that a request which nothing disturbs has the machine to itself: so "as before" is a
bound on the latency of each reply behind the fault.
"""

from itertools import pairwise
from typing import Final

import pytest
from planting import adapted, crash_after

from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.core.messages import Goal, Scheduled
from aftbed.inject.model import parse
from aftbed.inject.receipts import ReceiptState, fault_and_bits
from aftbed.judge.checks import corruptions
from aftbed.judge.reference import reference_run
from aftbed.judge.simulated import breaches
from aftbed.runtime.sim import processes
from aftbed.runtime.sim.world import Run, Setup, World, graph_of, simulate
from aftbed.vehicle.aeb.function import default_application

COUNT: Final = 40
RATE_HZ: Final = 200.0
PERIOD_MS: Final = 1e3 / RATE_HZ
CALM_MS: Final = 0.5  # a request that nothing disturbs
BEHIND: Final = 12  # requests: the fault is long over
PLACEMENTS: Final = ("process", "replica")


def played(ftm: str, *texts: str, placement: str = "process", seed: int = 1, count: int = COUNT) -> Run:
    faults = tuple(map(parse, texts))
    for fault in faults:
        fault.check(graph_of(ftm, placement))
    return World(Setup(ftm, placement, seed, count, RATE_HZ, faults)).run()


def latencies_ms(run: Run) -> dict[int, float]:
    """Of the first reply to each request."""
    sent = {e.request_id: e.t_ns for e in run.history.dialogue if e.kind is EntryKind.SENT}
    found: dict[int, float] = {}
    for entry in run.history.dialogue:
        if entry.kind is EntryKind.ANSWERED:
            found.setdefault(entry.request_id, (entry.t_ns - sent[entry.request_id]) / 1e6)
    return found


def receipts(run: Run) -> list[str]:
    return [fault.receipt.value for fault in run.faults]


def replies_to(run: Run, request_id: int) -> list[bytes]:
    answers = (e for e in run.history.dialogue if e.kind is EntryKind.ANSWERED)
    return [e.payload for e in answers if e.request_id == request_id]


def wrong(run: Run) -> list[int]:
    """The requests with a reply that is not the bare server's."""
    return [
        int(text.split()[1].rstrip(":"))
        for text in corruptions(run.history, reference_run(run.history, default_application()))
    ]


def strikes(run: Run) -> list[int]:
    """The requests at which fault after fault was applied."""
    return [r.request_id for r in run.history.events(Event.FAULT_APPLIED) if r.request_id]


def assert_healed(run: Run, behind: int = BEHIND) -> None:
    """Each request behind the fault is answered, right and in time."""
    took = latencies_ms(run)
    assert set(took) >= set(range(behind, COUNT + 1))
    assert max(took[number] for number in range(behind, COUNT + 1)) < CALM_MS
    assert not [number for number in wrong(run) if number >= behind]


# -- slow -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("ftm", ["pbr", "lfr", "pbr+tr"])
def test_a_slow_replica_takes_longer_for_so_long(ftm: str, placement: str) -> None:
    run = played(ftm, "slow primary by 0.2ms for 20ms at request.received nth 4", placement=placement)
    took = latencies_ms(run)
    assert took[3] < CALM_MS and min(took[n] for n in (4, 5, 6)) > 5 * 0.2
    assert_healed(run)
    assert receipts(run) == ["activated"]
    assert run.rest.leader == "a" and not run.history.events(Event.WATCHDOG_SUSPECT)


def test_a_slow_node_is_not_a_hung_one() -> None:
    """A step of 400 ms is longer than any deadline of a Watchdog."""
    run = played("pbr", "slow a/server by 400ms for 300ms at server.enter nth 4")
    assert max(latencies_ms(run).values()) > 400
    assert not run.history.events(Event.WATCHDOG_SUSPECT)
    assert len(latencies_ms(run)) == COUNT and run.rest.leader == "a" and wrong(run) == []


def test_without_a_duration_it_stays_slow_until_another_takes_its_place() -> None:
    run = played(
        "pbr", "slow primary by 0.2ms at request.received nth 4", "crash primary at reply.sent nth 9"
    )
    took = latencies_ms(run)
    assert min(took[n] for n in range(4, 10)) > CALM_MS
    assert run.rest.leader == "b"
    assert_healed(run)


def test_one_that_no_step_has_felt_is_applied_and_no_more() -> None:
    run = played("pbr", "slow engine by 1ms after 20ms")
    assert receipts(run) == ["applied"]


# -- channels -------------------------------------------------------------------------------------


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("channel", ["pxy2pro", "bfr2prd", "prd2srv", "aft2pro", "pro2pxy", "pxy2clt"])
def test_a_delay_holds_one_message_back(channel: str, placement: str) -> None:
    run = played("pbr", f"delay {channel} by 3ms nth 5", placement=placement)
    took = latencies_ms(run)
    assert {n for n, ms in took.items() if ms > CALM_MS} == {5} and 3 < took[5] < 3 + CALM_MS
    assert_healed(run)
    assert receipts(run) == ["activated"] and wrong(run) == []


def test_what_comes_behind_a_delayed_message_waits_and_order_is_kept() -> None:
    run = played("pbr", f"delay clt2pxy by {2.5 * PERIOD_MS}ms nth 5")
    took = latencies_ms(run)
    assert [n for n, ms in took.items() if ms > CALM_MS] == [5, 6, 7]
    assert all(one > other for one, other in pairwise([took[5], took[6], took[7]])), "one moment for all"
    assert list(took) == sorted(took)
    assert_healed(run)


def test_a_delay_that_lasts_makes_each_message_late() -> None:
    run = played("pbr", "delay pro2pxy by 2ms nth 5 permanent")
    took = latencies_ms(run)
    assert all((ms > 2) is (n >= 5) for n, ms in took.items())
    assert max(took.values()) < 2 + CALM_MS, "held back for so long, and not for what came before it too"


def test_an_omission_loses_one_reply_and_no_other() -> None:
    run = played("pbr", "omission pxy2clt nth 5")
    assert set(range(1, COUNT + 1)) - set(latencies_ms(run)) == {5}
    assert_healed(run)
    assert receipts(run) == ["activated"]
    assert run.faults[0].detail == "a message of proxy about request 5"


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_an_omitted_checkpoint_is_made_good_by_the_next(placement: str) -> None:
    run = played("pbr", "omission aft2aft nth 5", "crash primary at reply.sent nth 9", placement=placement)
    restored = [r.request_id for r in run.history.events(Event.STATE_RESTORED)]
    assert 4 in restored and 5 not in restored and 6 in restored
    assert run.rest.leader == "b" and wrong(run) == [] and len(latencies_ms(run)) == COUNT


def test_a_duplicate_is_sent_twice() -> None:
    run = played("pbr", "duplicate pxy2pro nth 5")
    assert [r.request_id for r in run.history.events(Event.DEDUPE_HIT)] == [5]
    assert len(latencies_ms(run)) == COUNT and wrong(run) == []
    assert_healed(run)
    assert receipts(run) == ["activated"]


def test_reordered_messages_change_places() -> None:
    run = played("pbr", "reorder aft2aft by 20ms nth 5")
    restored = [r.request_id for r in run.history.events(Event.STATE_RESTORED) if r.node == "b/server"]
    assert restored[3:6] == [4, 6, 5]
    assert receipts(run) == ["activated"] and len(latencies_ms(run)) == COUNT


def test_a_message_without_a_successor_is_late_and_not_swallowed() -> None:
    run = played("pbr", "reorder pxy2pro by 3ms nth 5")
    took = latencies_ms(run)
    assert 3 < took[5] < 3 + CALM_MS
    assert receipts(run) == ["applied"] and "late at most" in run.faults[0].detail
    assert_healed(run)


@pytest.mark.parametrize(
    ("again", "hit"),
    [
        ("", {5}),
        ("permanent", set(range(5, COUNT + 1))),
        ("intermittent every 7", {5, 12, 19, 26, 33, 40}),
    ],
)
def test_a_fault_of_a_channel_comes_again(again: str, hit: set[int]) -> None:
    run = played("pbr", f"omission pxy2clt nth 5 {again}")
    assert set(range(1, COUNT + 1)) - set(latencies_ms(run)) == hit
    assert strikes(run) == sorted(hit)
    times = f", and {len(hit) - 1} more times" if len(hit) > 1 else ""
    assert run.faults[0].detail == f"a message of proxy about request 5{times}"


def test_chance_is_of_the_seed() -> None:
    lost = [strikes(played("pbr", "omission pxy2clt intermittent p 0.3", seed=seed)) for seed in (1, 1, 2)]
    assert lost[0] == lost[1] != lost[2]
    assert all(found[0] == 1 and 3 < len(found) < 25 for found in lost)


def test_a_channel_of_who_takes_over_is_disturbed_there() -> None:
    run = played("pbr", "delay aft2pro by 3ms nth 30", "crash primary at reply.sent nth 5")
    (struck, bitten) = [
        r for r in run.history.events(Event.FAULT_APPLIED) if fault_and_bits(r.detail)[0] == 1_000_001
    ]
    assert (struck.node, bitten.node) == ("b/after", "b/after")
    assert receipts(run) == ["activated", "activated"]


def test_a_lasting_fault_of_a_channel_dies_with_its_sender() -> None:
    run = played("pbr", "delay aft2pro by 2ms nth 3 permanent", "crash primary at reply.sent nth 6")
    took = latencies_ms(run)
    assert all(took[n] > 2 for n in (3, 4, 5, 6)) and run.rest.leader == "b"
    assert_healed(run)


def test_who_takes_the_place_of_a_sender_sends_on_the_same_channel_and_is_sound() -> None:
    """The Before of pbr is exchanged for that of lfr; the channel to Proceed outlives it."""
    fault = parse("delay bfr2prd by 2ms nth 3 permanent")
    to_lfr = (Scheduled(Goal(expression="lfr"), at_request=6),)
    run = World(Setup("pbr", "process", 1, COUNT, RATE_HZ, (fault,), to_lfr)).run()
    assert [a.outcome for a in run.adaptations] == ["done"] and 3 in strikes(run)
    assert max(strikes(run)) < BEHIND
    assert_healed(run)


def test_what_is_held_back_is_not_held_back_any_longer_where_the_port_leads_elsewhere() -> None:
    """The Proxy asks again what it wants answered, and that is no message of the old channel."""
    run = played("pbr", "delay pxy2pro by 50ms nth 5", "crash primary at request.sent nth 6")
    took = latencies_ms(run)
    assert PERIOD_MS < took[5] < 2 * PERIOD_MS and run.rest.leader == "b"
    assert_healed(run)


def test_a_lasting_fault_of_a_living_sender_goes_on_at_its_new_channel() -> None:
    run = played("pbr", "delay pxy2pro by 2ms nth 3 permanent", "crash primary at reply.sent nth 9")
    took = latencies_ms(run)
    assert run.rest.leader == "b" and all(ms > 2 for n, ms in took.items() if n >= 11)


# -- values ---------------------------------------------------------------------------------------


def test_a_flipped_request_is_executed_and_the_client_has_asked_for_something_else() -> None:
    run = played("pbr", "bitflip request byte 4 nth 5")
    assert wrong(run)[:1] == [5] and receipts(run) == ["activated"]
    assert strikes(run)[0] == 5 and "of the request of request 5 in a/server" in run.faults[0].detail


def test_a_request_that_one_trial_was_handed_wrong_is_outvoted() -> None:
    run = played("pbr+tr", "bitflip request byte 4 nth 9")
    assert wrong(run) == [] and receipts(run) == ["activated"]
    assert [r.request_id for r in run.history.events(Event.VOTE_COMPARED) if r.detail == 3] == [5]
    assert_healed(run)


def test_a_flipped_checkpoint_is_the_backups_and_nobody_elses() -> None:
    alone = played("pbr", "bitflip checkpoint bit 8 nth 5")
    assert wrong(alone) == [] and receipts(alone) == ["activated"]
    flip, crash = "bitflip checkpoint bit 8 nth 5", "crash primary at checkpoint.sent nth 5"
    taken_over = played("pbr", flip, crash)
    assert min(wrong(taken_over)) == 6 and receipts(taken_over) == ["activated", "activated"]


def test_the_next_checkpoint_heals_the_backup() -> None:
    run = played("pbr", "bitflip checkpoint bit 8 nth 5", "crash primary at checkpoint.sent nth 6")
    assert wrong(run) == [] and run.rest.leader == "b"
    assert_healed(run)


def test_the_bits_of_a_checkpoint_are_those_of_the_state_and_then_of_the_reply() -> None:
    crash = "crash primary at checkpoint.sent nth 5"
    size = 8 * len(default_application().capture())
    run = played("pbr", f"bitflip checkpoint bit {size + 8} nth 5", crash)
    assert wrong(run) == [5], "the new leader answers with it once, and computes with what is right"


def test_a_kept_reply_that_was_hit_is_what_is_answered_once_more() -> None:
    flip = "bitflip log bit 8 in backup at checkpoint.applied nth 5"
    run = played("pbr", flip, "crash primary at checkpoint.sent nth 5")
    assert wrong(run) == [5] and receipts(run) == ["activated", "activated"]
    unasked = played("pbr", flip)
    assert wrong(unasked) == [] and receipts(unasked) == ["applied"], "no request was repeated"
    assert_healed(unasked)


def test_a_reply_is_hit_in_the_log_and_not_on_its_way() -> None:
    run = played("pbr", "bitflip log bit 8 nth 5", "duplicate pxy2pro nth 5")
    first, *again = replies_to(run, 5)
    assert first == replies_to(played("pbr"), 5)[0] and again != [first]
    assert receipts(run) == ["activated", "activated"]
    assert [r.request_id for r in run.history.events(Event.DEDUPE_HIT)] == [5]


@pytest.mark.parametrize(
    ("pattern", "bits"), [("bits 3", 3), ("burst 5", 5), ("burst 5 bit 8", 5), ("bit 8", 1), ("", 1)]
)
def test_so_many_bits_of_a_result_are_hit(pattern: str, bits: int) -> None:
    run = played("pbr", f"bitflip result {pattern} nth 5")
    assert wrong(run) == [5]
    assert strikes(run) == [5] * bits
    found = [
        fault_and_bits(r.detail)[1] for r in run.history.events(Event.FAULT_APPLIED) if r.request_id == 5
    ]
    assert run.faults[0].detail.startswith(f"bit{'s' * (bits > 1)} {', '.join(map(str, sorted(found)))} of")
    assert_healed(run)


def test_a_byte_has_another_value() -> None:
    run = played("pbr", "bitflip result byte 1 nth 5")
    assert wrong(run) == [5]
    assert {
        fault_and_bits(r.detail)[1] // 8 for r in run.history.events(Event.FAULT_APPLIED) if r.request_id
    } == {1}


def test_a_stuck_bit_is_activated_only_where_it_changes_something() -> None:
    one, other = (played("pbr", f"bitflip result stuck 8={value} nth 5") for value in (0, 1))
    assert sorted(receipts(one) + receipts(other)) == ["activated", "not_activated"]
    assert sorted([wrong(one), wrong(other)]) == [[], [5]]


def test_a_stuck_bit_that_lasts_has_its_value_in_all_results() -> None:
    run = played("pbr", "bitflip result stuck 8=1 permanent")
    answers = [e.payload for e in run.history.dialogue if e.kind is EntryKind.ANSWERED]
    assert all(answer[1] & 1 for answer in answers) and wrong(run)
    assert receipts(run) == ["activated"]


def test_a_bit_that_lasts_hits_the_same_place_each_time_and_the_new_leader_is_sound() -> None:
    run = played("pbr", "bitflip result nth 3 permanent", "crash primary at reply.sent nth 9")
    assert wrong(run) == list(range(3, 10)) and run.rest.leader == "b"
    flips = [fault_and_bits(r.detail) for r in run.history.events(Event.FAULT_APPLIED) if r.request_id]
    assert len(flips) == 7 and len(set(flips)) == 1
    assert ", and 6 more times" in run.faults[0].detail
    assert_healed(run)


def test_a_bit_that_lasts_is_beyond_time_redundancy() -> None:
    run = played("tr", "bitflip result bit 8 nth 9 permanent")
    assert wrong(run)[:1] == [5], "the limit of TR: it is in all trials"


def test_a_state_that_is_hit_in_a_backup_and_overwritten_was_never_used() -> None:
    run = played("pbr", "bitflip state bit 8 in backup at state.restored nth 5")
    assert receipts(run) == ["applied"] and wrong(run) == []
    used = played(
        "pbr", "bitflip state bit 8 in backup at state.restored nth 5", "crash primary at reply.sent nth 5"
    )
    assert receipts(used) == ["activated", "activated"] and min(wrong(used)) == 6


# -- receipts -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "receipt"),
    [
        ("crash backup at checkpoint.applied nth 5", "activated"),
        ("crash primary after 30ms", "activated"),
        ("crash primary at reply.sent nth 1000", "armed"),
        ("hang primary for 3ms at reply.sent nth 5", "activated"),
        ("hang primary at reply.sent nth 5", "activated"),  # found, and killed
        ("bitflip result bit 500 nth 5", "not_activated"),
        ("bitflip state bit 0 nth 5", "not_activated"),  # no function takes a state of another version
        ("omission pxy2pro nth 1000", "armed"),
        ("slow primary after 1h", "armed"),
    ],
)
def test_each_fault_ends_with_a_receipt(text: str, receipt: str) -> None:
    assert receipts(played("pbr", text.replace("1h", "3600s"))) == [receipt]


# -- where the host of a fault is replaced while the fault waits


@pytest.mark.parametrize(
    "fault", ["crash proxy at request.sent nth 30", "crash proxy at reply.delivered nth 30"]
)
def test_a_fault_that_waits_in_a_client_waits_on_in_the_next_one(fault: str) -> None:
    run = played("pbr", "crash client at request.sent nth 10", fault)
    assert receipts(run) == ["activated", "activated"]


def test_a_fault_strikes_while_an_adaptation_is_observed() -> None:
    """The brick that emits its event was exchanged just before: the occurrences on both sides count.

    One may be missed, that of the request which the new brick answers before the fault has moved there.
    """
    text, nth = "crash primary at server.exit nth {}", 14
    adaptation = (Scheduled(Goal(expression="lfr"), 4),)
    run = World(Setup("pbr", "replica", 1, COUNT, RATE_HZ, (parse(text.format(nth)),), adaptation)).run()
    assert receipts(run) == ["activated"]
    (struck,) = run.history.events(Event.FAULT_APPLIED)
    first = [r for r in run.history.journals["a.1"] if r.event is Event.SERVER_EXIT]
    second = [r for r in run.history.journals["a.2"] if r.event is Event.SERVER_EXIT]
    assert first and struck.t_ns == second[-1].t_ns
    assert 0 <= len(first) + len(second) - nth <= 1
    assert [o.outcome for o in run.adaptations] == ["rolled back"]


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_fault_strikes_once_though_the_process_that_it_waited_in_serves_again(placement: str) -> None:
    """It strikes from the new Before. So the adaptation is undone, and the old one comes to the point."""
    adaptation = (Scheduled(Goal(expression="lfr"), 4),)
    faults = (parse("crash backup at before.exit nth 8"),)
    run = World(Setup("pbr", placement, 1, COUNT, RATE_HZ, faults, adaptation)).run()
    assert [o.outcome for o in run.adaptations] == ["rolled back"]
    assert receipts(run) == ["activated"]
    strikes = [r for r in run.history.events(Event.FAULT_APPLIED) if r.node == "supervisor"]
    assert len(strikes) == 1
    after = [r for r in run.history.events(Event.BEFORE_EXIT) if r.t_ns > strikes[0].t_ns]
    assert len(after) > 2 * 8


@pytest.mark.parametrize("after_ms", [13.0, 31.0, 40.0])
def test_a_death_that_is_seen_late_is_that_of_a_process_that_was_exchanged_meanwhile(
    monkeypatch: pytest.MonkeyPatch, after_ms: float
) -> None:
    """An exchange gives a process another name; its death is waited for by its pid."""
    monkeypatch.setattr(processes, "PIDFD_NS", (5_000_000, 5_000_001))
    run = simulate(adapted("pbr", "lfr", crash_after("primary", after_ms), placement="replica"))
    assert [fault.receipt for fault in run.faults] == [ReceiptState.ACTIVATED]
    assert breaches(run) == ()
