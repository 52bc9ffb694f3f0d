"""A simulated run that says what happens, line by line, as a person would draw it on a whiteboard.

Who speaks stands first: a brick that puts a message into a channel, with the channel; a node that dies or
stops; the executive with each verb of a script. No time is shown: only the order counts. Everything takes the
same time as everything else of its kind (`Steady`), so the order hangs on no chance.

Left out, for the sake of the reader: what the executive and the nodes say to each other on their lines, the
pulses of a Watchdog, the births of nodes, and the records of what a message shows anyway.
"""

import re
from collections.abc import Callable, Iterator
from typing import Final

from counting import Counting

from aftbed.core import script
from aftbed.core.events import Event
from aftbed.core.journal import EntryKind, Record
from aftbed.core.messages import Message, Notification, Suspect, TakeOver, Trial, Trials
from aftbed.core.script import Phase
from aftbed.inject.channel import ChannelFault
from aftbed.inject.model import Fault
from aftbed.inject.receipts import fault_and_bits
from aftbed.runtime import control
from aftbed.runtime.sim.clock import Clock
from aftbed.runtime.sim.node_io import SimChannel, SimNode
from aftbed.runtime.sim.processes import SimProcess
from aftbed.runtime.sim.world import Setup, World

EXECUTIVE: Final = "executive"
HOP_NS: Final = 10_000
PERIOD_NS: Final = 400_000_000  # between two requests: whatever one of them sets off is over before the next
GAP_NS: Final = 50_000_000  # before a request: time for commands
SAID: Final = {  # events that no message shows
    Event.DEDUPE_HIT: "has the reply to {} already",
    Event.REPLY_REFUSED: "refuses a reply to {}",
    Event.FOLLOWER_DIVERGED: "has another reply to {}",
    Event.VOTE_COMPARED: "votes on {}: {}",
    Event.DETECTED_STOP: "gives no reply to {}, and stops",
    Event.REPLICA_PROMOTED: "leads, epoch {1}",
    Event.BACKUP_READY: "redundancy is back",
    Event.PEER_REFUSED: "refuses what it is told about {}",
}
VOTES: Final = {0: "no two are equal", 2: "two of two are equal", 3: "two of three are equal"}
TOLD: Final = (
    "roles",
    "script.done",
    "script.failed",
    "replaced",
    "adapt.phase",
    "adapted",
    "lost",
    "assert",
)
_MEASURED: Final = re.compile(r":? \d+\.\d\d ms")

Say = Callable[[str, str], None]


class Steady(Clock):
    """Nothing takes longer than usual."""

    def hop_ns(self) -> int:
        """Each the same."""
        return HOP_NS

    def between_ns(self, low_ns: int, high_ns: int) -> int:
        """The middle."""
        return (low_ns + high_ns) // 2


def _speaking(say: Say) -> type[SimChannel]:
    """Channels that tell what is put into them."""

    class Speaking(SimChannel):
        def put(self, message: Message) -> bool:
            """Send, and say so."""
            done = super().put(message)
            if done:
                say(self.link.source, f"{self.link.name:<8} {words(message)}")
            return done

    return Speaking


class _Records(list[Record]):
    """A journal that tells what is written."""

    def __init__(self, say: Callable[[Record], None]) -> None:
        super().__init__()
        self._say = say

    def append(self, record: Record) -> None:
        """Keep it, and say so."""
        super().append(record)
        self._say(record)


class _Executive:
    """The executive's journal, which tells what is written."""

    def __init__(self, inner: object, say: Callable[[Event, int], None]) -> None:
        self._inner, self._say = inner, say

    def write(self, now_ns: int, event: Event, request_id: int, detail: int, brick: int = 0) -> None:
        """Keep it, and say so."""
        self._inner.write(now_ns, event, request_id, detail, brick)  # type: ignore[attr-defined]
        self._say(event, detail)


