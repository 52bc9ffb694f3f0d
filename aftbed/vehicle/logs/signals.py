"""CSV wide by signal: what PlotJuggler and a spreadsheet open. It can be written and not read.

One column `time` in seconds, then one for each `Message.Signal` of the DBC that occurs; a row for each
frame, sorted by time, and empty where it brings no new value. Numbers are in physical units, without names
for values. A message that is on more than one interface has its columns once for each:
`can1.Message.Signal`.

Left out and counted: frames that the DBC does not have, frames of another length than it says, and all that
is no data frame. Frames are decoded as they are: no checksum is looked at.
"""

import csv
from collections import Counter
from pathlib import Path
from typing import Final

from aftbed.core.errors import ConfigError, PeerError
from aftbed.vehicle.can.dbc_file import Codec
from aftbed.vehicle.can.frame import CAN_ID_MAX
from aftbed.vehicle.logs.frames import Kind, Log, LoggedFrame, without

UNKNOWN: Final = "frame that the DBC does not have"
LENGTH: Final = "frame of another length than the DBC says"
Row = tuple[int, dict[str, float]]


def write(log: Log, codec: Codec, path: Path) -> Log:
    """All signals that `codec` knows; what was taken over. Raises ConfigError where that is nothing."""
    kept, rows, columns = _decoded(log, codec)
    if not rows:
        raise ConfigError(f"{codec.path}: describes none of the {len(log.frames)} frames")
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["time", *columns], restval="", lineterminator="\n")
        writer.writeheader()
        for t_us, values in sorted(rows, key=lambda row: row[0]):
            time = {"time": f"{t_us // 1_000_000}.{t_us % 1_000_000:06d}"}
            writer.writerow(time | {column: _shown(value) for column, value in values.items()})
    return kept


def _shown(value: float) -> str:
    """A number as it was meant: 13.889 and not 13.889000000000001."""
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _decoded(log: Log, codec: Codec) -> tuple[Log, list[Row], list[str]]:
    """What was taken over, the rows, and the columns in the order of the DBC."""
    data = without(log, Kind.REMOTE, Kind.ERROR)
    names = {(codec.can_id(name), codec.can_id(name) > CAN_ID_MAX): name for name in codec.names()}
    seen: dict[str, list[str]] = {}
    found: list[tuple[LoggedFrame, str, dict[str, float]]] = []
    reasons = Counter(data.left_out)
    for frame in data.frames:
        name = names.get((frame.can_id, frame.extended))
        if name is None:
            reasons[UNKNOWN] += 1
            continue
        try:
            found.append((frame, name, codec.decode(name, frame.data)))
        except PeerError:
            reasons[LENGTH] += 1
            continue
        if frame.interface not in seen.setdefault(name, []):
            seen[name].append(frame.interface)

    def column(interface: str, name: str, signal: str) -> str:
        return f"{name}.{signal}" if len(seen[name]) == 1 else f"{interface}.{name}.{signal}"

    rows = [
        (frame.t_us, {column(frame.interface, name, s): v for s, v in values.items()})
        for frame, name, values in found
    ]
    columns = [
        column(i, name, signal)
        for name in codec.names()
        for i in seen.get(name, ())
        for signal in codec.signal_names(name)
        if signal not in codec.misfits(name)
    ]
    return Log(tuple(frame for frame, _, _ in found), dict(reasons)), rows, columns
