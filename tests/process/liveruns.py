"""Real runs for tests: started, watched, broken, and looked for after their end.

`Started` is a run that this process launched and reads the reports of; `Command` is an `aftbed` of its
own. Both belong to a `Home` (`homes`).

Nothing here sleeps to wait: a wait is a poll of a descriptor or of a condition, with a deadline.
"""

import contextlib
import functools
import io
import json
import multiprocessing
import os
import select
import signal
import sys
import tempfile
import time
from multiprocessing.context import ForkServerContext, ForkServerProcess
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from typing import Final

import command_process
import msgspec
import psutil
import pytest
import typer  # noqa: F401 - without it `main` takes this interpreter for a command's, and ignores Ctrl-C at its end
from homes import (
    FORKED,
    GONE_SECONDS_MAX,
    LOOK_SECONDS,
    PATIENCE_SECONDS,
    WAIT_SECONDS_MAX,
    Home,
    home,
    until,
)

from aftbed.cli import main
from aftbed.core.errors import ConfigError
from aftbed.core.journal import EntryKind, entries
from aftbed.core.messages import Scheduled
from aftbed.inject.model import Fault
from aftbed.judge.record import RunRecord, read_record
from aftbed.judge.verdict import Verdict, judge
from aftbed.runtime.unix import control_client, run_directory
from aftbed.runtime.unix.control_client import ProcessRow
from aftbed.runtime.unix.launch import launch, options_for
from aftbed.runtime.unix.options import LoadRun, Work

RUN_SECONDS_MAX: Final = 60.0
NO_TIME: Final = "no answer within"  # why an adaptation was not done that had no CPU
ADAPT_TRIES: Final = 5
SHOWN_BYTES: Final = 3000  # of the output of a run, where a test fails
ENDLESS: Final = 10_000_000  # requests: the run goes on until it is stopped, on a machine of any speed
SHORT: Final = Path(__file__).with_name("short.yaml")  # a scenario
# commands that start no process
PLAIN: Final = (
    *("adapt", "check", "ftm", "graph", "init", "inject", "log", "map", "ps", "schema", "sim", "status"),
    "stop",
)

__all__ = [  # what others import from here
    "ADAPT_TRIES",
    "ENDLESS",
    "GONE_SECONDS_MAX",
    "LOOK_SECONDS",
    "NO_TIME",
    "PATIENCE_SECONDS",
    "SHORT",
    "WAIT_SECONDS_MAX",
    "Command",
    "Done",
    "Home",
    "Outcome",
    "Started",
    "adapted",
    "aftbed",
    "ended",
    "forked",
    "home",
    "readable",
    "state_of",
    "under_load",
    "until",
]


def readable(descriptor: int, seconds: float) -> bool:
    """Whether `descriptor` becomes readable (or ends) within `seconds`."""
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return bool(poll.poll(max(0.0, seconds) * 1e3))


def ended(pid: int, seconds: float = WAIT_SECONDS_MAX) -> bool:
    """Whether the process `pid` ends within `seconds`; one that is gone has ended."""
    try:
        pidfd = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return readable(pidfd, seconds)
    finally:
        os.close(pidfd)


class Outcome(msgspec.Struct, frozen=True):
    """A run that has ended."""

    record: RunRecord
    verdict: Verdict
    events: list[dict[str, object]]

    def told(self, event: str) -> list[str]:
        """The texts of all events of this kind."""
        return [str(e["text"]) for e in self.events if e["event"] == event]


