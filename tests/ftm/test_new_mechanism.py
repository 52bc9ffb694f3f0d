"""A new mechanism is one new file and one name in the registry: everything else reads its declaration.

The package is copied, the mechanism of docs/contributing.md is added to the copy, and the copy is used as a
user would use it.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

import aftbed

pytestmark = pytest.mark.process

PACKAGE: Final = Path(aftbed.__file__).parent
SECONDS_MAX: Final = 100
PAGE: Final = PACKAGE.parent / "docs" / "contributing.md"
EXAMPLE: Final = re.compile(r"```python file=aftbed/ftm/limit\.py\n(.*?)```", re.DOTALL)
REGISTRATION: Final = (
    (
        "from aftbed.ftm.lfr import LFR\n",
        "from aftbed.ftm.lfr import LFR\nfrom aftbed.ftm.limit import LIMIT\n",
    ),
    ("(PBR, LFR, TR, ASSERT, SUP)", "(PBR, LFR, TR, ASSERT, SUP, LIMIT)"),
)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package with one mechanism more."""
    root = tmp_path_factory.mktemp("project")
    shutil.copytree(PACKAGE, root / "aftbed")  # with its bytecode
    if (PACKAGE.parent / "dbc").is_dir():
        shutil.copytree(PACKAGE.parent / "dbc", root / "dbc")
    (example,) = EXAMPLE.findall(PAGE.read_text())
    (root / "aftbed" / "ftm" / "limit.py").write_text(example)
    registry = root / "aftbed" / "ftm" / "registry.py"
    text = registry.read_text()
    for old, new in REGISTRATION:
        assert text.count(old) == 1
        text = text.replace(old, new)
    registry.write_text(text)
    return root


def python(project: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(project)}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command,
        cwd=project,
        env=environment,
        capture_output=True,
        text=True,
        timeout=SECONDS_MAX,
        check=False,
    )


EACH: Final = """
import sys
from aftbed.cli import main
for words in sys.argv[1:]:
    sys.argv = ["aftbed", *words.split()]
    try:
        main()
        code = 0
    except SystemExit as end:
        code = end.code or 0
    sys.stderr.flush()
    print("exit code", code, flush=True)
"""


def run_each(project: Path, *commands: str) -> tuple[str, list[int]]:
    """What these commands of the copy print, one after the other in one interpreter; and their exit codes."""
    done = python(project, "-c", EACH, *commands)
    assert done.returncode == 0, done.stdout + done.stderr
    codes = [int(code) for code in re.findall(r"^exit code (\d+)$", done.stdout, re.MULTILINE)]
    return done.stdout + done.stderr, codes


def run(project: Path, *arguments: str, code: int = 0) -> str:
    """What `aftbed ...` of the copy prints."""
    done = python(project, "-m", "aftbed", *arguments)
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_its_brick_does_what_its_table_says(project: Path) -> None:
    done = python(
        project,
        "-c",
        "from aftbed.core.brick import Halt, Send\n"
        "from aftbed.core.messages import Reply\n"
        "from aftbed.ftm.registry import Setting, make\n"
        "after = make('limit.after', Setting(1, 1, True, None))\n"
        "assert after.open_ports() == ('prd2aft',) and after.quiescent()\n"
        "for size, last in ((64, Send), (65, Halt)):\n"
        "    assert type(after.step('prd2aft', Reply(1, 1, 1, bytes(size)), 0)[-1]) is last\n",
    )
    assert done.returncode == 0, done.stderr


def test_it_composes(project: Path) -> None:
    printed, codes = run_each(
        project, *(f"graph --ftm {ftm}" for ftm in ("pbr+limit", "limit+tr", "limit+limit"))
    )
    assert codes == [0, 0, 2]
    assert "node a/limit.after: a/limit.after (limit.after)" in printed
    assert "ftm limit+tr" in printed
    assert "limit within limit adds nothing" in printed


def test_the_suitability_table_has_it(project: Path) -> None:
    resilience = "ftm resilience --set pbr --adaptations 0 --json"
    printed, codes = run_each(project, "ftm list", "ftm check --ftm limit --faults implausible", resilience)
    assert codes == [0, 1, 0]
    assert '"words":"one like limit that also tolerates value"' in printed
    listed = printed.partition("exit code")[0]
    assert all(name in listed for name in ("limit", "pbr+limit", "lfr+limit", "limit+tr"))
    assert "limit detects implausible value faults and can only stop" in printed


def test_faults_are_aimed_at_its_events(project: Path) -> None:
    load = ("--ftm", "pbr+limit", "--count", "100", "--rate", "500")
    first = ("--inject", "crash backup at state.restored nth 2")
    second = ("--inject", "crash primary at proceed.enter nth 80")
    found = json.loads(run(project, "sim", *load, *first, *second, "--json"))
    assert found["verdict"] == "pass" and len(found["failovers"]) == 1
    refused = run(project, "sim", "--ftm", "limit", "--inject", "crash primary at vote.compared", code=2)
    assert "cannot trigger a fault under --ftm limit" in refused


def test_it_is_adapted_to_and_from(project: Path) -> None:
    load = ("--ftm", "pbr", "--count", "200", "--rate", "500")
    there = ("--adapt", "to pbr+limit at request 10", "--adapt", "to lfr at request 150")
    found = json.loads(run(project, "sim", *load, *there, "--json"))
    assert found["verdict"] == "pass" and len(found["adaptations"]) == 2


def test_it_is_explored(project: Path) -> None:
    chosen = ("--ftm", "lfr+limit", "--placement", "replica", "--count", "1", "--jobs", "1", "--json")
    found = json.loads(run(project, "explore", "crash", *chosen))
    assert found["explored"] > 50 and found["survived"] == found["explored"]


def test_its_hops_are_known_to_the_bench(project: Path) -> None:
    done = python(
        project,
        "-c",
        "from aftbed.ftm.compose import build, hops\n"
        "assert hops(build('pbr+limit', 'process')) == hops(build('pbr', 'process')) + 4\n",
    )
    assert done.returncode == 0, done.stderr
