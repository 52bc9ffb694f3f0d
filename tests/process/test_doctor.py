"""`aftbed doctor`: what a dead run left is named and removed; what is a live one's, or of no run, is not."""

import contextlib
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import msgspec
import pytest
from liveruns import ENDLESS, Command, Home, Started, aftbed, ended, only_run, state_of, under_load, until
from rundirs import new_run

from aftbed.cli.doctor import Diagnosis
from aftbed.runtime.unix import cleanup, run_directory
from aftbed.runtime.unix.cleanup import LeftDirectory, LeftModel
from aftbed.runtime.unix.options import LoadRun
from aftbed.runtime.unix.run_directory import Member

pytestmark = pytest.mark.process

STRAY: Final = """
import signal, sys
from pathlib import Path
from aftbed.runtime.unix import linux, run_directory
linux.set_name(sys.argv[2])
run_directory.mark(Path(sys.argv[1]))
print("marked", flush=True)
signal.pause()
"""
LOAD: Final = ("--load", f"{ENDLESS}@200")
OF_THE_MOMENT: Final = ("CPU steal", "load")  # measured anew by each command


def doctor(*arguments: str) -> tuple[int, Diagnosis]:
    """Its exit code, and the one document of --json."""
    done = aftbed("doctor", "--json", *arguments)
    assert done.err == ""
    return done.code, msgspec.json.decode(done.out, type=Diagnosis)


def of_run(run: Path) -> list[Member]:
    """All of its processes but the command."""
    return [m for m in run_directory.members() if m.run == str(run)]


def parts(run: Path) -> tuple[int, int]:
    """The pids of its supervisor and its warden."""
    names = {m.name: m.pid for m in of_run(run)}
    return names["aftbed-supervis"], names["aftbed-warden"]


