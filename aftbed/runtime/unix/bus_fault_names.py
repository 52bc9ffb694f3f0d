"""What the names in a fault mean on the bus of a run, and whether the run has a bus and a car for it.

The command resolves them before it starts or asks anything. The supervisor does not read the DBC, because its
failovers must not wait for that; nor does the hub.
"""

from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.inject.bus import BusFault
from aftbed.inject.model import Fault
from aftbed.runtime.unix.options import CarRun, LoadRun, ReplayRun, Work
from aftbed.vehicle.can.bus_model import NODES

PLAYER: Final = "player"
*_, GATEWAY = NODES


def with_names_resolved(fault: Fault, work: Work) -> Fault:
    """`fault`, with its names resolved if it is a fault of the bus.

    Raises ConfigError, also where there is no bus, or no car for its condition.
    """
    if fault.trigger.when is not None and not isinstance(work, CarRun):
        source = "--load" if isinstance(work, LoadRun) else "--replay"
        raise ConfigError(f"{fault}: 'when' looks at the car, and a run of {source} has none")
    action = fault.action
    if not isinstance(action, BusFault):
        return fault
    if isinstance(work, LoadRun):
        raise ConfigError(f"{fault}: a run of --load has no bus")
    from aftbed.vehicle.can.dbc_file import load_dbc  # noqa: PLC0415 - a tenth of a second, for those who need it
    from aftbed.vehicle.replay.map_file import find_map, load_mapped  # noqa: PLC0415

    codecs = [load_dbc()]
    if isinstance(work, ReplayRun):
        theirs = load_mapped(find_map(work.map), Path(work.dbc))
        bus = action.resolved([theirs, *codecs], (PLAYER, GATEWAY), car=False)
    else:
        bus = action.resolved(codecs)
    return msgspec.structs.replace(fault, action=bus)
