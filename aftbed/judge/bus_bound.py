"""How long a fault of the bus may take to be handled, at most, in bus time.

Some frames of one message, which come in a fixed cycle, are struck in a row. When the first frame behind them
is used again follows from the rules of the E2E supervision (`vehicle.can.e2e`):

| frames of the message | the first that is used again |
|---|---|
| missing or refused, fewer than `delta_max`, at most `errors_max` | the next one, by its counter |
| more of them | when the window has but `errors_max` errors, and `ok_min` in sequence |
| doubled | the next one |
| swapped | the next but one: the late one is refused |
| delayed | itself, or the next one; swapped if it comes just behind that |

The brakes look once in each step of the plant; in the simulator a reply takes the time of a request besides.

Limits: a fault alone in a drive in lockstep, where the bus waits for the function, or in a simulated one; one
message, struck once or for a time, when its supervision has settled. There is no bound where the brakes would
miss so many requests that they give up: a latch lasts until the car stands. There is none for a node that is
cut off, for more than one message is struck then, nor for what a good CRC makes a receiver believe. In a
paced drive the frames come when the machine lets them.
"""

from typing import Final, NamedTuple

from aftbed.core.graph import Graph
from aftbed.inject.bus import (
    BusFault,
    Delay,
    Duplicate,
    FlipBit,
    Masquerade,
    Omission,
    Reorder,
    SetSignal,
    StuckCounter,
)
from aftbed.inject.grammar import Lasting, Transient
from aftbed.judge.handling_bound import request_ns
from aftbed.vehicle.can.dbc_file import own_dbc
from aftbed.vehicle.can.e2e import P11, Supervision
from aftbed.vehicle.ecus import HOLD_US
from aftbed.vehicle.plant import STEP_US

EGO_STATE: Final = "EGO_STATE"
AEB_REQ: Final = "AEB_REQ"
RADAR_TRACK: Final = "RADAR_TRACK"
ASKING: Final = (RADAR_TRACK, AEB_REQ)  # without one of these the brakes get no request
WINDOWS: Final = 2  # of the supervision, until it has settled


class _Row(NamedTuple):
    """Of frames of one message: so many are `missed` in a row, and one is used again `after_us`."""

    missed: int
    after_us: int


def bus_bound_ms(fault: BusFault, struck_us: int, graph: Graph, *, simulated: bool) -> float | None:
    """In ms of bus time. `struck_us`: when the first frame was struck. None: there is no bound for it."""
    message = fault.frames.message if fault.frames is not None else ""
    if message not in (EGO_STATE, *ASKING):
        return None
    codec = own_dbc()
    cycle_us = codec.cycle_us(message)
    supervision = Supervision(P11(codec.data_id(message)), cycle_us, WINDOWS * cycle_us)
    reply_us = -(-request_ns(graph) // 1000) if simulated else 0
    brakes_us = STEP_US + reply_us  # from a RADAR_TRACK to what the brakes make of the reply
    row = _row(
        fault,
        supervision,
        early_us=reply_us if message == AEB_REQ else 0,
        behind_us=brakes_us if message == RADAR_TRACK else 0,
    )
    if row is None or struck_us < WINDOWS * supervision.window_size * cycle_us:
        return None
    if message in ASKING and (row.missed + 1) * cycle_us >= HOLD_US:
        return None
    return (row.after_us + brakes_us) / 1e3


def _row(fault: BusFault, supervision: Supervision, early_us: int, behind_us: int) -> _Row | None:
    """`early_us`: by how much a frame may come before its cycle is over. `behind_us`: until the last of two
    receivers has used what came in the place of a frame.
    """
    cycle_us, once = supervision.cycle_us, isinstance(fault.persistence, Transient)
    match fault.effect:
        case Duplicate():
            return _Row(0, cycle_us)
        case Reorder() if once:
            return _Row(1, 2 * cycle_us)
        case Delay(by_us) if once:
            late_us = -(-by_us // STEP_US) * STEP_US  # what is held back is let go in a step
            if cycle_us <= late_us < cycle_us + behind_us + STEP_US:  # it is refused while one still objects
                return _Row(1, 2 * cycle_us)
            return _Row(1, min(late_us, cycle_us))
        case FlipBit(crc_good=False) | SetSignal(crc_good=False) | Masquerade() | StuckCounter() | Omission():
            missed = _in_a_row(fault, cycle_us, early_us)
        case _:
            return None
    return (
        None if missed is None else _Row(missed, (missed + _refused_behind(missed, supervision)) * cycle_us)
    )


def _in_a_row(fault: BusFault, cycle_us: int, early_us: int) -> int | None:
    match fault.persistence:
        case Transient():
            return 1
        case Lasting(for_us):
            return -(-(for_us + early_us) // cycle_us)
        case _:
            return None


def _refused_behind(missed: int, supervision: Supervision) -> int:
    """How many sound frames are refused until one is used."""
    if missed <= supervision.errors_max and missed < supervision.delta_max:
        return 0
    return max(supervision.ok_min, supervision.window_size - supervision.errors_max - 1)
