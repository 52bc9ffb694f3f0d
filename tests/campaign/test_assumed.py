"""The FT/A/R table beside what was measured: it agrees, or it says where it does not."""

from pathlib import Path

import msgspec
import pytest
from campaigns import planned

from aftbed.campaign.assumptions import cells, markdown
from aftbed.campaign.experiment import Experiment, Result
from aftbed.campaign.ledger import Ledger, head_of

HIDDEN = "update app to aftbed.vehicle.aeb.variants:WithoutStateAccess at request 4"
NOISY = "update app to aftbed.vehicle.aeb.variants:NonDeterministic at request 4"
CRASH = "crash primary after 220ms"
FLIP = "bitflip result bit 5 after 220ms"
AT_REST = "bitflip state.t_ms bit 9 in primary after 220ms"
LASTING = "bitflip result bit 5 at server.exit nth 9 permanent"


def measured(
    folder: Path, ftm: str, faults: tuple[str, ...], adaptations: tuple[str, ...], *outcomes: str
) -> Ledger:
    results = []
    for index, outcome in enumerate(outcomes):
        adapted = ("refused",) if outcome == "refused" else ("done",) * len(adaptations)
        experiment = Experiment(
            f"{index:016x}", index, index, "here", 1, ftm, "process", "unix", "", 9, 0.0, faults, adaptations
        )
        came = "tolerated" if outcome == "refused" else outcome
        results.append(Result(experiment, came, adapted=adapted))
    return Ledger(folder, head_of(planned(folder)), tuple(results))


@pytest.mark.parametrize(
    ("ftm", "faults", "adaptations", "outcomes", "assumption", "agrees"),
    [
        ("pbr", (CRASH,), (), ("tolerated", "tolerated"), "", True),
        ("pbr", (CRASH,), (), ("tolerated", "sdc"), "", False),
        ("pbr", (FLIP,), (), ("sdc", "sdc"), "value faults", True),
        ("pbr", (FLIP,), (), ("masked", "masked"), "value faults", False),
        ("pbr", (CRASH,), (HIDDEN,), ("sdc",), "state access", True),
        ("lfr", (), (NOISY,), ("latent",), "deterministic", True),
        ("lfr+tr", (), (NOISY,), ("refused",), "deterministic", True),
        ("tr", (CRASH,), (), ("unavailable",), "crashes", True),
        ("lfr+tr", (FLIP,), (), ("tolerated",), "", True),
        ("lfr+tr", (LASTING,), (), ("sdc",), "transient", True),
        ("lfr+tr", (AT_REST,), (), ("sdc",), "wrong before", True),
    ],
)
def test_the_table_is_held_against_what_was_measured(
    tmp_path: Path,
    ftm: str,
    faults: tuple[str, ...],
    adaptations: tuple[str, ...],
    outcomes: tuple[str, ...],
    assumption: str,
    agrees: bool,
) -> None:
    (cell,) = cells(measured(tmp_path, ftm, faults, adaptations, *outcomes))
    assert cell.agrees is agrees
    assert assumption in cell.assumption and bool(assumption) == bool(cell.assumption), cell.assumption


def test_what_proves_nothing_is_left_out(tmp_path: Path) -> None:
    ledger = measured(tmp_path, "pbr", (CRASH,), (), "tolerated", "inconclusive", "harness_error", "masked")
    missed = msgspec.structs.replace(ledger.results[-1], activated=False)
    (cell,) = cells(msgspec.structs.replace(ledger, results=(*ledger.results[:-1], missed)))
    assert (cell.experiments, cell.outcomes) == (1, {"tolerated": 1})


def test_a_cell_that_differs_is_told_in_bold(tmp_path: Path) -> None:
    shown = markdown(measured(tmp_path, "pbr", (CRASH,), (), "sdc", "tolerated"))
    assert "| here | holds | 1 of 2 (1% to 99%) | sdc 1, tolerated 1 | **differs** |" in shown
