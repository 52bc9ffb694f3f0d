"""`make mutants`: plants each bug of the lists in a copy of the tree, and sees what notices it, and how soon.

First the finders look at the code as it is: if one finds something there, the results would mean nothing.
Then each bug is planted alone. Exit code 1: a bug survived the finder that has to notice it, or there is one
already.
"""

import argparse
import datetime
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
import venv
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from queue import SimpleQueue
from typing import Final, NamedTuple

from finders import IN_MEMORY
from source_mutants import MUTANTS, Finder, SourceMutant, planted

from aftbed.campaign.ledger import here
from aftbed.runtime.unix.code_version import code_version

ROOT: Final = Path(__file__).parents[2]
COPIED: Final = ("aftbed", "dbc", "docs", "tests", "pyproject.toml", "README.md", "CHANGELOG.md", "Makefile")
ONLY_REAL: Final = ("aftbed/runtime/unix/", "aftbed/functions/")  # the simulator does not execute them
SIMULATED: Final = (Finder.EXPLORERS, Finder.SWARM)
SCRIPTS: Final = {Finder.EXPLORERS: "explorers", Finder.SWARM: "swarm", Finder.CAMPAIGN: "campaign"}
SECONDS_MAX: Final = {
    Finder.UNIT_TESTS: 120.0,
    Finder.EXPLORERS: 300.0,
    Finder.SWARM: 180.0,
    Finder.CAMPAIGN: 240.0,
    Finder.PROCESS_TESTS: 300.0,
}
NO_TESTS: Final = 5  # exit code of pytest
WIDTH: Final = 120  # of a line of a page
BEGIN: Final = "<!-- mutants: written by make mutants -->"
END: Final = "<!-- end of mutants -->"


class Look(NamedTuple):
    """What came of a look for a bug: `words` are of the first thing that was found."""

    found: bool
    seconds: float
    words: str


class Row(NamedTuple):
    """A bug. There is no look by a finder that does not execute the code, or has no test that is about it."""

    name: str
    promise: str
    found_by: Finder
    looks: dict[Finder, Look]

    @property
    def survived(self) -> bool:
        """Whether the finder that has to notice it did not."""
        return self.found_by not in self.looks or not self.looks[self.found_by].found

    def __str__(self) -> str:
        told = [f"{finder.value} {_cell(look)}" for finder, look in self.looks.items()]
        return f"{self.name}: {', '.join(told)}{'; SURVIVED' * self.survived}"


class Tree:
    """A copy of the tree, with an interpreter that imports it."""

    def __init__(self, place: Path) -> None:
        place.mkdir()
        self._root, self._home = place / "tree", place / "home"
        self._home.mkdir(mode=0o700)
        self._root.mkdir()
        for name in COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
            copy(ROOT / name, self._root / name)  # with its bytecode
        venv.create(place / "venv", symlinks=True)
        (packages,) = (place / "venv" / "lib").glob("python*/site-packages")
        (ours,) = (Path(sys.prefix) / "lib").glob("python*/site-packages")
        (packages / "tree.pth").write_text(f"{self._root}\n{ours}\n")  # .pth files of `ours` are not read
        self._python = place / "venv" / "bin" / "python"
        self._process: subprocess.Popen[str] | None = None
        self._closed = False

    def examine(self, mutant: SourceMutant) -> Row:
        """Plant the bug, have it looked for, take it out again."""
        wanted = [f for f in Finder if not (f in SIMULATED and mutant.path.startswith(ONLY_REAL))]
        path = self._root / mutant.path
        right = path.read_text()
        self._write(path, planted(mutant, right))
        try:
            looks = {finder: self.look(finder, mutant.tests) for finder in wanted}
        finally:
            self._write(path, right)
        there = {finder: look for finder, look in looks.items() if look is not None}
        return Row(mutant.name, mutant.promise, mutant.found_by, there)

    def examine_in_memory(self, name: str) -> Row:
        """A bug that its finders plant. The experiments chosen for it are a test of every commit."""
        looks = {Finder.UNIT_TESTS: self._look_by_script(Finder.UNIT_TESTS, "own", name)}
        looks |= {one: self._look_by_script(one, SCRIPTS[one], name) for one in SIMULATED}
        return Row(name, IN_MEMORY[name].promise, Finder.UNIT_TESTS, looks)

    def look(self, finder: Finder, tests: Iterable[str]) -> Look | None:
        """Have `finder` look for a bug; None if there is no test of its kind."""
        if finder in SCRIPTS:
            return self._look_by_script(finder, SCRIPTS[finder])
        tier = "process" if finder is Finder.PROCESS_TESTS else "not process"
        options = ("-x", "-q", "--no-header", "-p", "no:cacheprovider", "-m", f"{tier} and not deep")
        code, seconds, lines = self._run(["-m", "pytest", *options, *tests], SECONDS_MAX[finder])
        failed = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
        return None if code == NO_TESTS else Look(code != 0, seconds, (failed or lines or ["no end"])[-1])

    def _look_by_script(self, finder: Finder, *words: str) -> Look:
        script = str(Path(__file__).with_name("finders.py").relative_to(ROOT))
        code, seconds, lines = self._run([script, *words], SECONDS_MAX[finder])
        return Look(code != 0, seconds, (lines or ["no end"])[-1])

    def _run(self, words: list[str], seconds_max: float) -> tuple[int | None, float, list[str]]:
        """The exit code, None if it took too long; the time; the lines that were printed."""
        environment = os.environ | {"XDG_RUNTIME_DIR": str(self._home), "XDG_STATE_HOME": str(self._home)}
        began_s = time.monotonic()
        with tempfile.TemporaryFile("w+") as out:
            self._process = subprocess.Popen(
                [str(self._python), *words],
                cwd=self._root,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                text=True,
            )
            code: int | None = None
            try:
                if self._closed:
                    raise KeyboardInterrupt
                code = self._process.wait(seconds_max)
            except subprocess.TimeoutExpired:
                pass
            finally:
                self._stop()
            out.seek(0)
            return code, time.monotonic() - began_s, out.read().splitlines()

    def close(self) -> None:
        """End what is under way. No other look begins."""
        self._closed = True
        self._stop()

    def _stop(self) -> None:
        process = self._process
        if process is not None and process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def _write(self, path: Path, text: str) -> None:
        path.write_text(text)
        for old in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            old.unlink()  # it may be of the same second and size


