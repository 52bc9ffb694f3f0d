"""The bus log of a run, frame by frame, with the signals of those that aftbed's DBC defines."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from aftbed.core.errors import ConfigError, PeerError
from aftbed.core.input_file import read_input
from aftbed.vehicle.can.candump import LogCounts, parse_lines
from aftbed.vehicle.can.dbc_file import Codec
from aftbed.vehicle.can.e2e import intact
from aftbed.vehicle.can.frame import Frame

BUS_LOG_BYTES_MAX: Final = 2 << 30


class DecodedFrame(NamedTuple):
    """A frame; `name` where the DBC defines it, `whole` (its E2E CRC is right) where it is protected.

    `signals` only of a whole frame, as on the bus: no receiver uses another one.
    """

    frame: Frame
    interface: str
    name: str | None = None
    whole: bool | None = None
    signals: dict[str, float] | None = None

    @property
    def t_ns(self) -> int:
        """In bus time."""
        return self.frame.t_us * 1000


def decoded_log(path: Path, codec: Codec, *, own: bool) -> Iterator[DecodedFrame]:
    """The frames in complete lines of the log; of a log that is not there, none.

    On a bus of other ECUs, which is not our `own`, only the frames of the gateway are decoded. Raises
    ConfigError if the log cannot be read.
    """
    readable = codec.names() if own else codec.sent_by("gateway")
    names = {codec.can_id(name): name for name in readable}
    data_ids = {name: _data_id(codec, name) for name in readable}
    try:
        content = read_input(path, BUS_LOG_BYTES_MAX)
    except FileNotFoundError:  # a run that ended early has none
        return
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    for logged in parse_lines(io.BytesIO(content), LogCounts()):
        frame, name = logged.frame, names.get(logged.frame.can_id)
        data_id = data_ids[name] if name is not None else None
        whole = None if data_id is None else intact(frame.data, data_id)
        signals = None
        if name is not None and whole:
            try:
                signals = codec.decode(name, frame.data)
            except PeerError:
                signals = None
        yield DecodedFrame(frame, logged.interface, name, whole, signals)


def _data_id(codec: Codec, name: str) -> int | None:
    try:
        return codec.data_id(name)
    except ConfigError:
        return None
