"""Campaign files for tests, and short ways through the campaign code."""

from pathlib import Path
from typing import Final

import msgspec

from aftbed.campaign import ledger, runner
from aftbed.campaign.experiment import Experiment, Result
from aftbed.campaign.ledger import Ledger
from aftbed.campaign.plan import CampaignPlan, plan
from aftbed.campaign.spec import read_spec

CRASHES: Final = """
campaign: try
seed: 3
system: {requests: 30, runtime: sim}
mechanisms: [pbr, lfr, none]
faults:
- name: crash
  fault: crash primary at {event} nth {nth}
  matrix: {event: [server.exit, reply.sent]}
  draw: {nth: [1, 25]}
  mechanisms: [pbr, lfr]
  expect: {"*": [tolerated]}
- name: nothing
stop: {experiments: 4}
not_activated_max: 0.5
"""


def written(folder: Path, text: str = CRASHES) -> Path:
    """The text as a file."""
    path = folder / "try.yaml"
    path.write_text(text)
    return path


def planned(folder: Path, text: str = CRASHES) -> CampaignPlan:
    """Its plan."""
    return plan(read_spec(str(written(folder, text))))


def ran(found: CampaignPlan, out: Path, jobs: int = 1, **asked: object) -> Ledger:
    """Run it; its ledger."""
    for _ in runner.run(found, msgspec.structs.replace(runner.CampaignRunOptions(out, jobs), **asked)):
        pass
    return ledger.read(out / ledger.NAME)


def result(
    outcome: str = "tolerated", stratum: str = "pbr · crash", index: int = 0, **more: object
) -> Result:
    """One that was never run."""
    experiment = Experiment(
        f"{index:016x}",
        index,
        index,
        stratum,
        index,
        "pbr",
        "process",
        "sim",
        "",
        30,
        0.0,
        ("crash primary",),
    )
    return msgspec.structs.replace(Result(experiment, outcome), **more)
