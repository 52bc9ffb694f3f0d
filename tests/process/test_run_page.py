"""The report of one run as a page, of real runs."""

import re
from pathlib import Path

import pytest
from browser import in_browser, measured, needs_browser
from liveruns import SHORT, Home, aftbed, forked

pytestmark = pytest.mark.process

FAULT = "crash primary at checkpoint.sent nth 5"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """For the record."""
    return tmp_path_factory.mktemp("run")


@pytest.fixture
def run(folder: Path, home: Home) -> tuple[Path, str]:
    """The record of a drive in which a replica dies and the mechanism is changed, and its page."""
    record, sink = folder / "record", folder / "run.html"
    if not sink.exists():
        drive = ("--scenario", SHORT, "--pace", "max", "--record", record, "--html", sink)
        done = forked("run", *drive, "--inject", FAULT, "--adapt", "compose pbr+tr at request 15")
        assert done.code == 0, done.out + done.err
        assert f"{sink}: " in done.out
    return record, sink.read_text()


def test_it_has_the_verdict_the_drive_what_happened_and_no_script(run: tuple[Path, str]) -> None:
    page = run[1]
    assert "✓ pass" in page and "<script" not in page and "http" not in page.replace("http://www.w3.org", "")
    for words in ("Speed of the car", "Gap as the radar sees it", "Deceleration", FAULT, "activated"):
        assert words in page, words
    assert re.search(r"<td>to epoch 2</td><td>crash primary", page)
    assert re.search(r"<td>to pbr\+tr at request 15</td><td class=\"\">done", page)
    assert "watchdog.suspect" in page and "adapted: 1: pbr to pbr+tr: done" in page
    assert re.search(r"<code>EGO_STATE</code></td><td class=\"number\">\d+", page)
    assert "Nobody but the processes of the run was on it." in page


def test_a_check_of_the_record_makes_the_same_page(run: tuple[Path, str], tmp_path: Path) -> None:
    record, page = run
    done = aftbed("check", record, "--html", tmp_path / "again.html", "--json")
    assert done.code == 0 and done.out.count("\n") == 1, "JSON and nothing else"
    assert (tmp_path / "again.html").read_text() == page


@needs_browser
@pytest.mark.parametrize("width", [1280, 420])
def test_a_browser_finds_nothing_lost_or_too_wide(run: tuple[Path, str], tmp_path: Path, width: int) -> None:
    dumped, console = in_browser(tmp_path, measured(run[1]), width=width)
    assert console == []
    assert "<title>measured 0 0 0 1 0</title>" in dumped


def test_a_load_that_lost_its_service_has_a_page_without_a_drive(home: Home, tmp_path: Path) -> None:
    sink = tmp_path / "load.html"
    done = forked(
        *("run", "--ftm", "none", "--load", "100@1000", "--inject", "crash primary at server.exit nth 20"),
        *("--html", sink),
    )
    assert done.code == 1, done.out + done.err
    page = sink.read_text()
    assert "✗ fail" in page and "exactly_one_answer: " in page
    assert 'id="drive"' not in page and 'id="bus"' not in page


def test_a_page_that_cannot_be_written_is_refused_before_the_run(home: Home, tmp_path: Path) -> None:
    done = forked("run", "--html", tmp_path / "no" / "run.html")
    assert done.code == 2 and "a file in a directory that exists is allowed" in done.err
