"""Experiments over several processes: in order; one that hangs, or whose process dies, is named."""

import itertools
import os
import signal
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from pathlib import Path

import pytest
from campaigns import planned

from aftbed.campaign import runner
from aftbed.core.errors import HarnessError
from aftbed.runtime.sim.world import Setup
from aftbed.runtime.unix import worker_pool
from aftbed.runtime.unix.worker_pool import each
from aftbed.search.explore import explore, explore_orders
from aftbed.search.road_table import RoadLine, driven, drives
from aftbed.vehicle.scenarios.tables import cases

pytestmark = pytest.mark.process

LIMIT_S = 20.0  # what a machine under load may take for a failure that is due after one second


def doubled(number: int) -> int:
    return 2 * number


def hangs_at_five(number: int) -> int:
    while number == 5:
        signal.pause()
    return number


def dies_at_five(number: int) -> int:
    if number == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def heavy(data: bytes) -> bytes:
    return data[::-1]


def fails_at_five(number: int) -> int:
    if number == 5:
        raise ArithmeticError("of its own")
    return number


def late(number: int) -> int:
    raise TimeoutError(f"of its own: {number}")


def workers() -> set[str]:
    """The children of this process."""
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_order(jobs: int) -> None:
    assert list(each(doubled, range(50), jobs)) == [(n, n, 2 * n) for n in range(50)]


def test_one_that_hangs_is_named_with_its_command_and_no_process_is_left() -> None:
    before, began_s = workers(), time.monotonic()
    found = each(hangs_at_five, range(9), 2, alone=lambda number, _: f"run {number}", seconds_max=1.0)
    with pytest.raises(HarnessError) as raised:
        list(found)
    assert str(raised.value) == "experiment 5 hangs, after 1 s there is no result; alone: run 5"
    assert time.monotonic() - began_s < LIMIT_S
    assert workers() <= before


def test_one_whose_process_dies_is_named_and_no_process_is_left() -> None:
    before = workers()
    with pytest.raises(HarnessError) as raised:
        list(each(dies_at_five, range(9), 2, alone=lambda number, _: f"run {number}"))
    said = "experiment 5 has no result, its process has been killed by signal 9; alone: run 5"
    assert str(raised.value) == said
    assert workers() <= before


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize(
    ("judge", "told"),
    [
        (dies_at_five, "5 has been killed by signal 9"),
        (hangs_at_five, "5 was hanging, and was killed after 1 s"),
    ],
)
def test_another_result_takes_the_place_of_one_that_is_lost_and_the_rest_follows(
    judge: Callable[[int], int | str], told: str, jobs: int
) -> None:
    before = workers()
    found = each(judge, range(9), jobs, seconds_max=1.0, apart=True, instead=lambda n, how: f"{n} {how}")
    assert [one for _, _, one in found] == [0, 1, 2, 3, 4, told, 6, 7, 8]
    assert workers() <= before


@pytest.mark.parametrize("fresh", [False, True])
def test_what_is_larger_than_a_pipe_comes_through_and_no_process_is_left(fresh: bool) -> None:
    before = workers()
    setups = [bytes([number]) * 3_000_000 + b"end" for number in range(6)]
    assert [found for _, _, found in each(heavy, setups, 2, fresh=fresh)] == [s[::-1] for s in setups]
    assert workers() <= before


class Unpickled:
    """A judge that does `what` to the process that is told of it."""

    def __init__(self, *what: object) -> None:
        self._what = what

    def __reduce__(self) -> tuple[object, ...]:
        function, *arguments = self._what
        return function, tuple(arguments)

    def __call__(self, setup: bytes) -> bytes:
        return setup


def test_a_worker_that_does_not_get_as_far_as_an_experiment_is_named() -> None:
    before = workers()
    with pytest.raises(HarnessError, match="experiment 0 has no result, its process has ended with code 7"):
        list(each(Unpickled(os._exit, 7), [b"a"], 1, fresh=True))
    assert workers() <= before


def test_one_that_does_not_take_what_it_is_given_is_named_and_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("aftbed.runtime.unix.worker_pool.TALK_SECONDS_MAX", 0.5)
    before, stops = workers(), Unpickled(signal.raise_signal, signal.SIGSTOP)
    with pytest.raises(HarnessError, match=r"experiment 0 hangs, after 0\.5 s there is no result"):
        list(each(stops, [bytes(30_000_000)], 1, fresh=True))
    assert workers() <= before


def test_results_before_an_error_are_handed_on_and_the_error_says_where_it_was_raised() -> None:
    found = each(fails_at_five, range(9), 2)
    assert [number for number, _, _ in itertools.islice(found, 5)] == [0, 1, 2, 3, 4]
    with pytest.raises(ArithmeticError, match="of its own") as raised:
        next(found)
    assert "in fails_at_five" in raised.value.__notes__[0]


def test_an_error_of_an_experiment_is_no_hang() -> None:
    with pytest.raises(TimeoutError, match="of its own: 0"):
        list(each(late, range(3), 2))


def campaign(folder: Path) -> Generator[object, None, None]:
    return runner.run(planned(folder), runner.CampaignRunOptions(folder / "out", jobs=2))


def explored(folder: Path) -> Generator[object, None, None]:
    return explore([Setup("lfr", seed=seed, count=1) for seed in range(9)], 2)


def ordered(folder: Path) -> Generator[object, None, None]:
    return explore_orders([Setup("none", seed=seed, count=1) for seed in range(9)], 9, 2)


def driven_rows(folder: Path) -> Generator[object, None, None]:
    return driven(drives(cases("r152", "m1")[:3], [RoadLine("bare", "none")], 0), 2)


@pytest.mark.parametrize("command", [campaign, explored, ordered, driven_rows])
def test_an_interrupt_while_workers_end_reaches_the_command(
    command: Callable[[Path], Generator[object, None, None]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The garbage collector, had it to end them, would write it to stderr as ignored, and go on."""
    before, ready, interrupts = workers(), worker_pool._ready, ["one"]

    def interrupted(fds: Iterable[int], seconds: float) -> set[int]:
        if interrupts:
            raise KeyboardInterrupt(interrupts.pop())
        return ready(fds, seconds)

    with pytest.raises(KeyboardInterrupt), closing(command(tmp_path)) as results:
        next(results)
        monkeypatch.setattr(worker_pool, "_ready", interrupted)
    assert not interrupts
    assert workers() <= before