class Started:
    """A run that this process launched. `close` ends it whatever happens; it is a context manager."""

    def __init__(
        self,
        home: Home,
        work: Work,
        *,
        ftm: str = "pbr",
        placement: str = "process",
        faults: tuple[Fault, ...] = (),
        adaptations: tuple[Scheduled, ...] = (),
        seed: int = 0,
        record: Path | None = None,
        bus_open: bool = False,
    ) -> None:
        options, listener = options_for(
            ftm=ftm,
            placement=placement,
            work=work,
            seed=seed,
            faults=faults,
            adaptations=adaptations,
            record=str(record) if record else None,
            bus_open=bus_open,
        )
        self.launched = launch(options, listener)
        for pid in (self.launched.supervisor, self.launched.warden):
            home.forked(pid)
        self.private = self.launched.private
        self.events: list[dict[str, object]] = []
        self._ended = self._closed = False

    def __enter__(self) -> "Started":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Kill it if it has not been seen to its end."""
        if self._closed:
            return
        self._closed = True
        if not self._ended:
            os.kill(self.launched.supervisor, signal.SIGKILL)
        self.launched.wait()
        self.launched.remove()

    # -- what it says -------------------------------------------------------------------------

    def _next(self, limit: float, what: str) -> bool:
        """Read one report; False at the end of the run."""
        if not readable(self.launched.line.fileno(), limit - time.monotonic()):
            pytest.fail(f"no report while waiting for {what}; so far: {self.events[-5:]}")
        for report in self.launched.reports():
            if report.kind == "event":
                self.events.append(json.loads(report.data))
            return True
        self._ended = True
        return False

    def wait_for(self, event: str, text: str = "", *, after: int = 0) -> dict[str, object]:
        """The first such event behind the first `after` ones, as soon as it is told."""
        limit, at = time.monotonic() + WAIT_SECONDS_MAX, after
        while True:
            for found in self.events[at:]:
                if found["event"] == event and text in str(found["text"]):
                    return found
            at = len(self.events)
            if not self._next(limit, f"{event} {text}"):
                printed = (self.launched.record / "processes.log").read_text()[-2000:]
                pytest.fail(f"ended without {event} {text}: {self.events[-5:]} {self.launched.end} {printed}")

    def heard(self) -> list[dict[str, object]]:
        """All that it has told so far."""
        while not self._ended and readable(self.launched.line.fileno(), 0.0):
            self._next(time.monotonic() + WAIT_SECONDS_MAX, "nothing")
        return self.events

    def finish(self, seconds: float = RUN_SECONDS_MAX) -> Outcome:
        """Follow the run to its end and judge it."""
        limit = time.monotonic() + seconds
        while self._next(limit, "the end"):
            pass
        self.launched.wait()
        record = read_record(self.launched.record, in_memory=True)  # its files go
        self._closed = True
        self.launched.remove()
        return Outcome(record, judge(record), self.events)

    def stop(self) -> Outcome:
        """Have it end when all is answered and nothing is under way, and judge it."""
        self.launched.stop()
        return self.finish()

    # -- what it does -------------------------------------------------------------------------

    def rows(self) -> list[ProcessRow]:
        """Its processes."""
        return control_client.processes(self.private)

    def pid(self, name: str) -> int:
        """The pid of the process called `name`."""
        return next(row.pid for row in self.rows() if row.name == name)

    def status(self) -> dict[str, object]:
        """What `aftbed status` would show."""
        return control_client.ask(self.private, control_client.StatusQuery())

    def redundant(self) -> bool:
        """Whether a backup stands and no script is under way."""
        try:
            status = self.status()
        except ConfigError:
            return False  # not listening yet
        return bool(status["backup"]) and not status["busy"]

    def states(self) -> str:
        """The supervisor and all its processes, and what each waits for: where a run does not go on."""
        supervisor = psutil.Process(self.launched.supervisor)
        return "".join(
            f"    {one.pid} of {one.ppid()} {one.name()} {one.status()} {wait_of(one.pid)}\n"
            for one in (supervisor, *supervisor.children(recursive=True))
        )

    def descriptors(self, pid: int) -> int:
        """How many descriptors the process `pid` has open."""
        return len(list(Path(f"/proc/{pid}/fd").iterdir()))

    def answered(self) -> int:
        """How many replies the client has got."""
        return self.entries(EntryKind.ANSWERED)

    def entries(self, kind: EntryKind) -> int:
        """How many entries of `kind` are in the client's dialogues, read as they grow."""
        folder = self.launched.record / "journal"
        return sum(
            entry.kind is kind
            for path in folder.glob("client.*.dialogue")
            if path.stat().st_size  # not there yet, and already in the directory
            for entry in entries(path.read_bytes())
        )

    def wait_for_answers(self, count: int) -> None:
        """Wait until the client has got `count` replies."""
        until(lambda: self.answered() >= count, f"{count} replies")

    def strike(self, name: str, sig: signal.Signals) -> int:
        """Signal the process called `name`; its pid. A stopped one is seen stopped."""
        pid = self.pid(name) if name != "supervisor" else self.launched.supervisor
        os.kill(pid, sig)
        if sig is signal.SIGSTOP:
            until(lambda: state_of(pid) == "T", f"{name} to stop")
        return pid


