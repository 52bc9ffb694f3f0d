"""The live page of a run: what it shows, what its buttons do, and which requests are refused."""

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs, urlsplit

import psutil
import pytest
from browser import driven, needs_browser
from liveruns import Command, Home, aftbed, ended, forked, until

from aftbed.report import live_page
from aftbed.runtime.unix import run_directory
from aftbed.runtime.unix.control_client import processes
from aftbed.vehicle.can.bus_model import frame_bits

pytestmark = pytest.mark.process

NOBODY: Final = 65534
SECONDS_MAX: Final = 20.0
ENDLESS: Final = ("--load", "1000000@100")
DRIVE: Final = ("--scenario", "free-drive", "--pace", "0.2")
DENSE: Final = ("--scenario", "free-drive", "--duration", "90s")  # some requests wait in each hang


@pytest.fixture
def run(home: Home) -> Iterator[Command]:
    """A run with a page, and without an end."""
    with Command(*ENDLESS, "--web") as command:
        command.started()
        yield command


def address(command: Command) -> str:
    return command.wait_for_error_line("page: ").split()[1]


def asked(
    shown: str, method: str = "GET", place: str = "/", body: str | None = None, **headers: str
) -> tuple[int, str]:
    """The answer of the page's server to a request as a browser sends it, but for `headers`: "" for none."""
    where, token = urlsplit(shown), parse_qs(urlsplit(shown).query)["token"][0]
    given = {"host": where.netloc, "origin": f"http://{where.netloc}", "token": token} | headers
    assert where.port is not None
    line = http.client.HTTPConnection("127.0.0.1", where.port, timeout=SECONDS_MAX)
    try:
        query = f"?token={given.pop('token')}"
        line.putrequest(method, place + query, skip_host=True)
        for name, value in given.items():
            if value:
                line.putheader(name, value)
        if body is not None:
            line.putheader("Content-Length", str(len(body)))
        line.endheaders(body.encode() if body is not None else None)
        answer = line.getresponse()
        return answer.status, answer.read().decode()
    finally:
        line.close()


def told(shown: str, words: str) -> tuple[int, str]:
    """The exit code and the output of a command that the page has sent."""
    status, text = asked(shown, "POST", "/command", words)
    assert status == 200, text
    found = json.loads(text)
    return found["code"], found["text"]


def stream(shown: str) -> socket.socket:
    """A connection that has asked for the snapshots."""
    where = urlsplit(shown)
    assert where.port is not None
    line = socket.create_connection(("127.0.0.1", where.port), SECONDS_MAX)
    line.sendall(f"GET /stream?{where.query} HTTP/1.1\r\nHost: {where.netloc}\r\n\r\n".encode())
    return line


def snapshots(line: socket.socket) -> Iterator[live_page.Snapshot]:
    """What comes, until the run has ended."""
    with line.makefile("rb") as lines:
        for text in lines:
            if text.startswith(b"event: end"):
                return
            if text.startswith(b"data: "):
                yield live_page.decode_snapshot(text[6:])


@needs_browser
def test_it_shows_a_crash_and_a_composition_that_its_buttons_asked_for(home: Home, tmp_path: Path) -> None:
    with Command(*DENSE, "--web") as command:
        command.wait_until_it_drives()
        with driven(tmp_path) as page:
            page.open(address(command))
            page.until("document.querySelectorAll('.node').length == 16")
            page.until("document.querySelectorAll('#plots svg').length >= 2")
            assert page.value("document.querySelectorAll('.node.dead').length") == 0
            page.value("document.querySelector('[data-words=\"inject crash primary\"]').click()")
            page.until("document.querySelector('[data-fact=leader]').textContent == 'b'")
            page.until("document.querySelector('[data-fact=backup]').textContent == 'a'")
            page.until("document.getElementById('events').textContent.includes('alarm: a: crash')")
            page.value("document.getElementById('mechanism').value = 'pbr+tr'")
            page.value("document.querySelector('[data-verb=compose]').click()")
            page.until("document.querySelector('[data-fact=mechanism]').textContent == 'pbr+tr'")
            page.until("document.getElementById('answer').textContent.includes('pbr to pbr+tr: done')")
            page.until("!!document.querySelector('[data-node=\"a/tr.after\"]')")
            page.until("document.querySelector('[data-fact=\"last blackout\"]').textContent.endsWith(' ms')")
            page.value("document.querySelector('[data-words=\"inject hang primary\"]').click()")
            page.until("document.getElementById('events').textContent.includes('alarm: b: hang')")
            page.until("parseFloat(document.querySelector('[data-fact=\"slowest reply\"]').textContent) > 5")
            for width, dark in ((1280, False), (420, True)):
                page.look(tmp_path / f"page{width}.png", width, dark=dark)
                assert page.value("document.documentElement.scrollWidth <= innerWidth"), width
            page.value("document.querySelector('[data-words=stop]').click()")
            page.until("document.getElementById('state').textContent.includes('has ended')")
            assert page.value("[...document.querySelectorAll('button')].every((one) => one.disabled)")
        done = command.done()
    assert done.code == 0, done.out + done.err
    assert "crash primary: activated" in done.out
    assert "at the end pbr+tr" in done.out


