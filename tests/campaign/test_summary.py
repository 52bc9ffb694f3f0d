"""Strata and gates: judged by the bound of an interval, and never a vacuous pass."""

from pathlib import Path

import msgspec
import pytest
from campaigns import CRASHES, planned, result

from aftbed.campaign.experiment import Result
from aftbed.campaign.ledger import Ledger, head_of
from aftbed.campaign.spec import Gate
from aftbed.campaign.statistics import proportion
from aftbed.campaign.summary import Summary, summarise


def judged(folder: Path, results: list[Result], *gates: Gate, text: str = CRASHES) -> Summary:
    head = head_of(planned(folder, text))
    spec = msgspec.structs.replace(head.spec, gates=gates)
    head = msgspec.structs.replace(head, spec=spec)
    return summarise(Ledger(folder, head, tuple(results)), len(results), 1.0)


def many(count: int, outcome: str = "tolerated", first: int = 0, **more: object) -> list[Result]:
    return [result(outcome, index=first + i, **more) for i in range(count)]


def test_counts_and_intervals(tmp_path: Path) -> None:
    found = judged(tmp_path, many(30) + many(2, "sdc", 30, unexpected=True))
    (stratum,) = found.strata
    assert found.outcomes == stratum.outcomes == {"tolerated": 30, "sdc": 2}
    assert (stratum.experiments, stratum.unexpected, stratum.failed) == (32, 2, 2)
    assert stratum.unexpected_interval == proportion(2, 32)
    assert stratum.population == 50 and stratum.failures.failures == pytest.approx(50 * 2 / 32)


@pytest.mark.parametrize(("count", "word"), [(10, "fail"), (35, "fail"), (36, "pass"), (100, "pass")])
def test_a_gate_is_judged_by_the_bound(tmp_path: Path, count: int, word: str) -> None:
    """0 of 35 may still be 10.003 %, 0 of 36 at most 9.74 % (Clopper-Pearson, 95 %)."""
    found = judged(tmp_path, many(count), Gate("sdc", max=0.1))
    assert found.gates[0].word == word
    assert found.gates[0].bound == proportion(0, count).high


def test_a_gate_with_a_lower_limit(tmp_path: Path) -> None:
    found = judged(tmp_path, many(100), Gate("tolerated", min=0.95), Gate("tolerated", min=0.97))
    assert [gate.word for gate in found.gates[:2]] == ["pass", "fail"]
    assert found.gate == "fail"


def test_a_gate_on_a_time_needs_enough_values(tmp_path: Path) -> None:
    few = judged(tmp_path, many(50, recovery_ms=1.0), Gate("recovery_ms_p99", max=5.0))
    assert few.gates[0].word == "fail"
    assert few.gates[0].reason == "50 values; 368 are needed to bound it at 95.0%"
    enough = judged(tmp_path, many(400, recovery_ms=1.0), Gate("recovery_ms_p99", max=5.0))
    assert (enough.gates[0].word, enough.gates[0].value) == ("pass", 1.0)


@pytest.mark.parametrize(("bad", "word"), [(0, "pass"), (1, "fail")])
def test_a_gate_of_none_is_judged_by_what_was_seen(tmp_path: Path, bad: int, word: str) -> None:
    """No number of experiments bounds a share by 0."""
    results = many(40 - bad) + many(bad, "sdc", 40, unexpected=True)
    found = judged(tmp_path, results, Gate("unexpected", max=0))
    assert (found.gates[0].word, found.gates[0].bound) == (word, bad / 40)


def test_a_stratum_that_may_miss_fails_nothing_unless_it_strikes_in_part(tmp_path: Path) -> None:
    text = CRASHES.replace("- name: nothing", "  may_miss: true\n- name: nothing")
    steady = many(40, stratum="pbr · nothing")
    missed = many(40, first=40, activated=False)
    assert judged(tmp_path, steady + missed).gate == "fail"
    assert judged(tmp_path, steady + missed, text=text).gate == "pass"
    partly = [*missed, *many(1, first=90)]
    assert judged(tmp_path, steady + partly, text=text).gate == "fail"


def test_a_gate_on_strata_that_do_not_exist_fails(tmp_path: Path) -> None:
    found = judged(tmp_path, many(100), Gate("sdc", max=0.5, strata="lfr*"))
    assert (found.gates[0].word, found.gates[0].reason) == ("fail", "no stratum is called 'lfr*'")


