"""A function from outside of the package: its run notes it, and a later judge executes what was noted."""

import json
import os
import stat
import subprocess
import sys
from hashlib import sha256
from pathlib import Path
from typing import Final

import pytest
from liveruns import aftbed, home

from aftbed.runtime.unix.supervisor import DRAIN_SECONDS_MAX

pytestmark = pytest.mark.process

__all__ = ["home"]

MINE: Final = "from aftbed.vehicle.aeb.function import AebFunction\n\n\nclass Mine(AebFunction):\n    pass\n"
SLOW_LIBRARY: Final = f"""import sys
import time

if "library" not in sys.modules:
    sys.modules["library"] = time
    time.sleep({DRAIN_SECONDS_MAX + 0.5})

"""
LOAD: Final = ("run", "--load", "60")


@pytest.fixture(autouse=True)
def ledger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """That of a user who has run nothing yet."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "aftbed" / "functions"


def test_a_file_that_was_run_is_known_to_its_user_and_to_no_other(
    tmp_path: Path, ledger: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine, record = tmp_path / "mine.py", tmp_path / "record"
    mine.write_text(MINE)
    umask = os.umask(0)
    try:
        done = aftbed(*LOAD, "--adapt", f"update app to {mine}:Mine at request 9", "--record", record)
    finally:
        os.umask(umask)
    assert done.code == 0 and "note" not in done.err, done.out + done.err
    digest = sha256(MINE.encode()).hexdigest()
    notes = set((record / "functions.jsonl").read_text().splitlines())
    assert [json.loads(one) for one in notes] == [{"place": str(mine), "file": str(mine), "sha256": digest}]
    assert ledger.read_text() == f"{digest}\n"
    assert stat.S_IMODE(record.stat().st_mode) == 0o700, "no one else writes what the run believes"
    assert aftbed("check", record).code == 0
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another"))
    judged = aftbed("check", record)
    assert judged.code == 3 and f"--trust {tmp_path}" in judged.out
    assert aftbed("check", record, "--trust", tmp_path).code == 0


def test_a_function_whose_import_takes_longer_than_the_load_is_exchanged(tmp_path: Path) -> None:
    mine = tmp_path / "mine.py"
    mine.write_text(SLOW_LIBRARY + MINE)
    done = aftbed(*LOAD, "--adapt", f"update app to {mine}:Mine at request 9", "--json")
    assert done.code == 0, done.out + done.err
    assert [one["outcome"] for one in json.loads(done.out)["adaptations"]] == ["done"]


def test_a_module_is_known_with_the_package_around_it(tmp_path: Path, ledger: Path) -> None:
    package, record = tmp_path / "libraries" / "outer", tmp_path / "record"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text('"""A package."""\n')
    (package / "inner.py").write_text(MINE)

    def command(*words: str | Path) -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"PYTHONPATH": str(package.parent)}
        line = [sys.executable, "-m", "aftbed", *map(str, words)]
        return subprocess.run(
            line, env=environment, capture_output=True, text=True, check=False, cwd=tmp_path
        )

    done = command(*LOAD, "--adapt", "update app to outer.inner:Mine at request 9", "--record", record)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(ledger.read_text().split()) == 2
    assert command("check", record).returncode == 0
    (package / "__init__.py").write_text('"""Another."""\n')
    assert command("check", record).returncode == 0, "the record has a copy of what was executed"
    ledger.write_text(f"{sha256(MINE.encode()).hexdigest()}\n")  # the package is not known any more
    judged = command("check", record)
    assert judged.returncode == 3 and "outer.inner:Mine is not trusted" in judged.stdout


def test_a_ledger_that_cannot_be_kept_is_a_note(tmp_path: Path, ledger: Path) -> None:
    mine = tmp_path / "mine.py"
    mine.write_text(MINE)
    ledger.parent.parent.touch()
    done = aftbed(*LOAD, "--adapt", f"update app to {mine}:Mine at request 9")
    assert done.code == 0
    assert "aftbed: note: aftbed check will ask for --trust" in done.err and "File exists" in done.err


def test_no_module_is_imported_from_the_working_directory(tmp_path: Path) -> None:
    """`python -m` puts it in the first place of the path."""
    for name in ("msgspec", "typer", "yaml", "can", "json", "multiprocessing"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'EXECUTED')!r}, 'a').write({name!r})\n")
    line = [sys.executable, "-m", "aftbed", "log", "convert", "none.asc", "none.log"]
    done = subprocess.run(line, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 2 and "none.asc: cannot be read" in done.stderr
    assert not (tmp_path / "EXECUTED").exists()
