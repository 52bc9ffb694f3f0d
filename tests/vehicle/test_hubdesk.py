"""Conditions of the car that others wait for: who is told, and when the car is answered."""

import socket
from collections.abc import Iterator

import pytest

from aftbed.core.busfault import Condition, Struck
from aftbed.vehicle.can.hub import Client, Hub, Watches

TTC = Condition("ttc", True, 1.2)


class Noting:
    """A desk that keeps what it is told; the line of the car and its answers are kept, too."""

    def __init__(self, *, lockstep: bool) -> None:
        self.told, self.answered, self.lines = list[tuple[int, int, int]](), list[Client](), list[bytes]()
        self.watches = Watches(self.lines.append, self.answered.append, self, lockstep=lockstep)

    def attend(self, hub: Hub) -> bool:
        return True

    def report(self, news: list[Struck]) -> None:
        raise AssertionError(f"no fault of the bus: {news}")

    def met(self, fault_number: int, t_us: int, since_ns: int) -> None:
        self.told.append((fault_number, t_us, since_ns))


@pytest.fixture
def car() -> Iterator[Client]:
    with socket.socket() as sock:
        yield Client(sock)


def test_in_lockstep_the_car_is_answered_when_it_is_done(car: Client) -> None:
    desk = Noting(lockstep=True)
    desk.watches.watch(7, TTC)
    assert desk.lines == [b"< watch 7 ttc below 1.2 >"]
    desk.watches.met(7, 2_000, 123, car)
    assert desk.told == [(7, 2_000, 0)] and desk.answered == []
    desk.watches.go_on(8)
    assert desk.answered == [], "that was another fault"
    desk.watches.go_on(7)
    desk.watches.go_on(7)
    assert desk.answered == [car]


def test_in_real_time_it_is_answered_at_once_and_the_desk_told_since_when(car: Client) -> None:
    desk = Noting(lockstep=False)
    desk.watches.watch(7, TTC)
    desk.watches.met(7, 2_000, 123, car)
    assert desk.told == [(7, 2_000, 123)] and desk.answered == [car]
    desk.watches.go_on(7)
    assert desk.answered == [car]


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_condition_is_met_once_and_those_of_the_bus_are_not_ours(car: Client, lockstep: bool) -> None:
    desk = Noting(lockstep=lockstep)
    desk.watches.watch(7, TTC)
    desk.watches.met(8, 1_000, 5, car)
    assert desk.told == [] and desk.answered == [car]
    desk.watches.met(7, 2_000, 6, car)
    desk.watches.met(7, 3_000, 7, car)
    assert len(desk.told) == 1 and desk.watches.lines() == b""


def test_a_car_that_comes_later_is_told_all(car: Client) -> None:
    desk = Noting(lockstep=True)
    desk.watches.watch(7, TTC)
    desk.watches.watch(8, Condition("gap", False, 30.5))
    assert desk.watches.lines() == b"< watch 7 ttc below 1.2 >< watch 8 gap above 30.5 >"
