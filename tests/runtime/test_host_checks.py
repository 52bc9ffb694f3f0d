"""What `aftbed doctor` says of a machine: what can be made wrong here is found, and has a remedy."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from aftbed.runtime.unix import doctor, run_directory
from aftbed.runtime.unix.doctor import HostCheck, inspect


@pytest.fixture
def limits() -> Iterator[None]:
    """What a test changes of this process is as before when it ends."""
    cpus = os.sched_getaffinity(0)
    yield
    os.sched_setaffinity(0, cpus)


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(doctor, "STEAL_SECONDS", 0.01)
    return tmp_path


def found(name: str) -> HostCheck:
    return next(check for check in inspect() if check.name == name)


def test_a_machine_that_runs_the_tests_has_what_a_run_needs() -> None:
    checks = {check.name: check for check in inspect()}
    assert [c for c in checks.values() if c.status == "missing"] == []
    for name in ("pidfd", "memfd", "parent death signal", "packet sockets", "loopback", "/proc"):
        assert (checks[name].status, checks[name].found) == ("ok", "works")
    assert checks["asserts"].found == "on"
    assert checks["run directory"].found == f"{run_directory.root()}, mode 0700"


def test_what_is_not_well_has_a_remedy() -> None:
    for check in inspect():
        assert check.found and check.serves
        assert bool(check.remedy) == (check.status != "ok"), check


def test_a_call_that_is_refused_is_missing() -> None:
    def refused() -> None:
        raise PermissionError(1, "Operation not permitted")

    check = doctor._tried("pidfd", "deaths", "allow it", refused)
    assert (check.status, check.remedy) == ("missing", "allow it")
    assert "Operation not permitted" in check.found


@pytest.mark.parametrize(("files", "status"), [(200, "missing"), (512, "warning"), (1024, "ok")])
def test_few_open_files(monkeypatch: pytest.MonkeyPatch, files: int, status: str) -> None:
    """The hard limit counts, which a test could not take back: a run raises the soft one."""
    monkeypatch.setattr("resource.getrlimit", lambda _: (100, files))
    check = found("open files")
    assert check.status == status
    assert check.found == f"{files} allowed"
    assert check.remedy == ("" if status == "ok" else "ulimit -n 1024")


def test_one_cpu(limits: None) -> None:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    check = found("CPUs")
    assert check.status == "warning" and check.found == f"1 usable of {os.cpu_count()}"


def test_a_path_that_is_too_long_for_a_socket(runtime: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep = runtime / ("d" * 100)
    deep.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(deep))
    check = found("run directory")
    assert check.status == "missing" and check.found.endswith("bytes too long for a socket's path")
    assert check.remedy == "set XDG_RUNTIME_DIR or TMPDIR to a shorter path"


def test_a_package_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(doctor.OPTIONAL, "no-such-package-of-aftbed", "nothing")
    check = found("no-such-package-of-aftbed")
    assert (check.status, check.found) == ("warning", "not installed")
    assert check.remedy == "pip install no-such-package-of-aftbed"
