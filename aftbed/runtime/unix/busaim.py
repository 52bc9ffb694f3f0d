"""A fault of the bus, aimed at the bus of a run: in the command, before anything is started or asked.

The DBC is read here and not in the supervisor, whose failovers must not wait for it, nor in the hub.
"""

from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.busfault import NODES, BusFault
from aftbed.core.errors import ConfigError
from aftbed.core.fault import Fault
from aftbed.runtime.unix.options import LoadRun, ReplayRun, Work

PLAYER: Final = "player"
*_, GATEWAY = NODES


def aim(fault: Fault, work: Work) -> Fault:
    """`fault`, with its names resolved if it is of the bus. Raises ConfigError, also where there is none."""
    action = fault.action
    if not isinstance(action, BusFault):
        return fault
    if isinstance(work, LoadRun):
        raise ConfigError(f"{fault}: a run of --load has no bus")
    from aftbed.vehicle.aim import aimed  # noqa: PLC0415 - a tenth of a second, for those who need it
    from aftbed.vehicle.dbcfile import load_dbc  # noqa: PLC0415

    codecs = [load_dbc()]
    if isinstance(work, ReplayRun):
        bus = aimed(action, [load_dbc(Path(work.dbc)), *codecs], (PLAYER, GATEWAY), car=False)
    else:
        bus = aimed(action, codecs)
    return msgspec.structs.replace(fault, action=bus)
