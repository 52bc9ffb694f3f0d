"""The judgement over simulated runs: it passes an unbroken one, and refuses each that is broken in one thing.

`test_check` shows which histories the checkers of `judge.checks` refuse. Here is what the simulator checks
beside them: whether what lives is the whole graph, whether the run came to rest, whether a loss is excused.
"""

from collections.abc import Callable
from typing import Final

import pytest
from msgspec.structs import replace
from planting import flip

from aftbed.core.events import Event
from aftbed.core.journal import Entry, EntryKind, Record
from aftbed.core.messages import Goal, Scheduled
from aftbed.core.script import ScriptKind
from aftbed.ftm.compose import build
from aftbed.inject.model import FaultReport
from aftbed.inject.receipts import ReceiptState
from aftbed.inject.value import ValuePlace
from aftbed.judge.checks import half_a_graph, missing
from aftbed.judge.outcome import outcome_of
from aftbed.judge.simulated import SHORT_HANG_MS, breaches, record_of, service_struck_down
from aftbed.judge.verdict import evidence_of, judge
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.run_controller import ScriptRun
from aftbed.runtime.sim.clock import START_NS
from aftbed.runtime.sim.world import Run, Setup, StruckNode, simulate
from aftbed.vehicle.aeb.function import default_application

Broken = Callable[[Run], Run]

MS: Final = 1_000_000
RENEWAL_MS: Final = 0.1  # from its beginning to its end
UNBROKEN: Final = simulate(Setup("pbr", count=6))
SIMPLEX: Final = simulate(Setup("tr", count=6))
SUPERVISED: Final = simulate(Setup("pbr+sup", count=6))
SWITCHED: Final = Outcome(1, "pbr to lfr", "drained", "lfr", "done")
UNDONE: Final = Outcome(1, "pbr to lfr", "drained", "pbr", "rolled back")


def noted(journal: str, event: Event, request_id: int, detail: int = 0) -> Broken:
    """One more record, at the end of a journal."""

    def broken(run: Run) -> Run:
        records = run.history.journals[journal]
        node = journal.rpartition(".")[0].replace(".", "/")
        more = Record(run.rest.ended_ns, event, request_id, detail, node)
        journals = run.history.journals | {journal: [*records, more]}
        return replace(run, history=replace(run.history, journals=journals))

    return broken


def retold(change: Callable[[Entry], list[Entry]]) -> Broken:
    """Another answer to request 3, or none, or two."""

    def broken(run: Run) -> Run:
        entries = run.history.dialogue
        meant = [e.request_id == 3 and e.kind is EntryKind.ANSWERED for e in entries]
        told = [
            e for entry, yes in zip(entries, meant, strict=True) for e in (change(entry) if yes else [entry])
        ]
        return replace(run, history=replace(run.history, dialogue=told))

    return broken


def rested(**changes: object) -> Broken:
    """Another end."""
    return lambda run: replace(run, rest=replace(run.rest, **changes))


def living(**changes: object) -> Broken:
    """Another graph runs, or another replica leads, in the end."""
    return lambda run: rested(hosted=replace(run.rest.hosted, **changes))(run)


def hosting(change: Callable[[set[tuple[str, str]]], set[tuple[str, str]]]) -> Broken:
    """Other bricks live, in the end."""
    return lambda run: living(bricks=tuple(sorted(change(set(run.rest.hosted.bricks)))))(run)


def adapted(*outcomes: Outcome) -> Broken:
    """The adaptations ended so."""
    return lambda run: replace(run, adaptations=outcomes)


def struck(*names: str, for_ms: int = 0) -> Broken:
    """Faults struck these, one each millisecond; stops of `for_ms`, or for good."""
    return lambda run: replace(
        run, struck=tuple(StruckNode(n * MS, name, for_ms) for n, name in enumerate(names, 1))
    )


def renewed(ms: float) -> Broken:
    """Redundancy was back at that time."""
    renewal = ScriptRun(ScriptKind.NEW_BACKUP, "b", round((ms - RENEWAL_MS) * MS), round(ms * MS))
    return lambda run: replace(run, scripts=(*run.scripts, renewal))


def with_a_flip(run: Run) -> Run:
    """A value fault was asked for, and applied."""
    fault = flip(ValuePlace.RESULT, 0, "server.exit", 1)
    setup = replace(run.setup, faults=(fault,))
    return replace(run, setup=setup, faults=(FaultReport(str(fault), ReceiptState.APPLIED),))


def all_of(*broken: Broken) -> Broken:
    """One after the other."""

    def every(run: Run) -> Run:
        for one in broken:
            run = one(run)
        return run

    return every


def reasons(run: Run) -> list[str]:
    return [str(breach) for breach in breaches(run)]


def outcome(run: Run) -> str:
    return outcome_of(evidence_of(record_of(run), default_application))[0]


WRONG: Final = retold(lambda e: [replace(e, payload=e.payload[:-1] + b"\xff")])
LOST: Final = rested(lost=True, leader="")


@pytest.mark.parametrize("run", [UNBROKEN, SIMPLEX, simulate(Setup("none", count=6))])
def test_an_unbroken_run_breaks_no_promise(run: Run) -> None:
    assert breaches(run) == ()
    assert outcome(run) == "masked"


