"""A mechanism of an installed package in a real run: its bricks in the nodes, its name in the record."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from liveruns import Home
from packages import install_new

pytestmark = pytest.mark.process


def called(path: Path | None, *words: str) -> subprocess.CompletedProcess[str]:
    """`aftbed` with what is installed in `path`."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    environment |= {"PYTHONPATH": str(path)} if path else {}
    command = [sys.executable, "-m", "aftbed", *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100, check=False)


def test_it_protects_a_run_whose_record_needs_its_package(home: Home, tmp_path: Path) -> None:
    site, record = tmp_path / "site", str(tmp_path / "record")
    install_new(site, "limit", tmp_path / "project")
    fault = "crash primary at server.exit nth 30"
    change = "to lfr+limit at request 200"
    words = ("--ftm", "pbr+limit", "--load", "300@300", "--inject", fault, "--adapt", change)
    done = called(site, "run", *words, "--record", record, "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["verdict"] == "pass" and found["failovers"] and found["adaptations"]
    assert found["code"].endswith(" aftbed-limit 0.1.0")

    again = called(site, "check", record, "--json")
    assert json.loads(again.stdout)["verdict"] == "pass"
    without = called(None, "check", record)
    assert without.returncode == 2
    assert "run.json: ftm: unknown FTM 'limit'" in without.stderr
    assert without.stderr.endswith("the run had it of aftbed-limit 0.1.0: install that to judge it\n")
