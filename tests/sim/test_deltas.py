"""With small pages, the checkpoints of the built-in function travel as those of a large state do."""

from collections.abc import Iterator
from typing import Final

import pytest

from aftbed.core.events import Event
from aftbed.core.messages import Goal, Pages, Scheduled
from aftbed.ftm import pages
from aftbed.inject.model import FaultReport, parse
from aftbed.judge.checks import corruptions
from aftbed.judge.reference import reference_run
from aftbed.judge.simulated import breaches
from aftbed.runtime.sim.world import Run, Setup, simulate
from aftbed.search.explore import PAGE_BYTES
from aftbed.vehicle.aeb.function import default_application

COUNT: Final = 40
RATE_HZ: Final = 200.0
STATE_BITS: Final = 8 * len(default_application().capture())
COUNTER_BIT: Final = 8  # in the first page, which each request changes
UNTOUCHED_BIT: Final = STATE_BITS - 1  # of the last track, which these requests do not have
FIELD_BIT: Final = 8 * 24 + 3  # of `clear_ms`


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Pages]]:
    """What the leaders' Servers made, in order."""
    found: list[Pages] = []
    right = pages.sealed

    def sealed(one: Pages) -> Pages:
        found.append(right(one))
        return found[-1]

    monkeypatch.setattr(pages, "sealed", sealed)
    yield found


def played(*texts: str, ftm: str = "pbr", placement: str = "process", page_bytes: int = PAGE_BYTES) -> Run:
    faults = tuple(map(parse, texts))
    return simulate(Setup(ftm, placement, 1, COUNT, RATE_HZ, faults, page_bytes=page_bytes))


def receipts(run: Run) -> list[str]:
    return [fault.receipt.value for fault in run.faults]


def refused(run: Run) -> list[int]:
    """The requests at which a brick stopped itself."""
    return [r.request_id for r in run.history.events(Event.DETECTED_STOP)]


def wrong(run: Run) -> list[str]:
    return corruptions(run.history, reference_run(run.history, default_application()))


@pytest.mark.parametrize("placement", ["process", "replica"])
@pytest.mark.parametrize("ftm", ["pbr", "pbr+tr", "pbr+assert"])
def test_a_new_leader_goes_on_from_the_pages_that_it_got(ftm: str, placement: str, sent: list[Pages]) -> None:
    run = played("crash primary at checkpoint.sent nth 12", ftm=ftm, placement=placement)
    assert breaches(run) == () and receipts(run) == ["activated"] and run.rest.leader == "b"
    whole = [at for at, one in enumerate(sent, 1) if not one.base]
    assert len(sent) == COUNT and whole[0] == 1 and min(whole[1:]) > 12, "until the failover: changes"
    assert len(whole) < 5, "until there is a new backup, and one for that"
    assert sum(len(one.data) for one in sent if one.base) < 100 * COUNT


@pytest.mark.parametrize("ftm", ["pbr", "pbr+tr"])
def test_a_new_backup_gets_all_of_it_once(ftm: str, sent: list[Pages]) -> None:
    run = played("crash backup at checkpoint.applied nth 12", ftm=ftm)
    assert breaches(run) == () and refused(run) == []
    assert [one.base == 0 for one in sent[-20:]] == [False] * 20


def test_adaptations_there_and_back_leave_no_pages_of_another_time(sent: list[Pages]) -> None:
    ways = ("pbr+tr", "lfr", "pbr", "tr", "pbr")
    wanted = tuple(Scheduled(Goal(expression=to), 20 + 80 * at) for at, to in enumerate(ways))
    run = simulate(Setup("pbr", count=440, rate_hz=400.0, adaptations=wanted, page_bytes=PAGE_BYTES))
    assert [one is not None and one.outcome for one in run.scheduled] == ["done"] * len(ways)
    assert breaches(run) == () and refused(run) == []
    assert 3 <= sum(not one.base for one in sent) < 10 < sum(bool(one.base) for one in sent)


