"""A traced run: beside what every run leaves behind, all that happened in it, in the order in which it did.

Only a traced world keeps each message that is put into a channel, and what was noted, logged and answered
between two of them; any other pays nothing. What is kept is a function of the run, and a run is a function of
its setup: two traces of one setup are equal byte for byte, on any machine.

Limits: bricks that share a node speak to each other without a channel, so in the placements `replica` and
`single` only the records show what happens inside. The executive's own records have their place by
their time, behind what else happened in that instant.
"""

import zlib
from collections.abc import Iterator
from heapq import merge
from typing import Final, assert_never

import msgspec

from aftbed.core.graph import Link
from aftbed.core.journal import Entry, EntryKind, Record
from aftbed.core.messages import Message
from aftbed.functions.load import NO_CODE, Code
from aftbed.runtime.assembly import MakeSetting
from aftbed.runtime.sim.clock import START_NS, Clock
from aftbed.runtime.sim.node_io import SimChannel
from aftbed.runtime.sim.world import Run, Setup, World

EXECUTIVE: Final = "supervisor.1"  # its journal
STRUCK: Final = "struck"  # the event of a node that died of a fault, or was stopped by one
_SHOWN: Final = ("replica", "generation", "node", "cause", "rerun")  # fields that are shown as they are


class Sent(msgspec.Struct, frozen=True):
    """A message when it was put into the channel `port` from the brick `source` to the brick `sink`."""

    t_ns: int
    source: str
    port: str
    sink: str
    message: Message


class LoggedLine(msgspec.Struct, frozen=True):
    """A line of the executive, for people; or, as `STRUCK`, the name of a node."""

    t_ns: int
    event: str
    text: str


Happening = Sent | Record | Entry | LoggedLine


class Trace(msgspec.Struct, frozen=True):
    """A run, and what happened in it, by time."""

    run: Run
    happened: tuple[Happening, ...]


def traced(setup: Setup, make: MakeSetting | None = None, code: Code = NO_CODE) -> Trace:
    """Run `setup` and keep all that happens; `make` makes other bricks than the catalog's."""
    world = _Traced(setup, make, code)
    run = world.run()
    struck = [LoggedLine(one.t_ns, STRUCK, one.node) for one in run.struck]
    sources: tuple[list[Happening], ...] = (world.happened, [*run.history.journals[EXECUTIVE]], [*struck])
    return Trace(run, tuple(merge(*sources, key=lambda one: one.t_ns)))


class _Records(list[Record]):
    """A journal that also appends its records to `happened`."""

    def __init__(self, happened: list[Happening]) -> None:
        super().__init__()
        self._happened = happened

    def append(self, record: Record) -> None:
        super().append(record)
        self._happened.append(record)


class _Traced(World):
    """A world that keeps what happens."""

    def __init__(self, setup: Setup, make: MakeSetting | None, code: Code) -> None:
        self.happened: list[Happening] = []
        super().__init__(setup, make=make, code=code, channel=_recording(self.happened))

    def _journal_for(self, name: str) -> list[Record]:
        return self.journals.setdefault(name, _Records(self.happened))

    def log(self, event: str, text: str) -> None:
        super().log(event, text)
        self.happened.append(LoggedLine(self.loop.ns, event, text))

    def write(self, now_ns: int, request_id: int, epoch: int, kind: EntryKind, payload: bytes) -> None:
        super().write(now_ns, request_id, epoch, kind, payload)
        self.happened.append(self.dialogue[-1])


def _recording(happened: list[Happening]) -> type[SimChannel]:
    """A class of channels that append what is sent to `happened`."""

    class Recorded(SimChannel):
        def __init__(self, link: Link, clock: Clock, first_number: int) -> None:
            super().__init__(link, clock, first_number)
            self._now = clock

        def put(self, message: Message) -> bool:
            if not super().put(message):
                return False
            link = self.link
            happened.append(Sent(self._now.ns, link.source, link.name, link.sink, message))
            return True

    return Recorded


# -- as text --------------------------------------------------------------------------------------


def lines(trace: Trace) -> Iterator[str]:
    """A line per entry, with the virtual time in ms; the last one is the end."""
    for one in trace.happened:
        yield f"{milliseconds(one.t_ns):.6f} {_line(one)}"
    rest = trace.run.rest
    ended = (f"end leader={rest.leader or 'none'}", "lost" if rest.lost else "", "; ".join(rest.why_not))
    yield f"{milliseconds(rest.ended_ns):.6f} {' '.join(filter(None, ended))}"


def milliseconds(t_ns: int) -> float:
    """Virtual time since the start of the run."""
    return (t_ns - START_NS) / 1e6


def brief(message: Message) -> str:
    """A message in a few words: its kind, its request as `#7`, its epoch as `e1`, what it carries."""
    words = [type(message).__name__]
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if name == "request_id":
            words.append(f"#{value}")
        elif name == "epoch":
            words.append(f"e{value}")
        elif name in _SHOWN:
            words.append(f"{name}={value}")
        elif isinstance(value, bytes) and value:
            words.append(f"{name}={digest(value)}")
        elif name == "tried":
            words += [f"({brief(one)})" for one in value]
    return " ".join(words)


def digest(data: bytes) -> str:
    """Length and hash of `data`."""
    return f"{len(data)}B/{zlib.crc32(data):08x}"


def _line(one: Happening) -> str:
    match one:
        case Sent():
            return f"sent {one.source} {one.port} {one.sink} {brief(one.message)}"
        case Record():
            where = f"{one.node}:{one.brick}" if one.brick else one.node
            return f"note {where} {one.event} #{one.request_id} {one.detail}"
        case Entry():
            return f"{one.kind.name.lower()} #{one.request_id} e{one.epoch} {digest(one.payload)}"
        case LoggedLine():
            return f"told {one.event} {one.text}"
        case _:
            assert_never(one)
