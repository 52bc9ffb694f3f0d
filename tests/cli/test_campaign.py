"""`aftbed campaign`, in the simulator: from a campaign file to reports and a gate."""

import hashlib
import json
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from fakerun import Call, Output
from liveruns import called

pytestmark = pytest.mark.simulation

SPEC = """
campaign: try
seed: 3
system: {requests: 30, runtime: sim}
mechanisms: [pbr, none]
faults:
- name: crash
  fault: crash primary at server.exit nth {nth}
  draw: {nth: [1, 25]}
  expect: {pbr: [tolerated], none: [unavailable]}
stop: {experiments: 12}
gates:
- {metric: unexpected, max: 0.2}
- {metric: failed, max: 0.3, strata: "pbr*"}
"""


@pytest.fixture
def spec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "try.yaml"
    path.write_text(SPEC)
    return path


Ran = Callable[[str], dict[str, object]]


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What SPEC comes to, run once."""
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "try.yaml").write_text(SPEC)
    done = called("campaign", "run", folder / "try.yaml", "--out", folder / "out", "--jobs", "1", "--json")
    assert done.code == 0, done.err
    return folder / "out"


@pytest.fixture
def ran(spec: Path, records: Path) -> Ran:
    """Put these records into a folder beside `spec`: its summary."""

    def to(name: str) -> dict[str, object]:
        shutil.copytree(records, spec.parent / name)
        summary: dict[str, object] = json.loads((records / "summary.json").read_text())
        return summary

    return to


def test_from_a_file_to_a_gate(spec: Path, call: Call) -> None:
    code, out, err = call("campaign", "run", spec, "--jobs", "1", "--json")
    assert code == 0, err
    document = json.loads(out)
    assert (document["campaign"], document["experiments"], document["gate"]) == ("try", 24, "pass")
    assert document["outcomes"] == {"tolerated": 12, "unavailable": 12}
    assert [s["name"] for s in document["strata"]] == ["pbr · crash", "none · crash"]
    folder = spec.parent / "campaign-try"
    assert json.loads((folder / "summary.json").read_text()) == document
    assert {p.name for p in folder.iterdir()} == {"records.jsonl", "summary.json", "junit.xml", "report.html"}


def test_a_failed_gate_is_exit_code_1(spec: Path, call: Call) -> None:
    spec.write_text(SPEC.replace("pbr: [tolerated]", "pbr: [masked]"))
    code, out, _ = call("campaign", "run", spec, "--jobs", "1", "--out", "out")
    assert code == 1
    assert "gate: fail" in out.splitlines()
    assert re.search(r"fail +unexpected +\* +at most 0.2 +0.5 ", out), out


def test_a_campaign_whose_faults_cannot_fire_fails(spec: Path, call: Call) -> None:
    text = (
        SPEC.replace("[1, 25]", "[100, 200]")
        .replace("[pbr, none]", "[pbr]")
        .replace(", none: [unavailable]", "")
    )
    spec.write_text(text)
    code, out, _ = call("campaign", "run", spec, "--jobs", "1", "--out", "out", "--json")
    document = json.loads(out)
    assert (code, document["gate"], document["outcomes"]) == (1, "fail", {"masked": 12})
    failed = {gate["metric"]: gate["reason"] for gate in document["gates"] if gate["word"] == "fail"}
    assert failed["not_activated"] == "none of 12 faults struck: this stratum could not have failed"


def test_a_report_from_records_equals_the_first(ran: Ran, output: Output) -> None:
    first = ran("out")
    again = json.loads(output("campaign", "report", "out", "--json"))
    assert first | {"seconds": 0} == again | {"seconds": 0}


def test_shards_are_merged(spec: Path, ran: Ran, output: Output, call: Call) -> None:
    whole = ran("whole")
    for shard in (1, 2):
        call("campaign", "run", spec, "--shard", f"{shard}/2", "--out", f"part{shard}", "--jobs", "1")
    merged = json.loads(output("campaign", "merge", "part1", "part2", "--out", "merged", "--json"))
    assert merged["strata"] == whole["strata"] and merged["gates"] == whole["gates"]


def test_a_plan_runs_nothing(spec: Path, output: Output) -> None:
    shown = output("campaign", "plan", spec, "--experiments", "3", "--out", "plan.jsonl")
    assert "6 experiments at most" in shown
    assert len((spec.parent / "plan.jsonl").read_text().splitlines()) == 6
    assert not (spec.parent / "campaign-try").exists()


def test_an_experiment_is_replayed(ran: Ran, output: Output) -> None:
    ran("out")
    found = json.loads(output("campaign", "replay", "out", "1", "--json"))
    assert found["before"]["outcome"] == found["after"]["outcome"] == "unavailable"
    shown = output("campaign", "replay", "out", "1")
    assert "aftbed sim --ftm none --placement process --seed" in shown


def test_an_experiment_is_shrunk(ran: Ran, output: Output) -> None:
    ran("out")
    found = json.loads(output("campaign", "shrink", "out", "1", "--json"))
    assert found["ftm"] == "none" and found["requests"] == 1
    assert found["faults"] == ["crash primary at server.exit nth 1"]


def test_two_campaigns_are_compared(spec: Path, ran: Ran, output: Output, call: Call) -> None:
    ran("base")
    same = json.loads(output("campaign", "compare", "base", "base", "--json"))
    assert not same["worse"] and [c["pairs"] for c in same["changes"]] == [12, 12]
    output("campaign", "compare", "base", "base", "--outcomes")
    records = spec.parent / "base" / "records.jsonl"
    worse = records.read_text().replace('"outcome":"tolerated"', '"outcome":"sdc"')
    (spec.parent / "new").mkdir()
    (spec.parent / "new" / "records.jsonl").write_text(worse)
    code, out, _ = call("campaign", "compare", "base", "new")
    assert code == 1
    assert re.search(
        r"12 pairs: 12 with another outcome, 0 failed only before, 12 only now .*: worse", out
    ), out


def test_an_outcome_that_is_another_one_or_missing_fails_a_comparison_of_outcomes(
    spec: Path, ran: Ran, call: Call
) -> None:
    ran("base")
    head, *results = (spec.parent / "base" / "records.jsonl").read_text().splitlines(keepends=True)
    better = [line.replace('"outcome":"tolerated"', '"outcome":"masked"') for line in results[:1]]
    for name, lines in {"better": better + results[1:], "fewer": results[1:], "same": results}.items():
        (spec.parent / name).mkdir()
        (spec.parent / name / "records.jsonl").write_text("".join([head, *lines]))
    for new, code in {"better": 1, "fewer": 1, "same": 0}.items():
        assert call("campaign", "compare", "base", new)[0] == 0, "no stratum is worse"
        assert call("campaign", "compare", "base", new, "--outcomes")[0] == code, new
    unknown = lines[0].replace('"outcome":"tolerated"', '"outcome":"inconclusive"')
    (spec.parent / "better" / "records.jsonl").write_text("".join([head, unknown, *lines[1:]]))
    assert "1 with another outcome (1 unknown)" in call("campaign", "compare", "base", "better")[1]
    assert call("campaign", "compare", "fewer", "base", "--outcomes")[0] == 0, "more is not less"


@pytest.mark.parametrize("name", ["out.csv", "out.parquet"])
def test_results_are_exported(spec: Path, ran: Ran, output: Output, name: str) -> None:
    ran("out")
    output("campaign", "export", "out", "--out", name)
    assert (spec.parent / name).stat().st_size > 1000


def test_the_schema_is_for_editors(output: Output) -> None:
    assert json.loads(output("campaign", "schema"))["$ref"] == "#/$defs/Spec"


def test_the_shipped_campaigns_are_listed(output: Output) -> None:
    names = [line.split()[0] for line in output("campaign", "list").splitlines()]
    assert names == [
        *("adaptation", "app-check", "assumptions", "bitflip", "bus", "certify"),
        *("ci-smoke", "crash", "fhti", "paper-recipe", "radar", "radar-ghost", "supervision"),
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "none-such"), "unknown campaign 'none-such'"),
        (("run", "nowhere.yaml"), "nowhere.yaml: cannot be read: No such file"),
        (("run", "crash", "--shard", "3/2"), "--shard '3/2': I/N is allowed, I from 1 to N"),
        (("run", "crash", "--jobs", "0"), "--jobs 0: 1 to "),
        (("run", "crash", "--experiments", "0"), "--experiments 0: 1 to 1000000 are allowed"),
        (("run", "crash", "--seed", "-1"), "--seed -1: 0 or more is allowed"),
        (("run", "crash", "--runtime", "ros"), "unknown runtime 'ros'"),
        (("run", "crash", "--executor", "dask"), "--executor dask and --scheduler ADDRESS go together"),
        (("run", "crash", "--executor", "slurm"), "unknown executor 'slurm'"),
        (
            ("run", "crash", "--resume", "--out", "x"),
            "x/records.jsonl: No such file or directory; is this the",
        ),
        (("report", "x"), "x/records.jsonl: No such file or directory; is this the"),
        (("export", "x", "--out", "y.ods"), "unknown kind of file '.ods'; did you mean '.csv'?"),
        (("replay", "x", "1"), "x/records.jsonl: No such file or directory; is this the"),
    ],
)
def test_bad_input_is_refused_and_nothing_is_run(
    refused: Output, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in refused("campaign", *arguments)
    assert list(tmp_path.iterdir()) == []


def test_a_bundle_is_made_and_verified(spec: Path, ran: Ran, output: Output, call: Call) -> None:
    ran("out")
    made = json.loads(output("campaign", "bundle", "out", "--out", "e.zip", "--json"))
    found = json.loads(output("campaign", "verify", "e.zip", "--json"))
    assert found == made | {"misfits": []}
    assert output("campaign", "verify", "e.zip").endswith("\nall fit\n")
    with zipfile.ZipFile(spec.parent / "e.zip", "a") as archive:
        archive.writestr("late.txt", "put in later")
    code, out, _ = call("campaign", "verify", "e.zip")
    assert code == 1 and out.endswith("\nlate.txt: it is not in SHA256SUMS\n"), out


def test_what_cannot_be_bundled_or_is_no_bundle_is_usage(spec: Path, ran: Ran, call: Call) -> None:
    ran("out")
    for arguments, why in {
        ("bundle", "out", "--out", "e.tar"): "--out e.tar: a file .zip in a directory that exists is allowed",
        ("bundle", "gone", "--out", "e.zip"): "is this the directory of a campaign?",
        ("verify", "try.yaml"): "try.yaml: found no zip archive, as a bundle is, or a broken one",
        ("verify", "gone.zip"): "gone.zip: cannot be read: No such file or directory",
    }.items():
        code, _, err = call("campaign", *arguments)
        assert code == 2 and why in err, err
    assert not (spec.parent / "e.zip").exists()


def test_an_argument_is_made_of_a_bundle(spec: Path, ran: Ran, output: Output, call: Call) -> None:
    ran("out")
    output("campaign", "bundle", "out", "--out", "e.zip")
    found = json.loads(output("campaign", "argument", "e.zip", "--plot", "a.svg", "--json"))
    (solution,) = [node for node in found["nodes"] if node["kind"] == "solution"]
    with zipfile.ZipFile(spec.parent / "e.zip") as archive:
        records = archive.read(solution["entry"])
    assert hashlib.sha256(records).hexdigest() == solution["sha256"]
    assert (spec.parent / "a.svg").read_text().startswith("<svg")
    assert "\nG1 supported: " in output("campaign", "argument", "e.zip")
    assert call("campaign", "argument", "e.zip", "--plot", "a.png")[0] == 2
    with zipfile.ZipFile(spec.parent / "e.zip", "a") as archive:
        archive.writestr("late.txt", "put in later")
    code, out, err = call("campaign", "argument", "e.zip", "--plot", "b.svg")
    assert (code, out) == (1, "") and "late.txt: it is not in SHA256SUMS" in err
    assert not (spec.parent / "b.svg").exists()


def test_a_goal_that_failed_is_exit_code_1(spec: Path, ran: Ran, output: Output, call: Call) -> None:
    ran("out")
    records = spec.parent / "out" / "records.jsonl"
    records.write_text(records.read_text().replace('"outcome":"tolerated"', '"outcome":"sdc"', 1))
    output("campaign", "bundle", "out", "--out", "e.zip")
    code, out, _ = call("campaign", "argument", "e.zip")
    assert code == 1 and "\nG3 failed: " in out and "  pbr failed: try: 1 of 12 experiments broke it" in out
