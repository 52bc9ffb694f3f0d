"""The live page of a run: what happens on the road, in the graph and on the bus, and the words that steer it.

A process of its own serves it, at a low priority: it asks the run as `aftbed status` does, and reads the
event log and the bus log as they grow. The run does not know of it, and a browser that does not read holds up
nothing but its own connection. It ends with the run.

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
import os
import secrets
import shlex
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Generator, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs, urlsplit

import msgspec

from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.graph import Graph
from aftbed.ftm.compose import EXPRESSIONS
from aftbed.report.steering import ANSWER_CHARACTERS_MAX, COMMAND_S_MAX, child_command
from aftbed.runtime.unix import control_client, linux
from aftbed.runtime.unix.control_client import ProcessRow
from aftbed.runtime.unix.run_directory import BUS_NAME, EVENT_LOG_NAME
from aftbed.vehicle.can.hub import user_behind

HOST: Final = "127.0.0.1"
PERIOD_S: Final = 0.1  # between two snapshots
IDLE_S: Final = 0.4  # between two looks whether the run lives, while there is no page
START_S_MAX: Final = 10.0  # from the start of the run to its first answer
LAST_S_MAX: Final = 0.2  # that the pages may take to read the end
END_S_MAX: Final = 0.8  # from the end of the run to that of the server
CONNECTIONS_MAX: Final = 16
COMMANDS_MAX: Final = 2  # at once
COMMAND_BYTES_MAX: Final = 1000
SEND_S_MAX: Final = 5.0  # that a browser may take to read, or to send its request
EVENTS_KEPT: Final = 500
READ_BYTES_MAX: Final = 1_000_000  # of a log, at once
NICE: Final = 10
TOKEN_VARIABLE: Final = "AFTBED_PAGE_TOKEN"  # not an argument: other users can read those
POLICY: Final = (
    "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; connect-src 'self';"
    " img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class Snapshot(msgspec.Struct, frozen=True):
    """The run as it is now.

    `status` is that of `aftbed status --json`; `nodes` has the nodes of the graph with their bricks, dead
    ones too, `processes` those that live. `events` are those since the last snapshot. `frames_s`: on the bus.
    """

    status: dict[str, object]
    nodes: dict[str, tuple[str, ...]]
    processes: list[ProcessRow]
    frames_s: float
    events: list[dict[str, object]]


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


class RunWatcher:
    """Looks at the run for all pages at once."""

    def __init__(self, private: Path) -> None:
        self._private = private
        self._changed = threading.Condition()
        self._now: Snapshot | None = None
        self._number = 0  # of the snapshot
        self._events: deque[dict[str, object]] = deque(maxlen=EVENTS_KEPT)
        self._events_seen = 0
        self._pages = 0
        self._ended = False

    def run(self) -> None:
        """Look until the run has ended; seldom, and only whether it lives, while there is no page."""
        try:
            status = self._first_answer()
            record = Path(str(status["record"]))
            events, bus = GrowingFile(record / EVENT_LOG_NAME), GrowingFile(record / BUS_NAME)
            counted_s = time.monotonic()
            while True:
                status = control_client.ask(self._private, control_client.StatusQuery())
                if self._pages:
                    frames, now_s = len(bus.lines()), time.monotonic()
                    self._tell(self._look(status, frames / max(now_s - counted_s, PERIOD_S)), events.lines())
                    counted_s = now_s
                with self._changed:
                    if not self._pages:
                        self._changed.wait(IDLE_S)
                time.sleep(PERIOD_S)
        except (ConfigError, HarnessError, OSError):  # it has ended
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _first_answer(self) -> dict[str, object]:
        """The status, once the run is there. Raises HarnessError if it does not come."""
        limit_s = time.monotonic() + START_S_MAX
        while True:
            try:
                return control_client.ask(self._private, control_client.StatusQuery())
            except ConfigError as error:
                if time.monotonic() > limit_s:
                    raise HarnessError(str(error)) from None
                time.sleep(PERIOD_S)

    def _look(self, status: dict[str, object], frames_s: float) -> Snapshot:
        graph = msgspec.convert(control_client.ask(self._private, control_client.GraphQuery()), Graph)
        rows = [row for row in control_client.processes(self._private) if row.node]
        return Snapshot(status, graph.nodes, rows, round(frames_s, 1), [])

    def _tell(self, snapshot: Snapshot, lines: list[bytes]) -> None:
        with self._changed:
            self._events += map(json.loads, lines)
            self._events_seen += len(lines)
            self._now = snapshot
            self._number += 1
            self._changed.notify_all()

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


class PageServer(ThreadingHTTPServer):
    """Serves the page of one run on `listener`, which is bound and listens."""

    daemon_threads = True

    def __init__(self, listener: socket.socket, private: Path, token: str) -> None:
        super().__init__(listener.getsockname(), PageRequest, bind_and_activate=False)
        self.socket.close()
        self.socket = listener
        self.private, self.token = private, token
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

    def serve_until_the_end(self) -> None:
        """Serve until the run has ended."""
        serving = threading.Thread(target=self.serve_forever, args=(PERIOD_S,), daemon=True)
        serving.start()
        self.watcher.run()
        self.shutdown()
        limit_s = time.monotonic() + LAST_S_MAX
        for _ in range(CONNECTIONS_MAX):  # each page has been sent the end
            self._room.acquire(timeout=max(0.0, limit_s - time.monotonic()))
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
            options = "".join(f"<option>{expression}</option>" for expression in EXPRESSIONS)
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
            code, text = carry_out(words, self.server.private, self.server.commands)
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


def carry_out(words: str, private: Path, at_once: threading.Semaphore) -> tuple[int, str]:
    """The exit code and the output of `aftbed WORDS` for this run, as at a second terminal."""
    try:
        command = child_command(shlex.split(words), private)
    except ValueError:
        return 2, f"{words}: quotation marks come in pairs"
    except ConfigError as error:
        return 2, str(error)
    if not at_once.acquire(blocking=False):
        return 2, f"{COMMANDS_MAX} commands are under way: wait for one of them"
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=COMMAND_S_MAX,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return 3, f"no answer within {COMMAND_S_MAX:.0f} s"
    finally:
        at_once.release()
    return done.returncode, (done.stdout + done.stderr).strip()[:ANSWER_CHARACTERS_MAX]


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


def serve(listener: socket.socket, private: Path, token: str) -> None:
    """Serve the page of the run in `private` until it has ended."""
    os.nice(NICE)
    PageServer(listener, private, token).serve_until_the_end()


if __name__ == "__main__":
    linux.die_with(int(sys.argv[1]))
    serve(socket.socket(fileno=int(sys.argv[2])), Path(sys.argv[3]), os.environ.pop(TOKEN_VARIABLE, ""))
