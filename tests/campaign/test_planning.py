"""The plan: the same for the same file and seed, and nothing else has a part in it."""

from pathlib import Path

import pytest
from campaigns import CRASHES, planned

from aftbed.campaign.plan import population


def test_strata_take_turns_through_their_matrices(tmp_path: Path) -> None:
    found = planned(tmp_path)
    names = [s.name for s in found.strata]
    assert names == ["pbr · crash", "pbr · nothing", "lfr · crash", "lfr · nothing", "none · nothing"]
    experiments = list(found.experiments())
    assert [e.index for e in experiments] == list(range(found.size)) == list(range(20))
    assert [e.stratum for e in experiments[:5]] == names
    events = [e.faults[0].split()[3] for e in experiments if e.stratum == names[0]]
    assert events == ["server.exit", "reply.sent", "server.exit", "reply.sent"]


def test_a_stratum_that_is_left_out_is_not_there_and_the_others_are_as_they_were(tmp_path: Path) -> None:
    whole = planned(tmp_path)
    less = planned(tmp_path, CRASHES.replace("stop:", "leave_out: ['lfr · *']\nstop:"))
    names = [stratum.name for stratum in whole.strata if not stratum.name.startswith("lfr · ")]
    assert [stratum.name for stratum in less.strata] == names != []
    seeds = {(e.stratum, e.number): (e.seed, e.faults) for e in whole.experiments()}
    assert all(seeds[e.stratum, e.number] == (e.seed, e.faults) for e in less.experiments())


def test_the_same_file_gives_the_same_plan(tmp_path: Path) -> None:
    assert list(planned(tmp_path).experiments()) == list(planned(tmp_path).experiments())


@pytest.mark.parametrize("change", [("seed: 3", "seed: 4"), ("requests: 30", "requests: 31")])
def test_another_file_gives_other_ids(tmp_path: Path, change: tuple[str, str]) -> None:
    first, other = planned(tmp_path), planned(tmp_path, CRASHES.replace(*change))
    assert first.digest != other.digest
    assert not {e.id for e in first.experiments()} & {e.id for e in other.experiments()}


TOWN = """
description: a standing car
duration_s: 8
ego: {speed_kmh: 30}
lead: {ttc_s: 3.0, speed_kmh: 0}
expect: {outcome: stop}
"""


def test_another_scenario_in_the_same_file_is_another_campaign(tmp_path: Path) -> None:
    town = tmp_path / "town.yaml"
    text = CRASHES.replace("requests: 30, ", f"scenario: {town}, ")
    digests = set()
    for scenario in (TOWN, TOWN, TOWN.replace("3.0", "3.5")):
        town.write_text(scenario)
        digests.add(planned(tmp_path, text).digest)
    assert len(digests) == 2


def test_more_experiments_leave_the_first_as_they_were(tmp_path: Path) -> None:
    """What is drawn depends on the stratum and the number alone."""
    few, many = planned(tmp_path), planned(tmp_path, CRASHES.replace("experiments: 4", "experiments: 9"))
    drawn = {(e.stratum, e.number): (e.seed, e.faults) for e in many.experiments()}
    assert all(drawn[e.stratum, e.number] == (e.seed, e.faults) for e in few.experiments())


def test_what_is_drawn_covers_its_limits(tmp_path: Path) -> None:
    found = planned(tmp_path, CRASHES.replace("experiments: 4", "experiments: 400"))
    drawn = {int(e.faults[0].split()[-1]) for e in found.experiments() if e.faults}
    assert drawn == set(range(1, 26))


def test_the_fault_space_of_a_stratum_is_counted(tmp_path: Path) -> None:
    found = planned(tmp_path)
    assert [population(s.fault) for s in found.strata] == [50, 1, 50, 1, 1]


def test_a_command_repeats_an_experiment(tmp_path: Path) -> None:
    experiment = next(planned(tmp_path).experiments())
    fault = experiment.faults[0]
    assert experiment.command() == (
        f"aftbed sim --ftm pbr --placement process --seed {experiment.seed} --count 30 --inject '{fault}'"
    )
