"""Where a run lives: private, found by itself, and refused where others could look in."""

import os
import re
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from rundirs import new_run

from aftbed.core.errors import ConfigError
from aftbed.runtime.unix import run_directory
from aftbed.runtime.unix.launch import launch, options_for
from aftbed.runtime.unix.options import LoadRun


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A runtime directory of this test alone; where the runs are."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "aftbed"


@pytest.fixture
def listeners() -> Iterator[list[socket.socket]]:
    found: list[socket.socket] = []
    yield found
    for sock in found:
        sock.close()


def alive(listeners: list[socket.socket]) -> Path:
    """A run whose supervisor listens."""
    private = new_run()
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    sock.bind(str(private / run_directory.SOCKET_NAME))
    sock.listen()
    listeners.append(sock)
    return private


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


def test_a_runs_directory_is_private(runtime: Path) -> None:
    private = new_run()
    assert private.parent == runtime == run_directory.root()
    assert mode(private) == mode(runtime) == 0o700


def test_each_run_has_its_own(runtime: Path) -> None:
    assert len({new_run() for _ in range(20)}) == 20


def test_a_run_that_has_just_taken_the_place_is_left_alone(runtime: Path) -> None:
    """Two commands that drew the same name: one of them says so, and removes nothing of the other's."""
    options, _ = options_for(ftm="none", placement="single", work=LoadRun(1, 0.0))
    taken = Path(options.private)
    run_directory.make(taken)
    run_directory._owned.pop(taken)  # as if by another process
    with pytest.raises(ConfigError, match=f"{taken}: cannot be made: File exists; start the run again"):
        launch(options, None)
    assert taken.is_dir()


def test_without_a_runtime_directory_it_lies_under_tmp(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    for missing in (None, str(tmp_path / "nowhere")):
        if missing is None:
            monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
        else:
            monkeypatch.setenv("XDG_RUNTIME_DIR", missing)
        assert run_directory.root().parent == tmp_path and run_directory.root().name.startswith("aftbed-")


@pytest.mark.parametrize(
    ("folder", "bytes_min", "expected"),
    [
        ("", 0, True),
        ("", 1 << 60, False),  # too small
        ("nowhere", 0, False),
    ],
)
def test_without_a_temporary_directory_it_lies_in_memory_that_suits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, bytes_min: int, expected: bool
) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.delenv("TMPDIR", raising=False)
    monkeypatch.setattr(run_directory, "MEMORY", tmp_path / folder)
    monkeypatch.setattr(run_directory, "MEMORY_BYTES_MIN", bytes_min)
    assert run_directory._place() == (tmp_path if expected else Path("/tmp")) / f"aftbed-{os.getuid()}"


@pytest.mark.parametrize("wide", [0o755, 0o770, 0o701, 0o777])
def test_a_directory_that_others_can_enter_is_refused(runtime: Path, wide: int) -> None:
    runtime.mkdir()
    runtime.chmod(wide)
    with pytest.raises(
        ConfigError, match=re.escape(f"{runtime}: must be a directory of this user alone (mode 0700)")
    ):
        new_run()


def test_a_directory_of_another_user_is_refused(runtime: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    another = run_directory.root().stat().st_uid + 1
    monkeypatch.setattr("os.getuid", lambda: another)
    with pytest.raises(ConfigError, match="must be a directory of this user alone"):
        run_directory.root()


def test_a_file_in_its_place_is_refused(runtime: Path) -> None:
    runtime.write_text("")
    with pytest.raises(ConfigError, match="must be a directory of this user alone"):
        run_directory.root()


def test_a_link_to_a_directory_is_refused(runtime: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    runtime.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="must be a directory of this user alone"):
        run_directory.root()


# -- the record


def test_without_a_wish_the_record_goes_with_the_run(runtime: Path) -> None:
    private = new_run()
    record = run_directory.record_directory(private / "record")
    assert record == private / "record" and (record / "journal").is_dir()
    run_directory.remove(private)
    assert not private.exists() and runtime.exists()


def test_a_wished_record_stays(runtime: Path, tmp_path: Path) -> None:
    private = new_run()
    record = run_directory.record_directory(tmp_path / "new" / "record")
    assert record == tmp_path / "new" / "record" and (record / "journal").is_dir()
    run_directory.remove(private)
    assert record.exists()


def test_a_record_directory_that_exists_is_refused(runtime: Path, tmp_path: Path) -> None:
    wanted = str(tmp_path / "record")
    Path(wanted).mkdir()
    message = re.escape(f"--record {wanted}: exists already; name a directory that does not")
    with pytest.raises(ConfigError, match=message):
        run_directory.record_directory(Path(wanted))
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="exists already"):
        run_directory.record_directory(tmp_path / "file")


