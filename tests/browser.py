"""A page in a real browser: its console, and what its layout engine measures. Skips where there is none."""

import contextlib
import json
import os
import select
import shutil
import subprocess
import time
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest

NAMES: Final = ("chromium", "chromium-browser", "google-chrome")
BROWSER: Final = next((found for name in NAMES if (found := shutil.which(name))), None)
BROWSER_SECONDS_MAX: Final = 60.0
LOOK_SECONDS: Final = 0.02  # between two looks at a page
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


def _command(folder: Path, width: int) -> list[str]:
    assert BROWSER is not None
    flags = ["--headless=new", "--disable-gpu", "--enable-logging=stderr", "--no-first-run"]
    flags += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    flags += ["--disable-dev-shm-usage"]  # there it leaves files behind at times, which are not of a run
    flags += ["--no-sandbox"] if os.geteuid() == 0 else []  # Chromium refuses to run as root with one
    return [BROWSER, *flags, f"--user-data-dir={folder / 'profile'}", f"--window-size={width},2000"]


def in_browser(folder: Path, page: str, *options: str, width: int = 1280) -> tuple[str, list[str]]:
    """The page as the browser dumps it after loading, and the lines on its console."""
    path = folder / "page.html"
    path.write_text(page, encoding="utf-8")
    command = [*_command(folder, width), *(options or ("--dump-dom",)), path.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=90)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


class DrivenPage:
    """A page that stays open, driven over the DevTools protocol: JSON documents, each ended by a NUL."""

    def __init__(self, sending: int, receiving: int) -> None:
        self._sending, self._receiving = sending, receiving
        self._rest, self._number, self._session = b"", 0, ""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Page.enable")

    def call(self, method: str, **parameters: object) -> dict[str, Any]:
        """The answer of the browser; what it tells unasked is skipped."""
        self._number += 1
        order = {"id": self._number, "method": method, "params": parameters}
        order |= {"sessionId": self._session} if self._session else {}
        os.write(self._sending, json.dumps(order).encode() + b"\0")
        limit = time.monotonic() + BROWSER_SECONDS_MAX
        while True:
            while b"\0" not in self._rest:
                wait = max(0.0, limit - time.monotonic())
                assert select.select([self._receiving], [], [], wait)[0], f"{method}: no answer"
                data = os.read(self._receiving, 1 << 16)
                assert data, f"{method}: the browser is gone"
                self._rest += data
            text, self._rest = self._rest.split(b"\0", 1)
            found = json.loads(text)
            if found.get("id") == self._number:
                assert "error" not in found, found
                return dict(found["result"])

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def value(self, script: str) -> object:
        """What `script` evaluates to in the page; None while that fails."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"]
        return found.get("value")

    def until(self, script: str, seconds: float = BROWSER_SECONDS_MAX) -> object:
        """Its value once that is true."""
        limit = time.monotonic() + seconds
        while not (value := self.value(script)):
            assert time.monotonic() < limit, f"never true: {script}: {self.value('document.body.innerText')}"
            select.select([], [], [], LOOK_SECONDS)
        return value

    def look(self, path: Path, width: int = 1280, *, dark: bool = False) -> None:
        """A screenshot of the whole page."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=1000, deviceScaleFactor=1, mobile=False
        )
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.call("Emulation.setEmulatedMedia", features=features)
        shot = self.call("Page.captureScreenshot", captureBeyondViewport=True)
        path.write_bytes(b64decode(shot["data"]))


@contextlib.contextmanager
def driven(folder: Path, width: int = 1280) -> Iterator[DrivenPage]:
    """A page in a browser that ends with the block. It reads orders from descriptor 3, and answers on 4."""
    command = [*_command(folder, width), "--remote-debugging-pipe"]
    orders, sending = os.pipe()
    receiving, answers = os.pipe()
    with (folder / "browser.log").open("wb") as log:
        process = subprocess.Popen(
            # bash, since other shells know descriptors of one digit only
            ["bash", "-c", f'exec "$@" 3<&{orders} 4>&{answers}', "bash", *command],
            pass_fds=(orders, answers),
            stdout=log,
            stderr=log,
        )
    os.close(orders)
    os.close(answers)
    try:
        yield DrivenPage(sending, receiving)
    finally:
        os.close(sending)  # which ends it in order: one that is killed leaves a directory in /tmp
        try:
            process.wait(BROWSER_SECONDS_MAX)
        finally:
            process.kill()
            process.wait()
            os.close(receiving)
