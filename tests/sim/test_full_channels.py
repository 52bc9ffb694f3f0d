"""A channel without room, and a fault that is armed at it, or lifted from it, in that very moment.

The backup is stopped for a moment, under a load that does not wait: its checkpoints fill their channel, and
the leader's After waits for room. Which checkpoints the backup gets in the end is what counts.
"""

from typing import Final

import pytest

from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.inject.model import parse
from aftbed.runtime.sim.node_io import QUEUE_MAX
from aftbed.runtime.sim.world import Run, Setup, simulate

COUNT: Final = 500
HANG: Final = "hang b/after for 40ms after 5ms"  # shorter than the deadline of its Watchdog
LATE: Final = 60  # requests: the run ends before the last delayed ones come
BLOCKED: Final = "after 30ms"  # the channel is full by then


def played(*texts: str) -> Run:
    return simulate(Setup("pbr", count=COUNT, faults=tuple(map(parse, (HANG, *texts)))))


def applied(run: Run) -> list[int]:
    return [r.request_id for r in run.history.events(Event.CHECKPOINT_APPLIED) if r.node == "b/after"]


def answered(run: Run) -> int:
    return sum(e.kind is EntryKind.ANSWERED for e in run.history.dialogue)


def struck(run: Run, number: int = 1_000_002) -> list[int]:
    records = run.history.events(Event.FAULT_APPLIED)
    return [r.request_id for r in records if r.detail & 0xFFFFFFFF == number and r.request_id]


def test_the_channel_is_full_meanwhile() -> None:
    run = played()
    sent = run.history.events(Event.CHECKPOINT_SENT)
    gap = max(range(1, len(sent)), key=lambda at: sent[at].t_ns - sent[at - 1].t_ns)
    assert sent[gap].t_ns - sent[gap - 1].t_ns > 20_000_000 and gap > QUEUE_MAX
    assert applied(run) == list(range(1, COUNT + 1)) and answered(run) == COUNT


@pytest.mark.parametrize("when", [BLOCKED, "nth 2", f"nth {QUEUE_MAX + 30}"])
def test_an_omission_that_is_armed_then_loses_one_message_and_no_other(when: str) -> None:
    run = played(f"omission aft2aft {when}")
    (lost,) = struck(run)
    assert sorted(set(range(1, COUNT + 1)) - set(applied(run))) == [lost]
    assert answered(run) == COUNT and run.rest.leader == "a"


@pytest.mark.parametrize("when", [BLOCKED, f"nth {QUEUE_MAX - 2}", f"nth {QUEUE_MAX - 20} permanent"])
def test_what_is_late_is_not_lost_where_there_is_no_room_for_it(when: str) -> None:
    run = played(f"delay aft2aft by 8ms {when}")
    found = applied(run)
    assert found == list(range(1, len(found) + 1)) and len(found) > COUNT - LATE, "in order, and no gap"
    assert run.faults[1].receipt.value == "activated"
    assert answered(run) == COUNT and run.rest.leader == "a" and run.rest.why_not == ()


def test_two_faults_of_a_full_channel_lose_what_they_say() -> None:
    run = played("omission aft2aft after 30ms", f"omission aft2aft nth {QUEUE_MAX + 40}")
    lost = [*struck(run), *struck(run, 1_000_003)]
    assert len(set(lost)) == 2 and set(range(1, COUNT + 1)) - set(applied(run)) == set(lost)
