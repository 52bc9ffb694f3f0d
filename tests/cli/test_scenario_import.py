"""`aftbed scenario import`: what is printed and written, and that a bad wish writes nothing.

The command is called inside this process; see `test_bad_input`.
"""

import json
from pathlib import Path

import pytest
from playedrun import Run

from aftbed.vehicle.scenarios.library import load_scenario

FOLDER = Path(__file__).resolve().parents[1] / "vehicle" / "xosc"
LEAD_BRAKES = FOLDER / "lead_brakes.xosc"
VALUES = FOLDER / "lead_brakes_values.xosc"
SLOW_LEAD = FOLDER / "slow_lead.xosc"


@pytest.fixture(autouse=True)
def nothing_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenario files without a folder go where the command is called."""
    monkeypatch.chdir(tmp_path)


def test_what_was_taken_ignored_and_written_is_printed(told: Run, tmp_path: Path) -> None:
    out = told("scenario", "import", LEAD_BRAKES, "--expect", "stop").splitlines()
    assert out[0] == f"{LEAD_BRAKES}: OpenSCENARIO 1.2: the car ahead brakes"
    taken, ignored, written = (out.index(word) for word in ("taken", "ignored", "written"))
    assert "  line 123   SpeedAction                Lead brakes at 6 m/s2 from 1 s on" in out[taken:ignored]
    assert "  line 18    SceneGraphFile             for pictures" in out[ignored:written]
    assert out[written:] == ["written", "  lead_brakes.yaml"]
    assert load_scenario(str(tmp_path / "lead_brakes.yaml")).expect.outcome == "stop"


def test_one_document_for_many_variations(told: Run, tmp_path: Path) -> None:
    out = told("scenario", "import", LEAD_BRAKES, "--variations", VALUES, "--out", "made", "--json")
    found = json.loads(out)
    assert set(found) == {
        *("file", "version", "description", "sets", "scenarios", "taken", "ignored"),
    }
    assert found["sets"] == len(found["scenarios"]) == 6
    assert found["scenarios"][0] == {
        "name": "lead_brakes-Gap-12-Deceleration-2",
        "path": "made/lead_brakes-Gap-12-Deceleration-2.yaml",
        "parameters": {"Gap": "12", "Deceleration": "2"},
    }
    assert all(load_scenario(one["path"]).plant.lead for one in found["scenarios"])
    assert {"path", "line", "element", "reason"} == set(found["ignored"][0])
    assert {"path", "line", "element", "meaning"} == set(found["taken"][0])


def test_an_entry_of_a_catalog_says_in_which_file_it_stands(told: Run) -> None:
    out = told("scenario", "import", SLOW_LEAD, "--ego", "Host", "--replace-controller", "--duration", "9")
    assert f"({FOLDER / 'catalogs' / 'cars.xosc'})" in out
    assert "replaced by aftbed's function, as asked for" in out
    assert load_scenario("./slow_lead.yaml").duration_ms == 9000


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ([SLOW_LEAD], "which vehicle is the ego? --ego NAME says it (one of: Host, Target)"),
        ([SLOW_LEAD, "--ego", "Host"], "  line 66: ActivateControllerAction: controllers: "),
        ([LEAD_BRAKES, "--ego", "Bert"], "--ego: unknown vehicle 'Bert' (one of: Ego, Lead)"),
        ([LEAD_BRAKES, "--expect", "crash"], "--expect: unknown outcome 'crash'"),
        ([LEAD_BRAKES, "--duration", "0"], "--duration: found 0, allowed is more than 0 and at most 3600"),
        ([LEAD_BRAKES, "--variations", LEAD_BRAKES], "no ParameterValueDistribution in it"),
        ([LEAD_BRAKES, "--out", LEAD_BRAKES], "cannot be written: "),
        ([VALUES], "a distribution: import lead_brakes.xosc with --variations"),
        (["nowhere.xosc"], "nowhere.xosc: cannot be read: No such file or directory"),
    ],
)
def test_a_bad_wish_writes_nothing(
    arguments: list[str | Path], reason: str, refused: Run, tmp_path: Path
) -> None:
    assert reason in refused("scenario", "import", *arguments)
    assert not list(tmp_path.glob("*.yaml"))


def test_a_file_of_somebody_elses_stays(told: Run, refused: Run, tmp_path: Path) -> None:
    mine = tmp_path / "lead_brakes.yaml"
    mine.write_text("mine")
    assert "exists, and says something else; --force" in refused("scenario", "import", LEAD_BRAKES)
    assert mine.read_text() == "mine"
    told("scenario", "import", LEAD_BRAKES, "--force")
    assert mine.read_text() != "mine"
