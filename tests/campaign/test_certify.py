"""`certify`: what is as it declares passes; a planted weakness fails the gate, and the report names it."""

from pathlib import Path

import pytest
from certified import certified, suite
from msgspec.structs import replace
from strangers import FATAL

from aftbed.campaign.summary import Summary
from aftbed.campaign.weaknesses import Weakness, weaknesses

pytestmark = pytest.mark.simulation

FEW = ("none", "pbr", "pbr+tr")
FAULTS = ("nothing", "crash primary", "wrong reply", "wrong state")


def of(summary: Summary, fault: str) -> Weakness:
    """The one of this fault."""
    (found,) = (one for one in summary.weaknesses if one.fault == fault)
    return found


def unexpected(summary: Summary) -> list[Weakness]:
    return [one for one in summary.weaknesses if not one.expected]


@pytest.mark.parametrize("function", ["Counter", "Stateless", "Closed", "Random"])
def test_a_function_that_is_what_it_declares_passes(tmp_path: Path, function: str) -> None:
    """Also one without a state, where a bit of the state has nothing to strike."""
    mechanisms = ("none", "lfr", "assert") if function == "Closed" else FEW
    spec = suite(tmp_path, function, mechanisms, *FAULTS)
    _, summary = certified(replace(spec, not_activated_max=0.9, unknown_max=0.9))  # of so few
    assert summary.gate == "pass", [gate for gate in summary.gates if gate.word == "fail"]
    assert unexpected(summary) == []


def test_a_forgotten_field_is_found_behind_a_failover_and_by_a_second_execution(tmp_path: Path) -> None:
    _, summary = certified(suite(tmp_path, "Forgetful", ("pbr", "pbr+tr"), "nothing", "crash primary"))
    assert summary.gate == "fail"
    crash, calm = of(summary, "crash primary"), of(summary, "nothing")
    assert (crash.effect, [one.place for one in crash.seen]) == ("wrong replies reach the client", ["pbr"])
    assert crash.advice.startswith(
        "behind a failover, a replica has a captured state: capture() or restore()"
    )
    assert [one.place for one in calm.seen] == ["pbr+tr"]
    assert "executed again from a captured state, it answers otherwise" in calm.advice
    assert calm.advice.endswith("requests.csv` tells what") and "`aftbed app check /" in calm.advice


def test_kinds_of_fault_that_show_one_cause_are_one_weakness(tmp_path: Path) -> None:
    faults = ("crash primary", "hang primary", "crash backup")
    _, summary = certified(suite(tmp_path, "Forgetful", ("pbr",), *faults), 2)
    (weak,) = unexpected(summary)
    assert weak.fault == "crash primary; hang primary"
    assert [(one.place, one.experiments) for one in weak.seen] == [("pbr", 4)]


def test_a_forgotten_field_is_found_in_the_second_failover_of_lfr(tmp_path: Path) -> None:
    """The first backup executes all requests; only the next one begins with a captured state."""
    faults = ("crash primary", "crash both in turn")
    _, summary = certified(suite(tmp_path, "Forgetful", ("lfr",), *faults), 2)
    assert [one.fault for one in unexpected(summary)] == ["crash both in turn"]


@pytest.mark.parametrize("function", ["Hidden", "Chance", "Address"])
def test_what_no_state_has_is_found(tmp_path: Path, function: str) -> None:
    _, summary = certified(suite(tmp_path, function, ("none", "pbr"), "nothing", "crash primary"))
    assert summary.gate == "fail"
    (weak,) = unexpected(summary)
    if function == "Hidden":  # a global that each replica has for itself
        assert weak.fault == "crash primary" and "capture() or restore() forgets something" in weak.advice
    else:
        assert weak.fault == "nothing" and "it is not deterministic" in weak.advice
        assert [one.place for one in weak.seen] == ["none", "pbr"]


def test_a_function_that_fails_on_a_request_is_named_with_the_request(tmp_path: Path) -> None:
    _, summary = certified(suite(tmp_path, "Fatal", ("none", "pbr"), "nothing", "crash primary"))
    assert summary.gate == "fail"
    (weak,) = unexpected(summary)
    assert weak.fault == "nothing" and weak.advice.startswith("it fails by itself: ")
    assert f"request {FATAL}" in weak.advice and "ZeroDivisionError: the distance is 0" in weak.advice


# -- what would have held -------------------------------------------------------------------------


def test_what_a_mechanism_does_not_promise_is_a_limit_and_those_that_held_it_are_named(
    tmp_path: Path,
) -> None:
    spec = suite(tmp_path, "Counter", FEW, "wrong reply")
    _, summary = certified(spec, 6)
    assert summary.gate == "pass"
    (limit,) = summary.weaknesses
    assert limit.expected and limit.effect == "wrong replies reach the client"
    assert [(one.place, one.count, one.experiments) for one in limit.seen] == [("none", 6, 6), ("pbr", 6, 6)]
    assert [(one.place, one.count, one.experiments) for one in limit.held] == [("pbr+tr", 6, 6)]
    assert 0.5 < limit.held[0].interval.low < 0.6 and limit.held[0].interval.high == 1.0


def test_few_experiments_recommend_nothing_and_it_is_told_how_many_would(tmp_path: Path) -> None:
    """Three that ended well may be chance."""
    spec = suite(tmp_path, "Counter", ("pbr", "pbr+tr"), "wrong reply")
    limit = of(certified(spec, 3)[1], "wrong reply")
    assert limit.held == ()
    named, _, number = limit.advice.partition("`--experiments ")
    assert named == "pbr+tr held it, which may be chance: "
    enough = of(certified(spec, int(number.removesuffix("` or more tell")))[1], "wrong reply")
    assert [one.place for one in enough.held] == ["pbr+tr"]


def test_what_cannot_occur_elsewhere_is_named(tmp_path: Path) -> None:
    spec = suite(tmp_path, "Counter", ("pbr", "pbr+tr", "lfr"), "wrong checkpoint")
    _, summary = certified(spec, 3)
    assert of(summary, "wrong checkpoint").advice == "it does not occur under lfr"


def test_what_would_have_held_but_does_not_suit_is_named_with_the_reason(tmp_path: Path) -> None:
    _, summary = certified(suite(tmp_path, "Closed", ("lfr",), "wrong reply"), 2)
    advice = of(summary, "wrong reply").advice
    assert advice.startswith("tr, pbr+tr, lfr+tr, assert+tr would hold it, not tried: ")
    assert "tr needs state access: every execution starts from the same state" in advice


def test_a_mechanism_that_is_weak_itself_is_not_recommended(tmp_path: Path) -> None:
    _, summary = certified(suite(tmp_path, "Forgetful", ("pbr", "pbr+tr"), "nothing", "wrong reply"), 2)
    limit = of(summary, "wrong reply")
    assert limit.held == () and limit.advice.startswith("pbr+tr would hold it, once the function")


def test_a_machine_that_was_too_busy_is_no_weakness(tmp_path: Path) -> None:
    spec = suite(tmp_path, "Counter", ("pbr",), "nothing")
    ledger, _ = certified(spec)
    busy = [replace(r, outcome="inconclusive", noisy=True) for r in ledger.results]
    name = busy[0].experiment.stratum
    assert weaknesses(ledger.head.spec, {name: busy}, 0.95) == ()
    unknown = [replace(r, noisy=False, reasons=("no record",)) for r in busy]
    (found,) = weaknesses(ledger.head.spec, {name: unknown}, 0.95)
    assert "no record" in found.advice