@pytest.mark.parametrize("placement", ["process", "replica"])
@pytest.mark.parametrize("how", ["omission aft2aft nth 5", "omission aft2aft nth 5 intermittent every 9"])
def test_a_lost_checkpoint_costs_the_backup_and_nothing_else(how: str, placement: str) -> None:
    run = played(how, placement=placement)
    assert breaches(run) == () and receipts(run) == ["activated"]
    assert refused(run)[0] == 6, "the one behind it"
    assert run.history.events(Event.BACKUP_READY)


# -- bits of a checkpoint: counted in the whole state, and in the reply behind it


def test_the_checksum_shows_a_bit_of_a_page_on_its_way() -> None:
    flip = f"bitflip checkpoint bit {COUNTER_BIT} nth 5"
    run = played(flip)
    assert receipts(run) == ["activated"] and run.faults[0].detail.startswith(f"bit {COUNTER_BIT} ")
    assert refused(run) == [5] and breaches(run) == () and run.rest.leader == "a"
    whole = played(flip, page_bytes=4096)
    assert receipts(whole) == ["activated"] and refused(whole) == []
    assert whole.faults[0].detail == run.faults[0].detail


def test_a_bit_of_a_page_that_stays_where_it_is_is_not_hit() -> None:
    run = played(f"bitflip checkpoint bit {UNTOUCHED_BIT} nth 5")
    (fault,) = run.faults
    assert isinstance(fault, FaultReport) and fault.receipt.value == "not_activated"
    where = f"bit {UNTOUCHED_BIT} of the checkpoint of request 5 in a/after"
    assert fault.detail == f"{where} did not travel: nothing has changed there"
    assert refused(run) == [] and breaches(run) == ()


def test_a_bit_that_there_is_not_is_not_hit() -> None:
    (fault,) = played("bitflip checkpoint bit 99999 nth 5").faults
    assert fault.receipt.value == "not_activated" and fault.detail.startswith("there are ")
    assert int(fault.detail.split()[2]) > STATE_BITS


@pytest.mark.parametrize("page_bytes", [PAGE_BYTES, 4096])
def test_a_bit_behind_the_state_is_one_of_the_reply(page_bytes: int) -> None:
    crash = "crash primary at checkpoint.sent nth 5"
    run = played(f"bitflip checkpoint bit {STATE_BITS + 8} nth 5", crash, page_bytes=page_bytes)
    assert receipts(run) == ["activated"] * 2
    (text,) = wrong(run)
    assert text.startswith("request 5")


@pytest.mark.parametrize("words", ["", "bits 3", "byte", "burst 3", "byte 0", f"burst 4 bit {COUNTER_BIT}"])
def test_drawn_bits_are_of_what_travels(words: str) -> None:
    run = played(f"bitflip checkpoint {words} nth 5")
    assert receipts(run) == ["activated"] and breaches(run) == ()


# -- bits of the state


def test_the_next_checkpoint_heals_a_bit_in_the_backup() -> None:
    run = played(f"bitflip state bit {FIELD_BIT} in backup at state.restored nth 5")
    assert receipts(run) == ["applied"] and refused(run) == []
    crash = "crash primary at checkpoint.sent nth 6"
    run = played(f"bitflip state bit {FIELD_BIT} in backup at state.restored nth 5", crash)
    assert wrong(run) == [] and len(set(run.rest.states.values())) == 1


@pytest.mark.parametrize("event", ["state.captured", "server.exit"])
def test_the_leader_hands_a_bit_of_its_state_to_the_backup(event: str) -> None:
    run = played(f"bitflip state bit {FIELD_BIT} at {event} nth 5")
    assert receipts(run) == ["activated"] and refused(run) == []
    assert len(set(run.rest.states.values())) == 1, "both have it"


def test_a_field_in_shared_memory_travels_with_its_page() -> None:
    run = played("bitflip state.clear_ms bit 3 at server.exit nth 5")
    assert receipts(run) == ["activated"] and refused(run) == []
    assert len(set(run.rest.states.values())) == 1
