"""The live page of a run: what happens on the road, in the graph and on the bus, and the words that steer it.

A process of its own serves it, at a low priority: while there is a page, it asks the run for its status as
`aftbed status` does, and reads the event log and the bus log as they grow. It asks for nodes and processes
only where an event says that they may have changed, and each `LOOK_S`. The run does not know of it, and a
browser that does not read holds up nothing but its own connection. Commands run at a higher priority.

It keeps one connection to the run, which ends with the run: then, and only then, the run has ended. A run
that does not answer is stopped, or has no CPU; the pages are told for how long (`Snapshot.silent_s`).

| request                    | answer                                                                    |
|----------------------------|---------------------------------------------------------------------------|
| `GET /?token=TOKEN`        | the page: one file, no request beyond the next two                        |
| `GET /stream?token=TOKEN`  | Server-Sent Events: a `Snapshot` as JSON, `PERIOD_S` apart; `end` at last |
| `POST /command?token=...`  | a body such as `inject crash primary`: what `aftbed` answers              |

Refused with 403: a process of another user, a request without the token, one with another Host (a name that
was made to lead here) or from a page of another Origin.
"""

import contextlib
import hmac
import json
import math
import os
import queue
import secrets
import select
import shlex
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import parse_qs, urlsplit

import msgspec

from aftbed.core.errors import AftbedError, ConfigError
from aftbed.core.graph import Graph
from aftbed.ftm.compose import expressions
from aftbed.report.steering import ANSWER_CHARACTERS_MAX, COMMAND_S_MAX, start_command
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.unix import control_client, linux, run_directory
from aftbed.runtime.unix.control_client import ProcessRow
from aftbed.runtime.unix.run_directory import BUS_NAME, EVENT_LOG_NAME
from aftbed.runtime.unix.transport import Line
from aftbed.vehicle.can.bus_load import load_percent, logged_frame
from aftbed.vehicle.can.hub import user_behind

HOST: Final = "127.0.0.1"
PERIOD_S: Final = 0.1  # between two snapshots
IDLE_S: Final = 0.4  # between two looks whether the run lives, while there is no page
LOOK_S: Final = 1.0  # between two looks at nodes and processes; for so long behind an event, each period
SILENT_S: Final = 1.0  # without an answer until the pages are told, and between two times that they are
LAST_COMMAND_S_MAX: Final = 3.0  # behind the end of the run, until the commands of pages have been answered
LAST_S_MAX: Final = 0.2  # that the pages may take to read the end
END_S_MAX: Final = LAST_COMMAND_S_MAX + LAST_S_MAX + 0.2  # from the end of the run to that of the server
CONNECTIONS_MAX: Final = 16
COMMANDS_MAX: Final = 2  # at once
COMMAND_BYTES_MAX: Final = 1000
SEND_S_MAX: Final = 5.0  # that a browser may take to read, or to send its request
EVENTS_KEPT: Final = 500
READ_BYTES_MAX: Final = 1_000_000  # of a log, at once
NICE: Final = 19
TOKEN_VARIABLE: Final = "AFTBED_PAGE_TOKEN"  # not an argument: other users can read those
POLICY: Final = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self';"
    " img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Snapshot(msgspec.Struct, frozen=True):
    """The run as it is now.

    `status` is that of `aftbed status --json`; `nodes` has the nodes of the graph with their bricks, dead
    ones too, `processes` those that live. `events` are those since the last snapshot. `frames_s` and
    `load_percent` (with stuffing at its worst, see `bus_load`) are of the bus, by its time; None without one.
    `blackout_ms`: of the last adaptation. `silent_s`: for how long the run has not answered; all else is then
    as before.
    """

    status: dict[str, object]
    nodes: dict[str, tuple[str, ...]]
    processes: list[ProcessRow]
    frames_s: float | None
    load_percent: float | None
    blackout_ms: float | None
    events: list[dict[str, object]]
    silent_s: float = 0.0


