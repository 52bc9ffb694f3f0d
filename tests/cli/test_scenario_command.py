"""`aftbed scenario`: list, show, tables with their exit codes and documents, import, and what is refused."""

import json
import shutil
from functools import partial
from pathlib import Path

import pytest
from fakerun import Call, Output

from aftbed.cli.scenario_table import TableArguments, table_drive
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault, FaultAction
from aftbed.search.worst_instant import ANCHOR, Course, Worst, strike
from aftbed.vehicle.scenarios.library import load_scenario, scenario_names
from aftbed.vehicle.scenarios.tables import table_names

pytestmark = pytest.mark.simulation

FOLDER = Path(__file__).resolve().parents[1] / "interop" / "xosc"
LEAD_BRAKES = FOLDER / "lead_brakes.xosc"
VALUES = FOLDER / "lead_brakes_values.xosc"
SLOW_LEAD = FOLDER / "slow_lead.xosc"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The working directory of the command: `scenario import` writes there by default."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def table(call: Call) -> Call:
    """Call `aftbed scenario table` with one process that simulates."""

    def aftbed(*arguments: str | Path) -> tuple[int, str, str]:
        return call("scenario", "table", *arguments, "--jobs", "1")

    return aftbed


def test_the_list_has_every_scenario_and_every_table(output: Output) -> None:
    found = json.loads(output("scenario", "list", "--json"))
    assert list(found["scenarios"]) == scenario_names()
    assert [one["table"] for one in found["tables"]] == table_names()
    lines = output("scenario", "list").splitlines()
    assert any(line.split()[:3] == ["m1", "9", "rows"] for line in lines)


def test_a_row_is_shown_with_what_its_table_demands(output: Output) -> None:
    out = output("scenario", "show", "r152:m1-60")
    assert out.startswith("r152:m1-60: ")
    assert "impact at 35 km/h at most, a warning 0.8 s before braking, a demand of 5 m/s2 at least" in out
    found = json.loads(output("scenario", "show", "r152:m1-60", "--json"))
    assert found["row"]["limit_kmh"] == 35
    assert found["scenario"]["plant"]["speed_ms"] == pytest.approx(60 / 3.6)


def test_a_scenario_of_no_table_is_shown_without_a_row(output: Output) -> None:
    assert "row of" not in output("scenario", "show", "ccrb-50-12m")
    assert json.loads(output("scenario", "show", "ccrb-50-12m", "--json"))["row"] is None


def test_a_table_that_passes_is_one_document_and_exit_code_0(table: Call) -> None:
    code, out, err = table("negative", "--group", "beside", "--json")
    found = json.loads(out)
    assert (code, err) == (0, "")
    assert (found["table"], found["group"], found["seed"], found["pass"]) == ("negative", "beside", 0, True)
    assert [row["case"] for row in found["rows"]] == [f"negative:beside-{v}" for v in (30, 50, 80)]
    keys = {"case", "speed_kmh", "limit_kmh", "impact_kmh", "min_gap_m", "warning_s", "pass"}
    assert all(keys <= set(row) for row in found["rows"])


def test_a_row_that_fails_is_exit_code_1_and_says_why(table: Call, tmp_path: Path) -> None:
    fault = "crash primary at server.enter nth 100"
    code, out, _ = table("ncap", "--group", "ccrb-12m-6", "--fault", fault)
    assert code == 1
    assert "none, crash primary at server.enter nth 100" in out.splitlines()
    assert "  ncap:ccrb-12m-6-50: impact at " in out
    assert f'  repeat  aftbed sim --scenario ncap:ccrb-12m-6-50 --ftm none --seed 0 --inject "{fault}"' in out
    assert "0 of 1 rows pass" in out


def test_the_same_fault_is_survived_under_a_mechanism(table: Call) -> None:
    fault = "crash primary at server.enter nth 100"
    code, out, _ = table("ncap", "--group", "ccrb-12m-6", "--fault", fault, "--ftm", "none,pbr", "--json")
    rows = json.loads(out)["rows"]
    assert code == 1
    assert [(row["ftm"], row["pass"]) for row in rows] == [("none", False), ("pbr", True)]


def test_a_fault_that_never_strikes_is_exit_code_3(table: Call) -> None:
    never = ("--fault", "crash primary at server.enter nth 100000")
    code, out, _ = table("negative", "--group", "following", *never)
    assert code == 3
    assert out.rstrip().split("\n")[-1].startswith("0 of 1 rows pass; the fault never struck in 1")