def control(tree: Tree, names: Sequence[str]) -> Iterator[str]:
    """What the finders of these bugs find in the code as it is."""
    tests = sorted({test for mutant in MUTANTS if mutant.name in names for test in mutant.tests})
    for finder in Finder if tests else SIMULATED:
        look = tree.look(finder, tests)
        print(f"without a bug: {finder.value}: {look.seconds if look else 0:.1f} s", flush=True)
        if look is not None and look.found:
            yield f"{finder.value}: {look.words}"


def examined(names: Sequence[str], trees: Sequence[Tree]) -> Iterator[Row]:
    """The bugs of these names, as their results come; as many at a time as there are trees."""
    in_source = {mutant.name: mutant for mutant in MUTANTS}
    free: SimpleQueue[Tree] = SimpleQueue()
    for tree in trees:
        free.put(tree)

    def examine(name: str) -> Row:
        tree = free.get()
        try:
            found = in_source.get(name)
            return tree.examine(found) if found is not None else tree.examine_in_memory(name)
        finally:
            free.put(tree)

    with ThreadPoolExecutor(len(trees)) as pool:
        try:
            for done in as_completed([pool.submit(examine, name) for name in names]):
                yield done.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for tree in trees:
                tree.close()


def markdown(rows: Sequence[Row], seconds: float) -> Iterator[str]:
    """The table, and above it the day, the machine, and who found how many."""
    about, today = here(), datetime.datetime.now(datetime.UTC).date()
    text = (
        f"Measured on {today} by `make mutants` in {seconds / 60:.0f} minutes:"
        f" CPUs {about.cpus}; {about.kernel.partition('-')[0]}; {about.python}; aftbed {code_version()}. "
    )
    counts = (
        f"{finder.value} {sum(row.looks[finder].found for row in rows if finder in row.looks)} of"
        f" {sum(finder in row.looks for row in rows)}"
        for finder in Finder
    )
    text += f"{len(rows)} bugs, {sum(row.survived for row in rows)} survived. Found by {', '.join(counts)}."
    yield from textwrap.wrap(text, WIDTH)
    yield ""
    yield f"| bug | promise | {' | '.join(finder.value for finder in Finder)} |"
    yield f"|---|---|{'---|' * len(Finder)}"
    for row in rows:
        cells = (_cell(row.looks[finder]) if finder in row.looks else "" for finder in Finder)
        yield f"| {row.name} | {row.promise} | {' | '.join(cells)} |"


def _cell(look: Look) -> str:
    return f"{look.seconds:.1f} s" if look.found else "-"


def write_into(page: Path, table: Iterable[str]) -> None:
    """Put the table between the two lines of `page`."""
    before, begin, rest = page.read_text().partition(f"{BEGIN}\n")
    _, end, after = rest.partition(END)
    assert begin and end, f"{page}: it needs the lines {BEGIN} and {END}"
    page.write_text("\n".join((f"{before}{BEGIN}", *table, f"{END}{after}")))


def main() -> int:
    """The exit code."""
    parser = argparse.ArgumentParser(prog="make mutants", description=__doc__)
    parser.add_argument(
        "--only", metavar="WORDS", help="bugs whose names have these words; no table is written"
    )
    parser.add_argument("--into", type=Path, metavar="PAGE", help="write the table into this page")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)), help="bugs at a time")
    given = parser.parse_args()
    order = [mutant.name for mutant in MUTANTS] + list(IN_MEMORY)
    names = [name for name in order if given.only is None or given.only in name]
    if not names:
        parser.error(f"--only {given.only}: no bug has that in its name")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as an interrupt: nothing is left
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutants-") as place:
        trees = [Tree(Path(place, str(number))) for number in range(min(given.jobs, len(names)))]
        found = list(control(trees[0], names))
        if found:
            print("\n".join(("there is a bug already:", *found)))
            return 1
        rows = []
        for row in examined(names, trees):
            print(row, flush=True)
            rows.append(row)
    rows.sort(key=lambda row: order.index(row.name))
    table = list(markdown(rows, time.monotonic() - began_s))
    if given.into is not None and given.only is None:
        write_into(given.into, table)
    else:
        print("\n".join(table))
    return int(any(row.survived for row in rows))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
