"""The closed loop without sockets or processes: plant, ECUs, gateway and function, in lockstep."""

import os
from collections.abc import Callable
from pathlib import Path

import msgspec

from aftbed.vehicle.aeb.function import AebFunction
from aftbed.vehicle.aeb.messages import AebOutput, decode_reply
from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.ecus import BrakeEcu, BrakePolicy, RadarEcu
from aftbed.vehicle.gateway import Gateway
from aftbed.vehicle.plant import Plant, PlantSetup, VehicleResult

CODEC = load_dbc()
_SHARED = os.environ.get("AFTBED_SHARED")
DATA = (Path(_SHARED) if _SHARED else Path(__file__).resolve().parents[2].parent / "shared") / "data"
TOYOTA_LOG, TOYOTA_DBC = DATA / "rav4_following_50kmh.log", DATA / "toyota_adas.dbc"


class Decision(msgspec.Struct, frozen=True):
    """One reply, and when."""

    t_us: int
    output: AebOutput


class Drive(msgspec.Struct, frozen=True):
    """All there is to see of a drive."""

    result: VehicleResult
    decisions: list[Decision]
    frames: list[Frame]
    gateway: Gateway
    brake: BrakeEcu
    plant: Plant

    def first_s(self, stage: int) -> float | None:
        """When a stage was first asked for."""
        return next((d.t_us / 1e6 for d in self.decisions if d.output.stage >= stage), None)


def as_it_is(frame: Frame) -> list[Frame]:
    """A bus without faults."""
    return [frame]


def drive(
    setup: PlantSetup,
    duration_ms: int,
    *,
    seed: int = 1,
    policy: BrakePolicy = "latch",
    bus: Callable[[Frame], list[Frame]] = as_it_is,
) -> Drive:
    """Drive to the end; `bus` makes of each frame what arrives in its place."""
    plant, radar, brake = Plant(setup), RadarEcu(CODEC, seed), BrakeEcu(CODEC, policy)
    gateway, function = Gateway(CODEC), AebFunction()
    decisions: list[Decision] = []
    frames: list[Frame] = []
    while plant.t_us < duration_ms * 1000 and not plant.collided:
        for sent in brake.frames(plant) + radar.frames(plant):
            for frame in bus(sent):
                frames.append(frame)
                request = gateway.on_frame(frame)
                if request is None:
                    continue
                reply = function.execute(request)
                decisions.append(Decision(frame.t_us, decode_reply(reply)))
                for answer in gateway.reply_frames(reply, frame.t_us, 1, 1, len(decisions)):
                    for arriving in bus(answer):
                        frames.append(arriving)
                        brake.on_frame(arriving)
        plant.step(brake.demand_ms2(plant))
    return Drive(plant.result(), decisions, frames, gateway, brake, plant)
