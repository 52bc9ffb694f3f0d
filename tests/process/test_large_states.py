"""A state that is larger than a packet goes the way of all states: through channels, failover, adaptation."""

from typing import Final

import pytest
from liveruns import ENDLESS, Command, Home, adapted, aftbed, under_load
from sampling import every

pytestmark = pytest.mark.process

BALLAST: Final = "aftbed.bench.ballast:{}Ballast{}v{}"
CRASH: Final = ("inject", "crash", "primary", "--at")


@pytest.mark.parametrize(
    ("ftm", "size"),
    every(2, [("pbr", 1_000_000), ("pbr", 100_000), ("lfr+tr", 300_000), ("pbr+tr", 100_000)]),
)
def test_a_large_state_is_carried(home: Home, ftm: str, size: int) -> None:
    """Into the new function, to the backup with each request, into a new leader, and to a new backup."""
    with under_load(home, ENDLESS, 250.0, ftm=ftm) as run:
        adapt("update", "app", "--to", BALLAST.format("", size, 1))
        crash = aftbed(*CRASH, "reply.sent", "--nth", "5")
        assert crash.code == 0, crash.err
        run.wait_for("roles", "backs up, epoch 2")
        run.wait_for_answers(run.answered() + 20)
        found = run.stop().verdict
    assert found.verdict == "pass", found.reasons
    assert found.requests.answered == found.requests.sent and found.requests.wrong == 0
    assert len(found.failovers) == 1


@pytest.mark.parametrize("size", [2_000_000, pytest.param(10_000_000, marks=pytest.mark.deep)])
def test_megabytes_are_updated_switched_and_taken_over(home: Home, size: int) -> None:
    """Compared by the Server, then told by a function that knows its changes."""
    with Command("--load", f"{ENDLESS}@50") as run:
        run.started()
        for epoch, function in ((2, ("", size, 1)), (3, ("Tracked", size, 2))):
            adapt("update", "app", "--to", BALLAST.format(*function))
            adapt("switch", "lfr")
            adapt("switch", "pbr")
            crash = aftbed(*CRASH, "checkpoint.sent", "--nth", "5")
            assert crash.code == 0, crash.err
            run.wait_for_line(f"backs up, epoch {epoch}")
        assert aftbed("stop").code == 0
        ended = run.done()
    assert ended.code == 0, ended.out + ended.err
    assert "0 lost, 0 duplicated" in ended.out and "0 wrong" in ended.out
    assert ended.out.count("failover   to epoch") == 2 and "verdict: pass" in ended.out


def adapt(*words: str) -> None:
    """It must be done."""
    found = adapted(*words, "--json")
    assert found.code == 0, found.out + found.err