def state_of(pid: int) -> str:
    """The state letter of proc(5), or `""` of a process that is gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""


def wait_of(pid: int) -> str:
    """Where in the kernel the process `pid` waits, or `""` of one that is gone."""
    try:
        return Path(f"/proc/{pid}/wchan").read_text()
    except OSError:
        return ""


def under_load(
    home: Home,
    count: int,
    rate_hz: float = 200.0,
    *,
    ftm: str = "pbr",
    placement: str = "process",
    faults: tuple[Fault, ...] = (),
) -> Started:
    """A run under synthetic load that has begun to answer."""
    run = Started(home, LoadRun(count, rate_hz), ftm=ftm, placement=placement, faults=faults)
    try:
        run.wait_for("started")
        run.wait_for_answers(20)
    except BaseException:
        run.close()
        raise
    return run


# -- the command in a process of its own --------------------------------------------------------


class Done(msgspec.Struct, frozen=True):
    """A command that has ended."""

    code: int
    out: str
    err: str

    def verdict(self) -> Verdict:
        """The one document of `--json`."""
        return msgspec.json.decode(self.out, type=Verdict)


def aftbed(*arguments: str | Path) -> Done:
    """Run a command to its end: in this process if it starts none."""
    return called(*arguments) if arguments[0] in PLAIN else forked(*arguments)


def adapted(*arguments: str | Path) -> Done:
    """`aftbed adapt`, once more where a busy machine gave it no time: then all is as it was."""
    for _ in range(ADAPT_TRIES):
        done = aftbed("adapt", *arguments)
        if NO_TIME not in done.out + done.err:
            break
    return done


def called(*arguments: str | Path) -> Done:
    """Run a command in this process."""
    out, err = (io.TextIOWrapper(io.BytesIO(), write_through=True) for _ in range(2))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = _main(arguments)
    return Done(code, *(text.buffer.getvalue().decode() for text in (out, err)))


def _main(arguments: tuple[str | Path, ...]) -> int:
    argv, sys.argv = sys.argv, ["aftbed", *map(str, arguments)]
    try:
        main()
        code: object = 0
    except SystemExit as ended:
        code = ended.code or 0
    finally:
        sys.argv = argv
    assert isinstance(code, int), code
    return code


@functools.cache
def _forks() -> ForkServerContext:
    """From where commands are forked, for as long as the tests run."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["warm_commands"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", FORKED)
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        ensure_running()
    return context


def forked(*arguments: str | Path, folder: Path | None = None, seconds: float = RUN_SECONDS_MAX) -> Done:
    """Run a command in a process of its own, a fork of one that has imported what a command needs.

    An interpreter's start and its imports would take longer than most commands.
    """
    with tempfile.TemporaryDirectory() as place:
        out, err = Path(place, "out"), Path(place, "err")
        process = _begun(arguments, folder or Path.cwd(), out, err)
        try:
            process.join(seconds)
            assert process.exitcode is not None, f"{arguments} took more than {seconds} s"
            return Done(process.exitcode, out.read_text(), err.read_text())
        finally:
            process.kill()
            process.join()
            process.close()


