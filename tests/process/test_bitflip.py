"""A bit flipped in one execution of one replica reaches the client where nothing compares; TR outvotes it.

Which requests a run serves, and so which bit means what, is fixed by its seed.
"""

import os
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest
from liveruns import ENDLESS, Done, Home, Started, aftbed, state_of, under_load, until
from sampling import every, sampled

from aftbed.core.events import Event
from aftbed.core.graph import PLACEMENTS
from aftbed.core.journal import Record
from aftbed.ftm.compose import EXPRESSIONS, replication_of
from aftbed.inject.model import parse
from aftbed.judge.intervals import Reaction
from aftbed.judge.record import RunRecord, read_record
from aftbed.judge.verdict import Verdict
from aftbed.runtime.unix import control_client, run_directory
from aftbed.runtime.unix.options import LoadRun

pytestmark = pytest.mark.process

COUNT: Final = 100  # requests
LOAD: Final = ("--load", str(COUNT))  # each follows the reply before it
HIT: Final = 40  # the request that is hit; TR executes each twice
PACED: Final = ("--load", "300@100")  # 3 s: a new backup has time to come, on a busy machine, too
STAGE: Final = 8  # bit 0 of byte 1 of a reply: of the stage
COUNTER: Final = 8  # bit 0 of byte 1 of a state: of the counter of the frames
VERSION: Final = 0  # bit 0 of a state: no function takes a state of another version
WITH_TR: Final = tuple(e for e in EXPRESSIONS if e.endswith("tr"))
WITHOUT: Final = ("none", "pbr", "lfr")


class Ran:
    """A run that has ended, by its document and its record."""

    def __init__(self, done: Done, record: RunRecord) -> None:
        self.code, self.record = done.code, record
        self.verdict: Verdict = done.verdict()
        self.receipts = [fault.receipt.value for fault in self.verdict.faults]
        self.details = [fault.detail for fault in self.verdict.faults]

    def events(self, *wanted: Event) -> list[Record]:
        return self.record.history.events(*wanted)

    def hits(self) -> list[tuple[str, int]]:
        """Which node was hit at which request, by time."""
        return [(r.node, r.request_id) for r in self.events(Event.FAULT_APPLIED) if r.request_id]


def served(
    folder: Path,
    ftm: str,
    *faults: str,
    placement: str = "process",
    seed: int = 0,
    work: tuple[str, ...] = LOAD,
) -> Ran:
    """A run under `ftm`, with these faults."""
    path = folder / f"record{len(list(folder.iterdir()))}"
    injected = [word for fault in faults for word in ("--inject", fault)]
    options = ("--placement", placement, "--seed", str(seed), "--record", path, "--json")
    done = aftbed("run", "--ftm", ftm, *work, *options, *injected)
    assert done.out, done.err
    return Ran(done, read_record(path))


def assert_served(ran: Ran) -> None:
    """The client has noticed nothing."""
    requests = ran.verdict.requests
    assert requests.sent == requests.answered == COUNT
    assert (requests.wrong, requests.lost, requests.duplicated) == (0, 0, 0)
    assert ran.verdict.failovers == []


# -- where nothing compares


@pytest.mark.parametrize("ftm", every(2, WITHOUT))
def test_a_flipped_result_reaches_the_client_and_fails(tmp_path: Path, ftm: str) -> None:
    ran = served(tmp_path, ftm, f"bitflip result bit {STAGE} at server.exit nth {HIT}")
    assert ran.code == 1 and ran.verdict.verdict == "fail"
    assert ran.verdict.requests.wrong == 1
    assert ran.verdict.checks["value"] == ran.verdict.checks["one_history"] == "fail"
    assert f"value: request {HIT}: sdc: stage 0 instead of 1" in ran.verdict.reasons
    assert ran.receipts == ["activated"]
    assert ran.details == [f"bit {STAGE} of the result of request {HIT} in a/server"]
    assert ran.hits() == [("a/server", HIT)]
    assert [(one.reaction, one.fhti_ms) for one in ran.verdict.intervals] == [(Reaction.NONE, None)]


