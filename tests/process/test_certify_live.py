"""The suites for a function of the user, from the command line: simulated, and on real processes."""

import json
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from campaigns import ran
from certified import STRANGERS, requests_in, suite
from liveruns import called
from msgspec.structs import replace

from aftbed.campaign.experiment import Experiment, Result
from aftbed.campaign.plan import CampaignPlan, plan
from aftbed.campaign.runner import _Really
from aftbed.campaign.spec import read_spec
from aftbed.campaign.summary import summarise
from aftbed.core.errors import HarnessError
from aftbed.report.html import html_report
from aftbed.report.terminal import summary_lines
from aftbed.runtime.unix.trust import OWN_RUN

pytestmark = pytest.mark.process

CARRY_OUT = """
import sys
import msgspec
from aftbed.campaign.experiment import Experiment, carry_out
experiment = msgspec.json.decode(sys.stdin.buffer.read(), type=Experiment)
sys.stdout.buffer.write(msgspec.json.encode(carry_out(experiment, lambda _: None)))
"""
MAKER = """
from random import Random

def requests(seed):
    chance = Random(seed)
    while True:
        yield chance.randbytes(4)
"""


@pytest.mark.deep  # a page of the docs runs one that passes
def test_certify_passes_a_good_function(tmp_path: Path) -> None:
    """All of it, once in each stratum: every mechanism suits, and each becomes each other one."""
    words = ("--app", f"{STRANGERS}:Counter", "--requests", requests_in(tmp_path), "--experiments", "1")
    out = tmp_path / "out"
    done = called("campaign", "run", "certify", *words, "--out", out, "--json")
    summary = json.loads(done.out)
    assert (done.code, summary["gate"]) == (0, "pass"), (done.err, summary["gates"])
    names = {stratum["name"] for stratum in summary["strata"]}
    assert {"lfr+tr · to pbr+assert · adapting", "pbr · steady · wrong checkpoint"} <= names
    assert all(weakness["expected"] for weakness in summary["weaknesses"])
    assert (out / "summary.md").read_text().startswith("# certify: pass\n")
    again = called("campaign", "report", out, "--json")
    assert json.loads(again.out) | {"seconds": 0} == summary | {"seconds": 0}


@pytest.fixture
def fragile(tmp_path: Path) -> CampaignPlan:
    """A wrong bit in the state ends the process in which the function is."""
    spec = suite(tmp_path, "Fragile", ("none", "lfr"), "nothing", "wrong state")
    return plan(replace(spec, stop=replace(spec.stop, experiments=1)), OWN_RUN)


def test_what_ends_the_simulator_is_carried_out_on_real_processes(
    tmp_path: Path, fragile: CampaignPlan
) -> None:
    """There the replica fails alone: the follower of `lfr` has executed the requests itself."""
    found = ran(fragile, tmp_path / "out")
    told = {r.experiment.stratum: (r.experiment.runtime, r.outcome) for r in found.results}
    assert told == {
        "none · nothing": ("sim", "masked"),
        "none · wrong state": ("unix", "unavailable"),
        "lfr · nothing": ("sim", "masked"),
        "lfr · wrong state": ("unix", "tolerated"),
    }
    summary = summarise(found, fragile.size, 1.0)
    (limit,) = summary.weaknesses
    assert limit.expected and [one.place for one in limit.seen] == ["none"]
    assert summary.really == ("none · wrong state", "lfr · wrong state")
    why = "since the function ends or blocks the simulator: none · wrong state, lfr · wrong state"
    assert f"2 of them on real processes, {why}" in "\n".join(summary_lines(summary))
    assert f"2 experiments, {why}" in html_report(summary, found, drawn=0)
    assert len(ran(fragile, tmp_path / "out", resume=True).results) == fragile.size


def test_a_function_that_always_ends_the_simulator_is_not_tried_for_ever(
    tmp_path: Path, fragile: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("aftbed.campaign.runner.REALLY_MAX", 0)
    with pytest.raises(HarnessError, match=r"Fragile: .* has ended with code 9: `--runtime unix` runs all"):
        ran(fragile, tmp_path / "out")


def test_a_worker_that_ends_behind_its_experiment_leaves_its_result(
    tmp_path: Path, fragile: CampaignPlan
) -> None:
    """It was in the records, so it is not carried out again."""
    found = ran(fragile, tmp_path / "out")
    known = _Really(found.path, fragile, 1.0)
    assert known(found.results[0].experiment, "has ended") == found.results[0]


def carried_out(experiment: Experiment) -> Result:
    """In a process of its own: it warms up for many runs."""
    line, data = [sys.executable, "-c", CARRY_OUT], msgspec.json.encode(experiment)
    done = subprocess.run(line, input=data, capture_output=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return msgspec.json.decode(done.stdout, type=Result)


@pytest.mark.parametrize(("function", "hides"), [("Counter", False), ("Hidden", True)])
def test_app_check_finds_hidden_state_on_real_processes(tmp_path: Path, function: str, hides: bool) -> None:
    (tmp_path / "maker.py").write_text(MAKER)
    spec = read_spec("app-check")
    system = replace(
        spec.system, app=f"{STRANGERS}:{function}", request_file=f"{tmp_path / 'maker.py'}:requests"
    )
    found = plan(replace(spec, system=system), OWN_RUN)
    experiment = next(e for e in found.experiments() if e.stratum == "pbr · steady · crash primary")
    assert experiment.runtime == "unix"
    result = carried_out(experiment)
    # On a busy machine the crash of the exact one is inconclusive: a late reply is the machine's then.
    assert (result.outcome == "sdc", result.unexpected, result.activated) == (hides, hides, True), (
        result.reasons
    )
    assert result.requests is not None and result.requests.sent == experiment.requests


@pytest.mark.deep
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("function", "code"), [("Counter", 0), ("Forgetful", 1), ("Hidden", 1), ("Chance", 1)]
)
def test_app_check_tells_false_declarations(tmp_path: Path, function: str, code: int) -> None:
    words = ("--app", f"{STRANGERS}:{function}", "--requests", requests_in(tmp_path), "--experiments", "2")
    done = called("campaign", "run", "app-check", *words, "--out", tmp_path / "out", "--json")
    assert done.code == code, (done.err, json.loads(done.out)["gates"])
    weak = [one for one in json.loads(done.out)["weaknesses"] if not one["expected"]]
    assert bool(weak) == (code == 1)
