"""Whole drives and replays: what the car comes to, whatever the mechanism and whatever the machine."""

import os
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import pytest
from junitparser import JUnitXml, Properties
from liveruns import SHORT, Done, aftbed
from sampling import sampled

from aftbed.core.journal import EntryKind
from aftbed.judge.record import read_record
from aftbed.runtime.unix.code_version import code_version
from aftbed.vehicle.aeb.messages import decode_reply
from aftbed.vehicle.scenarios.library import scenario_names

pytestmark = pytest.mark.process

_SHARED: Final = os.environ.get("AFTBED_SHARED")
DATA: Final = (Path(_SHARED) if _SHARED else Path(__file__).resolve().parents[2].parent / "shared") / "data"
TOYOTA_LOG, TOYOTA_DBC = DATA / "rav4_following_50kmh.log", DATA / "toyota_adas.dbc"
MECHANISMS: Final = ("none process", "pbr process", "pbr replica")  # with their placement
IN_TIME_TRIES: Final = 5
HEARTBEATS: Final = tuple(f" {number:03X}#" for number in range(0x700, 0x710))


def passed(*arguments: str | Path) -> Done:
    """A run that must pass."""
    done = aftbed("run", "--json", *arguments)
    assert done.code == 0, done.out + done.err
    assert done.verdict().verdict == "pass"
    return done


@cache
def bus_log(*arguments: str, again: bool = False) -> list[str]:
    """The frames of a short drive in lockstep; a drive of its own for each, and one more `again`."""
    with TemporaryDirectory() as folder:
        record = Path(folder) / "record"
        passed("--scenario", SHORT, "--pace", "max", "--record", record, *arguments)
        return (record / "bus.log").read_text().splitlines()


def without_heartbeats(lines: list[str]) -> list[str]:
    """All frames but those by which a mechanism shows itself."""
    return [line for line in lines if not any(mark in line for mark in HEARTBEATS)]


@pytest.mark.parametrize(("scenario", "mechanism"), sampled(scenario_names(), MECHANISMS))
def test_every_scenario_comes_to_what_it_expects(scenario: str, mechanism: str) -> None:
    ftm, placement = mechanism.split()
    done = passed("--scenario", scenario, "--ftm", ftm, "--placement", placement, "--pace", "max")
    verdict = done.verdict()
    assert verdict.vehicle is not None
    assert verdict.requests.answered == verdict.requests.sent > 0
    assert verdict.vehicle.braked is (scenario != "free-drive")


def test_what_a_drive_verifies_is_written_by_the_run_and_by_check(tmp_path: Path) -> None:
    """The requirements of the command, and those of the scenario."""
    scenario, record = tmp_path / "verifying.yaml", tmp_path / "record"
    scenario.write_text(f"{SHORT.read_text()}verifies: [SG-2, SG-1]\n")
    first, again = tmp_path / "first.xml", tmp_path / "again.xml"
    options = ("--pace", "max", "--verifies", "SG-1,FSR-3.2", "--junit", first, "--record", record)
    verdict = passed("--scenario", scenario, *options).verdict()
    assert verdict.verifies == ("SG-1", "FSR-3.2", "SG-2") and verdict.code == code_version()
    assert verdict.command.startswith("aftbed run --json --scenario ") and "--verifies" in verdict.command
    (suite,) = JUnitXml.fromfile(str(first))
    (case,) = suite
    found = {one.name: one.value for one in case.child(Properties)}
    assert (found["verifies"], found["n"], found["failed"]) == ("SG-1,FSR-3.2,SG-2", "1", "0")
    assert (found["command"], found["code"]) == (verdict.command, verdict.code)
    assert aftbed("check", record, "--junit", again).code == 0
    assert again.read_text() == first.read_text()


