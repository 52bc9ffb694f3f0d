"""Conditions of the car that faults beside the bus wait for: when the car is asked, and when answered."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from busharness import RawClient, RunningHub, running_hub

from aftbed.vehicle.can.hub import HubOptions
from aftbed.vehicle.condition import Condition

TTC = Condition("ttc", True, 1.2)
WATCH_7 = "< watch 7 ttc below 1.2 >"


@pytest.fixture(params=[True, False], ids=["lockstep", "real time"])
def paced(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[RunningHub, bool]]:
    with running_hub(tmp_path / "bus.log", HubOptions(lockstep=request.param)) as hub:
        yield hub, request.param


@pytest.fixture
def lockstep(tmp_path: Path) -> Iterator[RunningHub]:
    with running_hub(tmp_path / "bus.log", HubOptions(lockstep=True)) as hub:
        yield hub


def car(hub: RunningHub) -> RawClient:
    client = RawClient(hub.port, raw=False, ours=True)
    assert client.ask("< aftbed plant >") == "< ok >"
    return client


def test_in_lockstep_the_car_is_answered_when_it_is_done(lockstep: RunningHub) -> None:
    with car(lockstep) as plant:
        lockstep.order(lambda hub: hub.watch(7, TTC))
        assert plant.read() == WATCH_7
        plant.write("< aftbed met 7 2000 123 >")
        assert plant.ask("< echo >") == "< echo >", "no answer yet"
        lockstep.order(lambda hub: hub.go_on(8))
        assert plant.ask("< echo >") == "< echo >", "that was another fault"
        lockstep.order(lambda hub: hub.go_on(7))
        lockstep.order(lambda hub: hub.go_on(7))
        assert plant.read() == "< ok >"
        assert plant.ask("< echo >") == "< echo >", "it is answered once"
    assert lockstep.link.conditions_met == [(7, 2_000, 0)]


def test_in_real_time_it_is_answered_at_once_and_reported_with_its_time(hub: RunningHub) -> None:
    with car(hub) as plant:
        hub.order(lambda it: it.watch(7, TTC))
        assert plant.read() == WATCH_7
        assert plant.ask("< aftbed met 7 2000 123 >") == "< ok >"
        hub.order(lambda it: it.go_on(7))
        assert plant.ask("< echo >") == "< echo >"
    assert hub.link.conditions_met == [(7, 2_000, 123)]


def test_a_condition_is_met_once_and_only_if_it_is_watched(paced: tuple[RunningHub, bool]) -> None:
    hub, lockstep = paced
    left: list[tuple[int, Condition]] = []
    with car(hub) as plant:
        hub.order(lambda it: it.watch(7, TTC))
        assert plant.read() == WATCH_7
        assert plant.ask("< aftbed met 8 1000 5 >") == "< ok >"
        plant.write("< aftbed met 7 2000 6 >")
        plant.write("< aftbed met 7 3000 7 >")
        if lockstep:  # the answer to the second comes first
            assert plant.read() == "< ok >"
            hub.order(lambda it: it.go_on(7))
        else:
            assert plant.read() == "< ok >"
        assert plant.read() == "< ok >"
    assert [number for number, _, _ in hub.link.conditions_met] == [7]
    hub.order(lambda it: left.extend(it.conditions()))
    assert left == []


def test_there_is_one_car(hub: RunningHub) -> None:
    """Nobody else says that a condition holds, and nobody takes its place when it is gone."""
    hub.order(lambda it: it.watch(7, TTC))
    with car(hub) as plant, RawClient(hub.port, raw=False, ours=True) as other:
        assert plant.read() == WATCH_7
        assert "another client is the car" in other.ask("< aftbed plant >")
        assert "only the car knows" in other.ask("< aftbed met 7 2000 123 >")
        assert plant.ask("< aftbed plant >") == "< ok >"
        plant.sock.close()
        assert "another client is the car" in other.ask("< aftbed plant >")
    assert hub.link.conditions_met == []


def test_a_car_that_comes_later_is_sent_all_conditions(lockstep: RunningHub) -> None:
    lockstep.order(lambda hub: hub.watch(7, TTC))
    lockstep.order(lambda hub: hub.watch(8, Condition("gap", False, 30.5)))
    with car(lockstep) as plant:
        assert plant.read() == WATCH_7
        assert plant.read() == "< watch 8 gap above 30.5 >"
