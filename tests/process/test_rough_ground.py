"""Rough ground: surroundings in which a command cannot do its work, or could be thought not to.

Each row is a piece of shell that makes the surroundings and then runs the command, `"$@"`. Whatever they are,
the command ends with the right exit code and one clear line, and leaves neither a process nor a directory.
"""

import os
import re
import shutil
import signal
import site
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import pytest
from homes import WAIT_SECONDS_MAX, Home, until

pytestmark = pytest.mark.process

REPOSITORY: Final = Path(__file__).parents[2]
COMMAND: Final = (sys.executable, "-m", "aftbed")
LOAD: Final = "run --load 50"
DRIVE: Final = "run --scenario ccrs-20 --pace max"
PRIVATE: Final = ("unshare", "--mount")  # a namespace of its own: what is mounted goes with it
FULL_DISK: Final = 'mkdir $HERE/disk; mount -t tmpfs -o size={} none $HERE/disk; "$@" --record $HERE/disk/r'
NO_READER: Final = 'mkfifo $HERE/p; exec 3<>$HERE/p 4>$HERE/p 3<&-; "$@" >&4 4<&-'
REMOVED: Final = 'mkdir $HERE/gone; cd $HERE/gone; rmdir $HERE/gone; "$@"'
# As user 65534, who may not look into the home of root, where Python and this repository may lie.
NOBODY: Final = (
    "mkdir $HERE/python $HERE/packages $HERE/repository; mount --bind $PYTHON $HERE/python;"
    " mount --bind $PACKAGES $HERE/packages; mount --bind $REPOSITORY $HERE/repository;"
    " export PYTHONHOME=$HERE/python PYTHONPATH=$HERE/repository:$HERE/packages; shift; cd /;"
    ' set -- setpriv --reuid 65534 --regid 65534 --clear-groups $HERE/python/bin/python3 "$@"; '
)


class Row(NamedTuple):
    """`line` is found in what the command prints to standard error, or to standard output if that ends well.

    `words` is the command; `deep` rows have a sibling that is tried each time.
    """

    name: str
    shell: str
    words: str
    code: int
    line: str = ""
    deep: bool = False
    mounts: bool = False


