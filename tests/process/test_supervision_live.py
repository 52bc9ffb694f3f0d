"""What only supervision sees, on real processes: the replica stops, and the other one takes its place."""

import pytest
from liveruns import Home, Started

from aftbed.core.events import Event
from aftbed.inject.model import parse
from aftbed.runtime.unix.options import LoadRun

pytestmark = pytest.mark.process


@pytest.mark.parametrize(
    ("ftm", "placement", "fault"),
    [
        ("pbr+sup", "process", "omission prd2srv nth 10"),
        ("lfr+sup", "replica", "duplicate srv2prd nth 10"),
        ("pbr+sup+tr", "process", "duplicate bfr2prd nth 10"),
        ("pbr+sup", "replica", "slow primary by 20ms at server.enter nth 10"),
    ],
)
def test_a_step_that_is_skipped_doubled_or_late(home: Home, ftm: str, placement: str, fault: str) -> None:
    load = LoadRun(60, 200.0)
    with Started(home, load, ftm=ftm, placement=placement, faults=(parse(fault),)) as run:
        outcome = run.finish()
    assert outcome.verdict.verdict == "pass", (outcome.verdict.reasons, outcome.events)
    assert outcome.record.history.events(Event.DETECTED_STOP) and outcome.verdict.failovers
    requests = outcome.verdict.requests
    assert (requests.answered, requests.wrong) == (60, 0)