@pytest.mark.parametrize(
    ("broken", "found"),
    [
        (
            noted("a.server.1", Event.SERVER_EXIT, 6),
            "at_most_once (G1): a.server.1: request 6 (server.exit) after 6",
        ),
        (
            noted("b.server.1", Event.STATE_RESTORED, 2),
            "at_most_once (G1): b.server.1: request 2 (state.restored) after 6",
        ),
        (retold(lambda e: [e, e]), "exactly_one_answer (G2): request 3: 2 replies"),
        (retold(lambda e: []), "exactly_one_answer (G2): request 3: 0 replies"),
        (WRONG, "one_history (G3): request 3: the reply is not the bare server's"),
        (
            hosting(lambda bricks: bricks - {("b/after", "pbr.after")}),
            "whole_graph (G5): b/after (pbr.after) is missing",
        ),
        (
            hosting(lambda bricks: bricks | {("a/tr.after", "tr.after")}),
            "whole_graph (G5): a/tr.after (tr.after) should not be there",
        ),
        (
            hosting(lambda bricks: bricks - {("b/after", "pbr.after")} | {("b/after", "lfr.after")}),
            "whole_graph (G5): b/after (pbr.after) is missing",
        ),
        (living(ftm="lfr"), "whole_graph (G5): lfr runs, though the adaptations came to pbr"),
        (adapted(SWITCHED), "whole_graph (G5): pbr runs, though the adaptations came to lfr"),
        (
            all_of(adapted(UNDONE), living(ftm="lfr")),
            "whole_graph (G5): lfr runs, though the adaptations came to pbr",
        ),
        (
            living(leader=""),
            "exactly_one_answer (G2): the service is lost, though no node was struck",
        ),
        (
            noted("proxy.1", Event.REPLY_ACCEPTED, 6, 1 << 8 | 2),
            "one_master (G6): epoch 1: replies of replicas 1 and 2",
        ),
        (
            noted("proxy.1", Event.REPLY_ACCEPTED, 6, 2 << 8 | 2),
            "one_master (G6): replica 1 was not fenced between epochs 1 and 2",
        ),
        (
            rested(why_not=("requests wait", "no redundancy")),
            "at_rest: requests wait; no redundancy",
        ),
        (
            lambda run: replace(run, failures=("a/after: assertion failed", "b/after: assertion failed")),
            "assertions: a/after: assertion failed",
        ),
        (LOST, "exactly_one_answer (G2): the service is lost, though no node was struck"),
        (
            all_of(LOST, struck("a/server", "a/after")),
            "exactly_one_answer (G2): the service is lost, though only a/server, a/after was struck",
        ),
        (
            all_of(LOST, struck("proxy", "a/watchdog", "b")),
            "exactly_one_answer (G2): the service is lost, though only proxy, a/watchdog, b was struck",
        ),
        (
            all_of(LOST, struck("a/server", "b/server"), renewed(1.5)),
            "exactly_one_answer (G2): the service is lost, though only a/server, b/server was struck",
        ),
    ],
)
def test_a_broken_run_is_refused_for_what_is_broken(broken: Broken, found: str) -> None:
    """And for nothing else: each differs from an unbroken run in one thing."""
    assert reasons(broken(UNBROKEN)) == [found]


def test_a_wrong_value_under_a_value_fault_breaks_the_promise_of_values_too() -> None:
    found = breaches(all_of(with_a_flip, WRONG)(UNBROKEN))
    assert [(breach.check, breach.promise) for breach in found] == [("one_history", "G3"), ("value", "G4")]


def test_every_promise_of_a_run_is_told() -> None:
    run = all_of(WRONG, noted("a.server.1", Event.SERVER_EXIT, 6), rested(why_not=("no redundancy",)))(
        UNBROKEN
    )
    assert [breach.promise for breach in breaches(run)] == ["G1", "G3", ""]


def test_a_service_is_not_lost_in_vain() -> None:
    """Where faults struck each replica, no more is promised than at most once, and right replies."""
    gone = all_of(LOST, struck("a/server", "b/after"), rested(why_not=("requests wait",)))
    unanswered = all_of(gone, retold(lambda e: []))(UNBROKEN)
    assert breaches(unanswered) == ()
    assert outcome(unanswered) == "unavailable"
    assert judge(record_of(unanswered)).checks["exactly_one_answer"] == "unknown", "an excuse is no pass"
    assert [b.promise for b in breaches(all_of(gone, WRONG)(UNBROKEN))] == ["G3"]
    doubled = all_of(gone, noted("a.server.1", Event.SERVER_EXIT, 6))(UNBROKEN)
    assert [b.promise for b in breaches(doubled)] == ["G1"]


