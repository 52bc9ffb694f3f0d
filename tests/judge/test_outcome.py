"""The class of an outcome: each on a history that has just that, and on simulated runs that come to it."""

from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import pytest

from aftbed.campaign.experiment import Experiment, carry_out
from aftbed.core.events import Event
from aftbed.core.journal import Entry, EntryKind, History, Record
from aftbed.judge.bare_server import ReplyRule
from aftbed.judge.checks import LATE_NS, Evidence
from aftbed.judge.outcome import OUTCOMES, outcome_of, worst
from aftbed.judge.reference import reference_run
from aftbed.judge.simulated import record_of
from aftbed.judge.verdict import evidence_of
from aftbed.runtime.deployment import Hosted, digest
from aftbed.runtime.sim.world import Run, Setup, simulate
from aftbed.vehicle.aeb.function import default_application

CLEAN = simulate(Setup("pbr", count=8))
Entries = Callable[[list[Entry]], list[Entry]]


@dataclass
class Changed:
    """How a clean run is judged, once something in it is changed."""

    history: History = CLEAN.history
    lost: bool = False
    living: Hosted | None = CLEAN.rest.hosted
    digests: tuple[str, ...] = tuple(CLEAN.rest.states.values())

    def word(self) -> str:
        record = record_of(CLEAN)
        assert record.end is not None
        states = dict(zip("ab", self.digests, strict=True))
        end = msgspec.structs.replace(record.end, lost=self.lost, hosted=self.living, states=states)
        record = msgspec.structs.replace(record, history=self.history, end=end)
        return outcome_of(evidence_of(record, default_application))[0]


def dialogue(change: Entries) -> History:
    return msgspec.structs.replace(CLEAN.history, dialogue=change(list(CLEAN.history.dialogue)))


def noted(event: Event, detail: int = 0) -> History:
    journals = dict(CLEAN.history.journals)
    journals["a.after.1"] = [*journals["a.after.1"], Record(1, event, 3, detail, "a/after")]
    return msgspec.structs.replace(CLEAN.history, journals=journals)


def without(*ids: int) -> History:
    return dialogue(lambda es: [e for e in es if e.kind is EntryKind.SENT or e.request_id not in ids])


def answered(change: Callable[[Entry], list[Entry]]) -> History:
    def told(entries: list[Entry]) -> list[Entry]:
        meant = [e.request_id == 3 and e.kind is EntryKind.ANSWERED for e in entries]
        return [c for e, yes in zip(entries, meant, strict=True) for c in (change(e) if yes else [e])]

    return dialogue(told)


@pytest.mark.parametrize(
    ("found", "word"),
    [
        (Changed(), "masked"),
        (Changed(digests=("0" * 16, CLEAN.rest.states["a"])), "latent"),
        (Changed(noted(Event.RECOVERY_ENTER)), "tolerated"),
        (Changed(noted(Event.VOTE_COMPARED, 3)), "tolerated"),
        (Changed(noted(Event.VOTE_COMPARED, 2)), "masked"),
        (
            Changed(answered(lambda e: [msgspec.structs.replace(e, t_ns=e.t_ns + LATE_NS + 1)])),
            "degraded",
        ),
        (Changed(living=msgspec.structs.replace(CLEAN.rest.hosted, backup="")), "degraded"),
        (Changed(noted(Event.DETECTED_STOP)), "detected_stop"),
        (Changed(without(3)), "omission"),
        (Changed(answered(lambda e: [e, e])), "duplicate_effect"),
        (Changed(without(6, 7, 8), lost=True), "unavailable"),
        (Changed(without(6, 7, 8)), "hang"),
        (Changed(answered(lambda e: [msgspec.structs.replace(e, payload=b"x")])), "sdc"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_each_class_has_its_history(found: Changed, word: str) -> None:
    assert found.word() == word


def test_replicas_that_differ_are_told_of_a_function_that_has_no_right_state_too() -> None:
    record, reference = record_of(CLEAN), reference_run(CLEAN.history, default_application())
    assert record.end is not None
    end = msgspec.structs.replace(record.end, states={"a": "1", "b": "2"})
    record = msgspec.structs.replace(record, end=end)
    reference = msgspec.structs.replace(reference, rules=(ReplyRule(deterministic=False),))
    assert outcome_of(Evidence(record, reference)) == ("latent", ("the replicas differ",))


def test_the_worst_wins() -> None:
    found = Changed(answered(lambda e: [msgspec.structs.replace(e, payload=b"x")]), lost=True)
    assert found.word() == "sdc"
    assert worst(["tolerated", "omission", "masked"]) == "omission"
    assert worst([]) == OUTCOMES[0] == "masked"


def test_the_bare_server_ends_in_the_state_of_both_replicas() -> None:
    reference = reference_run(CLEAN.history, default_application())
    assert {digest(reference.state)} == set(CLEAN.rest.states.values())
    assert set(CLEAN.rest.states) == {"a", "b"}


def experiment(ftm: str, *faults: str, **more: object) -> Experiment:
    found = Experiment("0" * 16, 0, 0, "s", 5, ftm, "process", "sim", "", 40, 400.0, faults)
    return msgspec.structs.replace(found, **more)


@pytest.mark.parametrize(
    ("ftm", "fault", "word"),
    [
        ("pbr", "crash primary at server.exit nth 9", "tolerated"),
        ("pbr", "crash backup at state.restored nth 9", "tolerated"),
        ("pbr", "crash proxy at reply.sent nth 9", "masked"),
        ("pbr", "hang primary at server.exit nth 9", "tolerated"),
        ("none", "crash primary at server.exit nth 9", "unavailable"),
        ("none", "bitflip result bit 60 at server.exit nth 9", "sdc"),
        ("pbr", "bitflip result bit 60 at server.exit nth 9", "sdc"),
        ("pbr+tr", "bitflip result bit 60 at server.exit nth 9", "tolerated"),
        ("pbr", "bitflip state bit 40 in backup at state.restored nth 40", "latent"),
    ],
)
def test_a_simulated_run_comes_to_its_class(ftm: str, fault: str, word: str) -> None:
    result = carry_out(experiment(ftm, fault), lambda _: None)
    assert (result.outcome, result.activated) == (word, True), result.reasons
    assert result.unexpected is False, "nothing was expected of it"


def test_what_never_fired_is_said_not_to_have_been_activated() -> None:
    asked = experiment("pbr", "crash primary at server.exit nth 400", expected=("tolerated",))
    result = carry_out(asked, lambda _: None)
    assert (result.outcome, result.activated, result.unexpected) == ("masked", False, False)


def test_a_recovery_over_its_budget_is_degraded() -> None:
    asked = experiment("pbr", "crash primary at server.exit nth 9", budget_ms=0.01)
    result = carry_out(asked, lambda _: None)
    assert result.outcome == "degraded"
    assert result.reasons[0].endswith("0.01 are allowed")


def test_trouble_of_the_harness_is_an_outcome_and_not_a_pass() -> None:
    kept: list[object] = []
    result = carry_out(experiment("pbr", "crash nobody"), kept.append)
    assert (result.outcome, result.activated) == ("harness_error", False)
    assert "unknown target 'nobody'" in result.reasons[0]
    assert kept == [result]


def test_a_run_is_told_with_its_times() -> None:
    result = carry_out(experiment("pbr", "crash primary at server.exit nth 9"), lambda _: None)
    assert result.requests is not None and result.requests.sent == 40
    assert result.recovery_ms is not None and result.detected_ms is not None
    assert 0 < result.detected_ms < result.recovery_ms
    assert isinstance(CLEAN, Run)
