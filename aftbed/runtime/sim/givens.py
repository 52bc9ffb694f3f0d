"""What a simulated run is given: requests or a car, a graph, a journal. Made once where it can be."""

from functools import lru_cache
from typing import Final, NoReturn

from aftbed.core.errors import ConfigError
from aftbed.core.events import Event
from aftbed.core.graph import Graph
from aftbed.core.journal import Record
from aftbed.ftm.compose import build
from aftbed.inject.model import Fault
from aftbed.vehicle.aeb.function import sample_requests
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.drive_virtual import VirtualCar
from aftbed.vehicle.scenarios.library import load_scenario

REQUESTS: Final = 512


@lru_cache(maxsize=8)
def requests_of(seed: int) -> list[bytes]:
    """The load of a seed."""
    return sample_requests(seed, REQUESTS)


@lru_cache(maxsize=64)
def graph_of(ftm: str, placement: str) -> Graph:
    """The graph that a run begins with."""
    return build(ftm, placement)


def car_in(scenario: str, seed: int) -> VirtualCar:
    """A car, and what comes towards it."""
    return VirtualCar(load_scenario(scenario), seed=seed, codec=own_codec())


@lru_cache(maxsize=1)
def own_codec() -> Codec:
    """aftbed's own DBC."""
    return load_dbc()


def check(fault: Fault, scenario: str) -> None:
    """Raise ConfigError where there is nothing here that `fault` could strike, or wait for."""
    if not fault.action.simulated:
        raise ConfigError(f"{fault}: simulated processes have no memory of their own; use real ones")
    if scenario:
        return
    if fault.action.needs_bus:
        raise ConfigError(f"{fault}: without a scenario there is no bus")
    if fault.trigger.when is not None:
        raise ConfigError(f"{fault}: 'when' looks at the car, and without a scenario there is none")


def nothing_off_line(place: str) -> NoReturn:
    """No module is found. Raises ConfigError."""
    raise ConfigError(f"{place}: the simulator loads nothing that was written off line")


class SimJournal:
    """The executive's records."""

    def __init__(self, records: list[Record]) -> None:
        self._records = records

    def write(self, now_ns: int, event: Event, request_id: int, detail: int, brick: int = 0) -> None:
        """Append one."""
        self._records.append(Record(now_ns, event, request_id, detail, "supervisor", brick))
