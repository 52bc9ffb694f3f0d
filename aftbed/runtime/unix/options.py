"""What a run is made of, checked by the command before a process is started."""

from typing import Final

import msgspec

from aftbed.core.messages import Scheduled
from aftbed.inject.model import Fault

COMMAND_GONE: Final = "the command is gone"  # a reason to end at once, whatever waits for an answer


class LoadRun(msgspec.Struct, frozen=True, tag=True):
    """Requests without a car: for benches and for tests of the mechanism alone."""

    count: int
    rate_hz: float  # 0: closed loop


class CarRun(msgspec.Struct, frozen=True, tag=True):
    """A drive; `pace` None is lockstep."""

    scenario: str
    pace: float | None
    brake_policy: str


class ReplayRun(msgspec.Struct, frozen=True, tag=True):
    """A candump log through the bus."""

    log: str
    dbc: str
    map: str
    pace: float | None


Work = LoadRun | CarRun | ReplayRun


class RunOptions(msgspec.Struct, frozen=True):
    """`private` and `record` are directories, made by the launch; `listener` is the hub's bound socket."""

    run: str
    private: str
    record: str
    ftm: str
    placement: str
    seed: int
    work: Work
    faults: tuple[Fault, ...] = ()
    adaptations: tuple[Scheduled, ...] = ()
    pin: bool = True
    listener: int = -1
    port: int = 0


class VehicleOptions(msgspec.Struct, frozen=True):
    """A drive."""

    port: int
    scenario: str
    pace: float | None
    brake_policy: str
    seed: int


class PlayerOptions(msgspec.Struct, frozen=True):
    """A replay."""

    port: int
    log: str
    dbc: str
    map: str
    pace: float | None


class GatewayOptions(msgspec.Struct, frozen=True):
    """`dbc` and `map` are empty on aftbed's own bus."""

    port: int
    dialogue: str
    earlier: tuple[str, ...] = ()
    dbc: str = ""
    map: str = ""