@contextlib.contextmanager
def stray(run: Path, name: str) -> Iterator[int]:
    """The pid of a process with the mark of `run` that no process of it knows of."""
    process = subprocess.Popen(
        [sys.executable, "-c", STRAY, run, name], stdout=subprocess.PIPE, stdin=subprocess.DEVNULL
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == b"marked\n"
        yield process.pid
    finally:
        process.kill()
        process.communicate()


def stopped(pid: int) -> None:
    """Stop it, and see it stopped."""
    os.kill(pid, signal.SIGSTOP)
    until(lambda: state_of(pid) == "T", f"{pid} to stop")


def test_every_process_of_a_run_is_told_by_its_mark(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        known = {row.pid for row in run.rows()} | {run.launched.warden}
        marked = {m.pid for m in of_run(run.private)}
        assert known <= marked
        assert os.getpid() not in marked, "the command is not to be ended"
        run.stop()


@pytest.fixture(autouse=True)
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What other tests of this user leave of an FMU, whose process they kill, is not looked at here."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))


def test_nothing_is_left_where_all_is_well(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        code, found = doctor()
        assert (code, found.left, found.removed, found.ok) == (0, [], [], True)
        assert doctor("--clean")[1].removed == []
        assert run.status()["leader"] == "a"


def test_an_fmu_that_a_dead_process_had_unpacked_is_named_and_removed(home: Home, tmp_path: Path) -> None:
    """One that is in use has a lock, and stays."""
    above = tmp_path / f"aftbed-fmu-{os.getuid()}"
    dead, used = above / "unpacked-dead", above / "unpacked-used"
    for folder in (dead, used):
        (folder / "binaries").mkdir(parents=True)
        (folder / "binaries" / "model.so").write_bytes(bytes(100_000))
    lock = os.open(used, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        code, found = doctor()
        assert code == 1 and [(type(left), left.run) for left in found.left] == [(LeftModel, str(dead))]
        assert found.left[0].bytes_used >= 100_000 and str(dead) in str(found.left[0])
        code, found = doctor("--clean")
        assert (code, len(found.removed), found.left) == (0, 1, [])
        assert used.exists() and not dead.exists()
    finally:
        os.close(lock)
    assert [left.run for left in doctor("--clean")[1].removed] == [str(used)]


def test_a_run_killed_with_all_its_keepers_leaves_its_directory(home: Home) -> None:
    """Supervisor, warden and command at once: the kernel ends the nodes, the directory is not removed."""
    with Command(*LOAD) as command:
        command.started()
        run = only_run()
        supervisor, warden = parts(run)
        for pid in (warden, command.pid, supervisor):  # each cleans up after those behind it
            os.kill(pid, signal.SIGKILL)
        command.wait()
        assert ended(supervisor) and ended(warden)
        code, found = doctor()
        assert code == 1
        assert [type(left) for left in found.left] == [LeftDirectory]
        assert isinstance(found.left[0], LeftDirectory)
        assert (found.left[0].run, found.left[0].sockets) == (str(run), 1)
        assert found.left[0].files > 16
        code, found = doctor("--clean")
        assert (code, len(found.removed), found.left) == (0, 1, [])
        assert not run.exists()
        assert doctor()[1].left == doctor("--clean")[1].removed == []


def test_the_processes_of_a_dead_run_are_named_and_removed_and_a_live_run_goes_on(home: Home) -> None:
    """All keepers were killed, and two processes that they did not know of live on, one of them stopped."""
    with under_load(home, ENDLESS) as alive, Command(*LOAD) as command, contextlib.ExitStack() as strays:
        until(lambda: len(run_directory.live()) == 2, "two runs")
        command.started()
        run = next(path for path in home.runs() if path != alive.private)
        supervisor, warden = parts(run)
        idle, engine = (strays.enter_context(stray(run, name)) for name in ("stray", "engine"))
        stopped(engine)
        for pid in (warden, command.pid, supervisor):  # each cleans up after those behind it
            os.kill(pid, signal.SIGKILL)
        command.wait()
        assert ended(supervisor) and ended(warden)
        until(lambda: len(of_run(run)) == 2, "the end of all that the run knew of")
        there = {idle, engine}
        assert {m.pid for m in of_run(run)} == there and state_of(engine) == "T"

        code, found = doctor()
        assert code == 1
        assert {left.run for left in found.left} == {str(run)}
        processes = {left.pid: left for left in found.left if isinstance(left, Member)}
        assert set(processes) == there
        assert (processes[engine].name, processes[engine].state) == ("engine", "T")
        shown = aftbed("doctor")
        assert f"left     process {engine} (engine, stopped) of run {run.name}\n" in shown.out
        assert "left by dead runs: aftbed doctor --clean" in shown.out

        code, cleaned = doctor("--clean")
        assert code == 0
        assert {left.pid for left in cleaned.removed if isinstance(left, Member)} == there
        assert {left.run for left in cleaned.removed} == {str(run)}
        assert not any(state_of(pid) not in ("", "Z") for pid in there)
        assert home.runs() == [alive.private]
        assert doctor("--clean")[1].removed == []
        assert alive.status()["leader"] == "a"
        outcome = alive.stop()
        assert outcome.verdict.verdict == "pass"
        assert outcome.told("died") == outcome.told("replaced") == []


def test_a_run_is_alive_from_its_first_moment_to_the_last(home: Home) -> None:
    """Its directory is there before a process is, and after the last one."""
    private = new_run()
    try:
        assert doctor("--clean")[1].removed == []
        assert private.exists()
    finally:
        run_directory.remove(private)
    with Started(home, LoadRun(50, 1000.0)) as run:
        until(lambda: ended(run.launched.supervisor), "the end of the supervisor")
        assert doctor("--clean")[1].removed == []
        assert run.finish().verdict.verdict == "pass"


def test_a_stopped_command_has_a_live_run(home: Home) -> None:
    with Command(*LOAD) as command:
        command.started()
        run = only_run()
        stopped(command.pid)
        os.kill(parts(run)[0], signal.SIGKILL)
        assert doctor("--clean")[1].removed == []
        assert run.exists()
        os.kill(command.pid, signal.SIGCONT)
        assert command.done().code == 3


def test_a_run_whose_directory_was_removed_goes_on(home: Home) -> None:
    """Nobody finds it any more, but it is not dead."""
    with under_load(home, ENDLESS) as run:
        nodes = {row.pid for row in run.rows() if row.node}
        shutil.rmtree(run.private)
        code, found = doctor("--clean")
        assert (code, found.removed, found.left) == (0, [], [])
        assert nodes <= {m.pid for m in of_run(run.private)}


def test_a_run_that_is_just_ending_is_given_its_second(home: Home) -> None:
    """Its warden waits for the stopped supervisor before it kills it: what is there meanwhile is not left."""
    with Command(*LOAD) as command:
        command.started()
        stopped(parts(only_run())[0])
        command.kill()
        assert cleanup.find() == []


@pytest.fixture
def stranger(home: Home) -> Iterator[subprocess.Popen[bytes]]:
    """A process with a name like ours, whose output is in the directory of a dead run."""
    run = run_directory.root() / "abcdef"
    run.mkdir(mode=0o700)
    words = ["-c", "import sys; sys.stdin.read()", "aftbed-supervis", str(run)]
    with open(run / "events.jsonl", "w") as file:
        process = subprocess.Popen(
            [sys.executable, *words], stdin=subprocess.PIPE, stdout=file, cwd=run, executable=sys.executable
        )
    yield process
    process.kill()
    process.communicate()


def test_a_process_without_the_mark_is_not_touched(home: Home, stranger: subprocess.Popen[bytes]) -> None:
    (run_directory.root() / "notes").mkdir()
    (run_directory.root() / "fedcba").write_text("a file")
    code, found = doctor("--clean")
    assert code == 0
    assert [left.run for left in found.removed] == [str(run_directory.root() / "abcdef")]
    assert stranger.poll() is None
    assert {path.name for path in run_directory.root().iterdir()} == {"notes", "fedcba"}
    (run_directory.root() / "notes").rmdir()
    (run_directory.root() / "fedcba").unlink()


def test_a_place_that_others_can_enter_is_missing_and_nothing_is_cleaned(home: Home) -> None:
    root = run_directory.root()
    (root / "abcdef").mkdir()
    root.chmod(0o755)
    try:
        code, found = doctor("--clean")
        assert (code, found.removed, found.ok) == (1, [], False)
        check = next(c for c in found.checks if c.name == "run directory")
        assert check.status == "missing"
        assert check.found == f"{root}: must be a directory of this user alone (mode 0700); remove it"
        assert "XDG_RUNTIME_DIR" in check.remedy
        assert (root / "abcdef").exists()
    finally:
        (root / "abcdef").rmdir()


def test_the_document_and_the_lines_say_the_same(home: Home) -> None:
    code, found = doctor()
    shown = aftbed("doctor")
    assert shown.code == code
    lines = [line for line in shown.out.splitlines() if not line.startswith(" ")][:-1]
    for line, check in zip(lines, found.checks, strict=True):
        status, name = line.split(maxsplit=1)
        assert name.startswith(check.name)
        if check.name not in OF_THE_MOMENT:
            assert status == check.status
    assert all(bool(c.remedy) == (c.status != "ok") for c in found.checks)
    assert json.loads(aftbed("doctor", "--json").out)["left"] == []
