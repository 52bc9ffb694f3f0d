"""Rows of the tables, and the painted drive, on real processes: what the simulator says of them is so."""

from pathlib import Path

import pytest
from liveruns import Done, aftbed
from paintedlog import WHY_NOT, painted, real_drive
from puredrive import TOYOTA_DBC, TOYOTA_LOG

from aftbed.runtime.sim.world import Setup, simulate
from aftbed.vehicle.can.candump import log_line
from aftbed.vehicle.scenarios.tables import Case, broken, cases

pytestmark = pytest.mark.process

ROWS = ("r152:m1-60", "r152:m1-laden-42", "r152:m1-moving-40", "ncap:ccrs-warning-80", "negative:cut-in-80")
CASES = [case for table in ("r152", "ncap", "negative") for case in cases(table) if case.name in ROWS]


def passed(*arguments: str | Path) -> Done:
    """A run that must pass."""
    done = aftbed("run", "--json", "--pace", "max", *arguments)
    assert done.code == 0, done.out + done.err
    return done


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_row_comes_to_the_same_on_real_processes_and_in_the_simulator(case: Case) -> None:
    """But for the millisecond that a reply takes in the simulator, at the speed at which the gap closes."""
    vehicle = passed("--scenario", case.name, "--ftm", "none", "--seed", "5").verdict().vehicle
    simulated = simulate(Setup("none", scenario=case.name, seed=5)).vehicle
    assert vehicle is not None
    assert simulated is not None
    assert broken(case, vehicle) == broken(case, simulated) == []
    assert vehicle.min_gap_m == pytest.approx(simulated.min_gap_m, abs=case.speed_kmh / 3.6 * 0.001 + 1e-6)
    assert (vehicle.warning_s, vehicle.demand_max_ms2) == (simulated.warning_s, simulated.demand_max_ms2)


@pytest.mark.skipif(not TOYOTA_LOG.is_file(), reason=WHY_NOT)
@pytest.mark.parametrize("ftm", ["none", "pbr+tr"])
def test_the_painted_drive_is_braked_for(tmp_path: Path, ftm: str) -> None:
    path = tmp_path / "painted.log"
    path.write_text("".join(log_line(entry.frame, entry.interface) for entry in painted(real_drive())))
    replay = passed("--replay", path, "--dbc", TOYOTA_DBC, "--map", "toyota", "--ftm", ftm).verdict().replay
    assert replay is not None
    played = replay["played"]
    assert isinstance(played, dict)
    assert (played["stage_max"], played["deceleration_ms2_max"], played["missing_answers"]) == (3, 9.0, 0)