decode_snapshot: Final = msgspec.json.Decoder(Snapshot).decode


class GrowingFile:
    """The whole lines that were appended to a file since the last look; it need not exist yet."""

    def __init__(self, path: Path) -> None:
        self._path, self._offset, self._rest = path, 0, b""

    def lines(self) -> list[bytes]:
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                data = file.read(READ_BYTES_MAX)
        except OSError:
            return []
        self._offset += len(data)
        *whole, self._rest = (self._rest + data).split(b"\n")
        return whole


class BusMeter:
    """What the log of the bus says since the last look, by its own time; None where there is no bus."""

    def __init__(self, path: Path) -> None:
        self._log = GrowingFile(path)
        self._until_us = 0
        self.frames_s: float | None = None
        self.load_percent: float | None = None

    def read(self, bitrate_bps: object) -> None:
        if not isinstance(bitrate_bps, int):
            return
        frames = [found for line in self._log.lines() if (found := logged_frame(line + b"\n")) is not None]
        since_us, self._until_us = self._until_us, frames[-1][0] if frames else self._until_us
        seconds = (self._until_us - since_us) / 1e6
        self.frames_s = round(len(frames) / seconds, 1) if seconds > 0 else 0.0
        self.load_percent = round(load_percent(frames, since_us, self._until_us, bitrate_bps), 2)


class RunEndedError(AftbedError):
    """The run has ended."""


class RunConnection:
    """One connection to the run in `private`, which ends with it."""

    def __init__(self, private: Path, silent: Callable[[float], None]) -> None:
        self._private, self._silent = private, silent
        self._line: Line[control_client.Answer] | None = None

    def await_start(self) -> None:
        """Return when the run can be asked."""
        while True:
            with contextlib.suppress(OSError):
                self._line = self._connected()
                return
            time.sleep(PERIOD_S)

    def close(self) -> None:
        if self._line is not None:
            self._line.close()

    def check(self) -> None:
        """Raise RunEndedError if it has ended."""
        if self._line is not None and select.select([self._line], [], [], 0)[0]:  # no answer is owed: an end
            self._give_up(self._line)
        if self._line is None:
            self._line = self._reconnected()

    def ask(self, request: control_client.ControlRequest) -> dict[str, object]:
        """Its answer, however long it takes; `silent` is called while there is none. Raises RunEndedError."""
        asked_s = time.monotonic()
        while True:
            line = self._line = self._line or self._reconnected()
            try:
                line.send(request)
                while not select.select([line], [], [], SILENT_S)[0]:
                    self._silent(time.monotonic() - asked_s)
                got = line.recv()
            except OSError:
                got = None
            if got is not None:
                answer = json.loads(got[0].data)
                assert isinstance(answer, dict)
                return answer
            self._give_up(line)

    def _reconnected(self) -> Line[control_client.Answer]:
        """After an end that may have been one of the connection alone: there were too many."""
        asked_s = time.monotonic()
        while True:
            try:
                return self._connected()
            except (FileNotFoundError, ConnectionRefusedError):
                raise RunEndedError(self._private.name) from None
            except OSError:  # the run is too busy to take it
                self._silent(time.monotonic() - asked_s)

    def _connected(self) -> Line[control_client.Answer]:
        return Line(run_directory.connect(self._private), control_client.decode_answer)

    def _give_up(self, line: Line[control_client.Answer]) -> None:
        line.close()
        self._line = None
        time.sleep(PERIOD_S)


class Looked(NamedTuple):
    """What a snapshot has of the graph: its nodes, the processes of those that live, the last blackout."""

    nodes: dict[str, tuple[str, ...]]
    processes: list[ProcessRow]
    blackout_ms: float | None