PASS: Final = "verdict: pass"
MEMORY: Final = 'unset XDG_RUNTIME_DIR TMPDIR; mount -t tmpfs -o {} none /dev/shm; "$@" | cat'  # what is left
RUNS_IN_TMP: Final = "run directory +/tmp/aftbed-"
ROWS: Final = (
    # places for what a command writes
    Row(
        "record_below_proc",
        '"$@" --record /proc/x',
        LOAD,
        2,
        "error: --record /proc/x: cannot be made: No such",
    ),
    Row("record_without_a_name", '"$@" --record ""', LOAD, 2, "error: --record .: exists already", deep=True),
    Row(
        "campaign_below_proc",
        '"$@" --out /proc/x',
        "campaign run ci-smoke",
        2,
        "--out /proc/x: cannot be made: ",
    ),
    Row(
        "record_on_a_read_only_disk",
        'mkdir $HERE/disk; mount -t tmpfs -o ro none $HERE/disk; "$@" --record $HERE/disk/r',
        LOAD,
        2,
        "--record .*/disk/r: cannot be made: Read-only file system",
        mounts=True,
    ),
    Row(
        "disk_full_at_the_start",
        FULL_DISK.format("4k"),
        LOAD,
        3,
        "trouble: .*is the disk of .*/disk/r full",
        mounts=True,
    ),
    Row(
        "disk_full_while_nodes_start",
        FULL_DISK.format("600k"),
        LOAD,
        3,
        "trouble: .*is the disk of .*/disk/r.* full",
        deep=True,
        mounts=True,
    ),
    Row(
        "disk_full_while_it_serves",
        FULL_DISK.format("1300k"),
        "run --load 2000",
        3,
        "trouble: .*is the disk of .*/disk/r.* full",
        mounts=True,
    ),
    Row(
        "disk_full_while_it_drives",
        FULL_DISK.format("400k"),
        DRIVE,
        3,
        "trouble: .*is the disk of .*/disk/r.* full",
        deep=True,
        mounts=True,
    ),
    Row(
        "check_on_the_full_disk",
        FULL_DISK.format("600k") + " >/dev/null 2>&1; $1 -m aftbed check $HERE/disk/r",
        LOAD,
        3,
        "",
        deep=True,
        mounts=True,
    ),
    Row(
        "runs_on_a_full_disk",
        'unset XDG_RUNTIME_DIR; mount -t tmpfs -o size=600k none $TMPDIR; "$@"',
        LOAD,
        3,
        "trouble: .*is the disk of .* full",
        deep=True,
        mounts=True,
    ),
    Row("output_on_a_full_disk", '"$@" >/dev/full', LOAD, 3, "trouble: the output: No space left on device"),
    Row(
        "short_output_on_a_full_disk",
        '"$@" >/dev/full',
        "ftm list",
        3,
        "the output: No space left",
        deep=True,
    ),
    Row(
        "files_may_not_be_large",
        'ulimit -f 100; "$@"',
        LOAD,
        2,
        "a file may have 102400 bytes, and a journal takes",
    ),
    Row("journals_may_not_grow", 'ulimit -f 1024; "$@"', "run --load 12000", 3, "", deep=True),
    # the directory of runs
    Row("no_directory_of_runs", 'export XDG_RUNTIME_DIR=/nonexistent; "$@"', LOAD, 0, PASS, deep=True),
    Row(
        "no_directory_at_all",
        'export XDG_RUNTIME_DIR=/nonexistent TMPDIR=/nonexistent; "$@"',
        LOAD,
        2,
        "error: /nonexistent/aftbed-.*: cannot be made: No such file or directory; set XDG_",
    ),
    Row(
        "directory_of_runs_below_proc",
        'export XDG_RUNTIME_DIR=/proc; "$@"',
        "status",
        2,
        "/proc/aftbed: cannot be made",
    ),
    Row(
        "directory_of_runs_is_read_only",
        'mount -t tmpfs -o ro none $TMPDIR; unset XDG_RUNTIME_DIR; "$@"',
        LOAD,
        2,
        "cannot be made: Read-only file system; set XDG_RUNTIME_DIR",
        deep=True,
        mounts=True,
    ),
    Row(
        "directory_of_runs_is_open_to_others",
        'mkdir -m 777 $XDG_RUNTIME_DIR/aftbed; "$@"',
        LOAD,
        2,
        r"/aftbed: must be a directory of this user alone \(mode 0700\); remove it",
        deep=True,
    ),
    Row(
        "directory_of_runs_is_a_link",
        'mkdir -m 700 $HERE/a; ln -s $HERE/a $XDG_RUNTIME_DIR/aftbed; "$@"',
        LOAD,
        2,
        "/aftbed: must be a directory of this user alone",
        deep=True,
    ),
    Row(
        "above_it_is_a_link",
        'ln -s $XDG_RUNTIME_DIR $HERE/a; export XDG_RUNTIME_DIR=$HERE/a; "$@"',
        LOAD,
        0,
        PASS,
        deep=True,
    ),
    Row(
        "above_it_is_open_to_others",
        'mkdir -m 777 $HERE/a; export XDG_RUNTIME_DIR=$HERE/a; "$@"',
        LOAD,
        0,
        PASS,
        deep=True,
    ),
    Row(
        "path_with_blanks",
        'export TMPDIR="$HERE/a b  c"; mkdir "$TMPDIR"; unset XDG_RUNTIME_DIR; "$@"',
        LOAD,
        0,
        PASS,
        deep=True,
    ),
    Row(
        "path_too_long",
        'export TMPDIR=$HERE/$(printf %0100d 0); mkdir $TMPDIR; unset XDG_RUNTIME_DIR; "$@"',
        LOAD,
        2,
        "bytes too long for the path of a socket; set XDG_RUNTIME_DIR or TMPDIR to a shorter path",
    ),
    Row(
        "path_not_utf8",
        "export TMPDIR=$HERE/$'\\xff'; mkdir $TMPDIR; unset XDG_RUNTIME_DIR; \"$@\"",
        LOAD,
        2,
        "not UTF-8; set XDG_RUNTIME_DIR or TMPDIR to another path",
        deep=True,
    ),
    # another user
    Row(
        "another_user",
        NOBODY + 'export XDG_RUNTIME_DIR=; chmod 1777 $TMPDIR; "$@"',
        LOAD,
        0,
        PASS,
        mounts=True,
    ),
    Row(
        "directory_of_runs_of_another_user",
        NOBODY + 'chmod 755 $XDG_RUNTIME_DIR; "$@"',
        LOAD,
        2,
        "/aftbed: cannot be made: Permission denied; set XDG_RUNTIME_DIR or TMPDIR",
        deep=True,
        mounts=True,
    ),
    Row(
        "few_processes",
        NOBODY.replace("65534", "65533")
        + 'export XDG_RUNTIME_DIR=; chmod 1777 $TMPDIR; exec prlimit --nproc=12 "$@"',
        LOAD,
        3,
        "",
        deep=True,
        mounts=True,
    ),
    Row(
        "no_process",
        NOBODY + 'export XDG_RUNTIME_DIR=; chmod 1777 $TMPDIR; exec prlimit --nproc=1 "$@"',
        LOAD,
        2,
        "error: a run cannot be started: Resource temporarily unavailable",
        deep=True,
        mounts=True,
    ),
    Row(
        "umask_of_no_rights",
        'umask 777; "$@"',
        LOAD,
        2,
        "error: umask 0777: a run could not use its own files",
    ),
    # limits
    Row(
        "few_descriptors",
        'ulimit -n 64; "$@"',
        LOAD,
        2,
        "error: 64 open files are allowed, and a run needs 256",
    ),
    Row("few_descriptors_until_more_are_asked_for", 'ulimit -Sn 64; "$@"', LOAD, 0, PASS, deep=True),
    Row(
        "no_shared_memory",
        'mount --bind /proc/self/fdinfo /dev/shm; "$@"',
        LOAD,
        0,
        PASS,
        deep=True,
        mounts=True,
    ),
    Row(
        "large_shared_memory",
        MEMORY.format("size=2g"),
        "doctor",
        0,
        "run directory +/dev/shm/aftbed-",
        mounts=True,
    ),
    Row("small_shared_memory", MEMORY.format("size=64m"), "doctor", 0, RUNS_IN_TMP, deep=True, mounts=True),
    Row("nothing_is_executed_in_it", MEMORY.format("noexec,size=2g"), "doctor", 0, RUNS_IN_TMP, mounts=True),
    # standard streams
    Row("no_stdin", '"$@" <&-', LOAD, 0, PASS, deep=True),
    Row("no_stdout", '"$@" >&-', LOAD, 0, deep=True),
    Row("no_stderr", '"$@" 2>&-', DRIVE, 0, PASS, deep=True),
    Row("no_stream", '"$@" <&- >&- 2>&-', LOAD, 0, deep=True),
    Row("no_stream_and_a_drive", '"$@" <&- >&- 2>&-', DRIVE, 0),
    Row("no_stream_to_simulate", '"$@" <&- >&- 2>&-', "sim", 0, deep=True),
    Row("no_stream_to_list", '"$@" <&- >&- 2>&-', "ftm list", 0, deep=True),
    Row("reader_goes", '"$@" | head -1; exit ${PIPESTATUS[0]}', "run --load 2000@500", 141, "^run "),
    Row("reader_of_a_drive_goes", '"$@" | head -1; exit ${PIPESTATUS[0]}', DRIVE, 141, "^run ", deep=True),
    Row("reader_is_gone", NO_READER, "ftm list", 141),
    Row("reader_of_the_help_is_gone", NO_READER, "--help", 141, deep=True),
    # the interpreter and its environment
    Row("output_in_ascii", 'export PYTHONIOENCODING=ascii; "$@" --record $HERE/é', LOAD, 0, PASS, deep=True),
    Row(
        "json_in_ascii",
        "cp $REPOSITORY/aftbed/vehicle/scenarios/ccrs-20.yaml $HERE/é.yaml; export PYTHONIOENCODING=ascii;"
        ' "$@" --scenario $HERE/é.yaml --json',
        "sim",
        0,
        r"/\\u00e9\.yaml",
    ),
    Row(
        "error_in_ascii",
        'export PYTHONIOENCODING=ascii; "$@" $HERE/é',
        "check",
        2,
        r"/\\xe9/run.json: No such file",
    ),
    Row("c_locale", 'export LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0; "$@"', DRIVE, 0, PASS, deep=True),
    Row(
        "name_not_utf8",
        "\"$@\" --record $HERE/$'\\xff'",
        LOAD,
        2,
        r"'.*\\udcff': not UTF-8; choose another name",
    ),
    Row(
        "without_asserts", 'export PYTHONOPTIMIZE=1; "$@"', LOAD, 2, "error: refusing to run under python -O"
    ),
    Row(
        "without_docstrings",
        'export PYTHONOPTIMIZE=2; "$@"',
        "check x",
        2,
        "refusing to run under python -O",
        deep=True,
    ),
    Row("no_home", 'unset HOME; "$@"', LOAD, 0, PASS, deep=True),
    Row("no_environment", 'exec env -i HERE=$HERE TMPDIR=$TMPDIR "$@"', LOAD, 0, PASS, deep=True),
    Row("sigpipe_ignored", "trap '' PIPE; \"$@\" | true; exit ${PIPESTATUS[0]}", LOAD, 141, deep=True),
    Row("sigchld_ignored", 'exec env --ignore-signal=CHLD "$@"', LOAD, 0, PASS, deep=True),
    # the working directory
    Row("removed_folder", REMOVED, LOAD, 0, PASS, deep=True),
    Row(
        "record_in_a_removed_folder",
        REMOVED + " --record r",
        LOAD,
        2,
        "error: --record r: cannot be made: No such file or directory",
        deep=True,
    ),
    Row(
        "file_in_a_removed_folder",
        REMOVED + " --trace t.json",
        LOAD,
        2,
        "error: the working directory was removed; change to another one",
    ),
    Row(
        "campaign_in_a_removed_folder",
        REMOVED,
        "campaign run ci-smoke",
        2,
        "error: --out campaign-ci-smoke: cannot be made: No such file",
        deep=True,
    ),
)


