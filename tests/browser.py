"""A page in a real browser: its console, and what its layout engine measures. Skips where there is none."""

import os
import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest

NAMES: Final = ("chromium", "chromium-browser", "google-chrome")
BROWSER: Final = next((found for name in NAMES if (found := shutil.which(name))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason=f"none of {', '.join(NAMES)} is installed")

# Measured by a script that only the tests add to a page: elements that stick out, empty drawings, lost links,
# scripts (this one), and resources that were fetched.
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


def measured(page: str) -> str:
    """The page with the script: its title becomes `measured`, and the five counts."""
    return page.replace("</body>", f"{MEASURE}</body>")


def in_browser(folder: Path, page: str, *options: str, width: int = 1280) -> tuple[str, list[str]]:
    """The page as the browser dumps it after loading, and the lines on its console."""
    assert BROWSER is not None
    path = folder / "page.html"
    path.write_text(page, encoding="utf-8")
    flags = ["--headless=new", "--disable-gpu", "--enable-logging=stderr", "--no-first-run"]
    flags += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    flags += ["--no-sandbox"] if os.geteuid() == 0 else []  # Chromium refuses to run as root with one
    flags += [f"--user-data-dir={folder / 'profile'}", f"--window-size={width},2000"]
    command = [BROWSER, *flags, *(options or ("--dump-dom",)), path.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=90)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]
