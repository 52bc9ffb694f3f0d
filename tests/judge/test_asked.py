"""What was asked for and did not happen is never a pass: each row of the judge's table, and what it tells."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Final

import msgspec
import pytest
from msgspec.structs import replace
from records import CAR, CRASH, STOPPED, RecordInTheMaking, outcomes, whole

from aftbed.core.errors import ConfigError
from aftbed.core.messages import Goal, Scheduled
from aftbed.ftm.compose import build
from aftbed.functions.request_file import ExpectedReplies
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault
from aftbed.judge.asked import ASKED_FOR, Asked, AskedAdaptation
from aftbed.judge.record import RunRecord, read_record
from aftbed.judge.simulated import record_of
from aftbed.judge.verdict import Verdict, judge
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.runtime.unix.closed_loop import (
    PROPOSALS_NAME,
    REPORT_NAME,
    PolicyReport,
    Proposed,
    RuleReport,
)
from aftbed.runtime.unix.options import CarRun, LoadRun, PolicyOptions, ReplayRun
from aftbed.runtime.unix.request_store import EXPECTED_NAME, REQUESTS_NAME
from aftbed.runtime.unix.run_directory import HISTORY_NAME
from aftbed.vehicle.aeb.function import default_application, sample_requests

DONE: Final = {
    "blackout_ms": 1.5,
    "total_ms": 120.0,
    "scheduled": 1,
    "ftm": "lfr",
    "asked": "to lfr at request 2",
}
AT_2: Final = Scheduled(Goal(expression="lfr"), at_request=2)
RULE: Final = RuleReport("rules[0]", "2 crash within 10 s", "switch lfr", 12, True, 1)
PROPOSED: Final = Proposed(300.0, "rules[0]", "2 crash within 10 s", "switch lfr", "pbr", "lfr", "done")


# -- records of runs in which something did not happen


def unfired(path: Path) -> Verdict:
    record = whole(path, faults=(CRASH,))
    assert record.end is not None
    record.end["faults"] = [{"fault": str(CRASH), "receipt": "armed"}]
    return record.verdict()


def adapted(path: Path, asked: tuple[Scheduled, ...], *changes: dict[str, object]) -> RecordInTheMaking:
    record = whole(path)
    record.options = replace(record.options, adaptations=asked)
    (path / HISTORY_NAME).write_text(outcomes(*changes))
    return record


def shorter(path: Path) -> Verdict:
    record = whole(path)
    record.asked = 5
    return record.verdict()


def driven(path: Path, end: str | None, t_us: int, car: CarRun = CAR) -> Verdict:
    record = whole(path, car)
    assert record.end is not None
    record.end["result"] = {"end": end, "t_us": t_us, "result": msgspec.to_builtins(STOPPED)}
    return record.verdict()


def replayed(path: Path, **played: object) -> Verdict:
    record = whole(path, ReplayRun("drive.log", "radar.dbc", "toyota", None))
    assert record.end is not None
    record.end["result"] = {"played": played}
    return record.verdict()


def expecting(path: Path, replies: Sequence[bytes], answers: int = 1, count: int = 0) -> Verdict:
    """A run of three requests whose user expected `replies`; `answers` to the last."""
    record = RecordInTheMaking(path, LoadRun(3, 0.0, "mine.csv", "expected.csv"))
    for given in (1, 1, answers):
        record.request(answers=given)
    record.asked = count
    (path / REQUESTS_NAME).write_bytes(msgspec.msgpack.encode(sample_requests(7, 3)))
    (path / EXPECTED_NAME).write_bytes(msgspec.msgpack.encode(ExpectedReplies(tuple(replies))))
    return record.verdict()


def replies(count: int = 3) -> list[bytes]:
    """The right ones."""
    bare = default_application()
    return [bare.execute(request) for request in sample_requests(7, count)]


def not_in_the_record(path: Path) -> Verdict:
    expecting(path, replies())
    (path / EXPECTED_NAME).unlink()
    return judge(read_record(path))


def followed(
    path: Path, report: PolicyReport | None, *proposals: Proposed, may_fail: bool = False
) -> RecordInTheMaking:
    """A run under a policy; what it proposed and was done was done."""
    record = whole(path)
    record.options = replace(record.options, policy=PolicyOptions("mine.yaml", "auto", may_fail))
    if report is not None:
        (path / REPORT_NAME).write_bytes(msgspec.json.encode(report))
    (path / PROPOSALS_NAME).write_bytes(b"".join(msgspec.json.encode(one) + b"\n" for one in proposals))
    done = [{"ftm": one.target, "may_fail": True} for one in proposals if one.outcome == "done"]
    (path / HISTORY_NAME).write_text(outcomes(*done))
    if done:
        lives = [[b.name, b.kind] for b in build("lfr", "process").bricks]
        record.host(ftm="lfr", bricks=lives)
    return record


@cache
def simulated(scenario: str = "") -> RunRecord:
    return record_of(simulate(Setup(count=5, scenario=scenario)))


def never_simulated(**asked: object) -> Verdict:
    return judge(record_of(simulate(replace(Setup(count=5), **asked))))


def unfinished() -> RunRecord:
    """A car that is still under way."""
    record = simulated("ccrs-20")
    assert record.drive is not None
    return replace(record, drive=replace(record.drive, end=None, t_us=2_000_000))


Case = tuple[Callable[[Path], Verdict], str]
NEVER: Final = Fault(CRASH.action, "primary", Trigger("server.exit", 9))

NOT_HAPPENED: Final[
    dict[str, list[Case]]
] = {  # by what was asked for: runs, and the reason of their verdicts
    "fault": [
        (unfired, f"never fired: {CRASH}"),
        (lambda _: never_simulated(faults=(NEVER,)), f"never fired: {NEVER}"),
    ],
    "adaptation": [
        (lambda path: adapted(path, (AT_2,)).verdict(), f"{AT_2}: not ended: the run ended before it"),
        (
            lambda _: never_simulated(adaptations=(replace(AT_2, at_request=9),)),
            "to lfr at request 9: not begun: request 9 was never sent, 5 was the last",
        ),
    ],
    "number of requests": [
        (shorter, "3 requests were sent, 5 were asked for"),
        (
            lambda _: judge(replace(simulated(), options=replace(simulated().options, work=LoadRun(6, 0)))),
            "5 requests were sent, 6 were asked for",
        ),
    ],
    "drive to its end": [
        (
            lambda path: driven(path, "stopped", 1_500_000),
            "the drive was stopped after 1.5 s, which was not asked for",
        ),
        (lambda path: driven(path, "duration", 1_500_000), "the drive ended after 1.5 of 9 s"),
        (
            lambda path: driven(path, "slow", 1_500_000),
            "the drive ended after 1.5 s because the car was slow, which was not asked for",
        ),
        (
            lambda _: judge(unfinished()),
            "the drive was stopped after 2 s, which was not asked for",
        ),
    ],
    "replay to its end": [
        (lambda path: replayed(path, complete=False), "the log was not replayed to its end"),
        (replayed, "the log was not replayed to its end"),
    ],
    "expected replies": [
        (
            lambda path: expecting(path, replies(), answers=0),
            "no reply to 1 of 3 requests, the first is request 3",
        ),
        (
            lambda path: expecting(path, replies(5), count=5),
            "no reply to 2 of 5 requests, the first is request 4",
        ),
        (not_in_the_record, "the expected replies are not in the record"),
    ],
    "policy": [
        (lambda path: followed(path, None).verdict(), "the closed loop did not live to report"),
        (
            lambda path: followed(path, PolicyReport((replace(RULE, observations=0, proposed=0),))).verdict(),
            "never evaluated: 2 crash within 10 s",
        ),
        (
            lambda path: followed(path, PolicyReport((), "no journal could be read")).verdict(),
            "no journal could be read",
        ),
        *(
            (
                lambda path, outcome=outcome: followed(
                    path, PolicyReport((RULE,)), replace(PROPOSED, outcome=outcome, why="b died")
                ).verdict(),
                f"pbr to lfr (2 crash within 10 s): {outcome}: b died",
            )
            for outcome in ("rolled back", "refused", "failed", "cut off")
        ),
    ],
}


@pytest.mark.parametrize("row", ASKED_FOR, ids=lambda row: row.what)
def test_what_did_not_happen_is_no_pass(path: Path, row: Asked) -> None:
    """Each row has its cases above: a new one without them fails."""
    for number, (run, reason) in enumerate(NOT_HAPPENED[row.what]):
        verdict = run(path / str(number))
        lost = ("fail",) if verdict.requests.lost else ()  # a promise is broken, too
        assert verdict.verdict in ("inconclusive", *lost) and verdict.checks[row.check] == "unknown"
        assert f"{row.check}: {reason}" in verdict.reasons


@pytest.mark.parametrize("end", ["collision", "standstill", "duration"])
def test_a_drive_that_came_to_its_end_is_complete(path: Path, end: str) -> None:
    assert driven(path, end, 9_000_000).checks["complete"] == "pass"


def test_a_drive_of_a_duration_has_to_last_that_long(path: Path) -> None:
    asked = replace(CAR, duration_ms=1_500)
    assert driven(path / "whole", "duration", 1_500_000, asked).checks["complete"] == "pass"
    verdict = driven(path / "short", "duration", 1_499_000, asked)
    assert "complete: the drive ended after 1.499 of 1.5 s" in verdict.reasons


def test_a_drive_that_its_user_stopped_is_judged_by_what_it_did(path: Path) -> None:
    record = whole(path, CAR)
    assert record.end is not None
    result = {"end": "stopped", "t_us": 1_500_000, "result": msgspec.to_builtins(STOPPED)}
    record.end |= {"reason": "interrupted", "result": result}
    verdict = record.verdict()
    assert verdict.verdict == "pass" and "complete" not in verdict.checks


# -- policies


def test_a_policy_that_was_followed_is_told(path: Path) -> None:
    verdict = followed(path, PolicyReport((RULE,)), PROPOSED).verdict()
    assert (verdict.verdict, verdict.checks["policy_followed"]) == ("pass", "pass")
    assert (verdict.policy, verdict.proposals) == (PolicyReport((RULE,)), [PROPOSED])


def test_a_condition_that_never_held_is_no_failure(path: Path) -> None:
    never = PolicyReport((replace(RULE, held=False, proposed=0),))
    verdict = followed(path, never).verdict()
    assert (verdict.verdict, verdict.policy, verdict.proposals) == ("pass", never, [])


def test_what_a_policy_proposes_may_fail_where_its_user_says_so(path: Path) -> None:
    undone = replace(PROPOSED, outcome="rolled back", why="b died")
    assert followed(path, PolicyReport((RULE,)), undone, may_fail=True).verdict().verdict == "pass"


@pytest.mark.parametrize("outcome", ["declined", "superseded"])
def test_what_its_user_did_not_want_is_no_failure(path: Path, outcome: str) -> None:
    verdict = followed(path, PolicyReport((RULE,)), replace(PROPOSED, outcome=outcome)).verdict()
    assert verdict.verdict == "pass"


def test_a_proposal_that_was_made_again_and_done_came_about(path: Path) -> None:
    undone = replace(PROPOSED, outcome="rolled back", why="b died")
    twice = PolicyReport((replace(RULE, proposed=2),))
    assert followed(path / "1", twice, undone, PROPOSED).verdict().verdict == "pass"
    assert followed(path / "2", twice, PROPOSED, undone).verdict().verdict == "inconclusive"


@pytest.mark.parametrize(
    ("report", "proposals", "reason"),
    [
        (PolicyReport((RULE,)), (), "rules[0] proposed 1 times, and there are 0 proposals of it"),
        (
            PolicyReport((replace(RULE, proposed=2),)),
            (PROPOSED,),
            "rules[0] proposed 2 times, and there are 1 proposals of it",
        ),
    ],
)
def test_a_report_that_its_proposals_contradict_fails(
    path: Path, report: PolicyReport, proposals: tuple[Proposed, ...], reason: str
) -> None:
    verdict = followed(path, report, *proposals).verdict()
    assert (verdict.verdict, verdict.reasons) == ("fail", [f"sources_agree: {reason}"])


def test_a_proposal_that_no_adaptation_carried_out_fails(path: Path) -> None:
    record = followed(path, PolicyReport((RULE,)), PROPOSED)
    (path / HISTORY_NAME).unlink()
    assert (
        "sources_agree: the proposal of lfr was done, and no adaptation led there" in record.verdict().reasons
    )


def test_a_policy_that_nobody_asked_for_fails(path: Path) -> None:
    record = followed(path, PolicyReport((replace(RULE, proposed=0),)))
    record.options = replace(record.options, policy=None)
    assert record.verdict().reasons == ["sources_agree: a policy was followed, and none was asked for"]


# -- requests and replies that the user gave


def test_replies_that_are_as_expected_pass(path: Path) -> None:
    verdict = expecting(path, replies())
    assert (verdict.verdict, verdict.checks["expected_replies"]) == ("pass", "pass")
    assert verdict.scenario == "requests mine.csv"


def test_the_first_reply_that_is_not_as_expected_fails(path: Path) -> None:
    one, two, three = replies()
    verdict = expecting(path, [one, b"", three + b"x"])
    assert (verdict.verdict, verdict.checks["expected_replies"]) == ("fail", "fail")
    length = f"{len(two)} bytes"
    assert verdict.reasons == [
        f"expected_replies: request 2: found {length}, expected an empty reply (the request was refused)"
    ]


def test_a_wrong_reply_fails_even_where_another_is_missing(path: Path) -> None:
    one, two, three = replies()
    verdict = expecting(path, [one + b"x", two, three], answers=0)
    assert verdict.checks["expected_replies"] == "fail"
    assert [one for one in verdict.reasons if one.startswith("expected_replies")] == [
        f"expected_replies: request 1: found {len(one)} bytes, expected {len(one) + 1} bytes",
        "expected_replies: no reply to 1 of 3 requests, the first is request 3",
    ]


def test_without_expected_replies_there_is_no_such_check(path: Path) -> None:
    assert "expected_replies" not in whole(path).verdict().checks


@pytest.mark.parametrize(
    ("stored", "finding", "reason"),
    [
        (sample_requests(7, 2), "fail", "request 3: not that of requests.msgpack"),
        (sample_requests(8, 3), "fail", "request 1: not that of requests.msgpack"),
        (None, "unknown", "requests.msgpack is missing"),
    ],
    ids=["fewer", "others", "none"],
)
def test_requests_that_are_not_those_given_do_not_pass(
    path: Path, stored: list[bytes] | None, finding: str, reason: str
) -> None:
    expecting(path, replies())
    (path / REQUESTS_NAME).unlink()
    if stored is not None:
        (path / REQUESTS_NAME).write_bytes(msgspec.msgpack.encode(stored))
    verdict = judge(read_record(path))
    assert verdict.checks["sources_agree"] == finding
    assert f"sources_agree: {reason}" in verdict.reasons


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        (REQUESTS_NAME, b"\xc1", "requests.msgpack: "),
        (REQUESTS_NAME, msgspec.msgpack.encode([1]), "requests.msgpack: Expected `bytes`"),
        (REQUESTS_NAME, msgspec.msgpack.encode([]), "requests.msgpack: no request in it"),
        (
            EXPECTED_NAME,
            msgspec.msgpack.encode(ExpectedReplies((), "x:u9")),
            "expected.msgpack: column 1, x: unknown type 'u9'",
        ),
        (
            EXPECTED_NAME,
            msgspec.msgpack.encode(ExpectedReplies((), "x:u8", -1.0)),
            "expected.msgpack: tolerance: found -1.0",
        ),
    ],
)
def test_files_of_requests_that_are_none_are_told(path: Path, name: str, content: bytes, words: str) -> None:
    expecting(path, replies())
    (path / name).write_bytes(content)
    with pytest.raises(ConfigError) as found:
        read_record(path)
    assert words in str(found.value)


# -- loads and adaptations


def test_a_load_that_its_user_stopped_is_judged_by_what_it_did(path: Path) -> None:
    record = whole(path)
    record.asked = 5
    assert record.end is not None
    record.end["reason"] = "stopped"
    assert record.verdict().verdict == "pass"


def test_an_adaptation_that_was_done_is_told(path: Path) -> None:
    record = adapted(path, (AT_2,), DONE)
    record.host(ftm="lfr", bricks=[[b.name, b.kind] for b in build("lfr", "process").bricks])
    verdict = record.verdict()
    assert (verdict.verdict, verdict.checks["adaptations_done"]) == ("pass", "pass")
    assert verdict.adaptations == [
        AskedAdaptation("to lfr at request 2", "done", blackout_ms=1.5, total_ms=120.0)
    ]
    assert (verdict.ftm, verdict.ftm_at_end) == ("pbr", "lfr")


@pytest.mark.parametrize(
    ("asked", "changes", "reason"),
    [
        ((AT_2,), [DONE | {"outcome": "rolled back", "reason": "b died"}], "rolled back: b died"),
        ((AT_2,), [DONE | {"outcome": "refused", "reason": "no backup"}], "refused: no backup"),
        ((AT_2,), [], "not ended: the run ended before it"),
    ],
)
def test_one_that_was_not_done_proves_nothing(
    path: Path, asked: tuple[Scheduled, ...], changes: list[dict[str, object]], reason: str
) -> None:
    verdict = adapted(path / "1", asked, *changes).verdict()
    assert (verdict.verdict, verdict.checks["adaptations_done"]) == ("inconclusive", "unknown")
    assert verdict.reasons == [f"adaptations_done: to lfr at request 2: {reason}"]
    may_fail = tuple(replace(one, goal=replace(one.goal, may_fail=True)) for one in asked)
    changes = [one | {"may_fail": True} for one in changes]
    assert adapted(path / "2", may_fail, *changes).verdict().verdict == "pass"


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        (Scheduled(Goal(expression="lfr"), at_request=5000), "request 5000 was never sent, 3 was the last"),
        (Scheduled(Goal(expression="lfr"), after_ms=20_000), "the run ended after 1.5 s"),
    ],
)
def test_one_whose_time_never_came_proves_nothing(path: Path, asked: Scheduled, reason: str) -> None:
    verdict = adapted(path, (asked,)).verdict()
    assert verdict.verdict == "inconclusive"
    assert verdict.reasons == [f"adaptations_done: {asked}: not begun: {reason}"]


def test_one_that_was_asked_for_while_it_ran_is_told_behind_them(path: Path) -> None:
    live = {"outcome": "rolled back", "reason": "b died", "asked": "to lfr+tr"}
    verdict = adapted(path, (AT_2,), live, DONE | {"ftm": "pbr"}).verdict()
    assert [one.asked for one in verdict.adaptations] == ["to lfr at request 2", "to lfr+tr"]
    assert verdict.reasons == ["adaptations_done: to lfr+tr: rolled back: b died"]