@pytest.fixture
def here() -> Iterator[Path]:
    """A directory that every user may enter, by a short path."""
    path = Path(tempfile.mkdtemp(prefix="rg-", dir="/tmp"))
    path.chmod(0o755)
    yield path
    shutil.rmtree(path)


def surroundings(here: Path) -> dict[str, str]:
    """The environment of a row's shell. `HERE` is in that of all that descends from it."""
    places = {
        "HERE": here,
        "TMPDIR": here / "tmp",
        "PYTHON": sys.base_prefix,
        "PACKAGES": site.getsitepackages()[0],
        "REPOSITORY": REPOSITORY,
    }
    (here / "tmp").mkdir(mode=0o700)
    return {**os.environ, **{name: str(place) for name, place in places.items()}}


def left(home: Home, here: Path) -> list[str]:
    """The processes and the private directories of the runs of a row."""
    found = [f"directory {path}" for above in (home.path, here) for path in above.glob("**/aftbed*/*")]
    for process in Path("/proc").iterdir():
        try:
            if process.name.isdigit() and f"HERE={here}".encode() in (process / "environ").read_bytes().split(
                b"\0"
            ):
                found.append(f"process {process.name}")
        except OSError:
            continue
    return found


def may_mount() -> bool:
    """Whether a shell of the tests may have a mount namespace, and mount."""
    words = [*PRIVATE, "mount", "--bind", "/tmp", "/tmp"]
    return (
        shutil.which("unshare") is not None
        and not subprocess.run(words, capture_output=True, check=False).returncode
    )


