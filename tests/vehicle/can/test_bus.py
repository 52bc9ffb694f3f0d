"""Attaching to the bus: nothing lost in python-can's buffer, a lost hub seen, time kept and waited for."""

import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from busharness import DEADLINE_S, RawClient, RunningHub, running_hub

from aftbed.core.errors import ConfigError, HarnessError
from aftbed.vehicle.can import bus as bus_module
from aftbed.vehicle.can.bus import AnswerWatch, Bus, BusOptions, HubLine, Schedule, open_bus
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.can.hub import HubOptions

ANSWER_ID = 0x100


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[RunningHub]:
    with running_hub(tmp_path / "bus.log", HubOptions(lockstep=True)) as running:
        yield running


@pytest.fixture
def pair(hub: RunningHub) -> Iterator[tuple[Bus, Bus]]:
    a, b = open_bus(hub.options), open_bus(hub.options)
    yield a, b
    a.close()
    b.close()


def never() -> bool:
    return False


def waits() -> bool:
    """Given as `stop`, which is asked only before a wait."""
    raise AssertionError("it waits for a step that is late already")


def frames(count: int) -> list[Frame]:
    return [Frame(0, 0x200 + n % 16, n.to_bytes(2, "big")) for n in range(count)]


def test_no_frame_stays_behind_in_the_buffer_of_python_can(pair: tuple[Bus, Bus]) -> None:
    """Some are taken one by one, some by `drain`; all arrive, once, in order."""
    a, b = pair
    sent = frames(600)  # far more than one read of python-can holds
    for frame in sent:
        a.send(frame)
    found: list[Frame] = []
    end_s = time.monotonic() + DEADLINE_S
    while len(found) < len(sent) and time.monotonic() < end_s:
        one = b.recv(DEADLINE_S)
        assert one is not None
        found += [one, *b.drain()]
    assert found == sent
    assert b.recv(0) is None


def test_recv_gives_up_in_time(pair: tuple[Bus, Bus]) -> None:
    before_s = time.monotonic()
    assert pair[0].recv(0.02) is None
    assert 0.02 <= time.monotonic() - before_s < DEADLINE_S


def test_a_stamp_arrives_to_the_microsecond(hub: RunningHub, pair: tuple[Bus, Bus]) -> None:
    a, b = pair
    for t_us in (1, 999_999, 36_000_123_457):
        a.set_time(t_us)
        a.send(Frame(0, 0x123, b""))
        assert b.recv(DEADLINE_S) == Frame(t_us, 0x123, b"")
    assert a.errors == 0


def test_a_lost_hub_is_seen(hub: RunningHub, pair: tuple[Bus, Bus]) -> None:
    hub.stop()
    with pytest.raises(HarnessError, match="the hub is gone"):
        pair[0].recv(DEADLINE_S)
    with pytest.raises(HarnessError, match="the hub is gone"):
        pair[1].drain()


def test_what_the_hub_refuses_is_counted(hub: RunningHub, pair: tuple[Bus, Bus]) -> None:
    a, b = pair
    a.set_time(10)
    a.set_time(9)
    a.send(Frame(0, 0x122, b""))  # two connections have no order between them: b waits for a's to be taken
    assert b.recv(DEADLINE_S) == Frame(10, 0x122, b"")
    b.send(Frame(0, 0x123, b""))
    assert a.recv(DEADLINE_S) == Frame(10, 0x123, b"")
    assert a.errors == 1


def test_no_hub_is_said_at_once() -> None:
    options = BusOptions(port=1)
    with pytest.raises(HarnessError, match=r"no CAN hub at 127\.0\.0\.1:1"):
        open_bus(options)
    with pytest.raises(HarnessError, match=r"no CAN hub at 127\.0\.0\.1:1"):
        HubLine(options)


def test_a_channel_that_is_not_there(hub: RunningHub) -> None:
    with pytest.raises(HarnessError, match="only can0 is here"):
        HubLine(msgspec.structs.replace(hub.options, channel="can7"))


