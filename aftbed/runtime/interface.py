"""What the executive needs of a runtime: processes, channels, time. `unix` and `sim` both provide it.

The executive (scripts, adaptations, failovers, faults) is written once, above this interface. So what
the simulator explores is the very code that handles real processes; what differs is below: how a node is
made, how mail travels, what a moment is.
"""

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from enum import Enum
from typing import Final, NamedTuple, Protocol

from aftbed.core.events import Event
from aftbed.core.graph import Link
from aftbed.core.journal import Record
from aftbed.inject.kind import FaultKind
from aftbed.inject.receipts import BusReport, RadarReport
from aftbed.runtime.control import ToNode
from aftbed.runtime.tasks import Key, Tasks, Wait
from aftbed.vehicle.condition import Condition

# Zygotes, by what their spares can host: a node's modules must be imported before it is forked.
LIGHT: Final = "zygote"  # bricks
BUS: Final = "zygote.bus"  # and CAN

DRAW_BITS: Final = 63  # of the chance of a fault


class End(Protocol):
    """An end of a channel; its number is what travels with an order."""

    def fileno(self) -> int:
        """The number."""
        ...


class Channel(Protocol):
    """Both ends of `link`: order kept, a bounded queue, and it outlives the nodes at its ends."""

    link: Link

    @property
    def write(self) -> End:
        """Where the source writes."""
        ...

    @property
    def read(self) -> End:
        """Where the sink reads."""
        ...

    def fence(self) -> None:
        """No more mail: what was sent stays readable and then ends; a node that writes later dies."""
        ...

    def refuse(self) -> None:
        """No node will read: one that waits for room dies."""
        ...

    def nudge(self) -> None:
        """Wake the reader, so that it looks for orders."""
        ...

    def mail_waits(self) -> bool:
        """Whether there is a message that the sink has not taken."""
        ...

    def close(self) -> None:
        """Let go of both ends; nodes keep theirs."""
        ...


class SharedMemory(Protocol):
    """Memory that a node keeps the state of a function in."""

    memory: memoryview

    def fileno(self) -> int:
        """The number that travels with an order."""
        ...

    def seal(self) -> None:
        """No other process can get it from now on."""
        ...

    def close(self) -> None:
        """Let go of it; a node that lives keeps it."""
        ...


class StateFile(Protocol):
    """Where a node puts a state that is too large for its answer; the next node reads it from there."""

    def fileno(self) -> int:
        """The number that travels with an order."""
        ...

    def used(self) -> bool:
        """Whether a node has put a state there."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class ProcessKind(Enum):
    """What a process of a run is used for."""

    ZYGOTE = "zygote"  # forks spares
    SPARE = "spare"  # can become anything
    STAGED = "staged"  # hosts bricks beside a node that serves
    NODE = "node"  # a node of the graph that runs
    SERVICE = "service"  # no node: the hub, the vehicle
    KILLED = "killed"  # by the executive: its death is no news


class Process(Protocol):
    """What can host a node."""

    name: str
    kind: ProcessKind
    pid: int
    pidfd: int
    journal: str  # where it writes its records, `""` for nowhere
    incarnation: int
    bricks: tuple[tuple[str, str], ...]  # that it was ordered to host, with the kind of each
    alive: bool

    def kill(self) -> bool:
        """End it, with whatever is inside; False if it is gone."""
        ...

    def freeze(self, for_ms: int = 0) -> bool:
        """Stop it wherever it is, at most that long, 0 for good; False if it is gone.

        The process that stops it lets it go on; the time counts if that one dies first.
        """
        ...

    def thaw(self) -> bool:
        """Let it go on from there; False if it is gone."""
        ...

    def stopped(self) -> bool:
        """Whether it is seen to run no more: stopped, or dead."""
        ...

    def dying(self) -> bool:
        """Whether it is dead, or has begun to die, which `alive` does not show yet."""
        ...

    def hangs(self, now_ns: int, deadline_ns: int) -> bool:
        """Look: whether it was not seen alive for `deadline_ns`, though the machine lets it run."""
        ...

    def assigned(self) -> None:
        """It has become what it was assigned to be."""
        ...

    def announce(self) -> None:
        """Signal that an order waits."""
        ...

    def announced(self) -> bool:
        """Whether it has yet to look at its orders."""
        ...


class ProcessPool(Protocol):
    """Where processes come from."""

    @property
    def processes(self) -> Sequence[Process]:
        """All there are."""
        ...

    @property
    def zygotes(self) -> Mapping[str, Process]:
        """By name."""
        ...

    def spare(self, zygote: str) -> Generator[Wait, dict[Key, bytes], Process]:
        """A process that can become anything; waits for one if there is none."""
        ...

    def wait_for_forks(self, zygote: str) -> Generator[Wait, dict[Key, bytes], None]:
        """Wait until no spare is in the making."""
        ...

    def refill(self, zygote: str, count: int) -> None:
        """Have `count` spares, in the end."""
        ...

    def order(self, process: Process, order: ToNode, fds: tuple[int, ...] = ()) -> None:
        """Send an order with ends of channels. Raises StepFailed if the process is gone."""
        ...


class Journal(Protocol):
    """The executive's own records."""

    def write(self, now_ns: int, event: Event, request_id: int, detail: int, brick: int = 0) -> None:
        """Append one."""
        ...


