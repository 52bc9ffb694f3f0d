"""What the names of a bus fault mean: messages, signals and nodes, as numbers. The hub knows no DBC.

Aiming is done by whoever asks for the fault, before anything runs, so a name that does not exist is the
user's error and costs the run nothing.
"""

from collections.abc import Sequence
from typing import Final

import msgspec

from aftbed.core.busfault import (
    NODES,
    Aim,
    Babble,
    BusFault,
    BusOff,
    FlipBit,
    Mark,
    Masquerade,
    Partition,
    SetSignal,
    StuckCounter,
)
from aftbed.core.errors import ConfigError, unknown
from aftbed.vehicle.can.dbc_file import Codec

CRC_BITS: Final = 8  # of E2E profile 11: the first byte


def aimed(
    fault: BusFault, codecs: Sequence[Codec], nodes: Sequence[str] = NODES, *, car: bool = True
) -> BusFault:
    """`fault` with what its names mean on a bus of these messages and `nodes`; `car`: there is one.

    Raises ConfigError naming the message, signal, bit or node that does not exist.
    """
    if fault.opening.when is not None and not car:
        raise ConfigError(f"{fault}: 'when' looks at the car, and a replay has none")
    for node in _nodes(fault):
        if node not in nodes:
            raise unknown("node of the bus", node, nodes)
    marks = tuple(_mark(fault, codec, name) for codec, name in _messages(fault, codecs))
    return msgspec.structs.replace(fault, aim=Aim(marks))


def _nodes(fault: BusFault) -> tuple[str, ...]:
    match fault.act:
        case Babble(node) | BusOff(node):
            return (node,)
        case Partition(side, other):
            return (*side, *other)
        case _:
            return ()


def _messages(fault: BusFault, codecs: Sequence[Codec]) -> list[tuple[Codec, str]]:
    frames = fault.frames
    if frames is None:
        return []
    if frames.message:
        return [(_codec_of(frames.message, codecs), frames.message)]
    found = [(codec, name) for codec in codecs for name in codec.sent_by(frames.sender)]
    if not found:
        raise unknown("sender of frames", frames.sender, {s for codec in codecs for s in codec.senders()})
    return found


def _codec_of(message: str, codecs: Sequence[Codec]) -> Codec:
    for codec in codecs:
        if message in codec.names():
            return codec
    raise unknown("message", message, {name for codec in codecs for name in codec.names()})


def _mark(fault: BusFault, codec: Codec, name: str) -> Mark:
    can_id = codec.can_id(name)
    match fault.act:
        case FlipBit(bit, crc_good):
            if bit >= 8 * codec.length(name):
                raise ConfigError(f"bit {bit}: {name} has the bits 0 to {8 * codec.length(name) - 1}")
            if crc_good and bit < CRC_BITS:
                raise ConfigError(
                    f"bit {bit} crc good: bits 0 to {CRC_BITS - 1} of {name} are the CRC itself"
                )
            return Mark(can_id, codec.data_id(name) if crc_good else -1)
        case SetSignal(signal, value, crc_good):
            mask, bits = codec.patch(name, signal, value)
            return Mark(can_id, codec.data_id(name) if crc_good else -1, mask, bits)
        case Masquerade(message):
            own, other = codec.data_id(name), codec.data_id(message)
            if own == other:
                raise ConfigError(f"{name} as {message}: both have the data id {own}")
            return Mark(can_id, other)
        case StuckCounter():
            return Mark(can_id, codec.data_id(name))
        case _:
            return Mark(can_id)
