"""How the live page looks at a run: when the run has ended, when it only does not answer, and its bus."""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Final

import pytest

from aftbed.report import live_page
from aftbed.report.live_page import BusMeter, RunConnection, RunEndedError
from aftbed.runtime.unix import run_directory
from aftbed.runtime.unix.control_client import Answer, ControlRequest, StatusQuery, decode_request
from aftbed.runtime.unix.transport import Line
from aftbed.vehicle.can.bus_model import frame_bits
from aftbed.vehicle.can.candump import log_line
from aftbed.vehicle.can.frame import Frame

SECONDS_MAX: Final = 20.0


class Supervisor:
    """Listens as that of a run does; the test decides what it answers."""

    def __init__(self, private: Path) -> None:
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.listener.bind(str(private / run_directory.SOCKET_NAME))
        self.listener.listen(0)
        self.listener.settimeout(SECONDS_MAX)

    def asked(self) -> Line[ControlRequest]:
        """A connection over which the next request has come."""
        sock, _ = self.listener.accept()
        sock.settimeout(SECONDS_MAX)
        line = Line(sock, decode_request)
        got = line.recv()
        assert got is not None and got[0] == StatusQuery()
        return line


class Asking:
    """A question to the run, which waits for its answer in a thread."""

    def __init__(self, private: Path) -> None:
        self.silent = threading.Event()
        self.found: dict[str, object] | None = None
        self.ended = False
        self._run = RunConnection(private, self._on_silence)
        self._thread = threading.Thread(target=self._ask)
        self._thread.start()

    def _on_silence(self, seconds: float) -> None:
        assert seconds >= 0
        self.silent.set()

    def _ask(self) -> None:
        try:
            self.found = self._run.ask(StatusQuery())
        except RunEndedError:
            self.ended = True
        finally:
            self._run.close()

    def wait(self) -> None:
        self._thread.join(SECONDS_MAX)
        assert not self._thread.is_alive()


@pytest.fixture
def supervisor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Supervisor]:
    monkeypatch.setattr(live_page, "SILENT_S", 0.01)
    monkeypatch.setattr(live_page, "PERIOD_S", 0.0)
    monkeypatch.setattr(run_directory, "ANSWER_SECONDS_MAX", 0.01)
    found = Supervisor(tmp_path)
    with closing(found.listener):
        yield found


def answer(line: Line[ControlRequest]) -> None:
    line.send(Answer(b'{"run": "abc123"}'))


def test_a_run_that_does_not_answer_has_not_ended(supervisor: Supervisor, tmp_path: Path) -> None:
    asking = Asking(tmp_path)
    with closing(supervisor.asked()) as line:
        assert asking.silent.wait(SECONDS_MAX)
        answer(line)
        asking.wait()
    assert asking.found == {"run": "abc123"} and not asking.ended


def test_nor_has_one_that_takes_no_connection(supervisor: Supervisor, tmp_path: Path) -> None:
    with run_directory.connect(tmp_path):  # its queue is full
        asking = Asking(tmp_path)
        assert asking.silent.wait(SECONDS_MAX)
        supervisor.listener.accept()[0].close()
        with closing(supervisor.asked()) as line:
            answer(line)
            asking.wait()
    assert asking.found is not None


def test_nor_has_one_that_closes_the_connection(supervisor: Supervisor, tmp_path: Path) -> None:
    """As it does with one too many."""
    asking = Asking(tmp_path)
    supervisor.asked().close()
    with closing(supervisor.asked()) as line:
        answer(line)
        asking.wait()
    assert asking.found is not None


@pytest.mark.parametrize("remove", [lambda private: None, lambda private: (private / "control").unlink()])
def test_a_run_whose_socket_is_closed_has_ended(
    supervisor: Supervisor, tmp_path: Path, remove: Callable[[Path], None]
) -> None:
    """Whether its directory is there still, or has been removed."""
    asking = Asking(tmp_path)
    line = supervisor.asked()
    supervisor.listener.close()
    remove(tmp_path)
    line.close()
    asking.wait()
    assert asking.ended


def test_the_end_is_seen_without_a_question(supervisor: Supervisor, tmp_path: Path) -> None:
    run = RunConnection(tmp_path, lambda seconds: None)
    run.check()
    sock, _ = supervisor.listener.accept()
    run.check()
    supervisor.listener.close()
    sock.close()
    with pytest.raises(RunEndedError):
        run.check()


def test_the_load_is_that_of_the_frames_since_the_last_look(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    meter = BusMeter(log)
    meter.read(None)
    assert meter.load_percent is None, "a load has no bus"
    meter.read(500_000)
    assert meter.load_percent == 0.0, "no frame yet"
    with log.open("a") as file:
        for look, frames in enumerate((10, 20, 0)):
            ends_us = (look + 1) * 100_000
            for _ in range(frames):
                file.write(log_line(Frame(ends_us, 0x130, bytes(8)), "can0"))
            file.flush()
            meter.read(500_000)
            assert meter.load_percent == pytest.approx(frames * frame_bits(8) / 500)
            assert meter.frames_s == frames * 10
