"""`aftbed app new`: what it writes, and that the project passes its own tests."""

import resource
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import PLUGIN, called
from sampling import every

from aftbed.cli.init import KINDS, create
from aftbed.core.errors import ConfigError


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_new_project_is_listed_with_the_next_command(refused: Callable[..., str], here: Path) -> None:
    folder = create("heater", "so")
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    common = {"README.md", "requests.csv", "test_function.py", "campaign.yaml", ".github/workflows/test.yml"}
    assert files == common | {"function.c", "aft.h", "Makefile"}
    text = "".join(path.read_text() for path in folder.rglob("*") if path.is_file() and path.suffix != ".h")
    assert "heater" in text and "@APP@" not in text and "@NAME@" not in text
    assert len((folder / "README.md").read_text().splitlines()) <= 15
    assert "heater: is there already" in refused("app", "new", "heater")


@pytest.mark.parametrize(("kind", "needs"), [("class", "pytest"), ("fmu", "pytest FMPy")])
def test_what_a_project_needs_is_installed_by_its_ci_and_told(kind: str, needs: str, here: Path) -> None:
    """aftbed itself brings no FMPy."""
    folder = create("heater", kind)
    assert f'vars.AFTBED }}}}" {needs}\n' in (folder / ".github/workflows/test.yml").read_text()
    assert f"It needs (pip): aftbed {needs}.\n" in (folder / "README.md").read_text()


@pytest.mark.parametrize(
    "name", ["", "Heater", "../heater", "a/b", "-a", "1a", "a b", "a.b", "a" * 41, "h\u00e9ater", "a\n"]
)
def test_a_bad_name_is_refused(refused: Callable[..., str], here: Path, name: str) -> None:
    assert "is no name of a project: a small letter, then" in refused("app", "new", "--", name)
    assert list(here.iterdir()) == []


def test_an_unknown_kind_is_refused(refused: Callable[..., str], here: Path) -> None:
    assert "unknown kind 'clas'; did you mean 'class'?" in refused("app", "new", "a", "--kind", "clas")
    assert list(here.iterdir()) == []


def test_of_a_project_that_cannot_be_written_nothing_is_left(here: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(ConfigError, match=r"heater: cannot be written: File too large"):
            create("heater", "class")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert list(here.iterdir()) == []


@pytest.mark.process
@pytest.mark.parametrize("kind", every(3, ["so", "fmu", "stdio"]))
def test_a_new_project_passes_its_own_tests(kind: str, here: Path) -> None:
    """That of a class is tried by the test of docs/functions.md."""
    assert {"class", "so", "fmu", "stdio"} == {*KINDS}
    folder = create("heater", kind)
    if KINDS[kind].first:
        if shutil.which("gcc") is None or shutil.which("make") is None:
            pytest.skip("gcc or make is missing")
        made = called(*KINDS[kind].first.split(), folder=folder)
        assert made.returncode == 0, made.stderr
        assert "warning" not in made.stderr
    done = called(sys.executable, "-m", "pytest", "-q", *PLUGIN, "-W", "error", folder=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "8 passed" in done.stdout
    words = ("-m", "aftbed", "campaign", "run", "campaign.yaml", "--out", "out")
    done = called(sys.executable, *words, folder=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "gate: pass" in done.stdout


@pytest.mark.deep
def test_a_new_project_passes_on_real_processes(here: Path) -> None:
    folder = create("heater", "class")
    words = ("pytest", "-q", *PLUGIN, "--aftbed-runtime=unix", "-k", "corrected")
    done = called(sys.executable, "-m", *words, folder=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed" in done.stdout
