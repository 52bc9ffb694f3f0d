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
    client = RawClient(hub.port, raw=False)
    assert client.ask("< open can0 >") == "< ok >"
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
    with RawClient(hub.port, raw=False) as later:
        assert later.ask("< open can0 >") == "< ok >"
        assert later.ask("< aftbed plant >") == "< ok >"
        assert later.ask("< echo >") == "< echo >", "there is nothing left to watch"


def test_a_car_that_comes_later_is_sent_all_conditions(lockstep: RunningHub) -> None:
    lockstep.order(lambda hub: hub.watch(7, TTC))
    lockstep.order(lambda hub: hub.watch(8, Condition("gap", False, 30.5)))
    with car(lockstep) as plant:
        assert plant.read() == WATCH_7
        assert plant.read() == "< watch 8 gap above 30.5 >"