class RunWatcher:
    """Looks at the run for all pages at once."""

    def __init__(self, private: Path) -> None:
        self._run = RunConnection(private, self._tell_silence)
        self._changed = threading.Condition()
        self._now: Snapshot | None = None
        self._number = 0  # of the snapshot
        self._events: deque[dict[str, object]] = deque(maxlen=EVENTS_KEPT)
        self._events_seen = 0
        self._pages = 0
        self._ended = False

    def run(self, *, starting: bool) -> None:
        """Look until the run has ended; seldom, and only whether it lives, while there is no page.

        `starting`: it may not be there yet.
        """
        try:
            if starting:
                self._run.await_start()
            record = Path(str(self._run.ask(control_client.StatusQuery())["record"]))
            events, bus = GrowingFile(record / EVENT_LOG_NAME), BusMeter(record / BUS_NAME)
            graph = Looked({}, [], None)
            looked_s = changed_s = -math.inf
            while True:
                if self._pages:
                    status = self._run.ask(control_client.StatusQuery())
                    lines, now_s = events.lines(), time.monotonic()
                    if lines:
                        changed_s = now_s
                    if now_s - changed_s < LOOK_S or now_s - looked_s >= LOOK_S:
                        graph, looked_s = self._look(), now_s
                    bus.read(status.get("bitrate_bps"))
                    self._tell(
                        Snapshot(status, *graph[:2], bus.frames_s, bus.load_percent, graph[2], []), lines
                    )
                with self._changed:
                    if not self._pages:
                        self._changed.wait(IDLE_S)
                time.sleep(PERIOD_S)
                self._run.check()
        except RunEndedError:
            with self._changed:
                self._ended = True
                self._changed.notify_all()
        finally:
            self._run.close()

    def _look(self) -> Looked:
        graph = msgspec.convert(self._run.ask(control_client.GraphQuery()), Graph)
        rows = control_client.process_rows(self._run.ask(control_client.ProcessesQuery()))
        ended = self._run.ask(control_client.AdaptationsQuery())["adaptations"]
        blackouts = [one.blackout_ms for one in msgspec.convert(ended, list[Outcome])]
        return Looked(graph.nodes, [row for row in rows if row.node], blackouts[-1] if blackouts else None)

    def _tell(self, snapshot: Snapshot, lines: Sequence[bytes] = ()) -> None:
        with self._changed:
            self._events += map(json.loads, lines)
            self._events_seen += len(lines)
            self._now = snapshot
            self._number += 1
            self._changed.notify_all()

    def _tell_silence(self, seconds: float) -> None:
        if self._now is not None:
            self._tell(msgspec.structs.replace(self._now, silent_s=round(seconds, 1)))

    def snapshots(self) -> Generator[Snapshot, None, None]:
        """For one page, from now on; the events that are kept come with the first."""
        number = seen = 0
        with self._changed:
            self._pages += 1
            self._changed.notify_all()
        try:
            while True:
                with self._changed:
                    while not self._ended and self._number <= number:
                        self._changed.wait(SEND_S_MAX)
                    if self._ended or self._now is None:
                        return
                    new = min(self._events_seen - seen, len(self._events))
                    events = list(self._events)[len(self._events) - new :]
                    number, seen = self._number, self._events_seen
                    snapshot = msgspec.structs.replace(self._now, events=events)
                yield snapshot
        finally:
            with self._changed:
                self._pages -= 1


class Launcher:
    """Starts commands, in a thread that keeps the priority which the thread has that makes the Launcher."""

    def __init__(self) -> None:
        self._wanted: queue.SimpleQueue[tuple[Sequence[str], Path, Future[subprocess.Popen[str]]]] = (
            queue.SimpleQueue()
        )
        threading.Thread(target=self._serve, daemon=True).start()

    def start(self, words: Sequence[str], private: Path) -> subprocess.Popen[str]:
        """As `start_command`."""
        started: Future[subprocess.Popen[str]] = Future()
        self._wanted.put((words, private, started))
        return started.result()

    def _serve(self) -> None:
        while True:
            words, private, started = self._wanted.get()
            try:
                started.set_result(start_command(words, private))
            except (ConfigError, OSError, ValueError) as error:  # ValueError: a null byte among the words
                started.set_exception(error)


