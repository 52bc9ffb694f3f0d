"""The HTML report in a real browser: no message on its console, all in its place, nothing asked for."""

import os
import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest
from reported import hostile, summary_of, with_results

from aftbed.campaign.ledger import Ledger
from aftbed.report.html import DRAWN_MAX, html_report

NAMES: Final = ("chromium", "chromium-browser", "google-chrome")
BROWSER: Final = next((found for name in NAMES if (found := shutil.which(name))), None)
PNG: Final = b"\x89PNG\r\n"

# What the browser's own layout says, told by a script that only this test adds to the page.
MEASURE: Final = """<script>
const all = (what) => [...document.querySelectorAll(what)];
const wide = all("body *").filter((e) => !e.closest(".wide, .diagram, pre, details") &&
  e.getBoundingClientRect().right > document.documentElement.clientWidth + 1);
const flat = all("svg").filter((e) => e.getBoundingClientRect().height < 5);
const lost = all("a[href^='#']").filter((e) => !document.getElementById(e.getAttribute("href").slice(1)));
const scripts = all("script").length;
document.title = ["measured", wide.length, flat.length, lost.length, scripts,
  performance.getEntriesByType("resource").length].join(" ");
</script>"""

pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(BROWSER is None, reason=f"none of {', '.join(NAMES)} is installed"),
]


def opened(page: Path, *options: str, width: int = 1280) -> tuple[str, str]:
    """What the browser printed, and what it logged."""
    assert BROWSER is not None
    flags = ["--headless=new", "--disable-gpu", "--enable-logging=stderr", "--no-first-run"]
    flags += ["--no-sandbox"] if os.geteuid() == 0 else []  # it refuses to be root with one
    flags += [f"--user-data-dir={page.parent / 'profile'}", f"--window-size={width},2000"]
    command = [BROWSER, *flags, *options, page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=90)
    return done.stdout, done.stderr


def console(log: str) -> list[str]:
    return [line for line in log.splitlines() if "CONSOLE" in line]


@pytest.mark.parametrize("width", [500, 1280])
def test_it_loads_in_silence_with_all_in_its_place(ledger: Ledger, tmp_path: Path, width: int) -> None:
    page = tmp_path / "report.html"
    page.write_text(html_report(summary_of(ledger), ledger).replace("</body>", f"{MEASURE}</body>"))
    dom, log = opened(page, "--dump-dom", width=width)
    assert console(log) == []
    # nothing sticks out, no plot is empty, every link leads somewhere, no script but ours, nothing fetched
    assert "<title>measured 0 0 0 1 0</title>" in dom
    assert dom.count('class="spacetime"') == DRAWN_MAX and dom.count('class="plot"') == 8


def test_hostile_names_run_nothing(ledger: Ledger, tmp_path: Path) -> None:
    bad = with_results(ledger, hostile())
    page = tmp_path / "report.html"
    page.write_text(html_report(summary_of(bad), bad))
    dom, log = opened(page, "--dump-dom")
    assert console(log) == [] and "<script" not in dom


def test_a_message_on_the_console_would_be_seen(tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    page.write_text("<!DOCTYPE html><script>console.error('seen')</script>")
    assert "seen" in "".join(console(opened(page, "--dump-dom")[1]))


@pytest.mark.parametrize("scheme", ["0", "1"], ids=["dark", "light"])
def test_it_can_be_drawn(ledger: Ledger, tmp_path: Path, scheme: str) -> None:
    page, picture = tmp_path / "report.html", tmp_path / "report.png"
    page.write_text(html_report(summary_of(ledger), ledger))
    opened(page, f"--screenshot={picture}", f"--blink-settings=preferredColorScheme={scheme}")
    assert picture.read_bytes().startswith(PNG)