@pytest.mark.parametrize(
    "row", [pytest.param(row, id=row.name, marks=[pytest.mark.deep] if row.deep else []) for row in ROWS]
)
def test_a_command_ends_with_one_line_and_leaves_nothing(row: Row, home: Home, here: Path) -> None:
    if row.mounts and not may_mount():
        pytest.skip("to mount takes root, or a user namespace that may")
    shell = [*(PRIVATE if row.mounts else ()), "bash", "-c", row.shell, "rough"]
    done = subprocess.run(
        [*shell, *COMMAND, *row.words.split()],
        env=surroundings(here),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=WAIT_SECONDS_MAX,
        check=False,
    )
    said = f"{row.name}\n{done.stdout}\n{done.stderr}"
    assert done.returncode == row.code, said
    assert "Traceback" not in said
    match row.code:
        case 2:
            assert done.stdout == "" and len(done.stderr.splitlines()) == 1, said
            assert re.search("^aftbed: error: ", done.stderr) and re.search(row.line, done.stderr), said
        case 3:
            troubles = [line for line in done.stderr.splitlines() if line.startswith("aftbed: trouble: ")]
            assert troubles or "verdict: inconclusive" in done.stdout, said
            assert re.search(row.line, "".join(troubles)), said
        case _:
            assert done.stderr == "" and re.search(row.line, done.stdout), said
    until(lambda: not left(home, here), f"the end of {left(home, here)}")


def test_a_umask_opens_nothing_and_an_ignored_sigint_still_ends_a_run(home: Home, here: Path) -> None:
    """A shell without job control starts what is behind `&` with SIGINT ignored."""
    words = [
        "bash",
        "-c",
        "umask 000; trap '' INT; exec \"$@\"",
        "rough",
        sys.executable,
        "-m",
        "aftbed",
        "run",
    ]
    with subprocess.Popen(words, env=surroundings(here), stdout=subprocess.PIPE, text=True) as running:
        try:
            control = until(lambda: [*home.path.glob("aftbed/*/control")], "the control socket")[0]
            assert [path.stat().st_mode & 0o777 for path in (control, control.parent)] == [0o600, 0o700]
            assert running.stdout is not None
            while " 0.50 s " not in running.stdout.readline():  # requests were sent by then
                assert running.poll() is None
            running.send_signal(signal.SIGINT)
            out, _ = running.communicate(timeout=WAIT_SECONDS_MAX)
        finally:
            running.kill()
    assert running.returncode == 130 and "verdict: pass" in out
    until(lambda: not left(home, here), f"the end of {left(home, here)}")
