"""A share of a CPU, in virtual time: each step takes so many times as long, for so long."""

from typing import Final

import pytest

from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.inject.model import parse
from aftbed.runtime.sim.node_io import STEP_NS
from aftbed.runtime.sim.world import Run, Setup, World

COUNT: Final = 40
RATE_HZ: Final = 200.0
FROM: Final = 4  # the first request that feels it
STEPS: Final = 9  # of the primary, from the request to the reply


def played(*texts: str, placement: str = "process") -> Run:
    return World(Setup("pbr", placement, 1, COUNT, RATE_HZ, tuple(map(parse, texts)))).run()


def latencies_ns(run: Run) -> dict[int, int]:
    sent = {e.request_id: e.t_ns for e in run.history.dialogue if e.kind is EntryKind.SENT}
    answered = [e for e in run.history.dialogue if e.kind is EntryKind.ANSWERED]
    return {e.request_id: e.t_ns - sent[e.request_id] for e in answered}


@pytest.mark.parametrize("placement", ["process", "replica"])
@pytest.mark.parametrize(("share", "times"), [("50%", 2), ("25%", 4), ("5%", 20)])
def test_each_step_takes_so_many_times_as_long_and_then_no_longer(
    share: str, times: int, placement: str
) -> None:
    run = played(f"slow primary share {share} for 20ms at request.received nth {FROM}", placement=placement)
    took, calm = latencies_ns(run), latencies_ns(played(placement=placement))
    longer = took[FROM + 1] - calm[FROM + 1]
    assert longer == pytest.approx(STEPS * (times - 1) * STEP_NS, abs=5 * STEP_NS)
    assert [fault.receipt.value for fault in run.faults] == ["activated"]
    assert len(took) == COUNT and max(took[n] for n in range(12, COUNT + 1)) < 500_000, "it healed"
    assert not run.history.events(Event.WATCHDOG_SUSPECT)


def test_two_shares_of_one_node_are_a_share_of_a_share() -> None:
    half, both = (
        latencies_ns(played(*["slow a/server share 50% at server.enter nth 4"] * times)) for times in (1, 2)
    )
    assert both[9] - half[9] == pytest.approx(2 * (half[9] - half[2]), abs=4 * STEP_NS)


def test_without_a_step_there_is_no_share_to_feel() -> None:
    (fault,) = played("slow engine share 10% after 20ms").faults
    assert fault.receipt.value == "applied"
