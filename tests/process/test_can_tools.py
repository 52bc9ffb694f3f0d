"""Other people's tools on our logs and on the running bus: can-utils, and python-can's own logger and viewer.

Each is the real tool. Where it is not installed, or the kernel has no CAN, the test is skipped and says so.
"""

import contextlib
import json
import os
import pty
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import can
import msgspec
import pytest
from liveruns import Home
from mcap.reader import make_reader
from tracechecks import problems

from aftbed.interop.logs import READERS, CanLog, LoggedFrame, convert, read_candump, write_candump

pytestmark = pytest.mark.process

SECONDS_MAX: Final = 60.0
LONG_DRIVE: Final = """\
description: an empty road, for as long as a test looks
duration_s: 600
ego: {speed_kmh: 80}
expect: {outcome: no_braking}
"""


def needs(tool: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(
        shutil.which(tool) is None, reason=f"{tool} is not installed (Debian: can-utils)"
    )


def kernel_has_can() -> bool:
    try:
        socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


def aftbed(folder: Path, *words: str) -> str:
    """The output of one command that has to succeed."""
    done = subprocess.run(
        [sys.executable, "-m", "aftbed", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=SECONDS_MAX,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def tool(*words: str) -> str:
    done = subprocess.run(words, capture_output=True, text=True, timeout=SECONDS_MAX, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a drive with a crash and an adaptation in it: so late that there is a backup again."""
    folder = tmp_path_factory.mktemp("drive")
    aftbed(
        folder, "run", "--scenario", "ccrs-50", "--pace", "max", "--record", "rec", "--mcap", "run.mcap",
        "--trace", "run.json", "--inject", "crash primary at checkpoint.sent nth 5",
        "--adapt", "compose pbr+tr at request 260",
    )  # fmt: skip
    return folder


def seen(frames: tuple[LoggedFrame, ...]) -> list[tuple[int, int, bytes]]:
    """Without the date and the direction."""
    return [(frame.t_us - frames[0].t_us, frame.can_id, frame.data) for frame in frames]


@needs("log2asc")
def test_log2asc_reads_what_the_hub_logged_and_we_read_what_it_wrote(record: Path, home: Home) -> None:
    """It takes second 0 for "not begun" and gives each frame in it time 0: so the log gets a date."""
    ours = read_candump(record / "rec" / "bus.log").frames
    log, asc = record / "dated.log", record / "by-can-utils.asc"
    dated = tuple(msgspec.structs.replace(f, t_us=f.t_us + 1_700_000_000_000_000) for f in ours)
    write_candump(CanLog(dated), log)
    tool("log2asc", "-I", str(log), "-O", str(asc), "can0")
    assert seen(READERS["asc"](asc).frames) == seen(ours)
    tool("log2asc", "-I", str(record / "rec" / "bus.log"), "-O", str(asc), "can0")
    assert [one[1:] for one in seen(READERS["asc"](asc).frames)] == [one[1:] for one in seen(ours)]


@needs("asc2log")
def test_asc2log_reads_the_asc_that_we_write(record: Path, home: Home) -> None:
    log, asc, back = record / "rec" / "bus.log", record / "ours.asc", record / "back.log"
    convert(log, asc)
    back.write_text(tool("asc2log", "-I", str(asc)))
    assert seen(read_candump(back).frames) == seen(read_candump(log).frames)


@needs("canplayer")
@pytest.mark.skipif(not kernel_has_can(), reason="canplayer opens a CAN socket, and this kernel has no CAN")
def test_canplayer_plays_what_the_hub_logged(record: Path, home: Home) -> None:
    log = record / "rec" / "bus.log"
    assert tool("canplayer", "-t", "-I", str(log), "stdout=can0") == log.read_text()


def test_a_run_leaves_the_files_that_it_was_asked_for(record: Path, home: Home) -> None:
    """tests/interop/test_exported_runs.py checks the contents; here a real run has them."""

    events = json.loads((record / "run.json").read_text())["traceEvents"]
    assert problems(events) == []
    names = [event["name"] for event in events if event["ph"] in "ib"]
    assert "crash primary at checkpoint.sent nth 5" in names
    assert "adaptation 1" in names
    with (record / "run.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    found = {channel.topic: counts.get(number, 0) for number, channel in summary.channels.items()}
    assert min(found.values()) > 0, found
    assert found["/can"] == len(read_candump(record / "rec" / "bus.log").frames)
    again = aftbed(record, "log", "export", "rec", "--mcap", "again.mcap", "--trace", "again.json")
    assert again == f"again.mcap: {sum(found.values())} messages\nagain.json: {len(events)} trace events\n"


# -- the running bus ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Of a bus on which there is traffic."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        number: int = free.getsockname()[1]
    folder = tmp_path_factory.mktemp("bus")
    (folder / "long.yaml").write_text(LONG_DRIVE)
    words = ["run", "--scenario", "long.yaml", "--bus-port", str(number)]
    command = subprocess.Popen(
        [sys.executable, "-m", "aftbed", *words],
        cwd=folder,
        stdout=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
    )
    assert command.stdout is not None
    try:
        text = b""
        while b"started: " not in text:
            assert select.select([command.stdout], [], [], SECONDS_MAX)[0], text
            got = os.read(command.stdout.fileno(), 65536)
            assert got, text
            text += got
        yield number
    finally:
        command.terminate()
        for _ in iter(lambda: os.read(command.stdout.fileno(), 65536), b""):
            pass
        command.wait(SECONDS_MAX)
        command.stdout.close()


class Attached:
    """A tool of python-can's at the hub, on a terminal of its own."""

    def __init__(self, module: str, port: int, folder: Path, *words: str) -> None:
        where = ["--bus-kwargs", "host=127.0.0.1", f"port={port}"]
        arguments = ["-i", "socketcand", "-c", "can0", *words, *where]
        self._terminal, other = pty.openpty()
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            cwd=folder,
            stdin=other,
            stdout=other,
            stderr=other,
            env=os.environ | {"TERM": "xterm", "LINES": "40", "COLUMNS": "120"},
            start_new_session=True,
        )
        os.close(other)
        self.text = b""

    def wait_for(self, pattern: bytes) -> None:
        """Until its output has `pattern`."""
        limit = time.monotonic() + SECONDS_MAX
        while not re.search(pattern, self.text):
            assert time.monotonic() < limit, self.text[-2000:]
            if not select.select([self._terminal], [], [], 1.0)[0]:
                assert self._process.poll() is None, self.text[-2000:]
                continue
            try:
                self.text += os.read(self._terminal, 65536)
            except OSError:  # it has hung up
                pytest.fail(f"it ended: {self.text[-2000:]!r}")

    def end(self) -> None:
        """As Ctrl-C does; what it still says is taken, or it might wait for that."""
        self._process.send_signal(signal.SIGINT)
        limit = time.monotonic() + SECONDS_MAX
        while self._process.poll() is None and time.monotonic() < limit:
            if select.select([self._terminal], [], [], 0.1)[0]:
                try:
                    os.read(self._terminal, 65536)
                except OSError:
                    break
        try:
            self._process.wait(SECONDS_MAX)
        finally:
            self._process.kill()
            os.close(self._terminal)


def test_python_cans_logger_logs_the_running_bus_in_formats_that_we_read(
    port: int, tmp_path: Path, home: Home
) -> None:
    """One as its program, the others as the program has them."""
    formats = {"blf": "blf", "trc": "trc", "log": "candump"}
    paths = {name: tmp_path / f"theirs.{ending}" for ending, name in formats.items()}
    program = Attached("can.logger", port, tmp_path, "-f", str(tmp_path / "theirs.asc"))
    try:
        program.wait_for(b"Connected to")
        with (
            can.Bus(interface="socketcand", channel="can0", host="127.0.0.1", port=port) as bus,
            contextlib.ExitStack() as files,
        ):
            loggers = [files.enter_context(can.Logger(path)) for path in paths.values()]
            for _ in range(200):
                message = bus.recv(SECONDS_MAX)
                assert message is not None
                for logger in loggers:
                    logger(message)
    finally:
        program.end()
    for name, path in {"asc": tmp_path / "theirs.asc", **paths}.items():
        found = {frame.can_id for frame in READERS[name](path).frames}
        assert {0x100, 0x110, 0x120, 0x130} <= found, name


def test_python_cans_viewer_shows_the_running_bus(port: int, tmp_path: Path, home: Home) -> None:
    viewer = Attached("can.viewer", port, tmp_path)
    try:
        viewer.wait_for(rb"0x130")
        viewer.wait_for(rb"0x100")
    finally:
        viewer.end()