def test_a_flipped_state_stays_wrong(tmp_path: Path) -> None:
    ran = served(tmp_path, "pbr", f"bitflip state bit {COUNTER} nth {HIT}")
    assert ran.code == 1
    assert ran.verdict.requests.wrong == COUNT - HIT, "the reply was there before the hit"
    assert f"value: request {HIT + 1}: sdc: counter 11 instead of 10" in ran.verdict.reasons


def test_a_state_that_is_wrong_is_the_backups_too(tmp_path: Path) -> None:
    """The checkpoint carries the flipped bit, so the failover does not heal it."""
    flip, crash = f"bitflip state bit {COUNTER} nth {HIT}", "crash primary at request.received nth 70"
    ran = served(tmp_path, "pbr", flip, crash)
    assert ran.receipts == ["activated", "activated"]
    assert len(ran.verdict.failovers) == 1 and ran.verdict.requests.wrong == COUNT - HIT


def test_a_drive_says_what_the_brakes_were_asked_for() -> None:
    hit = 100  # by then it warns
    flip = f"bitflip result bit {STAGE} nth {hit}"
    done = aftbed("run", "--scenario", "ccrs-20", "--pace", "max", "--inject", flip)
    assert done.code == 1, done.out + done.err
    assert "1 wrong" in done.out and "verdict: fail" in done.out
    assert f"because    value: request {hit}: sdc: stage 0 instead of 1" in done.out
    assert f"activated, bit {STAGE} of the result of request {hit} in a/server" in done.out
    assert "  car        stopped " in done.out


# -- time redundancy


PLACES: Final = (f"result bit {STAGE}", f"state bit {COUNTER}")
RUNS: Final = {"first run": 2 * HIT - 1, "second run": 2 * HIT}


@pytest.mark.parametrize(("ftm", "place", "run"), sampled(WITH_TR, PLACES, tuple(RUNS)))
def test_a_third_run_outvotes_the_one_that_was_hit(tmp_path: Path, ftm: str, place: str, run: str) -> None:
    ran = served(tmp_path, ftm, f"bitflip {place} at server.exit nth {RUNS[run]}")
    assert ran.code == 0, ran.verdict.reasons
    assert_served(ran)
    assert (ran.verdict.checks["value"], ran.receipts, ran.hits()) == (
        "pass",
        ["activated"],
        [("a/server", HIT)],
    )
    votes = [r for r in ran.events(Event.VOTE_COMPARED) if r.node.startswith("a/")]
    assert [r.request_id for r in votes if r.detail == 3] == [HIT]
    assert len(votes) == COUNT
    exits = [r for r in ran.events(Event.SERVER_EXIT) if r.node == "a/server" and r.request_id == HIT]
    assert len(exits) == 3


@pytest.mark.parametrize(("ftm", "placement"), sampled(WITH_TR, PLACEMENTS))
def test_bits_of_several_requests_are_outvoted_in_every_placement(
    tmp_path: Path, ftm: str, placement: str
) -> None:
    where = (("result", 20), (f"state bit {COUNTER}", 61), ("result", 142))
    ran = served(tmp_path, ftm, *(f"bitflip {place} nth {nth}" for place, nth in where), placement=placement)
    assert_served(ran)
    assert ran.receipts == ["activated"] * 3 and ran.verdict.checks["value"] == "pass"
    assert len([r for r in ran.events(Event.VOTE_COMPARED) if r.detail == 3]) == 3


def test_what_is_hit_before_the_first_run_is_in_all_of_them(tmp_path: Path) -> None:
    """The limit of TR, and no more is promised: a fault of one execution is what it outvotes."""
    ran = served(tmp_path, "tr", f"bitflip state bit {COUNTER} at state.captured nth {HIT}")
    assert ran.code == 1 and ran.receipts == ["activated"]
    assert ran.verdict.checks["value"] == "fail"
    assert f"value: request {HIT}: sdc: counter 8 instead of 9" in ran.verdict.reasons