def test_a_drive_in_real_time_passes() -> None:
    """A machine may be too busy for the pace: then the verdict says so, and the car drives again."""
    for _ in range(IN_TIME_TRIES):
        verdict = aftbed("run", "--json", "--scenario", "ccrs-20", "--pace", "4").verdict()
        assert verdict.requests.answered == verdict.requests.sent > 0
        assert verdict.vehicle is not None
        if verdict.verdict == "pass":
            assert verdict.vehicle.stop_gap_m is not None
            return
        assert verdict.requests.late > 0, verdict
        assert "is this machine too slow or too busy for this pace?" in verdict.reasons[-1]
    pytest.fail(f"{IN_TIME_TRIES} drives, and in none the replies came in time: {verdict}")


@pytest.mark.deep
@pytest.mark.parametrize("scenario", scenario_names())
def test_every_scenario_passes_in_real_time_over_a_crash(scenario: str) -> None:
    fault = "crash primary at checkpoint.sent nth 60"
    verdict = passed("--scenario", scenario, "--pace", "real", "--inject", fault).verdict()
    assert len(verdict.failovers) == 1
    assert verdict.requests.lost == 0


def bus_log_under(mechanism: str) -> list[str]:
    ftm, placement = mechanism.split()
    return without_heartbeats(bus_log("--seed", "7", "--ftm", ftm, "--placement", placement))


def test_the_same_seed_gives_the_same_frames_byte_for_byte() -> None:
    pbr = ("--seed", "7", "--ftm", "pbr", "--placement", "process")
    first = bus_log(*pbr)
    assert bus_log(*pbr, again=True) == first
    assert len(first) > 400


def test_another_seed_gives_other_frames() -> None:
    assert without_heartbeats(bus_log("--seed", "8")) != bus_log_under("pbr process")


def test_no_mechanism_changes_what_is_on_the_bus() -> None:
    logs = [bus_log_under(mechanism) for mechanism in MECHANISMS]
    assert logs[0] == logs[1] == logs[2]


def test_a_crash_changes_nothing_on_the_bus() -> None:
    crashed = bus_log("--seed", "7", "--inject", "crash primary at checkpoint.sent nth 60")
    assert without_heartbeats(crashed) == bus_log_under("pbr process")


@pytest.mark.parametrize("policy", ["hold", "release", "latch"])
def test_a_brake_policy_does_not_matter_while_requests_come(policy: str) -> None:
    verdict = passed("--scenario", SHORT, "--pace", "max", "--brake-policy", policy).verdict()
    assert verdict.vehicle is not None
    assert not verdict.vehicle.collision


# -- a real drive --------------------------------------------------------------------------------


def replay(record: Path, *arguments: str) -> list[tuple[int, bytes]]:
    """The decisions over the real log, by id of the request; it must be believed and passed."""
    files = ("--replay", TOYOTA_LOG, "--dbc", TOYOTA_DBC, "--map", "toyota")
    verdict = passed(*files, "--pace", "max", "--record", record, *arguments).verdict()
    assert verdict.requests.sent == verdict.requests.answered > 100
    assert verdict.replay is not None
    gateway, played = verdict.replay["gateway"], verdict.replay["played"]
    assert isinstance(gateway, dict)
    assert isinstance(played, dict)
    assert gateway["refused"] == {}
    assert gateway["accepted"] == played["sent"] == len(TOYOTA_LOG.read_bytes().splitlines())
    assert (played["missing_answers"], played["deceleration_ms2_max"]) == (0, 0.0)
    dialogue = read_record(record).history.dialogue
    return [(e.request_id, e.payload) for e in dialogue if e.kind is EntryKind.ANSWERED]


@pytest.mark.skipif(not TOYOTA_LOG.is_file(), reason="the real drive is not here")
def test_a_real_drive_is_believed_never_braked_and_decided_alike(tmp_path: Path) -> None:
    bare = replay(tmp_path / "none", "--ftm", "none")
    assert replay(tmp_path / "pbr", "--ftm", "pbr") == bare
    fault = "crash primary at checkpoint.sent nth 100"
    assert replay(tmp_path / "crash", "--ftm", "pbr", "--inject", fault) == bare
    assert all(decode_reply(payload).deceleration_ms2 == 0.0 for _, payload in bare)
