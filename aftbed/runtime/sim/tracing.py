"""A traced run: beside what every run leaves behind, each message that was put into a channel.

Only a world that is made with a traced kind of channel keeps them; any other pays nothing. What is written
is a function of the run, and a run is a function of its setup: two traces of one setup are equal byte for
byte, on any machine.

Limits: bricks that share a node speak to each other without a channel, so in the placements `replica` and
`single` what happens inside is told by the records alone.
"""

import zlib
from collections.abc import Iterator
from heapq import merge
from operator import itemgetter
from typing import Final

import msgspec

from aftbed.core.graph import Link
from aftbed.core.journal import Entry, Record
from aftbed.core.message import Message
from aftbed.runtime.assembly import Make
from aftbed.runtime.sim.channels import Channel
from aftbed.runtime.sim.clock import START_NS, Clock
from aftbed.runtime.sim.world import Run, Setup, World

Timed = tuple[int, str]  # virtual time in ns, and a line of text

_SHOWN: Final = ("replica", "generation", "node", "cause", "rerun")  # fields that say more than their length


class Sent(msgspec.Struct, frozen=True):
    """A message at the moment at which it was put into the channel `port` from `source` to `sink`."""

    t_ns: int
    source: str
    port: str
    sink: str
    message: Message


class Trace(msgspec.Struct, frozen=True):
    """A run, and its messages in the order in which they were sent."""

    run: Run
    sent: tuple[Sent, ...]


def recording(sent: list[Sent]) -> type[Channel]:
    """A kind of channel that appends to `sent` whatever is put into it."""

    class Recorded(Channel):
        def __init__(self, link: Link, clock: Clock, first_number: int) -> None:
            super().__init__(link, clock, first_number)
            self._now = clock

        def put(self, message: Message) -> bool:
            if not super().put(message):
                return False
            link = self.link
            sent.append(Sent(self._now.ns, link.source, link.name, link.sink, message))
            return True

    return Recorded


def traced(setup: Setup, make: Make | None = None) -> Trace:
    """Run `setup` with every message kept; `make` makes other bricks than the catalog's."""
    sent: list[Sent] = []
    run = World(setup, make=make, channel=recording(sent)).run()
    return Trace(run, tuple(sent))


# -- as text --------------------------------------------------------------------------------------


def lines(trace: Trace) -> Iterator[str]:
    """The whole of it: a line for each message, record, entry of the dialogue, and thing told, by time."""
    history = trace.run.history
    journals = [map(_record_line, records) for records in history.journals.values()]
    sources = (
        map(_sent_line, trace.sent),
        *journals,
        map(_entry_line, history.dialogue),
        ((t_ns, f"told {event} {text}") for t_ns, event, text in trace.run.told),
    )
    for t_ns, line in merge(*sources, key=itemgetter(0)):
        yield f"{milliseconds(t_ns):.6f} {line}"
    rest = trace.run.rest
    yield f"{milliseconds(rest.ended_ns):.6f} end {rest.leader or '-'} {' '.join(rest.why_not)}".rstrip()


def milliseconds(t_ns: int) -> float:
    """Virtual time since the start of the run."""
    return (t_ns - START_NS) / 1e6


def brief(message: Message) -> str:
    """The message in a few words: its kind, its request as `#7`, its epoch as `e1`, what it carries."""
    words = [type(message).__name__]
    for name in message.__struct_fields__:
        value = getattr(message, name)
        if name == "request_id":
            words.append(f"#{value}")
        elif name == "epoch":
            words.append(f"e{value}")
        elif name in _SHOWN and value is not False and value != "":
            words.append(f"{name}={value}")
        elif isinstance(value, bytes) and value:
            words.append(f"{name}={len(value)}B/{zlib.crc32(value):08x}")
        elif name == "tried":
            words += [f"({brief(one)})" for one in value]
    return " ".join(words)


def _sent_line(sent: Sent) -> Timed:
    return sent.t_ns, f"sent {sent.source} {sent.port} {sent.sink} {brief(sent.message)}"


def _record_line(record: Record) -> Timed:
    where = f"{record.node}:{record.brick}" if record.brick else record.node
    return record.t_ns, f"note {where} {record.event} #{record.request_id} {record.detail}"


def _entry_line(entry: Entry) -> Timed:
    crc = f"{len(entry.payload)}B/{zlib.crc32(entry.payload):08x}"
    return entry.t_ns, f"client {entry.kind.name.lower()} #{entry.request_id} e{entry.epoch} {crc}"
