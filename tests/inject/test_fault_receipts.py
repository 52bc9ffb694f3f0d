"""What the receipts of faults say, of what nodes wrote down and of what was seen.

The rest is in `test_faults`.
"""

import pytest
from faultrun import FIRST, FakeProcess, Run, run

from aftbed.core.errors import StepFailed
from aftbed.core.events import Event
from aftbed.inject import hang
from aftbed.inject.receipts import record_detail
from aftbed.runtime import control

__all__ = ["run"]  # a fixture


@pytest.mark.parametrize(
    ("text", "event", "bits", "receipt", "detail"),
    [
        (
            "bitflip result bit 60",
            Event.FAULT_APPLIED,
            60,
            "activated",
            "bit 60 of the result of request 1 in a/server",
        ),
        (
            "bitflip state",
            Event.FAULT_APPLIED,
            9,
            "applied",
            "bit 9 of the state of request 1 in a/server",
        ),
        (
            "bitflip result bit 300",
            Event.PEER_REFUSED,
            264,
            "not_activated",
            "there are 264 bits of the result of request 1 in a/server",
        ),
        (
            "bitflip state",
            Event.PEER_REFUSED,
            0,
            "not_activated",
            "there are 0 bits of the state of request 1 in a/server",
        ),
        (
            "bitflip state bit 13",
            Event.PEER_REFUSED,
            264,
            "not_activated",
            "the function refused bit 13 of the state of request 1 in a/server",
        ),
    ],
)
def test_the_receipt_of_a_bitflip_says_what_was_hit(
    run: Run, text: str, event: Event, bits: int, receipt: str, detail: str
) -> None:
    fault = run.arm(text)
    run.happened("a/server", Event.PEER_REFUSED, 3)  # some other refusal is no word about a fault
    run.happened("a/server", event, 1, record_detail(FIRST + 1, 5))  # nor is that about another one
    run.happened("a/server", event, 1, record_detail(FIRST, bits))
    run.faults.fired(run.deployment.nodes["a/server"], FIRST)  # type: ignore[arg-type]
    assert run.reports() == [(str(fault), receipt, detail)]
    assert run.said[-1] == f"fault: {fault}: {receipt}, {detail}"


def test_a_bit_that_was_drawn_and_refused_is_named(run: Run) -> None:
    run.arm("bitflip state")
    draw = run.last_armed()[1].draw
    run.happened("a/server", Event.PEER_REFUSED, 1, record_detail(FIRST, 264))
    assert run.reports()[0][1] == "not_activated"
    assert f"bit {draw % 264} of the state" in run.reports()[0][2]


def test_a_node_that_died_with_the_word_in_its_journal_has_said_it(run: Run) -> None:
    fault = run.arm("bitflip result bit 3")
    run.happened("a/server", Event.FAULT_APPLIED, 1, record_detail(FIRST, 3))
    run.deployment.fail_over()
    told = len(run.deployment.told)
    run.do(run.faults.rearm())
    assert len(run.deployment.told) == told, "one execution was asked for"
    assert run.reports()[0] == (
        str(fault),
        "activated",
        "bit 3 of the result of request 1 in a/server",
    )


# -- what lasts, and what is slow


def test_what_has_struck_and_lasts_stays_with_its_process(run: Run) -> None:
    run.arm("bitflip result bit 3 nth 5 permanent")
    run.happened("a/server", Event.FAULT_APPLIED, 1, record_detail(FIRST, 3))
    told = len(run.deployment.told)
    run.deployment.fail_over()
    run.do(run.faults.rearm())
    run.deployment.renew(*(n for n in run.deployment.graph.nodes if n.startswith("a/")))
    run.deployment.backup = "a"
    run.do(run.faults.rearm())
    assert len(run.deployment.told) == told, "who takes the place is sound"
    assert run.reports()[0][1] == "activated"


def test_what_has_not_struck_yet_moves_though_it_will_last(run: Run) -> None:
    run.arm("bitflip result bit 3 nth 5 permanent")
    run.deployment.fail_over()
    run.do(run.faults.rearm())
    assert run.last_armed()[0] == "b/server"


def test_a_fault_of_a_channel_moves_with_its_sender_and_counts_anew(run: Run) -> None:
    run.arm("delay aft2pro nth 5")
    run.happened("a/after", Event.CHECKPOINT_SENT, 3)
    run.deployment.fail_over()
    run.do(run.faults.rearm())
    assert (run.last_armed()[0], run.last_armed()[1].nth) == ("b/after", 5)


def test_a_fault_of_a_channel_that_nobody_writes_any_more_waits(run: Run) -> None:
    run.arm("delay aft2aft nth 5 in a")
    run.deployment.leader, run.deployment.backup = "b", "a"  # b sends there now, and a lives on
    run.do(run.faults.rearm())
    assert (run.last_armed()[0], run.last_armed()[1].nth) == ("a/after", 0), "it does not wait there any more"
    assert run.reports()[0][1] == "armed"


def test_all_nodes_of_a_slow_replica_are_told_and_told_again(run: Run) -> None:
    run.arm("slow primary by 3ms for 1ms")
    nodes = run.deployment.slots["a"].nodes
    assert run.deployment.told == [(n, control.SlowDown(1, FIRST, 3_000_000)) for n in nodes]
    assert run.reports()[0][1] == "applied"
    run.deployment.told.clear()
    loop = run.deployment.runtime.loop
    loop.after(0.002, loop.end)
    loop.run()
    assert run.deployment.told == [(n, control.SlowDown(1, FIRST, 0)) for n in nodes]
    run.happened("a/after", Event.FAULT_APPLIED, 1, record_detail(FIRST))
    assert run.reports()[0][1] == "activated", "a step has felt it"


# -- when the injector itself fails


@pytest.mark.parametrize("text", ["slow primary", "omission pxy2pro", "bitflip result"])
def test_an_order_that_is_refused_is_the_injectors_failure(run: Run, text: str) -> None:
    run.deployment.refuses = True
    with pytest.raises(StepFailed):
        run.arm(text)
    (receipt,) = run.reports()
    assert receipt[1] == "inject_error" and receipt[2].endswith("no")


def test_a_process_that_will_not_stop_is_the_injectors_failure(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hang, "STOP_NS_MAX", 1_000_000)
    monkeypatch.setattr(FakeProcess, "stopped", lambda self: self.name != "a/server")
    run.arm("hang primary")
    (receipt,) = run.reports()
    assert receipt[1] == "inject_error"
    assert receipt[2] == "not seen stopped within 0.001 s: a/server"


@pytest.mark.parametrize(("thawed", "receipt"), [(True, "activated"), (False, "applied")])
def test_a_hang_is_activated_when_its_target_runs_on(run: Run, thawed: bool, receipt: str) -> None:
    run.arm("hang primary for 1ms")
    assert run.reports()[0][1] == "applied"
    for process in run.deployment.processes:
        process.thaws = thawed
    loop = run.deployment.runtime.loop
    loop.after(0.002, loop.end)
    loop.run()
    assert run.reports()[0][1] == receipt


def test_a_crash_is_activated_when_its_target_is_seen_dead(run: Run) -> None:
    run.arm("crash primary at checkpoint.sent")
    run.happened("a/after", Event.FAULT_APPLIED, 1, record_detail(FIRST))
    assert run.reports()[0][1] == "applied"
    run.deployment.nodes["a/after"].kill()
    assert run.reports()[0][1] == "activated"


def test_nobody_to_hit_is_said(run: Run) -> None:
    run.deployment.backup = ""
    fault = run.arm("crash backup")
    assert run.reports() == [(str(fault), "not_activated", "no process to hit")]
