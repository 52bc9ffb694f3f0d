"""An experiment is an outcome, whatever happens in it; what happens to its record is raised."""

import errno

import msgspec
import pytest

from aftbed.campaign import experiment
from aftbed.campaign.experiment import Experiment, Result, carry_out, golden_drive
from aftbed.judge.outcome import OUTCOMES

CALM = Experiment("0" * 16, 0, 0, "s", 5, "pbr", "process", "sim", "", 20, 400.0, ())
DRIVE = msgspec.structs.replace(
    CALM, ftm="none", scenario="ccrs-50", faults=("crash primary at server.exit nth 60",)
)


def test_what_goes_wrong_in_keeping_is_raised() -> None:
    """Nothing may be told as done that is in no ledger."""

    def full(_: Result) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        carry_out(CALM, full)


def test_an_error_of_any_kind_is_an_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bug of ours in one experiment of ten thousand ends neither the campaign nor as a pass."""
    monkeypatch.setattr(experiment, "setup_of", lambda *_: 1 // 0)
    kept: list[Result] = []
    result = carry_out(CALM, kept.append)
    assert (result.outcome, result.activated) == ("harness_error", False)
    assert result.reasons[0].startswith("ZeroDivisionError: ")
    assert kept == [result]


def test_a_drive_is_compared_with_the_golden_one() -> None:
    """A car that hits what the bare server stops for is at least `unavailable`."""
    golden = golden_drive("ccrs-50", CALM.seed)
    assert golden is not None and golden.stop_gap_m is not None and golden.stop_gap_m > 0
    hit = carry_out(DRIVE, lambda _: None)
    assert hit.collision and hit.golden_gap_m == golden.stop_gap_m
    assert OUTCOMES.index(hit.outcome) >= OUTCOMES.index("unavailable")
    calm = carry_out(msgspec.structs.replace(DRIVE, ftm="pbr"), lambda _: None)
    assert not calm.collision and calm.gap_m == pytest.approx(golden.stop_gap_m, abs=0.05)
