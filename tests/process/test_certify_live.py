"""The suites for a function of the user, from the command line: simulated, and on real processes."""

import json
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from certified import STRANGERS, requests_in
from liveruns import called
from msgspec.structs import replace

from aftbed.campaign.experiment import Experiment, Result
from aftbed.campaign.plan import plan
from aftbed.campaign.spec import read_spec
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


def carried_out(experiment: Experiment) -> Result:
    """In a process of its own: it warms up for many runs."""
    line, data = [sys.executable, "-c", CARRY_OUT], msgspec.json.encode(experiment)
    done = subprocess.run(line, input=data, capture_output=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return msgspec.json.decode(done.stdout, type=Result)


@pytest.mark.parametrize(("function", "outcome"), [("Counter", "tolerated"), ("Hidden", "sdc")])
def test_app_check_finds_hidden_state_on_real_processes(tmp_path: Path, function: str, outcome: str) -> None:
    (tmp_path / "maker.py").write_text(MAKER)
    spec = read_spec("app-check")
    system = replace(
        spec.system, app=f"{STRANGERS}:{function}", request_file=f"{tmp_path / 'maker.py'}:requests"
    )
    found = plan(replace(spec, system=system), OWN_RUN)
    experiment = next(e for e in found.experiments() if e.stratum == "pbr · steady · crash primary")
    assert experiment.runtime == "unix"
    result = carried_out(experiment)
    assert (result.outcome, result.unexpected) == (outcome, outcome == "sdc"), result.reasons
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
