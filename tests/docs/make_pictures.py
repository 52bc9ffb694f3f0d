"""Make the pictures of the README (docs/pictures/) of real runs: `make pictures`. Needs Chromium and tmux."""

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from PIL import Image  # a part of matplotlib
from rich.console import Console
from rich.terminal_theme import MONOKAI
from rich.text import Text

ROOT: Final = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from browser import BROWSER, DrivenPage, driven  # noqa: E402

PICTURES: Final = ROOT / "docs" / "pictures"
AFTBED: Final = str(Path(sys.executable).parent / "aftbed")
COLOURS: Final = 96  # of a palette: pages have few, and a picture is a third as large
COLUMNS, LINES = 110, 34  # of the terminal
SECONDS_MAX: Final = 120.0
SOCKET: Final = f"aftbed-pictures-{os.getpid()}"  # of a tmux of our own
CRASH: Final = "crash primary at checkpoint.sent nth 100"
LATE_CRASH: Final = "crash primary at server.exit nth 120"
TERMINAL: Final = """<body style="margin:0"><pre style="display:inline-block; margin:0; padding:14px 18px;
background:#0c0c0c; color:#d9d9d9; font:14px/1.25 'DejaVu Sans Mono', monospace">{code}</pre>"""


def live_page(folder: Path) -> None:
    """The page of a drive, after a crash of its primary that the page has asked for."""
    words = [AFTBED, "run", "--web", "--scenario", "ccrs-50", "--pace", "0.1"]
    with (
        subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as run,
        driven(folder) as page,
    ):
        assert run.stderr is not None
        page.open(next(line.split()[1] for line in run.stderr if line.startswith("page: ")))
        page.until("document.querySelectorAll('.node').length == 16", SECONDS_MAX)
        page.value("document.querySelector('[data-words=\"inject crash primary\"]').click()")
        page.until("document.querySelector('[data-fact=leader]').textContent == 'b'", SECONDS_MAX)
        page.until("document.querySelector('[data-fact=backup]').textContent == 'a'", SECONDS_MAX)
        page.until("document.querySelector('[data-fact=demand]').textContent.includes('full')", SECONDS_MAX)
        look(page, "page", 1280, 1180)
        page.value("document.querySelector('[data-words=stop]').click()")
        for _ in run.stderr:  # to the end of the run, which a full pipe would stop
            pass


def report(folder: Path) -> None:
    """The report of the drive that `make demo` does."""
    file = folder / "report.html"
    subprocess.run(
        [AFTBED, "run", "--pace", "max", "--inject", CRASH, "--html", file],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    with driven(folder) as page:
        page.open(file.as_uri())
        page.until("document.readyState == 'complete'")
        look(page, "report", 1280, 1700)


def terminal(folder: Path) -> None:
    """The live view in a terminal, while the car brakes behind a failover."""
    words = [AFTBED, "run", "--pace", "0.2", "--inject", CRASH]
    with terminal_of(words) as screen:
        shown = until(screen, lambda text: "FULL" in text)
    console = Console(record=True, width=COLUMNS, force_terminal=True, file=(folder / "shown").open("w"))
    console.print(Text.from_ansi(shown.rstrip("\n")))
    file = folder / "terminal.html"
    file.write_text(console.export_html(theme=MONOKAI, code_format=TERMINAL, inline_styles=True))
    with driven(folder) as page:
        page.open(file.as_uri())
        page.until("document.readyState == 'complete'")
        width, height = (
            int(str(page.value(f"Math.ceil(document.querySelector('pre').getBoundingClientRect().{side})")))
            for side in ("width", "height")
        )
        look(page, "terminal", width, height)


def plot(folder: Path) -> None:
    """The rows of a published table with a crash on the way, with and without a mechanism."""
    words = ["scenario", "table", "r152", "--group", "m1", "--ftm", "none,pbr", "--fault", LATE_CRASH]
    words += ["--plot", str(PICTURES / "road.svg")]
    done = subprocess.run([AFTBED, *words], check=False, stdout=subprocess.DEVNULL)
    assert done.returncode == 1, "without a mechanism rows fail"


def look(page: DrivenPage, name: str, width: int, height: int) -> None:
    """A picture of the upper left part of the page, in few colours."""
    path = PICTURES / f"{name}.png"
    page.look(path, width)
    with Image.open(path) as image:
        part = image.convert("RGB").crop((0, 0, min(width, image.width), min(height, image.height)))
        part.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def tmux(*words: str) -> str:
    command = ["tmux", "-L", SOCKET, "-f", "/dev/null", *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@contextlib.contextmanager
def terminal_of(words: list[str]) -> Iterator[Callable[[], str]]:
    """Run `words` in a terminal. Gives what its screen shows, with its colours."""
    size = ("-x", str(COLUMNS), "-y", str(LINES))
    kept = ("set-option", "-g", "remain-on-exit", "on", ";")  # the last words of a run that fails
    tmux(
        "start-server",
        ";",
        *kept,
        "new-session",
        "-d",
        *size,
        "env",
        "TERM=xterm-256color",
        "COLORTERM=truecolor",
        *words,
    )
    try:
        yield lambda: tmux("capture-pane", "-e", "-p")
    finally:
        tmux("kill-server")


def until(screen: Callable[[], str], wanted: Callable[[str], bool]) -> str:
    limit = time.monotonic() + SECONDS_MAX
    while not wanted(shown := screen()):
        assert time.monotonic() < limit and "Pane is dead" not in shown, f"never shown: {shown}"
        time.sleep(0.05)
    return shown


def main(names: list[str]) -> None:
    makers = {"page": live_page, "report": report, "terminal": terminal, "plot": plot}
    for tool, found in (("Chromium", BROWSER), ("tmux", shutil.which("tmux"))):
        if found is None:
            sys.exit(f"make pictures: {tool} is not installed: apt-get install {tool.lower()}")
    PICTURES.mkdir(exist_ok=True)
    for name in names or makers:
        with tempfile.TemporaryDirectory(prefix="aft-", dir="/tmp", ignore_cleanup_errors=True) as folder:
            os.environ["XDG_RUNTIME_DIR"] = folder  # no run of the user is seen, nor this one by the user
            makers[name](Path(folder))
        print(name)


if __name__ == "__main__":
    main(sys.argv[1:])
