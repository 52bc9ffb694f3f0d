"""A record with a flipped bit, or with a file missing, cut or exchanged, passes with no other meaning.

With its old seal every change is told. With a new one, the sources have to contradict each other, or the
record means the same: see `meaning`.
"""

import re
import shutil
from functools import cache
from pathlib import Path
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st
from writtenruns import SEED, meaning, setup, write_run

from aftbed.core.errors import ConfigError
from aftbed.core.journal import HEADER_BYTES, RECORD
from aftbed.judge.record import read_record
from aftbed.judge.verdict import judge
from aftbed.runtime.unix import seal
from aftbed.runtime.unix.run_directory import HISTORY_NAME

HEADER_USED: Final = 200  # of a journal's first page, what it has room for is empty


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("records") / "whole", setup())


@pytest.fixture(scope="module")
def copy(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Changed and mended again by each test."""
    return Path(shutil.copytree(whole, tmp_path_factory.mktemp("copies") / "copy"))


def files(record: Path) -> list[Path]:
    return sorted(path for path in record.rglob("*") if path.is_file() and path.name != seal.NAME)


@pytest.fixture(scope="module")
def places(copy: Path) -> list[tuple[Path, int]]:
    """Each byte that means something."""
    return [
        (path, at)
        for path in files(copy)
        for at in range(path.stat().st_size)
        if path.parent.name != "journal" or not HEADER_USED <= at < HEADER_BYTES
    ]


@cache
def meaning_of(record: Path) -> object:
    """Of one that nothing changes."""
    return meaning(read_record(record))


def passes_with_another_meaning(record: Path, original: Path) -> bool:
    try:
        found = read_record(record)
        if judge(found).verdict != "pass":
            return False
    except ConfigError:
        return False
    return meaning(found) != meaning_of(original)


def flipped(data: bytes, at: int, bit: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]


def test_as_it_is_it_passes(whole: Path) -> None:
    verdict = judge(read_record(whole))
    assert (verdict.verdict, verdict.reasons) == ("pass", [])
    assert len(verdict.faults) == len(verdict.adaptations) == len(verdict.failovers) == 1


@pytest.mark.parametrize(("crash_at", "adapt_at"), [(12, 0), (11, 0), (0, 12), (4, 12)])
def test_a_server_that_came_after_the_last_request_has_no_effects(
    tmp_path: Path, crash_at: int, adapt_at: int
) -> None:
    """As a new backup or by an adaptation, and there is nothing wrong with that."""
    verdict = judge(read_record(write_run(tmp_path / "run", setup(crash_at=crash_at, adapt_at=adapt_at))))
    assert (verdict.verdict, verdict.reasons) == ("pass", [])


def test_a_journal_that_was_just_being_made_is_no_gap(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run", setup(crash_at=0))
    (path / "journal" / "b.server.2.journal").touch()
    seal.write(path)
    assert judge(read_record(path)).reasons == []


@pytest.mark.parametrize(
    ("recipe", "blackout_ms", "lost", "reasons"),
    [
        ("drained", 1000.0, 9, ["the journal b.server.1 lacks what was between requests 8 and 10"]),
        ("paper", 0.0, 9, []),
        ("paper", 1000.0, 4, []),
        ("paper", 0.0, 4, ["the journal b.server.1 lacks what was between requests 3 and 5"]),
        ("paper", 1000.0, 11, ["the journal b.server.1 lacks what was between requests 10 and 12"]),
    ],
)
def test_only_the_recipe_of_the_paper_may_lose_a_checkpoint(
    tmp_path: Path, recipe: str, blackout_ms: float, lost: int, reasons: list[str]
) -> None:
    """In its blackout: it destroys bricks with what is inside them."""
    path = write_run(tmp_path / "run", setup(crash_at=0))
    journal = path / "journal" / "b.server.1.journal"
    whole = journal.read_bytes()
    records = [whole[at : at + RECORD.size] for at in range(HEADER_BYTES, len(whole), RECORD.size)]
    kept = [one for one in records if RECORD.unpack(one)[1] != lost]
    journal.write_bytes(whole[:HEADER_BYTES] + b"".join(kept))
    for name in ("run.json", HISTORY_NAME):
        told = path / name
        text = told.read_text().replace("drained", recipe)
        told.write_text(re.sub(r'("blackout_ms": ?)[\d.]+', rf"\g<1>{blackout_ms}", text))
    seal.write(path)
    assert judge(read_record(path)).reasons == [f"sources_agree: {one}" for one in reasons]


@given(data=st.data())
def test_a_flipped_bit_is_told_by_the_seal(copy: Path, data: st.DataObject) -> None:
    path = data.draw(st.sampled_from([one for one in files(copy) if one.stat().st_size]))
    before = path.read_bytes()
    at, bit = data.draw(st.integers(0, len(before) - 1)), data.draw(st.integers(0, 7))
    path.write_bytes(flipped(before, at, bit))
    try:
        changed = f"{path.relative_to(copy)} was changed since the record was sealed"
        assert changed in list(seal.changes(copy))
    finally:
        path.write_bytes(before)


@given(data=st.data())
def test_a_flipped_bit_under_a_new_seal_changes_no_meaning(
    copy: Path, places: list[tuple[Path, int]], whole: Path, data: st.DataObject
) -> None:
    path, at = data.draw(st.sampled_from(places))
    before = path.read_bytes()
    path.write_bytes(flipped(before, at, data.draw(st.integers(0, 7))))
    seal.write(copy)
    try:
        assert not passes_with_another_meaning(copy, whole), (path.name, at)
    finally:
        path.write_bytes(before)


def test_no_file_is_missing_cut_or_exchanged_without_a_word(copy: Path, whole: Path, tmp_path: Path) -> None:
    other = write_run(tmp_path / "other", setup(SEED + 1))
    for path in files(copy):
        before, exchanged = path.read_bytes(), other / path.relative_to(copy)
        changes = [None, before[: len(before) // 2]]
        changes += [before[:HEADER_BYTES]] if len(before) > HEADER_BYTES else []
        changes += [exchanged.read_bytes()] if exchanged.exists() else []
        for change in changes:
            if change is None:
                path.unlink()
            else:
                path.write_bytes(change)
            seal.write(copy)
            assert not passes_with_another_meaning(copy, whole), path.name
        path.write_bytes(before)