def test_the_hub_clock_sets_time_for_all(hub: RunningHub, pair: tuple[Bus, Bus]) -> None:
    a, b = pair
    clock = HubLine(hub.options)
    for t_us in range(0, 500_000, 5_000):  # the hub has the time before the frame, each time
        clock.set_time(t_us)
        a.send(Frame(0, 0x123, b""))
        frame = b.recv(DEADLINE_S)
        assert frame is not None
        assert frame.t_us == t_us
    with pytest.raises(HarnessError, match="runs backwards"):
        clock.set_time(0)
    clock.close()
    second = HubLine(hub.options)
    with pytest.raises(HarnessError, match="another client"):
        second.set_time(10**6)
    second.close()


# -- waiting for answers


def test_an_answer_ends_the_wait(hub: RunningHub, pair: tuple[Bus, Bus]) -> None:
    asker, answerer = pair
    seen: list[Frame] = []
    watch = AnswerWatch(asker, ANSWER_ID, seen.append)
    answerer.send(Frame(0, ANSWER_ID, b"old"))
    with RawClient(hub.port) as fence:
        while asker.recv(DEADLINE_S) is None:
            pass
        watch.asked()
        answerer.send(Frame(0, 0x701, b""))
        answerer.send(Frame(0, ANSWER_ID, b"new"))
        watch.wait(never)
        fence.fence()
    assert [frame.data for frame in seen] == [b"", b"new"]
    assert (watch.answered, watch.missing) == (1, 0)


def test_a_dead_function_costs_one_long_wait(monkeypatch: pytest.MonkeyPatch, pair: tuple[Bus, Bus]) -> None:
    monkeypatch.setattr(bus_module, "FIRST_ANSWER_S_MAX", 0.2)
    asker, answerer = pair
    watch = AnswerWatch(asker, ANSWER_ID, lambda _: None)
    waits_s = []
    for _ in range(5):
        watch.asked()
        before_s = time.monotonic()
        watch.wait(never)
        waits_s.append(time.monotonic() - before_s)
    assert watch.missing == 5
    assert waits_s[0] >= 0.2
    assert max(waits_s[1:]) < 0.2
    monkeypatch.setattr(bus_module, "NEXT_ANSWER_S_MAX", DEADLINE_S)
    watch.asked()
    for n in range(6):  # it is back, and answers what it owes: not taken for the answers to come
        answerer.send(Frame(0, ANSWER_ID, bytes([n])))
    watch.wait(never)
    assert (watch.answered, watch.missing) == (6, 5)
    watch.asked()
    answerer.send(Frame(0, ANSWER_ID, b"\x06"))
    watch.wait(never)
    assert (watch.answered, watch.missing) == (7, 5)


def test_a_wait_can_be_stopped_and_is_no_miss(pair: tuple[Bus, Bus]) -> None:
    watch = AnswerWatch(pair[0], ANSWER_ID, lambda _: None)
    watch.asked()
    watch.wait(lambda: True)
    assert watch.missing == 0


# -- the schedule


def test_a_schedule_keeps_its_pace_and_makes_up_for_a_hiccup() -> None:
    before_s = time.monotonic()
    schedule = Schedule(pace=10.0)
    for t_us in range(0, 200_000, 10_000):
        schedule.wait_until(t_us, never)
    assert 0.019 <= time.monotonic() - before_s < DEADLINE_S
    while time.monotonic() < before_s + 0.1:
        pass  # the hiccup
    for t_us in range(200_000, 900_000, 10_000):
        schedule.wait_until(t_us, waits)
    assert schedule.lag_ms_max > 50


def test_a_schedule_can_be_stopped() -> None:
    before_s = time.monotonic()
    Schedule(1.0).wait_until(3_600_000_000, lambda: True)
    assert time.monotonic() - before_s < DEADLINE_S


@pytest.mark.parametrize("pace", [0.0, -1.0, float("nan")])
def test_a_pace_must_be_one(pace: float) -> None:
    with pytest.raises(ConfigError, match="allowed is more than 0"):
        Schedule(pace)
