"""Each kind of function, and a crash at every event of a request, in real runs: more than an hour."""

import json
import subprocess
from pathlib import Path
from string import Template
from typing import Final

import pytest
from liveruns import Done, forked, home

from aftbed.cli.init import KINDS, create

pytestmark = [pytest.mark.process, pytest.mark.deep, pytest.mark.timeout(3600)]

__all__ = ["home"]

CRASHES: Final = Path(__file__).with_name("kinds.yaml")
EXCHANGE: Final = Template("""
campaign: exchange
about: One function takes the place of another one, and a replica is killed meanwhile, or soon after.
seed: 1
system: {requests: 120, rate_hz: 200}
mechanisms: [pbr, lfr, pbr+tr]
adaptations:
- {name: update, adapt: "update app to $function at request 40"}
faults:
- name: nothing
  expect: {"*": [masked, degraded]}
- name: crash within
  fault: crash {role} at adapt.step.{when} nth {step}
  matrix: {role: [primary, backup], when: [enter, act, exit], step: [1, 2, 3, 4, 5, 6, 7]}
  expect: {"*": [tolerated, degraded]}
- name: crash at the commit
  fault: crash {role} at adapt.commit
  matrix: {role: [primary, backup]}
  expect: {"*": [tolerated, degraded]}
- name: crash soon
  fault: crash {role} at server.exit nth {nth}
  matrix: {role: [primary, backup], nth: [39, 40, 41, 42, 43, 44]}
  expect: {"*": [tolerated, degraded]}
stop: {experiments: 42}
gates:
- {metric: unexpected, max: 0}
- {metric: not_activated, max: 0}
- {metric: failed, max: 0}
""")
WAYS: Final = (("class", "so"), ("so", "stdio"), ("stdio", "class"))
SECONDS_MAX: Final = 3600.0


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where projects are made."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def project(kind: str) -> str:
    """The function of a new project, whose state is that of the other kinds but for an FMU."""
    made = create(kind, kind).resolve()
    if KINDS[kind].first:
        subprocess.run(["make", "-s"], cwd=made, check=True, timeout=120)
    *program, file = KINDS[kind].app.split()
    return " ".join([*program, str(made / file)])


def campaign(file: Path, app: str, kind: str) -> Done:
    out = Path(f"out-{kind}")
    words = ("--app", app, "--requests", f"{kind}/requests.csv", "--out", out, "--json")
    return forked("campaign", "run", file, *words, seconds=SECONDS_MAX)


def judged(done: Done) -> None:
    summary = json.loads(done.out)
    assert (done.code, summary["gate"]) == (0, "pass"), (done.err, summary["gates"])


@pytest.mark.parametrize("kind", KINDS)
def test_no_crash_at_any_event_is_seen(kind: str) -> None:
    judged(campaign(CRASHES, project(kind), kind))


@pytest.mark.parametrize(("old", "new"), WAYS)
def test_no_crash_while_the_function_is_exchanged_is_seen(old: str, new: str, folder: Path) -> None:
    file = folder / "exchange.yaml"
    file.write_text(EXCHANGE.substitute(function=project(new)))
    judged(campaign(file, project(old), old))