def one_instant(course: Course, action: FaultAction, target: str) -> Worst:
    """Instead of a search for the worst one."""
    return Worst(strike(course, Fault(action, target, Trigger(ANCHOR, 100))), 1)


def test_outages_have_lines_of_their_own_and_are_plotted(
    table: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("aftbed.search.road_table.worst_instant", one_instant)
    plot = tmp_path / "road.svg"
    arguments = ("ncap", "--group", "ccrb-12m-6", "--ftm", "none", "--outage", "2s", "--plot", plot)
    code, out, _ = table(*arguments)
    assert code == 1
    lines = out.splitlines()
    assert "none" in lines and "outage 2000ms (under none)" in lines
    assert sum(" instants: every 0.4 s" in line for line in lines) == 1
    drawing = plot.read_text()
    assert (
        drawing.startswith("<svg ")
        and 'xmlns="http://www.w3.org/2000/svg"' in drawing
        and "outage 2000ms" in drawing
    )


def test_each_mechanism_and_each_outage_is_a_line() -> None:
    given = TableArguments("r152", "m1", ("pbr", "lfr", "pbr"), "worst-instant", ("2ms", "0.3s", "2ms"))
    lines = table_drive(given).lines
    crash = "crash primary at the worst instant"
    assert [line.name for line in lines] == [f"pbr, {crash}", f"lfr, {crash}", "outage 2ms", "outage 300ms"]
    assert [line.outage_ms for line in lines] == [None, None, 2, 300]
    assert all(line.searched for line in lines)


@pytest.mark.parametrize(
    ("given", "names"),
    [
        (TableArguments("r152"), ["none"]),
        (TableArguments("r152", outage=("2ms",)), ["outage 2ms"]),
        (TableArguments("r152", ftm=("pbr",), outage=("2ms",)), ["pbr", "outage 2ms"]),
        (
            TableArguments("r152", fault="worst-instant", outage=("2ms",)),
            ["none, crash primary at the worst instant", "outage 2ms"],
        ),
    ],
)
def test_without_a_mechanism_the_bare_function_is_driven(given: TableArguments, names: list[str]) -> None:
    assert [line.name for line in table_drive(given).lines] == names


def test_a_hang_can_be_searched_and_any_fault_aimed() -> None:
    searched = table_drive(
        TableArguments("r152", ftm=("pbr",), fault="hang primary for 30ms at worst-instant")
    ).lines[0]
    assert searched.searched and str(searched.fault) == "hang primary for 30ms"
    aimed = table_drive(
        TableArguments("r152", ftm=("pbr",), fault="bitflip result bit 3 at server.exit nth 9")
    ).lines[0]
    assert not aimed.searched and str(aimed.fault).endswith("at server.exit nth 9")


# -- what is refused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["r125"], "unknown table 'r125'; did you mean 'r152'?"),
        (["r152", "--group", "m2"], "unknown group of table r152 'm2'"),
        (["r152", "--ftm", "pbr,lfx"], "lfx"),
        (["r152", "--ftm", "pbr", "--fault", "explode primary"], "unknown fault 'explode'"),
        (["r152", "--fault", "crash backup at worst-instant"], "unknown target 'backup'"),
        (
            ["r152", "--fault", "crash primary after 1s at worst-instant"],
            "without any other time is searched",
        ),
        (["r152", "--fault", "bitflip result bit 3 at worst-instant"], "without any other time is searched"),
        (["r152", "--fault", "crash primary worst-instant"], "FAULT WORDS at worst-instant is allowed"),
        (["r152", "--fault", "crash hub"], "the simulator has no hub"),
        (["r152", "--outage", "300"], "--outage '300': a positive number with its unit is allowed"),
        (["r152", "--outage", "0.2ms"], "--outage 0.2ms: 1ms is the shortest that is allowed"),
        (["r152", "--outage", "10s"], "--outage 10s: r152:m1-10 lasts 10 s; a shorter one is allowed"),
        (["r152", "--seed", "-1"], "--seed -1: 0 to "),
        (["r152", "--jobs", "0"], "--jobs 0: 1 to "),
        (
            ["r152", "--plot", "road.png"],
            "--plot road.png: a file .svg in a directory that exists is allowed",
        ),
        (["r152", "--plot", "nowhere/road.svg"], "--plot nowhere/road.svg: a file .svg in a directory"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_names_the_argument(refused: Output, arguments: list[str], message: str) -> None:
    assert message in refused("scenario", "table", *arguments)


@pytest.mark.parametrize("command", ["show", "run"])
@pytest.mark.parametrize(
    ("name", "message"),
    [("ccrs-51", "unknown scenario 'ccrs-51'; did you mean"), ("r152:m1-61", "unknown case 'r152:m1-61'")],
)
def test_a_drive_that_does_not_exist(refused: Output, command: str, name: str, message: str) -> None:
    assert message in refused("scenario", command, name)


def test_run_is_aftbed_run(refused: Output) -> None:
    error = partial(refused, "scenario", "run", "ccrs-20")
    assert "--pace fast: real, max, or a factor" in error("--pace", "fast")
    assert "unknown fault 'explode'" in error("--inject", "explode primary")


# -- import


def test_import_prints_what_it_took_ignored_and_wrote(output: Output, tmp_path: Path) -> None:
    out = output("scenario", "import", LEAD_BRAKES, "--expect", "stop").splitlines()
    assert out[0] == f"{LEAD_BRAKES}: OpenSCENARIO 1.2: the car ahead brakes"
    taken, ignored, written = (out.index(word) for word in ("taken", "ignored", "written"))
    assert "  line 123   SpeedAction                Lead brakes at 6 m/s2 from 1 s on" in out[taken:ignored]
    assert "  line 18    SceneGraphFile             for pictures" in out[ignored:written]
    assert out[written:] == ["written", "  lead_brakes.yaml"]
    assert load_scenario(str(tmp_path / "lead_brakes.yaml")).expect.outcome == "stop"


def test_one_document_for_many_variations(output: Output, tmp_path: Path) -> None:
    out = output("scenario", "import", LEAD_BRAKES, "--variations", VALUES, "--out", "made", "--json")
    found = json.loads(out)
    assert set(found) == {
        *("file", "scenario_file", "version", "description", "sets", "scenarios", "left_out"),
        *("taken", "ignored"),
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


def test_an_entry_of_a_catalog_is_printed_with_its_file(output: Output) -> None:
    out = output("scenario", "import", SLOW_LEAD, "--ego", "Host", "--duration", "9s")
    assert f"({FOLDER / 'catalogs' / 'cars.xosc'})" in out
    assert "ObjectController           aftbed's function takes its place" in out
    assert load_scenario("./slow_lead.yaml").duration_ms == 9000


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ([SLOW_LEAD], "which vehicle is the ego? --ego NAME says it (one of: Host, Target)"),
        ([SLOW_LEAD, "--ego", "Target"], "  line 66: ActivateControllerAction: controllers: "),
        ([LEAD_BRAKES, "--pick", "Gap=12"], "--pick: "),
        ([VALUES, "--pick", "Gap"], "--pick: found 'Gap', allowed is NAME=VALUE"),
        ([VALUES, "--pick", "Gab=12"], "--pick: unknown varied parameter 'Gab'; did you mean 'Gap'?"),
        ([VALUES, "--pick", "Gap=13"], "--pick: Gap is never 13 (one of: 12, 40)"),
        ([VALUES, "--variations", VALUES], "a distribution, and --variations gives another one"),
        ([FOLDER, "--variations", VALUES], "--variations: is for one file"),
        ([FOLDER, "--pick", "Gap=12"], "--pick: is for one file"),
        ([LEAD_BRAKES, "--ego", "Bert"], "--ego: unknown vehicle 'Bert' (one of: Ego, Lead)"),
        ([LEAD_BRAKES, "--expect", "crash"], "--expect: unknown outcome 'crash'"),
        (
            [LEAD_BRAKES, "--duration", "9"],
            "--duration '9': a positive number with its unit is allowed, as 50ms or 2s",
        ),
        ([LEAD_BRAKES, "--variations", LEAD_BRAKES], "no ParameterValueDistribution in it"),
        ([LEAD_BRAKES, "--out", LEAD_BRAKES], "cannot be written: "),
        (["nowhere.xosc"], "nowhere.xosc: cannot be read: No such file or directory"),
    ],
)
def test_a_refused_import_writes_nothing(
    arguments: list[str | Path], reason: str, refused: Output, tmp_path: Path
) -> None:
    assert reason in refused("scenario", "import", *arguments)
    assert not list(tmp_path.glob("*.yaml"))


def test_import_overwrites_a_different_file_only_with_force(
    output: Output, refused: Output, tmp_path: Path
) -> None:
    mine = tmp_path / "lead_brakes.yaml"
    mine.write_text("mine")
    assert "exists, and says something else; --force" in refused("scenario", "import", LEAD_BRAKES)
    assert mine.read_text() == "mine"
    output("scenario", "import", LEAD_BRAKES, "--force")
    assert mine.read_text() != "mine"


# -- import of a folder


def test_a_folder_is_imported_with_a_line_for_each_file(output: Output, tmp_path: Path) -> None:
    shutil.copytree(FOLDER, tmp_path / "found")
    (tmp_path / "found" / "broken.xosc").write_text("<OpenSCENARIO>")
    out = output("scenario", "import", tmp_path / "found").splitlines()
    assert out == [
        "refused   broken.xosc: line 1: not XML: no element found",
        "refused   catalogs/cars.xosc: line 4: Catalog: a catalog: read where an entry of it is needed",
        "accepted  lead_brakes.xosc: 1 scenario",
        "accepted  lead_brakes_values.xosc: 6 scenarios",
        "refused   slow_lead.xosc: line 16: Entities: which vehicle is the ego? --ego NAME says it"
        " (one of: Host, Target)",
        "5 files: 2 accepted, 7 scenarios; 3 refused",
        "     1  not a readable XML file",
        "     1  a catalog, no scenario: read where an entry of it is needed",
        "     1  a mistake in the file, or an element that is not of the standard",
        "nothing is written: --out DIR says where to",
    ]
    assert not list(tmp_path.glob("**/*.yaml"))
    document = json.loads(output("scenario", "import", tmp_path / "found", "--out", "made", "--json"))
    assert (document["accepted"], document["refused"]) == (2, 3)
    assert document["causes"] == {"unreadable": 1, "catalog": 1, "mistake": 1}
    assert document["files"][0] == {
        "file": "broken.xosc",
        "accepted": False,
        "reason": "not XML: no element found",
        "line": 1,
        "cause": "unreadable",
        "scenarios": [],
        "left_out": [],
    }
    written = [one for file in document["files"] for one in file["scenarios"]]
    assert all(load_scenario(f"./{one['path']}") for one in written)
    assert written[1] == {
        "name": "lead_brakes_values-Gap-12-Deceleration-2",
        "path": "made/lead_brakes_values-Gap-12-Deceleration-2.yaml",
        "parameters": {"Gap": "12", "Deceleration": "2"},
    }


def test_a_folder_of_500_broken_files_is_refused_file_by_file(call: Call, tmp_path: Path) -> None:
    folder = tmp_path / "broken"
    folder.mkdir()
    whole = LEAD_BRAKES.read_text()
    for number in range(500):
        (folder / f"{number:03}.xosc").write_text(whole[: 30 + number * (len(whole) - 40) // 500])
    code, out, _ = call("scenario", "import", folder, "--json")
    document = json.loads(out)
    assert (code, document["accepted"], document["refused"]) == (2, 0, 500)
    assert {file["cause"] for file in document["files"]} == {"unreadable"}
    assert all(file["line"] and file["reason"] for file in document["files"])


def test_show_says_how_a_drive_ends_and_how_far_the_car_ahead_brakes(output: Output, tmp_path: Path) -> None:
    text = (
        "{description: x, duration_s: 20, ego: {speed_kmh: 50}, expect: {outcome: no_collision},"
        " lead: {gap_m: 12, speed_kmh: 50, braking: {after_s: 3, deceleration_ms2: 6, to_kmh: 2}},"
        " ends: {below_kmh: 40, below_lead_kmh: 0, after_s: 2}}"
    )
    (tmp_path / "mine.yaml").write_text(text)
    out = output("scenario", "show", "mine.yaml")
    assert "brakes at 6 m/s2 to 2 km/h after 3 s" in out
    assert "20 s at most, until 2 s after the car is slower than 40 km/h or slower than the car ahead" in out


def test_a_folder_without_files_is_refused(refused: Output, tmp_path: Path) -> None:
    (tmp_path / "nothing").mkdir()
    assert "no .xosc file in it, or in a folder of it" in refused("scenario", "import", tmp_path / "nothing")


EMPTY_ROAD = (
    "{description: an empty road, duration_s: 1, ego: {speed_kmh: 80}, expect: {outcome: no_braking}}"
)


def test_the_ftti_of_a_scenario_with_the_margin_of_a_mechanism(call: Call, tmp_path: Path) -> None:
    (tmp_path / "empty.yaml").write_text(EMPTY_ROAD)
    (tmp_path / "fhti.json").write_text(
        '{"pbr": {"p50": 0.1, "p99": 0.2, "bound": 0.5}, "lfr": {"p50": 1, "p99": 2}}'
    )
    given = (
        "scenario",
        "ftti",
        "empty.yaml",
        "--jobs",
        "1",
        "--fault",
        "omission,wrong-value",
        "--fhti",
        "fhti.json",
    )
    code, out, _ = call(*given, "--json")
    silent, wrong = json.loads(out)["rows"]
    assert code == 1, "lfr takes longer than 1 ms"
    keys = "scenario speed_kmh fault ftti_ms closed_form_ms broken_by worst_instant_s mechanisms"
    assert list(wrong) == keys.split()
    assert wrong["ftti_ms"] == 1.0 and wrong["mechanisms"]["pbr"]["margin"] == 0.5
    assert wrong["mechanisms"]["pbr"]["fhti_ms"] == {"p50": 0.1, "p99": 0.2, "bound": 0.5}
    assert wrong["mechanisms"]["lfr"]["margin"] == -1.0
    assert silent["ftti_ms"] is None and silent["mechanisms"]["pbr"]["margin"] is None
    _, out, _ = call(*given, "--plot", "ftti.svg")
    assert "no FTTI up to 2 s" in out and "-100.0%" in out
    drawn = (tmp_path / "ftti.svg").read_text()
    assert ">wrong-value<" in drawn and "FHTI of lfr" in drawn


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["ccrs-20", "--fault", "omision"], "unknown fault 'omision'; did you mean 'omission'?"),
        (["ccrs-20", "--brake-policy", "lock"], "unknown brake policy 'lock'"),
        (["ccrs-21"], "unknown scenario 'ccrs-21'"),
        (["ccrs-20", "--plot", "ftti.png"], "--plot ftti.png"),
        (
            ["ccrs-20", "--fhti", "nowhere.json"],
            "--fhti nowhere.json: cannot be read: No such file or directory",
        ),
        (
            ["ccrs-20", "--fhti", "list.json"],
            "--fhti list.json: line 1, column 1: found [], allowed is keys and values; allowed",
        ),
        (
            ["ccrs-20", "--fhti", "odd.json"],
            "--fhti odd.json: pbr: found p50 3, p99 2, bound 2; allowed is 0 <= p50",
        ),
    ],
)
def test_what_ftti_refuses(arguments: list[str], reason: str, refused: Output, tmp_path: Path) -> None:
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "odd.json").write_text('{"pbr": {"p50": 3, "p99": 2}}')
    assert reason in refused("scenario", "ftti", *arguments)