# -- the other replica


def test_a_follower_that_was_hit_has_diverged_and_the_client_has_its_reply(tmp_path: Path) -> None:
    ran = served(tmp_path, "lfr", f"bitflip result bit {STAGE} in backup nth {HIT}")
    assert ran.verdict.requests.wrong == 0 and ran.receipts == ["activated"]
    assert ran.hits() == [("b/server", HIT)]
    assert [(r.node, r.request_id) for r in ran.events(Event.FOLLOWER_DIVERGED)] == [("b/after", HIT)]


@pytest.mark.parametrize("ftm", every(3, [e for e in WITH_TR if replication_of(e)]))
def test_a_bit_of_the_backup_is_no_concern_of_the_client(tmp_path: Path, ftm: str) -> None:
    executes = ftm.startswith("lfr")
    fault = "result in backup nth" if executes else f"state bit {COUNTER} in b at state.restored nth"
    ran = served(tmp_path, ftm, f"bitflip {fault} {HIT}")
    assert_served(ran)
    assert ran.code == 0, ran.verdict.reasons
    assert [node for node, _ in ran.hits()] == ["b/server"]
    assert ran.events(Event.FOLLOWER_DIVERGED) == []


# -- receipts


def test_a_bit_beyond_the_end_was_not_flipped_and_proves_nothing(tmp_path: Path) -> None:
    ran = served(tmp_path, "pbr", f"bitflip result bit 500 nth {HIT}")
    assert ran.code == 3 and ran.receipts == ["not_activated"]
    assert re.fullmatch(rf"there are [0-9]+ bits of the result of request {HIT} in a/server", ran.details[0])
    assert_served(ran)


def test_a_state_that_the_function_refuses_was_not_flipped(tmp_path: Path) -> None:
    ran = served(tmp_path, "pbr", f"bitflip state bit {VERSION} nth {HIT}")
    assert ran.code == 3 and ran.receipts == ["not_activated"]
    assert ran.details == [f"the function refused bit {VERSION} of the state of request {HIT} in a/server"]
    assert ran.verdict.checks["faults_applied"] == "unknown"
    assert_served(ran)


def test_a_bit_that_is_not_named_is_drawn_by_the_seed_and_reported(tmp_path: Path) -> None:
    one, again, other = (
        served(tmp_path, "pbr", f"bitflip result nth {HIT}", seed=seed) for seed in (1, 1, 2)
    )
    assert one.details == again.details and one.details != other.details
    for ran in (one, other):
        assert re.fullmatch(rf"bit [0-9]+ of the result of request {HIT} in a/server", ran.details[0])


# -- when


def test_each_of_several_strikes_at_its_own_execution(tmp_path: Path) -> None:
    """They wait for the same event in the same node, and were not armed in their order."""
    ran = served(tmp_path, "pbr", *(f"bitflip result bit {STAGE} nth {nth}" for nth in (80, 20, 50)))
    assert ran.hits() == [("a/server", 20), ("a/server", 50), ("a/server", 80)]
    assert ran.verdict.requests.wrong == 3 and ran.receipts == ["activated"] * 3


@pytest.mark.parametrize("placement", ["process", "replica"])
def test_a_bitflip_follows_the_leader_over_a_failover(tmp_path: Path, placement: str) -> None:
    flip, crash = f"bitflip result bit {STAGE} nth 200", "crash primary at reply.sent nth 80"
    ran = served(tmp_path, "pbr", flip, crash, placement=placement, work=PACED)
    assert ran.receipts == ["activated", "activated"] and len(ran.verdict.failovers) == 1
    ((node, request_id),) = ran.hits()
    assert node.startswith("b") and request_id >= 200  # what comes before it has moved is not counted