class Loop(Protocol):
    """Time, and what is to happen in it."""

    tasks: Tasks

    def now_ns(self) -> int:
        """Monotonic."""
        ...

    def after(self, seconds: float, call: Callable[[], None]) -> None:
        """Call `call` once, `seconds` from now."""
        ...

    def rest(self, seconds: float) -> None:
        """Stay out of the way of others for a moment."""
        ...


class Met(NamedTuple):
    """A condition holds, at `t_us` of the drive. The car waits for `go_on`; or it does not wait.

    Then `since_ns` is when it was found to hold, by the loop's clock; else 0.
    """

    t_us: int
    since_ns: int
    go_on: Callable[[], None]


class Runtime(Protocol):
    """A runtime, whole."""

    @property
    def loop(self) -> Loop:
        """Time."""
        ...

    @property
    def pool(self) -> ProcessPool:
        """Processes."""
        ...

    @property
    def journal(self) -> Journal:
        """What the executive does is recorded here."""
        ...

    def channel(self, link: Link) -> Channel:
        """A fresh one."""
        ...

    def shared_memory(self) -> SharedMemory:
        """A fresh one, all zero."""
        ...

    def state_file(self) -> StateFile | None:
        """A fresh one; None where an answer holds any state."""
        ...

    def device(self, kind: str, incarnation: int) -> tuple[str, bytes]:
        """What joins a brick of `kind` to the world, and its options; `""` for nothing."""
        ...

    def journal_of(self, node: str, incarnation: int) -> str:
        """Where that node will write its records."""
        ...

    def records(self, journal: str) -> Iterable[Record]:
        """What it has written so far."""
        ...

    def recorded_requests(self) -> tuple[bytes, ...]:
        """The first few requests of the run."""
        ...

    def draw(self, number: int) -> int:
        """Chance for fault `number`, the same whenever this seed is used: 63 bits."""
        ...

    def disturb(self, number: int, fault: FaultKind, draw: int) -> Generator[Wait, dict[Key, bytes], None]:
        """Arm a fault of the bus or of the radar; it is armed when this ends.

        Raises StepFailed where there is no bus, or no radar.
        """
        ...

    def watch(
        self, number: int, condition: Condition, met: Callable[[Met], None]
    ) -> Generator[Wait, dict[Key, bytes], None]:
        """For fault `number`: have `met` called once, at the first step at which `condition` holds.

        It is looked at from when this ends. Raises StepFailed where there is no car.
        """
        ...

    def flip_memory(self, process: Process, bit: int | None, address: int | None, draw: int) -> str:
        """Flip that bit of the byte at `address` of `process`; which it was, in words. What is None is drawn.

        Raises StepFailed.
        """
        ...

    def disturbance(self, number: int) -> BusReport | RadarReport | None:
        """What has become of it, as far as is known."""
        ...

    def pin(self, pid: int, cpu: int) -> None:
        """Have the process `pid` run on `cpu` only."""
        ...

    def record_adaptation(self, adaptation: bytes) -> None:
        """Write down how an adaptation ended, as JSON."""
        ...

    def log(self, event: str, text: str) -> None:
        """A line for people."""
        ...
