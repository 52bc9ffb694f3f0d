"""A small campaign with many outcomes, simulated once, for the tests of reports."""

from pathlib import Path
from typing import Final

import msgspec
from campaigns import planned, result

from aftbed.campaign.experiment import Result, carry_out
from aftbed.campaign.ledger import Environment, Ledger, head_of
from aftbed.campaign.spec import Gate
from aftbed.campaign.summary import Summary, summarise

MIXED: Final = """
campaign: mixed
about: Crashes, hangs and flipped bits.
seed: 7
system: {requests: 40, runtime: sim}
mechanisms: [none, pbr, lfr, pbr+tr]
adaptations:
- name: steady
- {name: compose tr, adapt: compose pbr+tr at request 20, mechanisms: [pbr]}
faults:
- name: crash primary
  fault: crash primary at {event} nth {nth}
  matrix: {event: [server.enter, server.exit]}
  draw: {nth: [1, 35]}
  expect: {none: [unavailable], "*": [tolerated]}
- name: hang primary
  fault: hang primary for 90ms at server.exit nth {nth}
  draw: {nth: [1, 35]}
  mechanisms: [none, pbr, lfr]
  expect: {"*": [tolerated]}
- name: bitflip result
  fault: bitflip result at server.exit nth {nth}
  draw: {nth: [1, 35]}
  expect: {pbr+tr: [tolerated], "*": [sdc]}
- name: nothing
  expect: {"*": [masked]}
stop: {experiments: 3}
recovery_budget_ms: 4
gates:
- {metric: unexpected, max: 0.1}
- {metric: recovery_ms_p50, max: 3, strata: "pbr*crash primary"}
"""

HOSTILE: Final = """<script>alert("1")</script> & 'x' ]]> {{ 7 * 7 }} \x01 é"""
MACHINE: Final = Environment("CPython 3.11.0", "Linux 6.1", "2 of 2, Some CPU", "aftbed campaign")


def mixed(folder: Path) -> Ledger:
    """All its experiments, carried out."""
    found = planned(folder, MIXED)
    results = tuple(carry_out(experiment, lambda _: None) for experiment in found.experiments())
    head = msgspec.structs.replace(head_of(found), environment=MACHINE)
    return Ledger(folder / "records.jsonl", head, results)


def summary_of(ledger: Ledger) -> Summary:
    """As at the end of a campaign."""
    return summarise(ledger, len(ledger.results), 2.5)


def with_results(ledger: Ledger, *results: Result, gates: tuple[Gate, ...] = ()) -> Ledger:
    """Another one, of the same campaign file but for its gates."""
    spec = msgspec.structs.replace(ledger.head.spec, gates=gates, not_activated_max=1.0, unknown_max=1.0)
    head = msgspec.structs.replace(ledger.head, spec=spec)
    return msgspec.structs.replace(ledger, head=head, results=results)


def named(result_: Result, stratum: str) -> Result:
    """The same in another stratum."""
    return msgspec.structs.replace(
        result_, experiment=msgspec.structs.replace(result_.experiment, stratum=stratum)
    )


def hostile() -> Result:
    """One whose every text would be markup."""
    found = result("sdc", index=1, unexpected=True, reasons=(HOSTILE,), recovery_ms=1.0)
    return named(found, HOSTILE)
