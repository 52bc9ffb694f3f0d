"""A state that is larger than a packet goes the way of all states: through channels, failover, adaptation."""

import pytest
from liveruns import aftbed
from sampling import every

pytestmark = pytest.mark.process

BALLAST = "update app to aftbed.bench.ballast:Ballast{size}v1 at request 10"


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
