"""Real runs whose bus strangers flood and forge frames on, from before the first node of the run is on it."""

import os
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import pytest
from busharness import DEADLINE_S, RawClient
from liveruns import Home, Started, aftbed, until

from aftbed.runtime.unix.options import CarRun
from aftbed.runtime.unix.run_directory import members
from aftbed.vehicle.can.hub import BEACON

pytestmark = pytest.mark.process

DRIVE: Final = CarRun("ccrs-20", None, "latch")
FORGED: Final = b"< send 130 8 0 1 2 3 4 5 6 7 >"  # RADAR_TRACK
ANSWER: Final = "< frame 100 "  # AEB_REQ
FLOODS: Final = 2
SECRET: Final = re.compile(rb"(?<![0-9a-f])[0-9a-f]{32}(?![0-9a-f])")


@contextmanager
def flooded(port: int) -> Iterator[None]:
    """As much as the hub takes, and again whenever it puts the stranger out."""
    over = threading.Event()

    def flood() -> None:
        while not over.is_set():
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), DEADLINE_S) as stranger:
                stranger.sendall(b"< open can0 >< rawmode >")
                while not over.is_set():
                    stranger.sendall(FORGED * 100)

    floods = [threading.Thread(target=flood) for _ in range(FLOODS)]
    for one in floods:
        one.start()
    try:
        yield
    finally:
        over.set()
        for one in floods:
            one.join()


def readable_of(pid: int) -> bytes:
    """The command line and the environment of a process; nothing of one that has ended."""
    about = Path(f"/proc/{pid}")
    with suppress(FileNotFoundError, ProcessLookupError):
        return (about / "cmdline").read_bytes() + (about / "environ").read_bytes()
    return b""


def test_a_flood_of_forged_frames_does_not_starve_a_run_and_is_told(home: Home, tmp_path: Path) -> None:
    """And the secret of the bus is in no file of the record, on no command line, in no environment."""
    with Started(home, DRIVE, record=tmp_path / "record") as run, flooded(run.launched.options.port):
        run.wait_for("started")
        own = [one for one in members() if one.run == str(run.private)]
        seen = b"".join(readable_of(one.pid) for one in own)
        outcome = run.finish()
    verdict = outcome.verdict
    # How many the drive has depends on what its car is told, and by forged frames, too.
    assert verdict.requests.answered == verdict.requests.sent and verdict.checks["complete"] == "pass"
    assert verdict.checks["no_forged_frames"] == "unknown" and verdict.verdict != "pass"
    assert {name for name, word in verdict.checks.items() if word == "fail"} <= {"vehicle"}
    (stranger,) = verdict.strangers
    assert stranger.forged == {"RADAR_TRACK": stranger.frames} and stranger.put_out_fast
    assert any(text.endswith("is on the bus") for text in outcome.told("bus"))
    assert aftbed("check", tmp_path / "record", "--html", tmp_path / "run.html").code == 3
    assert f"{stranger.frames} RADAR_TRACK)" in (tmp_path / "run.html").read_text()
    files = [path for path in (tmp_path / "record").rglob("*") if path.is_file()]
    of_the_test = "\0".join(os.environ.values()).encode()
    assert seen and set(SECRET.findall(seen)) <= set(SECRET.findall(of_the_test))
    assert [path.name for path in files if SECRET.search(path.read_bytes())] == []


def test_on_a_bus_that_was_opened_a_listener_and_a_sender_change_no_verdict(home: Home) -> None:
    with Started(home, DRIVE, bus_open=True) as run, RawClient(run.launched.options.port) as stranger:
        stranger.write("< send 701 1 1 >")
        stranger.fence()
        outcome = run.finish()
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    (found,) = outcome.verdict.strangers
    assert (found.connections, found.frames) == (1, 1)


@contextmanager
def beacons() -> Iterator[socket.socket]:
    """Where beacons arrive. Only one program of a machine can listen there, so it may take some seconds."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:

        def bound() -> bool:
            with suppress(OSError):
                ear.bind(BEACON)
                return True
            return False

        until(bound, "no other program listens for beacons")
        yield ear


def test_a_stranger_finds_the_run_and_cannot_be_its_car(home: Home) -> None:
    """And it is told when the run ends. Other runs on this machine have beacons, too."""
    with beacons() as ear, Started(home, CarRun("free-drive", 1.0, "latch", 60_000)) as run:
        port = run.launched.options.port
        ear.settimeout(DEADLINE_S)
        while f"<URL>can://127.0.0.1:{port}</URL>".encode() not in (beacon := ear.recv(1024)):
            pass
        assert f'<CANBeacon name="aftbed run {run.private.name}"'.encode() in beacon
        run.wait_for("started")
        with RawClient(port) as stranger:
            stranger.write("< aftbed plant >")
            while "only the nodes of the run may do this" not in stranger.read():
                pass
            while not stranger.read().startswith(ANSWER):  # a run without one proves nothing
                pass
            run.launched.stop()
            outcome = run.finish()
            last = element = stranger.read()
            while element:
                last, element = element, stranger.read()
    assert last.endswith("the run has ended >")
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    (found,) = outcome.verdict.strangers
    assert (found.connections, found.refused, found.commands_refused, found.frames) == (1, 1, 1, 0)