class PageServer(ThreadingHTTPServer):
    """Serves the page of one run on `listener`, which is bound and listens."""

    daemon_threads = True

    def __init__(self, listener: socket.socket, private: Path, token: str, launcher: Launcher) -> None:
        super().__init__(listener.getsockname(), PageRequest, bind_and_activate=False)
        self.socket.close()
        self.socket = listener
        self.private, self.token, self.launcher = private, token, launcher
        self.port = int(listener.getsockname()[1])
        self.watcher = RunWatcher(private)
        self.commands = threading.Semaphore(COMMANDS_MAX)
        self._room = threading.Semaphore(CONNECTIONS_MAX)

    def verify_request(self, request: object, client_address: object) -> bool:
        assert isinstance(request, socket.socket)
        request.settimeout(SEND_S_MAX)
        return self._room.acquire(blocking=False)

    def process_request_thread(self, request: object, client_address: object) -> None:
        try:
            super().process_request_thread(request, client_address)  # type: ignore[arg-type]
        finally:
            self._room.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that went away, or did not read, is no trouble; anything else is printed."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]

    def serve_until_the_end(self, *, starting: bool) -> None:
        """Serve until the run has ended. `starting`: it may not be there yet."""
        serving = threading.Thread(target=self.serve_forever, args=(PERIOD_S,), daemon=True)
        serving.start()
        self.watcher.run(starting=starting)
        self.shutdown()
        _acquire_all(self.commands, COMMANDS_MAX, LAST_COMMAND_S_MAX)  # as the one that has stopped the run
        _acquire_all(self._room, CONNECTIONS_MAX, LAST_S_MAX)  # each page has been sent the end
        self.server_close()

    def refusal(self, handler: "PageRequest") -> str:
        """Why a request is refused; "" if it is not."""
        uid = user_behind(handler.connection)
        if uid != os.getuid():
            return "this page belongs to another user of the machine"
        here = (f"{HOST}:{self.port}", f"localhost:{self.port}")
        if handler.headers.get("Host") not in here:
            return f"ask for http://{here[0]}"
        origin = handler.headers.get("Origin")  # a browser sends it with each POST
        may_lack = handler.command == "GET" and origin is None
        if not may_lack and origin not in [f"http://{name}" for name in here]:
            return "a page from elsewhere may not steer this run"
        given = parse_qs(urlsplit(handler.path).query).get("token", [""])[0]
        if not hmac.compare_digest(given.encode(), self.token.encode()):
            return "open the whole address that `aftbed` has printed, with its token"
        return ""


def _acquire_all(room: threading.Semaphore, count: int, seconds_max: float) -> None:
    """Wait until all `count` places of `room` are free, for `seconds_max` at most."""
    limit_s = time.monotonic() + seconds_max
    for _ in range(count):
        room.acquire(timeout=max(0.0, limit_s - time.monotonic()))


