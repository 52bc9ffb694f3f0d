"""A state that is larger than a packet goes the way of all states: through channels, failover, adaptation."""

from typing import Final

import pytest
from liveruns import ENDLESS, Command, Home, adapted, aftbed
from sampling import every

pytestmark = pytest.mark.process

BALLAST: Final = "update app to aftbed.bench.ballast:Ballast{size}v1 at request 10"


@pytest.mark.parametrize(
    ("ftm", "size"),
    every(2, [("pbr", 1_000_000), ("pbr", 100_000), ("lfr+tr", 300_000), ("pbr+tr", 100_000)]),
)
def test_a_large_state_is_carried(ftm: str, size: int) -> None:
    """Into the new function, to the backup with each request, into a new leader, and to a new backup."""
    found = aftbed(
        *("run", "--ftm", ftm, "--load", "200@250", "--adapt", BALLAST.format(size=size)),
        *("--inject", "crash primary at reply.sent nth 150", "--json"),
    ).verdict()
    assert found.verdict == "pass", found.reasons
    assert found.requests.answered == 200 and found.requests.wrong == 0
    assert len(found.failovers) == 1


@pytest.mark.parametrize("size", [2_000_000, pytest.param(10_000_000, marks=pytest.mark.deep)])
def test_megabytes_are_updated_switched_and_taken_over(home: Home, size: int) -> None:
    """Compared by the Server, then told by a function that knows its changes."""
    with Command("--load", f"{ENDLESS}@50") as run:
        run.started()
        for epoch, function in ((2, f"Ballast{size}v1"), (3, f"TrackedBallast{size}v2")):
            adapt("update", "app", "--to", f"aftbed.bench.ballast:{function}")
            adapt("switch", "lfr")
            adapt("switch", "pbr")
            crash = aftbed("inject", "crash", "primary", "--at", "checkpoint.sent", "--nth", "5")
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
