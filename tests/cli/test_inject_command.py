"""`aftbed inject`: which fault the run is asked for, and what is refused. See also `test_live_process.py`."""

from pathlib import Path

import msgspec
import pytest
from fakerun import Call, FakeRun, Output

from aftbed.runtime.unix.options import CarRun


@pytest.fixture
def drive(fake: FakeRun, tmp_path: Path) -> FakeRun:
    """A live run that is a drive, with the head of its record."""
    work = msgspec.to_builtins(CarRun("ccrs-50", 1.0, "latch"))
    (tmp_path / "run.json").write_bytes(msgspec.json.encode({"work": work}))
    fake.record = tmp_path
    return fake


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (("crash", "primary"), "crash primary"),
        (("crash", "leader"), "crash primary"),
        (("hang", "follower", "--for", "50ms"), "hang backup for 50ms"),
        (("crash leader at server.exit nth 3",), "crash primary at server.exit nth 3"),
        (("fault", "omission aft2aft in follower nth 5"), "omission aft2aft in backup nth 5"),
        (
            ("crash", "primary", "--at", "checkpoint.sent", "--nth", "3"),
            "crash primary at checkpoint.sent nth 3",
        ),
        (("crash", "a/server", "--after", "200ms"), "crash a/server after 200ms"),
        (("crash", "primary", "--when", "ttc<1.2"), "crash primary when ttc < 1.2"),
        (("crash", "primary", "--when", "gap > 30"), "crash primary when gap > 30"),
        (
            ("hang", "backup", "--for", "50ms", "--at", "reply.sent"),
            "hang backup for 50ms at reply.sent nth 1",
        ),
        (("slow", "primary"), "slow primary by 2ms"),
        (("slow", "primary", "--by", "5ms", "--for", "1s"), "slow primary by 5ms for 1000ms"),
        (
            ("slow", "primary", "--share", "25%", "--after", "2s"),
            "slow primary share 25% after 2000ms",
        ),
        (("omission", "pxy2pro", "--nth", "3"), "omission pxy2pro in primary nth 3"),
        (
            ("omission", "aft2aft", "--replica", "backup", "--permanent"),
            "omission aft2aft in backup nth 1 permanent",
        ),
        (
            ("delay", "pxy2pro", "--by", "5ms", "--every", "3"),
            "delay pxy2pro by 5ms in primary nth 1 intermittent every 3",
        ),
        (
            ("duplicate", "pro2pxy", "--chance", "0.1", "--nth", "2"),
            "duplicate pro2pxy in primary nth 2 intermittent p 0.1",
        ),
        (
            ("reorder", "aft2aft", "--by", "9ms", "--after", "1s", "--permanent"),
            "reorder aft2aft by 9ms in primary after 1000ms permanent",
        ),
        (
            ("bitflip", "result", "--bit", "60", "--nth", "3"),
            "bitflip result bit 60 in primary at server.exit nth 3",
        ),
        (
            ("bitflip", "state", "--bits", "2", "--at", "server.exit", "--nth", "4"),
            "bitflip state bits 2 in primary at server.exit nth 4",
        ),
        (
            ("bitflip", "checkpoint", "--byte", "drawn", "--every", "2"),
            "bitflip checkpoint byte in primary intermittent every 2",
        ),
        (("bitflip", "request", "--byte", "4"), "bitflip request byte 4 in primary"),
        (("bitflip", "log", "--burst", "3", "--bit", "5"), "bitflip log burst 3 bit 5 in primary"),
        (
            ("bitflip", "result", "--stuck", "60=1", "--replica", "backup", "--chance", "0.5"),
            "bitflip result stuck 60=1 in backup intermittent p 0.5",
        ),
        (
            ("bitflip", "b", "--level", "memory", "--unsafe-memory", "--address", "0x7f00", "--bit", "3"),
            "bitflip memory bit 3 address 0x7f00 in b",
        ),
        (("bus", "omission bus RADAR_TRACK for 200ms"), "omission bus RADAR_TRACK for 200ms"),
        (
            ("radar", "ghost", "--range", "30", "--speed", "10", "for", "200ms"),
            "radar ghost range 30 speed 10 for 200ms",
        ),
        (("radar", "bias", "--by", "-5", "--when", "ttc<2"), "radar bias by -5 when ttc < 2 permanent"),
        (
            ("radar", "fov", "--angle", "20", "--after", "1s", "--for", "2s"),
            "radar fov range 150 angle 20 after 1000ms for 2000ms",
        ),
        (("radar", "missed", "--chance", "0.1"), "radar missed intermittent p 0.1"),
    ],
)
def test_the_options_of_a_fault_are_its_words(
    drive: FakeRun, call: Call, arguments: tuple[str, ...], fault: str
) -> None:
    code, out, err = call("inject", *arguments)
    assert (code, out, err) == (0, "", f"run abc123: {fault}\n")
    assert len(drive.faults) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("crash", "primary", "--nth", "2"), "'nth 2' counts an event: 'at EVENT nth 2' is allowed"),
        (
            ("omission", "pxy2pro", "--permanent", "--every", "2"),
            "'permanent' and 'intermittent every 2': one of them is allowed",
        ),
        (("bitflip", "primary", "--level", "memory"), "say --unsafe-memory if that is wanted"),
        (
            ("bitflip", "primary", "--level", "memory", "--unsafe-memory", "--replica", "b"),
            "--replica b: with --level memory the target is 'primary' already",
        ),
        (("bitflip", "primary", "--level", "disk"), "unknown level of a bitflip 'disk'"),
        (("bus", "omission bus RADAR_TRAK"), "RADAR_TRAK"),
        (("radar", "ghost", "--range", "400"), "range '400': a number above 0 and up to 150 m"),
        (("radar", "ghost", "--range", "30", "--for", "-5ms"), "duration '-5ms': a positive number"),
        (("radar", "missed", "--by", "3"), "unknown word in fault 'radar missed by 3': 'by'"),
    ],
)
def test_wrong_options_are_refused(
    drive: FakeRun, refused: Output, arguments: tuple[str, ...], message: str
) -> None:
    assert message in refused("inject", *arguments)
    assert drive.faults == []