@needs_browser
def test_of_a_replay_it_shows_what_the_function_sees(
    home: Home, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert aftbed("init", "map", "mine").code == 0
    log = ("--replay", "mine.log", "--dbc", "ars408-like", "--map", "mine.yaml", "--loop")
    with Command(*log, "--web") as command, driven(tmp_path) as page:
        page.open(address(command))
        page.until("document.getElementById('road').textContent.includes('km/h, demand: ')")
        page.until("document.getElementById('plots').textContent.includes('gap (m)')")
        page.look(tmp_path / "replay.png")
        assert aftbed("stop").code == 0
        assert command.done().code == 0


def test_who_must_not_get_it_is_refused_and_changes_nothing(run: Command) -> None:
    shown = address(run)
    crash = ("POST", "/command", "inject crash primary")
    other = "http://127.0.0.1:1"
    for found, words in (
        (asked(shown, token=""), "open the whole address"),
        (asked(shown, token="x"), "open the whole address"),
        (asked(shown, place="/stream", token="x"), "open the whole address"),
        (asked(shown, *crash, token="x"), "open the whole address"),
        (asked(shown, *crash, origin=other), "a page from elsewhere"),
        (asked(shown, *crash, origin=""), "a page from elsewhere"),
        (asked(shown, place="/stream", origin="null"), "a page from elsewhere"),
        (asked(shown, host="made.up:80"), "ask for http://127.0.0.1:"),
    ):
        assert found[0] == 403 and found[1].startswith(words), found
    assert asked(shown, place="/other")[0] == 404
    assert asked(shown, "POST", "/command", "x" * 1001) == (413, "a command has at most 1000 bytes")
    status = json.loads(aftbed("status", "--json").out)
    assert (status["epoch"], status["leader"]) == (1, "a")
    assert aftbed("stop").code == 0
    done = run.done()
    assert done.code == 0, done.out + done.err


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a socket of another user")
def test_another_user_of_the_machine_is_refused(run: Command) -> None:
    """A socket is that of the effective user who makes it."""
    shown = address(run)
    assert asked(shown)[0] == 200
    os.seteuid(NOBODY)
    try:
        found = asked(shown)
    finally:
        os.seteuid(0)
    assert found == (403, "this page belongs to another user of the machine")


def test_a_command_is_that_of_a_second_terminal(run: Command) -> None:
    shown = address(run)
    code, text = told(shown, "inject crash primary")
    assert (code, text.split(": ", 1)[1]) == (0, "crash primary")
    until(lambda: json.loads(aftbed("status", "--json").out)["backup"] == "a", "a new backup")
    code, text = told(shown, "adapt to lfrr")
    assert code == 2 and "did you mean 'lfr'" in text
    assert told(shown, "doctor --clean") == (2, "doctor: adapt, inject, stop are allowed here")
    assert told(shown, "inject 'crash") == (2, "inject 'crash: quotation marks come in pairs")
    assert told(shown, "inject crash\0") == (2, "a command has no null bytes")
    assert told(shown, "") == (2, "nothing: adapt, inject, stop are allowed here")
    assert told(shown, "stop")[0] == 0
    assert run.done().code == 0


def supervisor_of(private: Path) -> int:
    """The pid of the run's supervisor."""
    return next(row.pid for row in processes(private) if row.name == "supervisor")


def server_of(run: Command) -> psutil.Process:
    """The process that serves the page."""
    return next(p for p in psutil.Process(run.pid).children() if "aftbed.report.live_page" in p.cmdline())


def test_a_command_that_is_under_way_at_the_end_of_the_run_is_answered(run: Command) -> None:
    shown = address(run)
    server, supervisor = server_of(run), supervisor_of(run_directory.find(None))
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(told, shown, "inject crash primary")
        (command,) = until(server.children, "the command")
        assert command.nice() < server.nice()
        command.suspend()
        try:
            assert aftbed("stop").code == 0
            assert ended(supervisor) and not ended(server.pid, 1.0)
        finally:
            command.resume()
        code, text = answer.result(SECONDS_MAX)
    assert (code, "no such run is alive" in text) == (2, True), text
    assert run.done().code == 0


def test_a_browser_that_does_not_read_holds_up_nobody(run: Command) -> None:
    shown = address(run)
    with stream(shown), stream(shown) as other:
        seen = snapshots(other)
        first = next(seen)
        assert len(first.nodes) == 16 and {row.name for row in first.processes} >= set(first.nodes)
        assert [one["event"] for one in first.events] == ["started", "roles"]
        later = next(one for one in seen if one.status["seconds"] != first.status["seconds"])
        assert later.events == [], "each event comes once"
        assert told(shown, "stop")[0] == 0
        assert not [one.status for one in seen if one.status["run"] != first.status["run"]]
    done = run.done()
    assert done.code == 0, done.out + done.err


def test_a_run_that_is_stopped_for_a_while_has_not_ended(run: Command) -> None:
    """Its pages are told that it does not answer, and go on when it does."""
    shown = address(run)
    supervisor = supervisor_of(run_directory.find(None))
    with stream(shown) as line:
        seen = snapshots(line)
        assert not next(seen).silent_s
        os.kill(supervisor, signal.SIGSTOP)
        try:
            silent = next(one for one in seen if one.silent_s > 2.5)
        finally:
            os.kill(supervisor, signal.SIGCONT)
        assert len(silent.nodes) == 16
        later = next(one for one in seen if not one.silent_s)
        assert later.status["seconds"] != silent.status["seconds"]
        assert told(shown, "stop")[0] == 0
        assert all(not one.silent_s for one in seen)
    done = run.done()
    assert done.code == 0, done.out + done.err


def test_the_load_of_the_bus_is_that_of_the_drive(home: Home) -> None:
    """Of RADAR_TRACK, AEB_REQ, BRAKE_STATUS and EGO_STATE, at 50 kbit/s: some 40 %, and never none."""
    with Command(*DRIVE, "--web", "--bitrate", "50000") as command:
        command.wait_until_it_drives()
        shown = address(command)
        with stream(shown) as line:
            one = next(one for one in snapshots(line) if one.load_percent)
            assert one.frames_s and one.load_percent
            assert one.load_percent == pytest.approx(one.frames_s * frame_bits(8) / 500, rel=0.05)
            assert told(shown, "stop")[0] == 0
        assert command.done().code == 0


def test_it_ends_with_the_command_whatever_ends_that(run: Command) -> None:
    address(run)
    server = server_of(run)
    os.kill(run.pid, signal.SIGKILL)
    assert ended(server.pid, 1.0)


def test_the_page_of_a_run_that_lives_ends_with_it(home: Home) -> None:
    with Command(*ENDLESS) as command:
        run = command.started()
        page = subprocess.Popen(
            [sys.executable, "-m", "aftbed", "web", "--run", run], stdout=subprocess.PIPE, text=True
        )
        with page:
            assert page.stdout is not None
            shown = page.stdout.readline().removeprefix(f"run {run}: ").strip()
            assert asked(shown)[0] == 200
            assert told(shown, "stop")[0] == 0
            assert page.stdout.read() == f"run {run} has ended\n"
        assert page.returncode == 0
        assert command.done().code == 0


def test_a_port_that_is_taken_and_options_that_say_nothing_are_refused(home: Home) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        for arguments, words in (
            (("run", "--web", "--port", port), f"--port {port}: Address already in use; choose another"),
            (("run", "--web", "--port", "70000"), "--port 70000: 0 to 65535 are allowed"),
            (("run", "--port", port), "only with --web: leave out --port"),
            (("run", "--open"), "only with --web: leave out --open"),
            (("web",), "no run is alive"),
        ):
            done = forked(*arguments)
            assert done.code == 2 and words in done.err, done
    assert run_directory.live() == []