def test_a_drive_that_is_broken_without_a_fault_is_refused(refused: Output, tmp_path: Path) -> None:
    (tmp_path / "near.yaml").write_text(
        "{description: too near, duration_s: 3, ego: {speed_kmh: 60}, lead: {gap_m: 10, speed_kmh: 0},"
        " expect: {outcome: stop}}"
    )
    assert "near.yaml: is broken without a fault, so has no FTTI: collision" in refused(
        "scenario", "ftti", "near.yaml", "--jobs", "1"
    )


def test_the_margin_is_that_of_a_campaign(call: Call, output: Output, tmp_path: Path) -> None:
    (tmp_path / "empty.yaml").write_text(EMPTY_ROAD)
    (tmp_path / "small.yaml").write_text(
        "{campaign: small, about: A crash., seed: 1, system: {runtime: sim, requests: 40}, mechanisms: [pbr],"
        " faults: [{name: crash, fault: 'crash primary at server.exit nth {nth}', draw: {nth: [5, 30]},"
        " expect: {'*': [masked, tolerated]}}], stop: {experiments: 20},"
        " gates: [{metric: unexpected, max: 0.9}]}"
    )
    output("campaign", "run", "small.yaml", "--out", "small", "--jobs", "1")
    _, out, _ = call(
        "scenario", "ftti", "empty.yaml", "--jobs", "1", "--fault", "wrong-value", "--fhti", "small", "--json"
    )
    (row,) = json.loads(out)["rows"]
    pbr = row["mechanisms"]["pbr"]
    handled_ms = pbr["fhti_ms"]["bound"] or pbr["fhti_ms"]["p99"]
    assert 0.0 < pbr["fhti_ms"]["p50"] <= pbr["fhti_ms"]["p99"]
    assert pbr["margin"] == pytest.approx(1.0 - handled_ms / row["ftti_ms"], abs=1e-4)
