"""The cells of a run, as the executive has them: who lives in which, and what is flipped there.

One for each process that hosts a Server at which a fault of a field is aimed, from its arming on. A process
that takes the place of another has none before it is told to move into a fresh one.
"""

from collections.abc import Generator, Iterable
from typing import NamedTuple

import msgspec

from aftbed.core.events import Event
from aftbed.core.fault import marked
from aftbed.core.journal import Record
from aftbed.core.valuefault import Flip, hit
from aftbed.runtime import control
from aftbed.runtime.cell import Layout, check_field
from aftbed.runtime.deployment import Deployment
from aftbed.runtime.interface import Cell, Process
from aftbed.runtime.jobs import Key, StepFailed, Wait
from aftbed.runtime.receipts import ACTIVATED, APPLIED, NOT_ACTIVATED, Receipt


class Home:
    """A process, the cell that its function lives in, and, once it has answered, the layout.

    The cell has the `number` of the fault for whose sake it was made, the first one there.
    """

    def __init__(self, number: int, brick: str, process: Process, cell: Cell) -> None:
        self.number, self.brick, self.process, self.cell = number, brick, process, cell
        self.layout = Layout()
        self.moved_in = False

    def flip(self, flip: Flip, now_ns: int, draw: int) -> "Hit":
        """Flip there. Raises ConfigError where the function has no such bits."""
        field, memory = check_field(flip, self.layout.fields), self.cell.memory
        first, behind = field.offset_bytes, field.offset_bytes + field.size_bits // 8
        bits = hit(flip.pattern, bytes(memory[first:behind]), draw)
        assert bits is not None, f"{flip} in {field}"
        for bit in bits:
            memory[first + bit // 8] ^= 1 << bit % 8
        return Hit(self, flip, bits, frozenset(8 * first + bit for bit in bits), now_ns)


class Hit(NamedTuple):
    """What was flipped: bits of the field, which are these bits of the state; none, if it was so already."""

    home: Home
    flip: Flip
    bits: tuple[int, ...]
    in_state: frozenset[int]
    since_ns: int


class Cells:
    """Of one run."""

    def __init__(self, deployment: Deployment) -> None:
        self._deployment = deployment
        self._homes: dict[Process, Home] = {}

    def leave_the_dead(self) -> None:
        """Let go of the cells of processes that are gone."""
        for dead in [process for process in self._homes if not process.alive]:
            self._homes.pop(dead).cell.close()

    def of(self, replica: str, fault: int) -> Generator[Wait, dict[Key, bytes], Home]:
        """Where the function of `replica` lives from now on. Raises StepFailed if there is none."""
        deployment, brick = self._deployment, f"{replica}/server"
        self.leave_the_dead()
        node = next((n for n, hosted in deployment.graph.nodes.items() if brick in hosted), "")
        process = deployment.nodes.get(node)
        if process is None or not process.alive:
            raise StepFailed("nobody to hit")
        home = self._homes.get(process)
        if home is None:
            home = Home(fault, brick, process, deployment.support.cell())
            self._homes[process] = home
        if not home.moved_in:
            number, ends = home.number, (home.cell.fileno(),)
            data = yield from deployment.ask(
                node, lambda token: control.KeepInCell(token, brick, number), ends
            )
            home.layout, home.moved_in = msgspec.msgpack.decode(data, type=Layout), True
            home.cell.seal()
        return home


def receipt(struck: Hit, records: Iterable[Record]) -> Receipt:
    """Whether the function has used what was flipped, by what its node has written down."""
    where = f"{struck.flip.where} in {struck.home.brick}"
    if not struck.bits:
        return Receipt(NOT_ACTIVATED, f"{struck.flip.pattern} of {where}: it is so already")
    said = f"bit{'s' * (len(struck.bits) > 1)} {', '.join(map(str, struck.bits))} of {where}"
    for record in records:
        number, bit = marked(record.detail)
        if number != struck.home.number or bit not in struck.in_state or record.t_ns < struck.since_ns:
            continue
        if record.event is Event.FAULT_APPLIED:
            return Receipt(ACTIVATED, f"{said}, taken over")
        if record.event is Event.PEER_REFUSED:
            return Receipt(ACTIVATED, f"{said}, refused: its node has ended itself")
    return Receipt(APPLIED, f"{said}, not used so far, or covered up before")
