"""`aftbed check`: a directory that is no record is refused. Real records are in `test_live_process.py`."""

from pathlib import Path

import pytest
from fakerun import Output


@pytest.mark.parametrize(
    ("content", "word"), [("{", "not JSON"), ("[]", "not a JSON object"), ("{}", "run.json")]
)
def test_a_record_without_a_good_head(refused: Output, tmp_path: Path, content: str, word: str) -> None:
    (tmp_path / "run.json").write_text(content)
    error = refused("check", tmp_path)
    assert "run.json" in error and word in error


def test_a_trusted_directory_that_is_none(refused: Output, tmp_path: Path) -> None:
    error = refused("check", tmp_path, "--trust", tmp_path / "absent")
    assert f"--trust {tmp_path / 'absent'}: no such directory" in error


def test_a_directory_that_is_no_record(refused: Output, tmp_path: Path) -> None:
    error = refused("check", tmp_path)
    assert "run.json" in error and "is this the record of a run?" in error
    assert "is this the record of a run?" in refused("check", tmp_path / "absent")
