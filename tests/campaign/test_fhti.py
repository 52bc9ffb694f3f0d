"""Intervals of fault handling in a campaign: quantiles, coverage, the margin to the FTTI, and the bound."""

from pathlib import Path

import msgspec
import pytest
from campaigns import CRASHES, planned, ran, result

from aftbed.campaign.experiment import Result, without_times
from aftbed.campaign.ledger import Ledger, head_of
from aftbed.campaign.spec import Gate
from aftbed.campaign.statistics import quantile_bound
from aftbed.campaign.summary import GateResult, Summary, fhti_figures, handling, summarise
from aftbed.core.errors import ConfigError
from aftbed.judge.intervals import HandlingIntervals, Occasion, Reaction

FTTI = CRASHES + "ftti: 20ms\n"
MARGIN = Gate("fhti_margin", min=0.3)
ADAPTED = """
campaign: try
seed: 1
ftti: 5ms
system: {requests: 120, rate_hz: 1000, runtime: sim}
mechanisms: [pbr]
adaptations:
- {name: ours, adapt: compose pbr+tr at request 40}
- {name: the paper's, adapt: compose pbr+tr at request 40, recipe: paper}
faults:
- {name: crash, fault: crash primary at server.exit nth 20}
stop: {experiments: 3}
gates:
- {metric: fhti_margin, min: 0.3, strata: "* ours *"}
- {metric: fhti_margin, min: 0.3, strata: "* the paper's *"}
"""


def handled(
    fhti_ms: float | None = 2.0, bound_ms: float | None = 8.0, *, fdti_ms: float | None = 0.5, **more: object
) -> HandlingIntervals:
    frti_ms = None if fhti_ms is None or fdti_ms is None else fhti_ms - fdti_ms
    reaction = Reaction.NONE if fhti_ms is None else Reaction.OPERATIONAL
    made = HandlingIntervals("crash primary", fdti_ms, frti_ms, fhti_ms, reaction, bound_ms)
    return msgspec.structs.replace(made, **more)


def one(index: int = 0, *intervals: HandlingIntervals, outcome: str = "tolerated", **more: object) -> Result:
    found = result(outcome, index=index, intervals=intervals, **more)
    experiment = msgspec.structs.replace(found.experiment, ftti_ms=20.0)
    return msgspec.structs.replace(found, experiment=experiment)


def judged(folder: Path, results: list[Result], *gates: Gate, text: str = FTTI) -> Summary:
    head = head_of(planned(folder, text))
    head = msgspec.structs.replace(head, spec=msgspec.structs.replace(head.spec, gates=gates))
    return summarise(Ledger(folder, head, tuple(results)), len(results), 1.0)


def gate(found: Summary, metric: str) -> GateResult:
    return next(gate for gate in found.gates if gate.metric == metric)


def test_of_299_values_the_greatest_bounds_the_p99_and_of_298_none_does() -> None:
    values = [float(n) for n in range(299)]
    assert quantile_bound(values, 0.99) == 298.0
    assert quantile_bound(values[1:], 0.99) is None


def test_how_the_faults_of_a_stratum_were_handled() -> None:
    group = [one(n, handled(float(n + 1))) for n in range(10)]
    found = handling([*group, one(10, handled(None, None, fdti_ms=None), outcome="hang")], 0.95)
    assert found is not None and found.fhti_ms is not None and found.fdti_ms is not None
    assert (found.fhti_ms.p50, found.fhti_ms.max, found.fhti_ms.p99_bound) == (5.0, 10.0, None)
    assert found.reactions == {"operational": 10, "safe": 0, "none": 1}
    assert (found.bound_ms, found.of_bound) == (8.0, 1.25)


def test_coverage_is_of_what_was_detected_or_tolerated() -> None:
    unseen = handled(2.0, fdti_ms=None)
    group = [
        one(0, handled()),
        one(1, handled(None), outcome="sdc"),  # detected, and wrong all the same
        one(2, unseen, outcome="masked"),
        one(3, unseen, outcome="latent"),
        one(4, unseen, outcome="sdc"),
        one(5, unseen, outcome="inconclusive"),  # of these, nothing is known
        one(6, unseen, outcome="masked", noisy=True),
        one(7, outcome="masked", activated=False),
    ]
    found = handling(group, 0.95)
    assert found is not None and found.coverage is not None
    shown = found.coverage
    assert (shown.activated, shown.detected, shown.tolerated, shown.latent, shown.uncovered) == (
        5,
        2,
        1,
        1,
        1,
    )
    assert shown.interval.low < 3 / 5 < shown.interval.high


@pytest.mark.parametrize(("fhti_ms", "word"), [(14.0, "pass"), (14.1, "fail")])
def test_the_margin_is_that_of_the_longest_handling(tmp_path: Path, fhti_ms: float, word: str) -> None:
    found = gate(judged(tmp_path, [one(0, handled()), one(1, handled(fhti_ms, None))], MARGIN), "fhti_margin")
    assert found.word == word and found.bound == found.value == pytest.approx(1 - fhti_ms / 20)
    assert found.reason == ("" if word == "pass" else "the longest 14.1 ms of 20 ms")


