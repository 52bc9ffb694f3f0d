"""A campaign on real processes: killed at any moment, gone on with; complete, nothing left, nothing twice."""

import json
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from random import Random

import pytest
from liveruns import GONE_SECONDS_MAX, Home, aftbed, until

from aftbed.campaign import ledger
from aftbed.core.errors import ConfigError
from aftbed.runtime.unix import seal

pytestmark = pytest.mark.process

SPEC = """
campaign: live
seed: 2
system: {requests: 40}
mechanisms: [pbr, lfr]
faults:
- name: crash
  fault: crash primary at {event} nth {nth}
  matrix: {event: [server.exit, reply.sent]}
  draw: {nth: [1, 35]}
  expect: {"*": [tolerated, degraded]}
- name: nothing
  expect: {"*": [masked, degraded]}
stop: {experiments: 3}
unknown_max: 1.0
not_activated_max: 1.0
"""
HANG = """\
campaign: hang
seed: 1
system: {requests: 50, rate_hz: 400}
mechanisms: [pbr]
faults:
- {name: lost, fault: omission pxy2pro nth 1, expect: {"*": [hang]}}
stop: {experiments: 1}
not_activated_max: 1.0
unknown_max: 1.0
"""
WRONG = """\
campaign: wrong
system: {requests: 30}
mechanisms: [pbr]
faults:
- {name: flip, fault: bitflip result bit 60 at server.exit nth 9, expect: {"*": [tolerated]}}
- {name: expected, fault: bitflip result bit 60 at server.exit nth 9, expect: {"*": [sdc]}}
stop: {experiments: 1}
"""
EXPERIMENTS = 12
SMOKE_SECONDS_MAX = 600.0  # of all its experiments


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    path = tmp_path / "live.yaml"
    path.write_text(SPEC)
    return path


def done(out: Path) -> int:
    """How many experiments the ledger has by now."""
    try:
        return max(0, (out / ledger.NAME).read_bytes().count(b"\n") - 1)
    except OSError:
        return 0


def reached(out: Path, mark: int, running: subprocess.Popen[bytes]) -> bool:
    """Whether more than `mark` are done, or no more will come."""
    return done(out) > mark or running.poll() is not None


@pytest.mark.parametrize("moments", [2, pytest.param(10, marks=pytest.mark.deep)])
def test_a_campaign_that_is_killed_again_and_again_comes_to_its_end(
    moments: int, home: Home, spec: Path, tmp_path: Path
) -> None:
    out, chance = tmp_path / "out", Random(7)
    marks = sorted(chance.sample(range(EXPERIMENTS), moments))
    command = [sys.executable, "-m", "aftbed", "campaign", "run", str(spec), "--out", str(out), "--jobs", "2"]
    for number, mark in enumerate(marks):
        resumed = ["--resume"] if number else []
        running = subprocess.Popen([*command, *resumed], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            until(partial(reached, out, mark, running), f"experiment {mark}")
            running.send_signal(signal.SIGKILL)
            running.wait()
        finally:
            running.kill()
            running.wait()
        assert home.seconds_to_clean() < GONE_SECONDS_MAX, home.left()
    ended = aftbed(*command[3:], "--resume", "--json")
    assert ended.code in (0, 1), ended.err
    document = json.loads(ended.out)
    assert (document["experiments"], document["planned"]) == (EXPERIMENTS, EXPERIMENTS)
    found = ledger.read(out / ledger.NAME)  # refuses what stands twice
    assert [r.experiment.index for r in found.results] == list(range(EXPERIMENTS))
    assert all(r.activated for r in found.results)
    assert not any(r.unexpected for r in found.results), [r for r in found.results if r.unexpected]
    assert not home.left()


def test_the_records_are_complete_before_a_run_is_taken_down(home: Home, spec: Path, tmp_path: Path) -> None:
    """Whatever is in the ledger is a whole result: there is no torn line, wherever it was killed."""
    out = tmp_path / "out"
    ended = aftbed("campaign", "run", spec, "--out", out, "--experiments", "1", "--json")
    assert ended.code in (0, 1), ended.err
    assert done(out) == 4
    with pytest.raises(ConfigError, match="stands twice"):
        lines = (out / ledger.NAME).read_bytes().splitlines(keepends=True)
        (out / ledger.NAME).write_bytes(b"".join((*lines, lines[-1])))
        ledger.read(out / ledger.NAME)


def test_a_run_that_hangs_as_expected_breaks_nothing(home: Home, tmp_path: Path) -> None:
    """What its history cannot show is unknown, which is no broken promise."""
    (tmp_path / "hang.yaml").write_text(HANG)
    done = aftbed("campaign", "run", tmp_path / "hang.yaml", "--out", tmp_path / "out", "--json")
    assert done.code == 0, done.out + done.err
    (result,) = ledger.read(tmp_path / "out" / ledger.NAME).results
    assert (result.broken, result.unexpected) == ((), False)
    assert result.outcome == "hang" or result.noisy, result.reasons


def test_the_record_of_a_run_that_went_otherwise_than_expected_is_kept(home: Home, tmp_path: Path) -> None:
    (tmp_path / "wrong.yaml").write_text(WRONG)
    done = aftbed("campaign", "run", tmp_path / "wrong.yaml", "--out", tmp_path / "out", "--json")
    assert done.code == 1, done.out + done.err
    flip, expected = ledger.read(tmp_path / "out" / ledger.NAME).results
    assert flip.unexpected and not expected.unexpected
    (record,) = (tmp_path / "out" / ledger.RECORDS).iterdir()
    assert record.name == flip.experiment.id and seal.sealed(record)
    judged = aftbed("check", record)
    assert judged.code == 1 and "value: request 9: sdc" in judged.out, judged.out + judged.err
    assert not home.left()


@pytest.mark.timeout(SMOKE_SECONDS_MAX + 60)
@pytest.mark.deep  # `.ci/run` runs it whole
def test_the_smoke_campaign_has_nothing_unexpected(home: Home, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["campaign", "run", "ci-smoke", "--out", str(out), "--jobs", "1"]
    command = [sys.executable, "-m", "aftbed", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=SMOKE_SECONDS_MAX)
    assert ended.returncode == 0, ended.stdout
    found = ledger.read(out / ledger.NAME).results
    assert len(found) == 12 * 12
    assert not any(r.unexpected for r in found), [r for r in found if r.unexpected]
    assert all(r.activated for r in found), [r for r in found if not r.activated]
