"""What a run is made of, checked by the command before a process is started."""

from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.core.messages import Scheduled
from aftbed.core.units import duration, milliseconds
from aftbed.inject.bus import BusFault
from aftbed.inject.model import Fault
from aftbed.vehicle.can.bus_load import BITRATE_BPS
from aftbed.vehicle.can.bus_model import NODES

COMMAND_GONE: Final = "the command is gone"  # a reason to end at once, whatever waits for an answer
PLAYER: Final = "player"
*_, GATEWAY = NODES


class Turns(msgspec.Struct, frozen=True):
    """Of each `of` turns of `ns` of the monotonic clock, `share` of them from `number` on."""

    ns: int
    number: int
    of: int = 2
    share: int = 1

    def left_ns(self, now_ns: int) -> int:
        """Until the next of these turns begins; 0 within one."""
        turn, into_ns = divmod(now_ns, self.ns)
        since = (turn - self.number) % self.of
        return (self.of - since) * self.ns - into_ns if since >= self.share else 0


class LoadRun(msgspec.Struct, frozen=True, tag=True):
    """Requests without a car: drawn from the seed, for benches and tests, or given by the user.

    `requests`, `expect`: what the user named, "" if nothing; the record has what was in them. `turns`: it
    sends only in these, and the others are left to what a bench measures beside it.
    """

    count: int
    rate_hz: float  # 0: closed loop
    requests: str = ""
    expect: str = ""
    turns: Turns | None = None

    @property
    def option(self) -> str:
        """By which it was asked for."""
        return "--requests" if self.requests else "--load"


class CarRun(msgspec.Struct, frozen=True, tag=True):
    """A drive; `pace` None is lockstep. `duration_ms`: how long it may last, else as its scenario says.

    `bitrate_bps`: the bitrate that the load of the bus is measured by.
    """

    scenario: str
    pace: float | None
    brake_policy: str
    duration_ms: int | None = None
    bitrate_bps: int = BITRATE_BPS


class ReplayRun(msgspec.Struct, frozen=True, tag=True):
    """A log through the bus: the file `log`. Its frames come with the run, since the command has read it.

    `loop`: behind its end it begins again. It ends after `duration_ms` at the latest, of bus time.
    `bitrate_bps`: as of a drive.
    """

    log: str
    dbc: str
    map: str
    pace: float | None
    loop: bool = False
    duration_ms: int | None = None
    bitrate_bps: int = BITRATE_BPS


Work = LoadRun | CarRun | ReplayRun


class PolicyOptions(msgspec.Struct, frozen=True):
    """The policy that a run follows, by its name or path. `may_fail`: what it proposes may fail."""

    name: str
    approve: str
    may_fail: bool = False


class RunOptions(msgspec.Struct, frozen=True):
    """`private` and `record` are directories, made by the launch; `listener` is the hub's bound socket, and
    `log` a memfd with the `PlayedLog` of a ReplayRun.

    `bus_open`: other users may attach to the bus, and the verdict stands whatever strangers send.
    `application`: the protected function that the run begins with, "" for the built-in one. `drive`: the
    scenario of a CarRun as MessagePack, read once for all processes. `ftti_ms`: of bus time, the fault
    tolerant time interval that the verdict holds against each fault; 0: none. `verifies`: requirements, of
    the command and of the scenario. `command`: as it was typed, "" if another program launched the run.
    `code`: the version of the code, "" where the run is neither kept nor evidence of a requirement.
    `packages`: by name and version, those that declare mechanisms of `ftm` and `adaptations`.
    """

    run: str
    private: str
    record: str
    ftm: str
    placement: str
    seed: int
    work: Work
    faults: tuple[Fault, ...] = ()
    adaptations: tuple[Scheduled, ...] = ()
    policy: PolicyOptions | None = None
    pin: bool = True
    listener: int = -1
    log: int = -1
    port: int = 0
    bus_open: bool = False
    application: str = ""
    drive: bytes = b""
    ftti_ms: float = 0.0
    verifies: tuple[str, ...] = ()
    command: str = ""
    code: str = ""
    packages: tuple[str, ...] = ()


class SourceOptions(msgspec.Struct, frozen=True):
    """For the process that makes the requests: the host of the Client, the vehicle or the player.

    `port` is the hub's, `secret` its bus's. `journals` is the directory of the dialogues of this Client,
    which was made as the `incarnation`th, and of its predecessors. `application`, `drive`: see `RunOptions`.
    """

    work: Work
    seed: int
    port: int
    secret: str
    journals: str = ""
    incarnation: int = 1
    application: str = ""
    drive: bytes = b""


def cycle_ms_of(work: Work) -> float:
    """Between two requests, of a car in bus time; 0: each follows the reply before it, or as a log has it."""
    match work:
        case LoadRun(_, rate_hz):
            return 1e3 / rate_hz if rate_hz else 0.0
        case CarRun():
            from aftbed.vehicle.can.dbc_file import own_dbc  # noqa: PLC0415 - as below

            return own_dbc().cycle_us("RADAR_TRACK") / 1e3
        case ReplayRun():
            return 0.0


def ftti_ms_of(what: str, text: str, work: Work) -> float:
    """A fault tolerant time interval, as `100ms`. Raises ConfigError, also if it is shorter than a cycle."""
    ftti_ms, cycle_ms = milliseconds(what, text), cycle_ms_of(work)
    if ftti_ms < cycle_ms:
        raise ConfigError(
            f"{what} {text}: shorter than a cycle of {duration(cycle_ms)}: no fault can be handled before the"
            " next request"
        )
    return ftti_ms


def with_names_resolved(fault: Fault, work: Work) -> Fault:
    """`fault`, with its names resolved if it is a fault of the bus.

    Raises ConfigError, also where there is no bus, or no car for its condition.
    """
    if fault.trigger.when is not None and not isinstance(work, CarRun):
        source = work.option if isinstance(work, LoadRun) else "--replay"
        raise ConfigError(f"{fault}: 'when' looks at the car, and a run of {source} has none")
    action = fault.action
    if action.needs_car and not isinstance(work, CarRun):
        source = work.option if isinstance(work, LoadRun) else "--replay"
        raise ConfigError(f"{fault}: a run of {source} has no radar; --scenario has one")
    if not isinstance(action, BusFault):
        return fault
    if isinstance(work, LoadRun):
        raise ConfigError(f"{fault}: a run of {work.option} has no bus")
    # Imported here, by the command: the supervisor must not read a DBC, since a failover would wait for it.
    from aftbed.vehicle.can.dbc_file import own_dbc  # noqa: PLC0415
    from aftbed.vehicle.replay.map_file import find_map, load_mapped  # noqa: PLC0415

    if isinstance(work, ReplayRun):
        mapped = load_mapped(find_map(work.map), Path(work.dbc))
        action = action.resolved([mapped, own_dbc()], (PLAYER, GATEWAY), car=False)
    else:
        action = action.resolved([own_dbc()])
    return msgspec.structs.replace(fault, action=action)
