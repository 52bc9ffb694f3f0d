"""The checkers: each one passes a good history, and refuses every history in which its promise is broken.

Each broken history differs from a good one by one thing.
"""

from collections.abc import Callable

import pytest
from tales import Tale, good, judged

from aftbed.core.events import Event
from aftbed.judge import checks
from aftbed.judge.checks import REASONS_MAX, Check


def test_a_good_history_passes_every_check() -> None:
    assert set(judged(good()).values()) == {Check("pass")}


@pytest.mark.parametrize(
    ("broken", "promise", "reason"),
    [
        (
            lambda: good().executed(3, "b/server.1"),
            "at_most_once",
            "b/server.1: request 3 (server.exit) after 3",
        ),
        (
            lambda: Tale().served(1).restored(1, "a/server.1"),
            "at_most_once",
            "a/server.1: request 1 (state.restored) after 1",
        ),
        (
            lambda: Tale().served(1).executed(1, "b/server.1"),
            "at_most_once",
            "b/server.1: request 1 (server.exit) after 1",
        ),
        (
            lambda: Tale().served(1).served(2).restored(1, "b/server.1"),
            "at_most_once",
            "b/server.1: request 1 (state.restored) after 2",
        ),
        (
            lambda: Tale().served(1).rerun(1).executed(1),  # after the vote, from the state after it
            "at_most_once",
            "a/server.1: request 1 (server.exit) after 1",
        ),
        (
            lambda: Tale().served(1).served(2).rerun(1),  # undoes what 2 did
            "at_most_once",
            "a/server.1: request 1 (server.exit) after 2",
        ),
        (
            lambda: Tale().served(1).rerun(1, "b/server.1"),  # of a checkpoint, not of an execution
            "at_most_once",
            "b/server.1: request 1 (server.exit) after 1",
        ),
        (
            lambda: Tale().served(1).rerun(1).restored(1, "a/server.1"),
            "at_most_once",
            "a/server.1: request 1 (state.restored) after 1",
        ),
        (lambda: good().sent(4), "exactly_one_answer", "request 4: 0 replies"),
        (
            lambda: good().answered(3, payload=good().dialogue[-1].payload),
            "exactly_one_answer",
            "request 3: 2 replies",
        ),
        (
            lambda: good().note("client.1", Event.PEER_REFUSED, 3),
            "exactly_one_answer",
            "request 3: one reply too many reached the client",
        ),
        (lambda: good().answered(4, epoch=2), "exactly_one_answer", "request 4: answered, but never sent"),
        (
            lambda: Tale().sent(1).answered(1, payload=b"00000000"),
            "one_history",
            "request 1: the reply is not the bare server's",
        ),
        (
            lambda: Tale().served(1).sent(2).answered(2, payload=b""),
            "one_history",
            "request 2: the reply is not the bare server's",
        ),
        (
            lambda: Tale().sent(1).sent(2).answered(2).answered(1),  # executed in the wrong order
            "one_history",
            "request 1: the reply is not the bare server's",
        ),
        (lambda: Tale().served(2).served(1), "one_history", "the ids of the requests are not 1, 2, 3, ..."),
        (lambda: Tale().served(1).served(3), "one_history", "the ids of the requests are not 1, 2, 3, ..."),
        (lambda: Tale().served(1).sent(1), "one_history", "the ids of the requests are not 1, 2, 3, ..."),
        (
            lambda: good().accepted(3, epoch=1, replica=1),
            "one_master",
            "a reply of epoch 1 accepted after one of epoch 2",
        ),
        (
            lambda: good().accepted(4, epoch=2, replica=1),
            "one_master",
            "epoch 2: replies of replicas 2 and 1",
        ),
        (
            lambda: Tale().served(1).promoted(2).served(2, epoch=2, replica=2),
            "one_master",
            "replica 1 was not fenced between epochs 1 and 2",
        ),
        (
            lambda: Tale().served(1).fenced(2).promoted(2).served(2, epoch=2, replica=2),  # the wrong one
            "one_master",
            "replica 1 was not fenced between epochs 1 and 2",
        ),
        (
            lambda: Tale().served(1).promoted(2).served(2, epoch=2, replica=2).fenced(1),  # too late
            "one_master",
            "replica 1 was not fenced between epochs 1 and 2",
        ),
    ],
)
def test_a_broken_history_is_refused_by_its_check(
    broken: Callable[[], Tale], promise: str, reason: str
) -> None:
    found = judged(broken())[promise]
    assert found.finding == "fail" and reason in found.reasons


def test_what_one_server_did_is_not_held_against_the_next() -> None:
    """The effect of a request that died with its replica was never applied to what goes on."""
    tale = Tale().served(1).sent(2).executed(2).fenced(1).promoted(2).executed(2, "b/server.1")
    assert checks.at_most_once(tale.history()) == Check("pass")
    tale.executed(3, "a/server.1").executed(3, "a/server.2")
    assert checks.at_most_once(tale.history()) == Check("pass")


def test_a_rerun_stands_in_the_place_of_the_run_before_it() -> None:
    """A vote of two, a vote of three, and what follows: one effect for each request."""
    tale = Tale().sent(1).executed(1).rerun(1).sent(2).executed(2).rerun(2).rerun(2).executed(3)
    assert checks.at_most_once(tale.history()) == Check("pass")


def test_a_refusal_of_something_else_is_no_second_answer() -> None:
    tale = good().note("client.1", Event.PEER_REFUSED, 0).note("proxy.1", Event.PEER_REFUSED, 3)
    assert checks.exactly_one_answer(tale.history()) == Check("pass")


def test_a_reply_that_was_on_its_way_may_be_accepted_behind_the_fence() -> None:
    """The fence ends a channel after what was sent: its master is none, its last reply is still one."""
    tale = Tale().served(1).sent(2).executed(2).restored(2)
    tale.fenced(1).accepted(2, epoch=1, replica=1).answered(2)
    tale.promoted(2).served(3, epoch=2, replica=2)
    assert set(judged(tale).values()) == {Check("pass")}


def test_epochs_without_a_reply_are_skipped() -> None:
    tale = Tale().served(1).fenced(1).promoted(2).fenced(2).promoted(3).served(2, epoch=3, replica=1)
    assert checks.one_master(tale.history()) == Check("pass")


def test_each_failover_needs_its_own_fence() -> None:
    tale = good().promoted(3).served(4, epoch=3, replica=1)
    assert checks.one_master(tale.history()).reasons == ("replica 2 was not fenced between epochs 2 and 3",)


def test_an_empty_history_is_unknown_and_no_pass() -> None:
    found = judged(Tale())
    assert {name for name, c in found.items() if c.finding == "unknown"} == {
        "exactly_one_answer",
        "one_history",
        "one_master",
    }


def test_the_first_few_reasons_are_given() -> None:
    tale = Tale()
    for number in range(1, 2 * REASONS_MAX):
        tale.sent(number)
    assert len(checks.exactly_one_answer(tale.history()).reasons) == REASONS_MAX


def test_a_request_that_the_function_refuses_is_answered_with_nothing() -> None:
    tale = Tale().sent(1, b"").answered(1, payload=b"").served(2)
    assert judged(tale)["one_history"] == Check("pass")