def test_a_record_directory_that_cannot_be_made_is_refused(runtime: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"--record .*/file/record: cannot be made: Not a directory"):
        run_directory.record_directory(tmp_path / "file" / "record")


# -- finding runs


def test_the_only_run_is_found_by_itself(runtime: Path, listeners: list[socket.socket]) -> None:
    private = alive(listeners)
    new_run()  # a run whose supervisor is gone: nothing listens
    assert run_directory.live() == [private.name]
    assert run_directory.find(None) == run_directory.find(private.name) == private


def test_no_run_is_alive(runtime: Path) -> None:
    with pytest.raises(ConfigError, match="no run is alive; start one with `aftbed run`"):
        run_directory.find(None)
    with pytest.raises(ConfigError, match=r"--run xyz: no such run is alive \(alive: none\)"):
        run_directory.find("xyz")


def test_several_runs_are_alive(runtime: Path, listeners: list[socket.socket]) -> None:
    names = {alive(listeners).name, alive(listeners).name}
    with pytest.raises(ConfigError, match=r"2 runs are alive: name one with --run \(alive: ") as caught:
        run_directory.find(None)
    assert all(name in str(caught.value) for name in names)
    with pytest.raises(ConfigError, match="--run xyz: no such run is alive") as caught:
        run_directory.find("xyz")
    assert all(name in str(caught.value) for name in names)


def test_an_id_may_be_shortened_as_long_as_it_means_one_run(
    runtime: Path, listeners: list[socket.socket]
) -> None:
    one, other = alive(listeners), alive(listeners)
    same = os.path.commonprefix([one.name, other.name])  # noqa: RUF071 - of the digits of two ids
    for run in (one, other):
        assert run_directory.find(run.name[: len(same) + 1]) == run
    names = {one.name, other.name}
    while not same:  # until two of them begin with the same digit
        names.add(alive(listeners).name)
        same = next((name[:1] for name in names if sum(n[0] == name[0] for n in names) > 1), "")
    with pytest.raises(ConfigError, match=rf"--run {same}: \d+ runs begin so: ") as caught:
        run_directory.find(same)
    assert all(name in str(caught.value) for name in names if name.startswith(same))


def test_a_dead_run_is_no_run(runtime: Path, listeners: list[socket.socket]) -> None:
    private = alive(listeners)
    listeners[0].close()
    assert (private / run_directory.SOCKET_NAME).exists() and run_directory.live() == []
    with pytest.raises(OSError, match="refused"):
        run_directory.connect(private)


# -- whose it is


def test_a_run_has_an_owner_until_it_is_removed(runtime: Path) -> None:
    private = new_run()
    assert run_directory.owned(private)
    run_directory.remove(private)
    assert not run_directory.owned(private)


def test_a_child_of_its_owner_does_not_own_it(runtime: Path) -> None:
    """Else a run would seem alive as long as any other run of the same command."""
    private = new_run()
    end, life = os.pipe()
    told, telling = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(life)
        os.write(telling, b"!")
        os.read(end, 1)  # lives until the test has looked
        os._exit(0)
    try:
        assert os.read(told, 1) == b"!"
        os.close(run_directory._owned.pop(private))  # as at the owner's death
        assert not run_directory.owned(private)
    finally:
        for descriptor in (life, end, told, telling):
            os.close(descriptor)
        os.waitpid(child, 0)