class Whiteboard(World):
    """A world of `payloads`, one request every `PERIOD_NS`; `said` has all lines so far."""

    def __init__(self, expression: str, payloads: list[bytes], seed: int = 0) -> None:
        self.said: list[str] = []
        self._steps: list[script.Step] = []  # of the adaptation under way
        setup = Setup(expression, seed=seed, count=len(payloads), rate_hz=1e9 / PERIOD_NS)
        super().__init__(
            setup, function=Counting, requests=payloads, channel=_speaking(self.say), clock=Steady
        )
        self.journal = _Executive(self.journal, self._of_the_executive)  # type: ignore[assignment]
        pool = self.pool
        heard, ended, frozen = pool.on_report, pool.on_end, pool.on_freeze

        def on_report(process: SimProcess, report: control.FromNode) -> None:
            self._ordered(report)
            heard(process, report)

        def on_end(process: SimProcess, reason: str) -> None:
            self.say(process.name, "dies" + (f": {reason.partition(': ')[2]}" if ": " in reason else ""))
            ended(process, reason)

        def on_freeze(process: SimProcess, for_ms: int) -> None:
            self.say(process.name, "stops where it is")
            frozen(process, for_ms)

        pool.on_report, pool.on_end, pool.on_freeze = on_report, on_end, on_freeze

    # -- what happens, in words ----------------------------------------------------------------

    def say(self, who: str, what: str) -> None:
        """Another line."""
        self.said.append(f"{who:<17} {what}")

    def inject(self, fault: Fault) -> None:
        """Arm it; its words are those of its strike."""
        self._armed = fault
        super().inject(fault)

    def log(self, event: str, text: str) -> None:
        """For the outcome; and some of it is said."""
        super().log(event, text)
        if event in TOLD:
            self.say(EXECUTIVE, ("a new " if event == "replaced" else "") + _MEASURED.sub(" is done", text))

    def write(self, now_ns: int, request_id: int, epoch: int, kind: EntryKind, payload: bytes) -> None:
        """An entry of the dialogue; a reply is said."""
        super().write(now_ns, request_id, epoch, kind, payload)
        if kind is EntryKind.ANSWERED:
            self.say("client", f"has the reply to {request_id}: {payload.decode(errors='replace')}")

    def _journal_for(self, name: str) -> list[Record]:
        return self.journals.setdefault(name, _Records(self._noted))

    def _noted(self, record: Record) -> None:
        if record.event is Event.FAULT_APPLIED:
            bit = fault_and_bits(record.detail)[1]
            if record.request_id and isinstance(self._armed.action, ChannelFault):
                self.say(record.node, f"is struck by {self._armed}")
            elif record.request_id:  # a node that strikes itself is seen to die
                self.say(record.node, f"bit {bit} flips in what it makes of {record.request_id}")
        elif record.event is Event.VOTE_COMPARED:
            self.say(record.node, f"votes on {record.request_id}: {VOTES[record.detail]}")
        elif record.event in SAID and (record.request_id or record.event is not Event.PEER_REFUSED):
            self.say(record.node, SAID[record.event].format(record.request_id, record.detail))

    def _of_the_executive(self, event: Event, detail: int) -> None:
        if event is Event.ADAPT_STEP_ENTER:
            for verb in script.flat((self._steps[detail - 1],)):
                self.say(EXECUTIVE, spoken(verb))

    def _ordered(self, report: control.FromNode) -> None:
        match report:
            case control.Ordered(brick, ordered, Phase.WHOLE):
                self.say(brick, f"orders: {ordered.purpose}")
                for verb in (*ordered.prepare, *ordered.commit):
                    self.say("", f"  {spoken(verb)}")
            case control.Ordered(brick, ordered, phase):
                staged = [v for v in script.flat(ordered.prepare) if isinstance(v, script.Stage)]
                self._steps = [*staged, *ordered.commit]
                self.say(brick, f"orders: {ordered.purpose}, {phase.value}")

    # -- how far it goes -----------------------------------------------------------------------

    def until(self, request_id: int, words: str = "") -> None:
        """Go on to a while before the request behind that one; or until a line has these words."""
        seen = len(self.said)
        while self.loop.heap[0][0] < self._end_ns(request_id):
            self.loop.step()
            self.loop.watch_jobs()
            if words and any(words in line for line in self.said[seen:]):
                return
        assert not words, f"never said: {words}"

    def _end_ns(self, request_id: int) -> int:
        """Of the time of that request; the first one comes when it comes."""
        first_ns = self.dialogue[0].t_ns if self.dialogue else self.loop.ns + PERIOD_NS
        return first_ns + request_id * PERIOD_NS - GAP_NS

    def nodes(self) -> Iterator[SimNode]:
        """Those that live."""
        for process in self.controller.deployment.nodes.values():
            if isinstance(process, SimProcess) and process.node is not None and not process.dead:
                yield process.node


def words(message: Message) -> str:
    """A message, as short as it can be."""
    match message:
        case Suspect(node=node, cause=cause):
            about = f"{node} {cause.value}"
        case TakeOver(epoch=epoch):
            about = f"epoch {epoch}"
        case Trial(request_id=number, rerun=True):
            about = f"{number} again"
        case Trials(request_id=number, tried=tried):
            about = f"{number} x{len(tried)}"
        case Notification(request_id=number):
            about = f"{number}"
        case _:
            about = str(message.request_id)  # type: ignore[union-attr]
    return f"{type(message).__name__}({about})"


def spoken(verb: script.Step) -> str:
    """A verb of a script."""
    match verb:
        case script.Promote(replica, epoch):
            return f"promote {replica}, epoch {epoch}"
        case script.Attach(replica, epoch):
            return f"attach proxy to {replica}, epoch {epoch}"
        case script.Bind(brick, port, target):
            into = f" {verb.target_port}" if verb.target_port not in ("", port) else ""
            return f"bind {port} of {brick} to {target}{into}"
        case script.Unbind(brick, port):
            return f"unbind {port} of {brick}"
        case script.Transfer(source, sink) | script.Align(source, sink):
            return f"{script.verb_of(verb)} {source} to {sink}"
        case _:
            return f"{script.verb_of(verb)} {' '.join(script.names(verb))}"
