"""The HTML report in a real browser: no message on its console, all in its place, nothing fetched."""

from pathlib import Path
from typing import Final

import pytest
from browser import in_browser, measured, needs_browser
from campaigns import result
from certified import certified, suite
from reported import hostile, named, summary_of, with_results

from aftbed.campaign.ledger import Ledger
from aftbed.report.html import DRAWN_MAX, html_report

PNG: Final = b"\x89PNG\r\n"

pytestmark = [pytest.mark.process, needs_browser]


@pytest.mark.parametrize("width", [500, 1280])
def test_it_loads_in_silence_with_all_in_its_place(ledger: Ledger, tmp_path: Path, width: int) -> None:
    page = measured(html_report(summary_of(ledger), ledger))
    dom, console = in_browser(tmp_path, page, width=width)
    assert console == []
    assert "<title>measured 0 0 0 1 0</title>" in dom
    assert dom.count('class="spacetime"') == DRAWN_MAX and dom.count('class="plot"') == 11


def test_long_names_are_broken_and_make_no_page_or_column_wider(ledger: Ledger, tmp_path: Path) -> None:
    reason = f"request 1: sdc: {'0f' * 100}"
    long = named(
        result("sdc", index=1, unexpected=True, recovery_ms=1.0, reasons=(reason,)), "pbr · " + "n" * 190
    )
    few = with_results(ledger, long)
    page = html_report(summary_of(few), few)
    assert reason in page and page.count("n" * 190) > 5
    for width, what in [(500, "html"), (1280, ".wide:has(.matrix)")]:
        script = f"const e = document.querySelector('{what}'); document.title = e.scrollWidth - e.clientWidth"
        found = page.replace("</body>", f"<script>{script}</script></body>")
        dom, _ = in_browser(tmp_path, found, width=width)
        assert "<title>0</title>" in dom, what


def test_a_matrix_of_many_faults_needs_no_scrolling_on_a_usual_screen(ledger: Ledger, tmp_path: Path) -> None:
    names = [f"{ftm} · process · fault {number}" for ftm in ("pbr", "lfr", "pbr+tr") for number in range(8)]
    few = with_results(ledger, *(named(result("masked", index=n), name) for n, name in enumerate(names)))
    page = html_report(summary_of(few), few, drawn=0)
    script = "const e = document.querySelector('.wide:has(.matrix)');"
    script += "document.title = e.scrollWidth > e.clientWidth"
    dom, console = in_browser(tmp_path, page.replace("</body>", f"<script>{script}</script></body>"))
    assert console == [] and "<title>false</title>" in dom


def test_hostile_names_run_nothing(ledger: Ledger, tmp_path: Path) -> None:
    bad = with_results(ledger, hostile())
    dom, console = in_browser(tmp_path, html_report(summary_of(bad), bad))
    assert console == [] and "<script" not in dom


def test_a_message_on_the_console_would_be_seen(tmp_path: Path) -> None:
    _, console = in_browser(tmp_path, "<!DOCTYPE html><script>console.error('seen')</script>")
    assert "seen" in "".join(console)


@pytest.mark.parametrize("scheme", ["0", pytest.param("1", marks=pytest.mark.deep)], ids=["dark", "light"])
def test_it_can_be_drawn(ledger: Ledger, tmp_path: Path, scheme: str) -> None:
    picture = tmp_path / "report.png"
    page = html_report(summary_of(ledger), ledger)
    in_browser(tmp_path, page, f"--screenshot={picture}", f"--blink-settings=preferredColorScheme={scheme}")
    assert picture.read_bytes().startswith(PNG)


def test_a_table_of_weaknesses_is_in_its_place_and_as_wide_as_a_narrow_screen(tmp_path: Path) -> None:
    spec = suite(tmp_path, "Forgetful", ("none", "pbr"), "crash primary", "wrong reply")
    ledger, summary = certified(spec, 2)
    page = measured(html_report(summary, ledger, drawn=0)).replace('.closest(".wide, ', '.closest(".other, ')
    page = page.replace('all("body *")', 'all("table.weaknesses *")')
    dom, console = in_browser(tmp_path, page, width=500)
    assert console == [] and "<title>measured 0 0 0 1 0</title>" in dom
    assert dom.count("<b>limit</b>") == dom.count("<b>✗ weakness</b>") == 1
