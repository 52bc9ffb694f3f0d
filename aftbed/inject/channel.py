"""Faults of a channel: messages are lost, late, doubled or out of order. They strike at the sender.

    omission|duplicate CHANNEL           [in REPLICA] [nth N | after 200ms | when ttc < 1.2] [AGAIN]
    delay|reorder      CHANNEL [by 20ms] [in REPLICA] [nth N | after 200ms | when ttc < 1.2] [AGAIN]

AGAIN is `permanent`, `intermittent every N` or `intermittent p 0.1`.

While a fault waits for its message, what the sender puts into the channel passes a *filter*, which is pure:
time comes in, messages to send come out. Several faults of one channel stand behind each other in it. Order
is kept except where it is the fault to break it, and nothing is held back for ever.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from typing import Final, NamedTuple, Self, assert_never

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.graph import Graph
from aftbed.core.messages import Message
from aftbed.core.units import DURATION_MS_MAX, duration, milliseconds
from aftbed.inject import targets
from aftbed.inject.grammar import REPEAT_KEYS, FaultWords, Persistence, gap
from aftbed.inject.kind import AnyFault, FaultKind, Injection, RunControl
from aftbed.inject.receipts import Receipt, ReceiptState, fault_and_bits, more_times

HOLD_MS: Final = 20.0
HELD: Final = 0  # the detail of a record: a message was held back
ALTERED: Final = 1  # what was sent is not what should have been sent


class Disturbance(Enum):
    """What is done to a message."""

    OMISSION = "omission"  # it is not sent
    DELAY = "delay"  # it is sent later, and what comes behind it as well
    DUPLICATE = "duplicate"  # it is sent twice
    REORDER = "reorder"  # it is sent behind its successor, if that comes in time


HOLDING: Final = (Disturbance.DELAY, Disturbance.REORDER)


class ChannelFault(FaultKind, frozen=True, tag="disturb"):
    """Messages on `channel` are disturbed; HOLDING ones hold a message back for `by_ms` at most."""

    how: Disturbance
    channel: str
    by_ms: float = HOLD_MS

    NAMES = tuple(how.value for how in Disturbance)
    KEYS = ("by", "in", "nth", "after", "when", *REPEAT_KEYS)

    repeats = True
    counts_messages = True
    acts_in_node = True

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        how = Disturbance(words.name)
        if "by" in words and how not in HOLDING:
            later = " and a ".join(h.value for h in HOLDING)
            raise ConfigError(f"'by {words['by']}': {how.value} holds nothing back; a {later} does")
        return cls(how, words.subject, milliseconds("delay", words["by"]) if "by" in words else HOLD_MS)

    @property
    def name(self) -> str:
        return self.how.value

    def subject(self, target: str) -> list[str]:
        return [self.channel, f"by {duration(self.by_ms)}" if self.how in HOLDING else "", "in", target]

    def validate(self, fault: AnyFault) -> None:
        """It counts messages, whatever the events."""
        if fault.trigger.event:
            raise ValueError(f"a fault of a channel waits for no event: {fault.trigger.event}")

    @classmethod
    def subjects(cls, graph: Graph) -> list[str]:
        return list(dict.fromkeys(link.name for link in graph.links))

    @classmethod
    def next_words(cls, words: Sequence[str], graph: Graph) -> Iterable[str]:
        holding = Disturbance(words[0]) in HOLDING
        return (word for word in super().next_words(words, graph) if holding or word != "by")

    def check(self, fault: AnyFault, graph: Graph) -> None:
        """The target has to send on the channel, in the roles that it can have."""
        channels = self.subjects(graph)
        if self.channel not in channels:
            raise unknown("channel", self.channel, channels)
        if not 0 < self.by_ms <= DURATION_MS_MAX:
            raise ConfigError(f"by {self.by_ms:g}ms: up to {DURATION_MS_MAX}ms are allowed")
        targets.possible_roles(fault.target, graph)
        if all(self.waits_in(fault, roles) is None for roles in targets.role_assignments(graph)):
            raise ConfigError(
                f"{fault}: under --ftm {graph.ftm} {fault.target} sends nothing on {self.channel}"
            )

    def waits_in(self, fault: AnyFault, roles: targets.Roles) -> str | None:
        return targets.sender(roles, self.channel, roles.replica(fault.target))

    def receipt(self, injection: Injection, run: RunControl) -> Receipt:
        """Activated when a message went out altered; applied while it is merely held back."""
        found = run.records_about(injection)
        if not found:
            return injection.receipt
        altered = [r for r in found if fault_and_bits(r.detail)[1] == ALTERED]
        request = (altered or found)[0].request_id
        about = f"a message of {injection.brick} about {f'request {request}' if request else 'no request'}"
        if not altered:
            return Receipt(ReceiptState.APPLIED, f"{about} was held back, and is late at most")
        return Receipt(ReceiptState.ACTIVATED, f"{about}{more_times(len(altered))}")


# -- in the node: what lies on a channel -----------------------------------------------------------


RecordStrike = Callable[[int, int], None]  # HELD or ALTERED, and the request that the message is about


class _HeldMessage(NamedTuple):
    """A message, until when it is held back, and whether for its own sake."""

    due_ns: int
    message: Message
    struck: bool


class FilterStage:
    """One fault of one channel. It strikes the `nth` message, and then as its persistence says."""

    def __init__(
        self, fault: ChannelFault, nth: int, persistence: Persistence, draw: int, record: RecordStrike
    ) -> None:
        self._how, self._by_ns = fault.how, round(fault.by_ms * 1e6)
        self._persistence, self._draw, self._record = persistence, draw, record
        self._left, self._strikes = nth, 0
        self._held: deque[_HeldMessage] = deque()

    @property
    def over(self) -> bool:
        """It will do nothing any more."""
        return self._left <= 0 and not self._held

    def due_ns(self) -> int | None:
        return self._held[0].due_ns if self._held else None

    def stop(self) -> None:
        self._left = 0

    def take(self, message: Message, now_ns: int) -> list[Message]:
        """What is sent when the sender sends `message`."""
        due = self.release(now_ns)
        return [*due, *(self._strike(message, now_ns) if self._is_hit() else self._pass(message))]

    def release(self, now_ns: int) -> list[Message]:
        """What is held back and due. Of a reordered message no successor has come: it is merely late."""
        found = []
        while self._held and self._held[0].due_ns <= now_ns:
            held = self._held.popleft()
            found.append(held.message)
            if held.struck and self._how is Disturbance.DELAY:
                self._record(ALTERED, request_of(held.message))
        return found

    def flush(self) -> list[Message]:
        """All that is held back, since another channel is bound."""
        return self.release(self._held[-1].due_ns) if self._held else []

    def _is_hit(self) -> bool:
        if self._how is Disturbance.REORDER and self._held:
            return False  # a successor goes ahead, whatever else is due
        if self._left <= 0:
            return False
        self._left -= 1
        if self._left:
            return False
        self._strikes += 1
        self._left = gap(self._persistence, self._draw, self._strikes)
        return True

    def _strike(self, message: Message, now_ns: int) -> list[Message]:
        about = request_of(message)
        match self._how:
            case Disturbance.OMISSION:
                self._record(ALTERED, about)
                return []
            case Disturbance.DUPLICATE:
                self._record(ALTERED, about)
                return [message, message]
            case Disturbance.DELAY | Disturbance.REORDER:
                last_ns = self._held[-1].due_ns if self._held else 0
                self._held.append(_HeldMessage(max(last_ns, now_ns + self._by_ns), message, struck=True))
                self._record(HELD, about)
                return []
            case _:
                assert_never(self._how)

    def _pass(self, message: Message) -> list[Message]:
        if not self._held:
            return [message]
        if self._how is Disturbance.DELAY:  # behind what is held back, at once
            self._held.append(_HeldMessage(self._held[-1].due_ns, message, struck=False))
            return []
        overtaken = self._held.popleft().message
        self._record(ALTERED, request_of(overtaken))
        return [message, overtaken]


class ChannelFilter:
    """All faults of one channel; what one lets through comes to the next."""

    def __init__(self) -> None:
        self._stages: dict[int, FilterStage] = {}

    def add(self, fault: int, stage: FilterStage) -> None:
        """One more, behind the others; one that is there already begins anew."""
        self._stages[fault] = stage

    def stop(self, fault: int) -> None:
        """`fault` strikes no more; what it holds back is sent in its time."""
        if fault in self._stages:
            self._stages[fault].stop()

    @property
    def over(self) -> bool:
        """Nothing will be disturbed any more."""
        return all(stage.over for stage in self._stages.values())

    def due_ns(self) -> int | None:
        dues = (stage.due_ns() for stage in self._stages.values())
        return min((due for due in dues if due is not None), default=None)

    def take(self, message: Message, now_ns: int) -> list[Message]:
        return self._through(0, [message], now_ns)

    def release(self, now_ns: int) -> list[Message]:
        return self._let(lambda stage: stage.release(now_ns), now_ns)

    def flush(self, now_ns: int) -> list[Message]:
        """All that is held back, in its order."""
        found = self._let(lambda stage: stage.flush(), now_ns)
        while self.due_ns() is not None:  # what one stage has let go, the next one has held back
            found += self._let(lambda stage: stage.flush(), now_ns)
        return found

    def _let(self, what: Callable[[FilterStage], list[Message]], now_ns: int) -> list[Message]:
        found: list[Message] = []
        for place, stage in reversed(list(enumerate(self._stages.values()))):
            found += self._through(place + 1, what(stage), now_ns)
        return found

    def _through(self, place: int, messages: list[Message], now_ns: int) -> list[Message]:
        """What comes out of the stages from `place` on."""
        for stage in list(self._stages.values())[place:]:
            messages = [out for message in messages for out in stage.take(message, now_ns)]
        return messages


def request_of(message: Message) -> int:
    """The request that `message` is about, or 0."""
    found = getattr(message, "request_id", 0)
    assert isinstance(found, int)
    return found
