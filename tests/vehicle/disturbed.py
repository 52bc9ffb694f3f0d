"""The same drive with the same faults, over a real hub in lockstep and in virtual time."""

from collections import deque
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import msgspec
from busharness import FunctionGateway, RunningHub, running_hub
from buslog import read_log
from puredrive import CODEC

from aftbed.inject.bus import BusFault, read_bus_fault
from aftbed.inject.bus_disturber import Disturber
from aftbed.inject.model import parse
from aftbed.inject.radar import RadarFault, RadarFaults
from aftbed.inject.receipts import BusReport, RadarReport
from aftbed.vehicle.aeb.function import default_application
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.can.hub import HubOptions
from aftbed.vehicle.drive_real import CarBuses, DriveOptions, DriveReport, drive
from aftbed.vehicle.drive_virtual import VirtualCar
from aftbed.vehicle.plant import VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario

FIRST_NUMBER = 7
SEED = 5


def fault(words: str) -> BusFault:
    return read_bus_fault(words).resolved([CODEC])


def radar_faults(*words: str) -> RadarFaults:
    faults = RadarFaults()
    for number, action in enumerate((parse(text).action for text in words), FIRST_NUMBER):
        assert isinstance(action, RadarFault)
        faults.arm(number, action, SEED)
    return faults


class Disturbed(msgspec.Struct):
    """A drive that came to its end."""

    frames: list[Frame]
    result: VehicleResult
    struck: list[BusReport]
    refused: dict[str, int]
    report: DriveReport | None = None
    radar: list[RadarReport] = msgspec.field(default_factory=list)

    def of(self, can_id: int) -> list[Frame]:
        """The frames of one identifier, as they were on the bus."""
        return [frame for frame in self.frames if frame.can_id == can_id]

    @property
    def ids(self) -> set[int]:
        return {frame.can_id for frame in self.frames}


def arm(hub: RunningHub, faults: tuple[str, ...]) -> None:
    for number, words in enumerate(faults, FIRST_NUMBER):
        hub.arm(number, fault(words), SEED)


def real(
    log: Path,
    *faults: str,
    pace: float | None = None,
    then: Callable[[RunningHub, int], None] | None = None,
    radar: tuple[str, ...] = (),
) -> Disturbed:
    """Over a hub on 127.0.0.1. `then` is called with the hub and the time, each 50 ms of bus time."""
    lockstep, of_radar = pace is None, radar_faults(*radar)
    with (
        running_hub(log, HubOptions(lockstep=lockstep, pace=pace or 1.0)) as hub,
        FunctionGateway(hub.options, CODEC, named=True) as gateway,
        closing(CarBuses(hub.options, (CODEC.can_id("AEB_REQ"),))) as buses,
    ):
        arm(hub, faults)
        report = drive(
            load_scenario("ccrs-50"),
            CODEC,
            buses,
            DriveOptions(pace=pace, seed=SEED),
            report=lambda telemetry: then(hub, telemetry.t_ms) if then is not None else None,
            stop=lambda: False,
            radar=of_radar,
        )
        struck = hub.struck()
        gateway.rest()
        refused = dict(gateway.gateway.counts.refused)
    frames = [entry.frame for entry in read_log(log)[0]]
    return Disturbed(frames, report.result, struck, refused, report, of_radar.reports())


def virtual(
    *faults: str, late_ns: int = 0, tick_ns: int | None = None, radar: tuple[str, ...] = ()
) -> Disturbed:
    """In virtual time; each reply comes that late. `tick_ns` advances the car that often as well."""
    frames: list[Frame] = []
    car = VirtualCar(load_scenario("ccrs-50"), seed=SEED, codec=CODEC, on_frame=frames.append)
    disturber = Disturber()
    for number, words in enumerate(faults, FIRST_NUMBER):
        disturber.arm(number, fault(words), SEED, car.before(0))
        car.disturb(disturber)
    of_radar = radar_faults(*radar)
    if radar:
        car.before(0)
        car.disturb_radar(of_radar)
    function, now_ns = default_application(), 0
    replies: deque[tuple[int, bytes]] = deque()
    while (due_ns := car.due_ns()) is not None:
        next_ns = due_ns if tick_ns is None else min(due_ns, now_ns + tick_ns)
        now_ns = min(next_ns, replies[0][0]) if replies else next_ns
        while replies and replies[0][0] <= now_ns:
            car.deliver(replies.popleft()[1], now_ns)
        for payload in car.advance(now_ns):
            reply = function.execute(payload)
            if late_ns:
                replies.append((now_ns + late_ns, reply))
            else:
                car.deliver(reply, now_ns)
    refused = dict(car.counts.refused)
    return Disturbed(frames, car.result(), disturber.reports(), refused, radar=of_radar.reports())