class PageRequest(BaseHTTPRequestHandler):
    """One request of a browser."""

    server: PageServer
    server_version, sys_version = "aftbed", ""

    def do_GET(self) -> None:
        place = urlsplit(self.path).path
        if why := self.server.refusal(self):
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", why)
        elif place == "/":
            nonce = secrets.token_urlsafe(12)
            page = resources.files("aftbed.report").joinpath("templates/live.html").read_text("utf-8")
            options = "".join(f"<option>{expression}</option>" for expression in expressions())
            page = page.replace("MECHANISMS", options).replace("NONCE", nonce)
            self._answer(HTTPStatus.OK, "text/html", page, nonce)
        elif place == "/stream":
            self._stream()
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", f"there is no {place} here")

    def do_POST(self) -> None:
        if why := self.server.refusal(self):
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", why)
            return
        length = self.headers.get("Content-Length", "")
        if urlsplit(self.path).path != "/command" or not length.isdecimal():
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", "POST /command with the words of a command")
        elif int(length) > COMMAND_BYTES_MAX:
            why = f"a command has at most {COMMAND_BYTES_MAX} bytes"
            self._answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "text/plain", why)
        else:
            words = self.rfile.read(int(length)).decode(errors="replace")
            if not self.server.commands.acquire(blocking=False):
                self._answer_command(2, f"{COMMANDS_MAX} commands are under way: wait for one of them")
                return
            try:
                self._answer_command(*carry_out(words, self.server.private, self.server.launcher))
            finally:
                self.server.commands.release()

    def _answer_command(self, code: int, text: str) -> None:
        self._answer(HTTPStatus.OK, "application/json", json.dumps({"code": code, "text": text}))

    def _answer(self, status: HTTPStatus, kind: str, text: str, nonce: str = "") -> None:
        data = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(data)))
        self._guard(nonce)
        self.end_headers()
        self.wfile.write(data)

    def _guard(self, nonce: str = "") -> None:
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", POLICY.format(nonce=nonce))
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")

    def _stream(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/event-stream")
        self._guard()
        self.end_headers()
        with contextlib.closing(self.server.watcher.snapshots()) as snapshots:
            for snapshot in snapshots:
                self.wfile.write(b"data: " + msgspec.json.encode(snapshot) + b"\n\n")
        self.wfile.write(b"event: end\ndata: {}\n\n")

    def log_message(self, *arguments: object) -> None:
        """Nothing: the terminal belongs to the run."""


def carry_out(words: str, private: Path, launcher: Launcher) -> tuple[int, str]:
    """The exit code and the output of `aftbed WORDS` for this run, as at a second terminal."""
    if "\0" in words:
        return 2, "a command has no null bytes"
    try:
        process = launcher.start(shlex.split(words), private)
    except ValueError:
        return 2, f"{words}: quotation marks come in pairs"
    except ConfigError as error:
        return 2, str(error)
    with process:
        try:
            text, _ = process.communicate(timeout=COMMAND_S_MAX)
        except subprocess.TimeoutExpired:
            process.kill()
            return 3, f"no answer within {COMMAND_S_MAX:.0f} s"
    return process.returncode, text.strip()[:ANSWER_CHARACTERS_MAX]


# -- how it is started --------------------------------------------------------------------------------


def new_token() -> str:
    return secrets.token_urlsafe(16)


def address(listener: socket.socket, token: str) -> str:
    """What a browser is given."""
    return f"http://{HOST}:{listener.getsockname()[1]}/?token={token}"


@contextlib.contextmanager
def beside(listener: socket.socket, private: Path, token: str) -> Iterator[None]:
    """Serve the page from a process of its own, which ends with the block, or with this process."""
    arguments = (str(os.getpid()), str(listener.fileno()), str(private))
    process = subprocess.Popen(
        [sys.executable, "-m", "aftbed.report.live_page", *arguments],
        pass_fds=(listener.fileno(),),
        stdin=subprocess.DEVNULL,
        env={**os.environ, TOKEN_VARIABLE: token},
        start_new_session=True,  # a Ctrl-C is for the command
    )
    listener.close()
    try:
        yield
    finally:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(END_S_MAX)  # it tells the pages
        process.kill()
        process.wait()


def serve(listener: socket.socket, private: Path, token: str, *, starting: bool = False) -> None:
    """Serve the page of the run in `private` until it has ended. `starting`: it may not be there yet."""
    launcher = Launcher()
    linux.yield_cpu(NICE)
    PageServer(listener, private, token, launcher).serve_until_the_end(starting=starting)


if __name__ == "__main__":
    linux.die_with(int(sys.argv[1]))
    token_given = os.environ.pop(TOKEN_VARIABLE, "")
    serve(socket.socket(fileno=int(sys.argv[2])), Path(sys.argv[3]), token_given, starting=True)