@pytest.mark.parametrize(
    ("broken", "down"),
    [
        (struck(), False),
        (struck("a"), False),
        (struck("a/server", "a/before"), False),
        (struck("a/server", "b/watchdog"), False),
        (struck("client", "proxy", "recovery", "engine"), False),
        (struck("a", "b"), True),
        (struck("b/after", "a/protocol"), True),
        (all_of(struck("a", "b"), renewed(1.5)), False),
        (all_of(struck("a", "b"), renewed(0.5)), True),  # before the first
        (all_of(struck("a", "b"), renewed(2.5)), True),  # too late
        (all_of(struck("a", "b", "a"), renewed(1.5)), True),  # the second pair of strikes
        (all_of(struck("a", "b", "a"), renewed(1.5), renewed(2.5)), False),
        (struck("a", "b", for_ms=SHORT_HANG_MS), False),  # both go on
        (struck("a", "b", for_ms=SHORT_HANG_MS + 1), True),
    ],
)
def test_a_duplex_is_struck_down_by_two_faults_with_no_redundancy_between(broken: Broken, down: bool) -> None:
    assert service_struck_down(broken(UNBROKEN)) is down


def test_a_single_replica_is_struck_down_by_one_fault() -> None:
    assert not service_struck_down(struck("client", "a/watchdog")(SIMPLEX))
    assert service_struck_down(struck("a/server")(SIMPLEX))
    assert not service_struck_down(struck("a/server", for_ms=SHORT_HANG_MS)(SIMPLEX))


@pytest.mark.parametrize(("adapted_after_ms", "down"), [(None, False), (1.0, False), (-1.0, True)])
def test_a_stop_by_supervision_excuses_a_loss_only_where_no_other_replica_served(
    adapted_after_ms: float | None, down: bool
) -> None:
    """Stopped at the end of the run; adapted to one replica then or so, or never."""
    run = noted("a.after.1", Event.DETECTED_STOP, 3)(with_a_flip(SUPERVISED))
    if adapted_after_ms is not None:
        asked_ms = (run.rest.ended_ns - START_NS) / MS + adapted_after_ms
        alone = Outcome(1, "pbr+sup to sup", "drained", "sup", "done", asked_ms=asked_ms, tried_ftm="sup")
        setup = replace(run.setup, adaptations=(Scheduled(Goal(expression="sup")),))
        run = replace(adapted(alone)(run), setup=setup)
    assert service_struck_down(run) is down


def test_what_lives_must_be_the_graph_of_who_leads() -> None:
    """After a failover too, and after an adaptation that is done."""
    begun = UNBROKEN.rest.hosted
    assert half_a_graph(replace(begun, leader="b", backup="a"), "pbr") == []
    switched = replace(begun, ftm="lfr", bricks=bricks_of("lfr"))
    assert half_a_graph(switched, "lfr") == []
    assert half_a_graph(replace(begun, ftm="lfr"), "lfr")[0] == "a/after (lfr.after) is missing"


def test_after_a_failover_one_replica_alone_is_that_which_leads() -> None:
    """An adaptation to a mechanism of one replica leaves it where it is."""
    graph = build("assert", "process", "b")
    alone = tuple((brick.name, brick.kind) for brick in graph.bricks)
    hosted = replace(UNBROKEN.rest.hosted, ftm="assert", leader="b", backup="", bricks=alone)
    assert half_a_graph(hosted, "assert") == []
    assert half_a_graph(replace(hosted, leader="a"), "assert")[0] == "a/after (assert.after) is missing"


def test_of_a_survivor_alone_only_its_own_replica_is_asked_for() -> None:
    alone = tuple(brick for brick in bricks_of("pbr") if not brick[0].startswith("a/"))
    survivor = replace(UNBROKEN.rest.hosted, leader="b", backup="", bricks=alone)
    assert half_a_graph(survivor, "pbr") == []
    broken = replace(survivor, bricks=tuple(b for b in alone if b[0] != "b/server"))
    assert half_a_graph(broken, "pbr") == ["b/server (server) is missing"]
    assert half_a_graph(replace(survivor, backup="a"), "pbr")[0] == "a/after (pbr.after) is missing"


def bricks_of(ftm: str) -> tuple[tuple[str, str], ...]:
    return tuple((b.name, b.kind) for b in build(ftm, "process").bricks)


def test_all_that_differs_from_a_whole_graph_is_told() -> None:
    graph = build("pbr", "replica")
    whole = [(b.name, b.kind) for b in graph.bricks]
    assert missing(whole, graph) == []
    assert missing(reversed(whole), graph) == []
    assert missing(whole[1:], graph) == [f"{whole[0][0]} ({whole[0][1]}) is missing"]
    assert missing([*whole, ("a/spare", "server")], graph) == ["a/spare (server) should not be there"]
    assert len(missing([], graph)) == len(whole)


@pytest.mark.parametrize(
    ("broken", "word"),
    [
        (WRONG, "sdc"),
        (all_of(WRONG, LOST), "sdc"),  # the worst one wins
        (LOST, "unavailable"),
        (retold(lambda e: [replace(e, t_ns=e.t_ns + 100 * MS)]), "degraded"),
        (noted("recovery.1", Event.RECOVERY_ENTER, 0), "tolerated"),
    ],
)
def test_the_outcome_of_a_run_is_the_worst_that_happened(broken: Broken, word: str) -> None:
    assert outcome(broken(UNBROKEN)) == word
