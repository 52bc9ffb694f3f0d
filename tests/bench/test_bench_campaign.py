"""`aftbed bench campaign`: what it counts are experiments that came to their verdict."""

import json
from typing import Final

import pytest
from liveruns import Home, aftbed

pytestmark = pytest.mark.process

PROCESSES: Final = {("--jobs", "1"): 17, ("--placement", "replica"): 9}  # the nodes and the supervisor


@pytest.mark.parametrize("options", [("--placement", "replica"), ("--sim",)])
def test_every_experiment_is_carried_out(home: Home, options: tuple[str, ...]) -> None:
    done = aftbed("bench", "campaign", "--experiments", "4", "--rounds", "2", *options, "--json")
    assert done.code == 0, done.err
    found = json.loads(done.out)
    inconclusive = found["outcomes"].pop("inconclusive", 0)
    assert inconclusive <= found["noisy"], "only where the machine was too busy for times to mean anything"
    assert found["outcomes"].pop("tolerated", 0) == found["experiments"] - inconclusive == 4 - inconclusive
    assert found["outcomes"] == {}
    assert found["cpu_ms"] > 0 and found["per_minute"] > 0
    assert found["ratio"]["rounds"] == 2 and found["ratio"]["p50"]["median"] > 0
    bare = "its requests, bare" if "--sim" in options else f"fork and wait of {PROCESSES[options]} processes"
    assert found["limit"]["name"] == bare
    assert found["runtime"] == ("sim" if "--sim" in options else "unix")


def test_an_unknown_placement_is_refused(home: Home) -> None:
    done = aftbed("bench", "campaign", "--placement", "nowhere")
    assert done.code == 2
    assert "system.placements[0]: unknown name 'nowhere'" in done.err
