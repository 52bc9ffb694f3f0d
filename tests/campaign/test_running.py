"""A campaign, run in the simulator: the same however it is cut up, and ended when enough is known."""

from pathlib import Path

import pytest
from campaigns import CRASHES, planned, ran

from aftbed.campaign import ledger, runner
from aftbed.core.errors import ConfigError

pytestmark = pytest.mark.simulation


def told(found: ledger.Ledger) -> list[tuple[object, ...]]:
    return [(r.experiment, r.outcome, r.faults, r.recovery_ms) for r in found.results]


def test_the_same_seed_gives_the_same_outcomes_over_any_number_of_jobs(tmp_path: Path) -> None:
    found = planned(tmp_path)
    first, second = ran(found, tmp_path / "a"), ran(found, tmp_path / "b", jobs=2)
    assert told(first) == told(second) and len(first.results) == 20
    assert {r.outcome for r in first.results} == {"masked", "tolerated"}
    assert not any(r.unexpected for r in first.results) and all(r.activated for r in first.results)


@pytest.mark.parametrize("cut", [1, 7, 19])
def test_resume_does_what_is_missing_and_nothing_twice(tmp_path: Path, cut: int) -> None:
    found = planned(tmp_path)
    whole = ran(found, tmp_path / "whole")
    path = tmp_path / "out" / ledger.NAME
    path.parent.mkdir()
    lines = (tmp_path / "whole" / ledger.NAME).read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[: 1 + cut]) + lines[1 + cut][:10])  # torn
    resumed = ran(found, tmp_path / "out", resume=True)
    assert told(resumed) == told(whole)


def test_a_wrong_expectation_ends_it_where_the_first_failure_is_to(tmp_path: Path) -> None:
    text = CRASHES.replace("[tolerated]", "[masked]")
    text = text.replace("stop: {experiments: 4}", "stop: {experiments: 4, first_failure: true}")
    found = ran(planned(tmp_path, text), tmp_path / "out")
    assert len(found.results) == 1 and found.results[0].unexpected


def test_better_than_expected_is_unexpected_too(tmp_path: Path) -> None:
    """An oracle that never sees anything would agree with every mechanism."""
    found = ran(planned(tmp_path, CRASHES.replace("[tolerated]", "[unavailable]")), tmp_path / "out")
    crashes = [r for r in found.results if r.experiment.faults]
    assert all(r.unexpected and r.outcome == "tolerated" for r in crashes)


def test_a_stratum_that_is_known_well_enough_is_left(tmp_path: Path) -> None:
    stop = "stop: {experiments: 20, looks: 4, half_width: 0.15}"
    found = ran(planned(tmp_path, CRASHES.replace("stop: {experiments: 4}", stop)), tmp_path / "out")
    assert len(found.results) == 5 * 15, "0 of 15 are narrow enough, 0 of 10 are not"


def test_a_shard_cannot_stop_by_what_it_does_not_see(tmp_path: Path) -> None:
    text = CRASHES.replace("stop: {experiments: 4}", "stop: {experiments: 4, half_width: 0.1}")
    with pytest.raises(ConfigError, match=r"--shard: stop\.half_width looks at all results"):
        runner.run(planned(tmp_path, text), runner.CampaignRunOptions(tmp_path / "out", shard=1, shards=2))
    assert not (tmp_path / "out").exists()


def test_a_result_is_in_the_ledger_before_it_is_told(tmp_path: Path) -> None:
    out = tmp_path / "out"
    results = runner.run(planned(tmp_path), runner.CampaignRunOptions(out))
    first = next(results)
    assert [r.experiment for r in ledger.read(out / ledger.NAME).results] == [first.experiment]
    results.close()