def test_a_replica_is_hit_whatever_its_role_is_by_then(tmp_path: Path) -> None:
    flip, crash = f"bitflip result bit {STAGE} in a nth 120", "crash primary at reply.sent nth 80"
    ran = served(tmp_path, "lfr", flip, crash, work=PACED)
    assert ran.receipts == ["activated", "activated"] and len(ran.verdict.failovers) == 1
    ((node, request_id),) = ran.hits()
    assert node == "a/server" and request_id >= 120, "as a follower, in its next life"
    assert ran.verdict.requests.wrong == 0


# -- in a live run


def test_a_live_run_is_hit_from_a_second_command(home: Home) -> None:
    with under_load(home, ENDLESS) as started:
        done = aftbed("inject", "bitflip", "result", "--bit", str(STAGE), "--nth", "5")
        assert done.code == 0, done.err
        assert "bitflip result bit 8 in primary at server.exit nth 5" in done.err
        told = started.wait_for("fault", "activated")
        outcome = started.stop()
    assert outcome.verdict.requests.wrong == 1 and outcome.verdict.verdict == "fail"
    (fault,) = outcome.verdict.faults
    assert str(told["text"]) == f"{fault.fault}: activated, {fault.detail}"


@contextmanager
def held_in_its_launch(home: Home) -> Iterator[tuple[Started, int]]:
    """A run, and the zygote that its launch waits for: it is stopped. A launch may be quicker than we are."""
    for _ in range(5):
        with Started(home, LoadRun(ENDLESS, 200.0)) as started:
            until(
                lambda: run_directory.live() and any(row.role == "zygote" for row in started.rows()),
                "a zygote",
            )
            zygote = next(row.pid for row in started.rows() if row.role == "zygote")
            os.kill(zygote, signal.SIGSTOP)
            until(lambda: state_of(zygote) == "T", "it to stop")  # noqa: B023
            if "launch" in str(started.status()["busy"]):
                yield started, zygote
                return
    pytest.fail("no launch was caught under way")


def test_what_is_asked_while_a_run_starts_is_done_when_it_has(home: Home) -> None:
    with held_in_its_launch(home) as (started, zygote):
        given_up = control_client.send(started.private, control_client.InjectCommand(parse("crash primary")))
        started.status()
        given_up.close()
        asked = control_client.send(
            started.private, control_client.InjectCommand(parse("bitflip result bit 8"))
        )
        started.status()
        os.kill(zygote, signal.SIGCONT)
        control_client.receive(asked)
        started.wait_for("fault", "activated")
        outcome = started.stop()
    ((fault, receipt),) = [(fault.fault, fault.receipt.value) for fault in outcome.verdict.faults]
    assert fault.startswith("bitflip") and receipt == "activated", "who has given up is not obeyed"


def test_after_a_while_the_next_execution_is_hit(home: Home) -> None:
    with under_load(home, ENDLESS) as started:
        done = aftbed("inject", "bitflip", "result", "--replica", "a", "--bit", "8", "--after", "100ms")
        assert done.code == 0, done.err
        started.wait_for_answers(started.answered() + 75)  # at 200 a second: that is behind the hit
        outcome = started.stop()
    (fault,) = outcome.verdict.faults
    assert fault.receipt.value == "activated"
    assert fault.fault == "bitflip result bit 8 in a after 100ms"
    assert outcome.verdict.requests.wrong == 1


def test_what_cannot_be_flipped_is_refused_and_the_run_goes_on(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        for arguments, words in (
            (("reslt",), "unknown place of a bitflip 'reslt'; did you mean 'result'?"),
            (("result", "--replica", "c"), "unknown replica 'c'"),
            (("result", "--bit", "-1"), "bit '-1': a whole number from 0"),
            (
                ("state", "--at", "reply.sent"),
                "unknown event for a bit of the state in primary: 'reply.sent'",
            ),
            (("result", "--replica", "backup"), "the Server of a backup executes nothing"),
        ):
            done = aftbed("inject", "bitflip", *arguments)
            assert done.code == 2 and words in done.err, done.err
        assert run.stop().verdict.verdict == "pass"
