"""The states with which a run ends are those behind its last request, of a replica that is late too."""

import pytest
from liveruns import Home, Started

from aftbed.inject.words import parse
from aftbed.runtime.unix.options import LoadRun

pytestmark = pytest.mark.process

COUNT = 30


def test_a_follower_that_is_behind_is_waited_for(home: Home) -> None:
    """Its last requests take it a tenth of a second, the leader has answered long before."""
    fault = parse(f"slow backup by 20ms at server.exit nth {COUNT - 2}")
    outcome = Started(home, LoadRun(COUNT, 200.0), ftm="lfr", faults=(fault,)).finish()
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert outcome.verdict.faults[0]["receipt"] in ("applied", "activated")
    assert outcome.record.end is not None
    states = outcome.record.end["states"]
    assert isinstance(states, dict) and set(states) == {"a", "b"}
    assert states["a"] == states["b"]