def test_of_enough_values_the_bound_of_the_p99_judges_the_margin(tmp_path: Path) -> None:
    results = [one(n, handled(2.0)) for n in range(700)] + [one(700, handled(19.0, None))]
    found = gate(judged(tmp_path, results, MARGIN), "fhti_margin")
    assert (found.word, found.value, found.bound) == ("pass", pytest.approx(0.05), pytest.approx(0.9))


def test_a_fault_that_was_never_handled_leaves_no_margin(tmp_path: Path) -> None:
    results = [one(0, handled()), one(1, handled(None), outcome="hang")]
    found = gate(judged(tmp_path, results, MARGIN), "fhti_margin")
    assert (found.word, found.reason) == (
        "fail",
        "experiment 0000000000000001: crash primary: never handled",
    )
    assert gate(judged(tmp_path, [one()], MARGIN), "fhti_margin").reason == "no fault was handled"


def test_the_blackout_of_an_adaptation_takes_from_the_margin(tmp_path: Path) -> None:
    adapted = handled(18.0, None, occasion=Occasion.ADAPTATION)
    found = judged(tmp_path, [one(0, handled(), adapted)], MARGIN)
    assert gate(found, "fhti_margin").word == "fail"
    assert found.strata[0].handling is not None and found.strata[0].handling.fhti_ms is not None
    assert found.strata[0].handling.fhti_ms.max == 2.0, "but it is no fault"


def test_a_handling_beyond_its_bound_fails_the_campaign(tmp_path: Path) -> None:
    within = [one(n, handled(8.0)) for n in range(20)]
    assert judged(tmp_path, within).gate == "pass"
    beyond = one(20, handled(8.5))
    found = judged(tmp_path, [*within, beyond])
    assert (found.gate, gate(found, "fhti_bound").word) == ("fail", "fail")
    assert gate(found, "fhti_bound").reason == (
        "experiment 0000000000000014: crash primary: handled after 8.5 ms, the bound is 8"
    )
    assert judged(tmp_path, [*within, without_times(beyond)]).gate == "pass"


def test_on_real_processes_a_bound_fails_a_campaign_that_asks_for_it(tmp_path: Path) -> None:
    results = [*(one(n, handled(8.0)) for n in range(20)), one(20, handled(8.5))]
    real = FTTI.replace("runtime: sim", "runtime: unix")
    assert real != FTTI
    found = judged(tmp_path, results, text=real)
    assert (found.gate, gate(found, "fhti_bound").value) == ("pass", 8.5 / 8.0)
    assert gate(found, "fhti_bound").reason.endswith("the bound is 8; judged with `bounded`")
    assert judged(tmp_path, results, text=f"bounded: true\n{real}").gate == "fail"


def test_on_a_busy_machine_late_handling_breaks_nothing() -> None:
    late = one(0, handled(30.0), broken=("ftti: crash primary: handled after 30 ms", "one_master: two"))
    found = without_times(late)
    assert found.broken == ("one_master: two",)
    assert (found.fhti_ms, found.of_bound, found.intervals[0].reaction) == (None, None, Reaction.OPERATIONAL)


def test_the_figures_of_a_mechanism() -> None:
    found = fhti_figures([one(n, handled(float(n + 1), 100.0)) for n in range(100)])
    assert {name: (f.p50, f.p99, f.bound) for name, f in found.items()} == {"pbr": (50.0, 99.0, 100.0)}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            CRASHES + "gates: [{metric: fhti_margin, min: 0.3}]\n",
            "gates[0].metric: fhti_margin is of an FTTI",
        ),
        (
            CRASHES.replace("30, ", "30, rate_hz: 50, ") + "ftti: 19ms\n",
            "ftti 19ms: shorter than a cycle of 20ms",
        ),
        (CRASHES + "ftti: 100\n", "ftti"),
        (CRASHES + 'ftti: "0ms"\n', "ftti '0ms': a positive number with its unit is allowed"),
    ],
)
def test_what_is_no_ftti_is_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        planned(tmp_path, text)
    assert words in str(refusal.value)


def test_the_intervals_of_an_experiment_are_in_its_record_and_its_command(tmp_path: Path) -> None:
    records = ran(planned(tmp_path, FTTI), tmp_path / "out")
    crashes = [r for r in records.results if r.experiment.faults]
    assert crashes and all(r.experiment.command().endswith("--ftti 20ms") for r in crashes)
    for found in crashes:
        assert [one.fault for one in found.intervals] == [report.fault for report in found.faults]
        assert 0 < (found.fdti_ms or 0) < (found.fhti_ms or 0) < 20
        assert 0 < (found.of_bound or 0) <= 1


def test_the_margin_holds_with_our_adaptation_and_not_with_the_recipe_of_the_paper(tmp_path: Path) -> None:
    records = ran(planned(tmp_path, ADAPTED), tmp_path / "out")
    ours, papers = summarise(records, 6, 1.0).gates[:2]
    assert (ours.word, papers.word) == ("pass", "fail"), (ours, papers)
