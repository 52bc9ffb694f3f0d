"""A field of the state, flipped in memory, in virtual time: it bit, or it healed; the receipt says which."""

from typing import Final

import pytest

from aftbed.core.events import Event
from aftbed.inject.model import parse
from aftbed.judge.checks import corruptions
from aftbed.judge.reference import reference_run
from aftbed.runtime.sim.world import Run, Setup, World, graph_of
from aftbed.vehicle.aeb.function import default_application

COUNT: Final = 40
FLIP: Final = "bitflip state.counter bit 0"  # a state like any other
REFUSED: Final = "bitflip state.counter bit 7"  # no state has such a counter
PLACEMENTS: Final = ("process", "replica", "single")


def played(ftm: str, *texts: str, placement: str = "process") -> Run:
    faults = tuple(map(parse, texts))
    for fault in faults:
        fault.check(graph_of(ftm, placement))
    return World(Setup(ftm, placement, 1, COUNT, 200.0, faults)).run()


def wrong(run: Run) -> list[int]:
    """The requests with a reply that is not the bare server's."""
    return [
        int(text.split()[1].rstrip(":"))
        for text in corruptions(run.history, reference_run(run.history, default_application()))
    ]


def receipts(run: Run) -> list[tuple[str, str]]:
    return [(fault.receipt.value, fault.detail) for fault in run.faults]


def from_(request: int) -> list[int]:
    return list(range(request, COUNT + 1))


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize(
    ("ftm", "event", "first"),
    [
        ("pbr", "request.received nth 10", 10),
        ("pbr", "server.exit nth 10", 11),  # the reply is made; the checkpoint takes it along
        ("lfr", "before.exit nth 10", 10),
        ("pbr+tr", "reply.sent nth 10", 11),  # at rest, between two requests: both executions start from it
    ],
)
def test_where_nothing_compares_the_next_reply_is_wrong_and_all_behind_it(
    ftm: str, event: str, first: int, placement: str
) -> None:
    run = played(ftm, f"{FLIP} at {event}", placement=placement)
    assert wrong(run) == from_(first)
    assert receipts(run) == [("activated", "bit 0 of state.counter in a/server, taken over")]


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_between_capture_and_execution_it_is_outvoted(placement: str) -> None:
    """Under PBR+TR the state is captured twice a request: before the first trial, and for the checkpoint."""
    run = played("pbr+tr", f"{FLIP} at state.captured nth 19", placement=placement)
    assert wrong(run) == []
    assert receipts(run) == [("activated", "bit 0 of state.counter in a/server, taken over")]
    assert len(run.history.events(Event.SERVER_EXIT)) == 2 * COUNT + 1, "a third trial of request 10"
    assert len(set(run.rest.states.values())) == 1


@pytest.mark.parametrize("ftm", ["pbr", "lfr", "pbr+tr"])
def test_a_state_that_the_function_refuses_ends_its_node_and_no_more(ftm: str) -> None:
    run = played(ftm, f"{REFUSED} at reply.sent nth 10")
    assert wrong(run) == [] and run.rest.leader == "b" and run.rest.why_not == ()
    said = "bit 7 of state.counter in a/server, refused: its node has ended itself"
    assert receipts(run) == [("activated", said)]
    assert len(run.history.events(Event.DETECTED_STOP)) == 1
    assert len(set(run.rest.states.values())) == 1, "the new backup has not read the cell of the dead one"


def test_what_is_not_read_any_more_is_latent() -> None:
    run = played("pbr", f"{FLIP} at reply.delivered nth {COUNT}")
    assert wrong(run) == []
    said = "bit 0 of state.counter in a/server, not used so far, or covered up before"
    assert receipts(run) == [("applied", said)]
    assert run.rest.states["a"] != run.rest.states["b"], "seen at the end, and not by looking"


def test_a_checkpoint_covers_up_what_was_flipped_in_the_backup() -> None:
    run = played("pbr", f"{FLIP} in backup at server.exit nth 10")
    assert wrong(run) == [] and [r for r, _ in receipts(run)] == ["applied"]
    assert len(set(run.rest.states.values())) == 1


def test_a_follower_goes_on_with_it() -> None:
    run = played("lfr", f"{FLIP} in backup at reply.sent nth 10")
    assert wrong(run) == [] and [r for r, _ in receipts(run)] == ["activated"]
    assert len(run.history.events(Event.FOLLOWER_DIVERGED)) == COUNT - 10
    assert len(set(run.rest.states.values())) == 2


def test_the_cell_of_a_dead_replica_is_not_read() -> None:
    """What is flipped in the old cell dies with it; who takes its place is hit in a cell of its own."""
    old = f"{FLIP} in a at before.exit nth 10"
    crash = "crash a/server at proceed.enter nth 10"
    run = played("lfr", old, crash)
    assert wrong(run) == [] and run.rest.leader == "b"
    assert [r for r, _ in receipts(run)] == ["applied", "activated"]
    assert len(set(run.rest.states.values())) == 1
    run = played("lfr", old, crash, f"{FLIP} in a at reply.delivered nth 30")
    assert [r for r, _ in receipts(run)] == ["applied", "activated", "activated"]
    assert wrong(run) == [] and len(set(run.rest.states.values())) == 2


def test_a_fault_moves_with_the_role_and_finds_a_cell_there() -> None:
    run = played("pbr", "crash primary at request.received nth 5", f"{FLIP} at reply.sent nth 20")
    first = wrong(run)[0]  # a reply that the new leader sends before the fault has come to it is not counted
    assert first in (21, 22) and wrong(run) == from_(first) and run.rest.leader == "b"
    assert receipts(run)[1] == ("activated", "bit 0 of state.counter in b/server, taken over")


def test_a_bit_that_is_stuck_at_what_it_is_changes_nothing() -> None:
    run = played("pbr", "bitflip state.counter stuck 7=0 at reply.sent nth 10")
    assert receipts(run) == [("not_activated", "stuck 7=0 of state.counter in a/server: it is so already")]
    assert wrong(run) == []


@pytest.mark.parametrize("when", ["", " after 50ms"])
def test_memory_is_there_at_any_time(when: str) -> None:
    run = played("pbr", f"bitflip state.t_ms bit 2{when}")
    assert [r for r, _ in receipts(run)] == ["activated"]


def test_two_faults_in_one_cell_have_a_receipt_each() -> None:
    """The cell was made for the first, which never comes to its point."""
    never, second = f"{FLIP} at reply.sent nth 1000", "bitflip state.counter bit 1 at reply.sent nth 10"
    run = played("pbr", never, second, f"bitflip state.counter bit 2 at reply.delivered nth {COUNT}")
    assert [r for r, _ in receipts(run)] == ["armed", "activated", "applied"]


def test_the_same_seed_hits_the_same_bit() -> None:
    first, second = (played("pbr", "bitflip state.track0.range_m at reply.sent nth 10") for _ in range(2))
    assert first.faults == second.faults and first.rest.states == second.rest.states