def _begun(
    arguments: tuple[str | Path, ...], folder: Path, out: Path, err: Path, *, session: bool = False
) -> ForkServerProcess:
    words = ["aftbed", *map(str, arguments)]
    process = _forks().Process(
        target=command_process.run, args=(words, dict(os.environ), folder, out, err, session)
    )
    process.start()
    return process


class Command:
    """An `aftbed run` in the background, in a session of its own. A context manager that kills it."""

    def __init__(self, *arguments: str | Path) -> None:
        self._place = tempfile.TemporaryDirectory()  # for as long as the command
        out, self._errors = Path(self._place.name, "out"), Path(self._place.name, "err")
        os.mkfifo(out)
        self._out = os.open(out, os.O_RDONLY | os.O_NONBLOCK)  # does not wait for its writers
        self._process = _begun(("run", *arguments), Path.cwd(), out, self._errors, session=True)
        self._text = b""

    def __enter__(self) -> "Command":
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        self._process.close()
        with contextlib.suppress(BlockingIOError):
            while got := os.read(self._out, 65536):
                self._text += got
        print(self._text[-SHOWN_BYTES:].decode(errors="replace"))  # pytest shows it where a test fails
        os.close(self._out)
        self._place.cleanup()

    @property
    def pid(self) -> int:
        """That of the command, not of its run."""
        assert self._process.pid is not None
        return self._process.pid

    def wait(self) -> None:
        """Until the command has ended, whatever its run does."""
        self._process.join(WAIT_SECONDS_MAX)
        assert self._process.exitcode is not None, "the command goes on"

    def kill(self) -> None:
        """End it at once, and wait for that."""
        self._process.kill()
        self.wait()

    def wait_until_it_drives(self) -> None:
        """Requests are answered by then; the first line of the car is of 0.00 s, before any request."""
        self.wait_for_line("km/h", nth=2)

    def wait_for_line(self, words: str, nth: int = 1) -> str:
        """The `nth` line of its output that has `words`."""
        limit = time.monotonic() + WAIT_SECONDS_MAX
        while True:
            lines = self._text.decode(errors="replace").splitlines(keepends=True)
            found = [line for line in lines if words in line and line.endswith("\n")]
            if len(found) >= nth:
                return found[nth - 1].rstrip()
            if not readable(self._out, limit - time.monotonic()):
                pytest.fail(f"no line with {words!r} in {self._text[-500:]!r}")
            got = os.read(self._out, 65536)
            if not got:
                pytest.fail(f"ended without {words!r}: {self._text[-500:]!r} {self._error_text()}")
            self._text += got

    def started(self) -> str:
        """Wait until the graph stands; the id of the run."""
        line = self.wait_for_line("run ")
        self.wait_for_line("started: ")
        return line.split()[1].rstrip(":")

    def wait_for_error_line(self, words: str) -> str:
        """The first line that has `words` of what it writes to standard error."""

        def found() -> list[str]:
            return [line for line in self._error_text().splitlines(keepends=True) if words in line]

        return until(lambda: found() and found()[0].endswith("\n") and found()[0], words).rstrip()

    def _error_text(self) -> str:
        return self._errors.read_text() if self._errors.exists() else ""

    def done(self) -> Done:
        """Wait for its end."""
        limit = time.monotonic() + RUN_SECONDS_MAX
        while True:
            if not readable(self._out, limit - time.monotonic()):
                pytest.fail(f"the command goes on: {self._text[-500:]!r}")
            got = os.read(self._out, 65536)
            if not got:
                break
            self._text += got
        self.wait()
        assert self._process.exitcode is not None
        return Done(self._process.exitcode, self._text.decode(errors="replace"), self._error_text())


def only_run() -> Path:
    """The private directory of the only live run, as soon as it answers."""
    return run_directory.root() / until(run_directory.live, "a run")[0]