def test_a_gate_sees_only_its_strata(tmp_path: Path) -> None:
    results = many(100) + many(100, "sdc", 100, experiment=result(stratum="lfr · crash").experiment)
    found = judged(tmp_path, results, Gate("sdc", max=0.1, strata="pbr*"))
    assert found.gates[0].word == "pass"


def test_a_campaign_whose_faults_do_not_strike_fails(tmp_path: Path) -> None:
    """The gate on what was not activated is there without being asked for."""
    missed = judged(tmp_path, many(40) + many(60, first=40, activated=False))
    assert missed.gate == "fail"
    assert [(g.metric, g.word) for g in missed.gates] == [
        ("not_activated", "fail"),
        ("unknown", "pass"),
        ("broken", "pass"),
    ]
    assert judged(tmp_path, many(95) + many(5, first=95, activated=False)).gate == "pass"


def test_one_experiment_that_broke_what_no_fault_excuses_fails_the_campaign(tmp_path: Path) -> None:
    masters = msgspec.structs.replace(result("masked", index=400), broken=("one_master: two at 3 ms",))
    found = judged(tmp_path, [*many(400), masters])
    assert (found.gate, found.gates[-1].metric, found.gates[-1].word) == ("fail", "broken", "fail")
    assert found.gates[-1].reason == f"experiment {masters.experiment.id}: one_master: two at 3 ms"


def test_trouble_of_the_harness_is_told_with_the_gate(tmp_path: Path) -> None:
    full = "HarnessError: the supervisor cannot go on: No space left on device"
    trouble = msgspec.structs.replace(result("harness_error", index=3), reasons=(full,))
    found = judged(tmp_path, [*many(3), trouble])
    (gate,) = (one for one in found.gates if one.metric == "unknown")
    assert gate.word == "fail" and gate.reason.endswith(f"; experiment {trouble.experiment.id}: {full}")


def test_a_stratum_in_which_nothing_struck_fails_by_itself(tmp_path: Path) -> None:
    lone = result(stratum="lfr · crash", index=990).experiment
    results = [*many(400), msgspec.structs.replace(result(index=990, activated=False), experiment=lone)]
    found = judged(tmp_path, results)
    assert found.gates[-1].reason == "none of 1 faults struck: this stratum could not have failed"
    assert found.gate == "fail"


def test_a_stratum_of_which_nothing_is_known_fails_by_itself(tmp_path: Path) -> None:
    """Not one of which a part is known."""
    busy = [msgspec.structs.replace(r, outcome="inconclusive") for r in many(2, first=900)]
    lone = [
        msgspec.structs.replace(r, experiment=msgspec.structs.replace(r.experiment, stratum="lfr · crash"))
        for r in busy
    ]
    assert judged(tmp_path, [*many(400), *busy]).gate == "pass"
    found = judged(tmp_path, [*many(400), *lone])
    assert found.gates[-1].reason == (
        "of none of 2 experiments anything is known: this stratum could not have failed"
    )
    assert (found.gate, found.gates[-1].strata) == ("fail", "lfr · crash")
    allowed = CRASHES.replace("not_activated_max: 0.5", "not_activated_max: 0.5\nunknown_max: 1")
    assert judged(tmp_path, [*many(400), *lone], text=allowed).gate == "pass"


def test_what_is_not_known_is_not_counted_as_expected(tmp_path: Path) -> None:
    busy = [msgspec.structs.replace(r, outcome="inconclusive") for r in many(6, first=900)]
    (stratum,) = judged(tmp_path, [*many(6), *busy]).strata
    assert stratum.unexpected_interval == proportion(0, 6)


def test_a_campaign_without_results_is_no_pass(tmp_path: Path) -> None:
    assert judged(tmp_path, []).gate == "fail"


def test_looks_make_the_intervals_wider(tmp_path: Path) -> None:
    text = CRASHES.replace("experiments: 4}", "experiments: 40, half_width: 0.1, looks: 4}")
    found = judged(tmp_path, many(30), text=text)
    assert found.strata[0].unexpected_interval == proportion(0, 30, 1 - 0.05 / 4)
