"""What a kind of fault is. Everything outside of `inject` knows a fault by this interface only.

A kind is one file and one line in `model.FaultAction`. The file has the rule of its words, what it may
target, where it waits, what it does, what its receipt shows, and how it is undone:

    being typed       next_words  what may stand next, for the completion of a shell
    words             from_words  `run --inject "..."`, `aftbed inject`, campaigns
    fault             check       before a run starts, and in it
    armed             waits_in    the brick that comes to its point; none: it strikes at once
    at its point      act         what the supervisor does, as a task of the runtime
    after `lasts_ms`  undo
    at any time       receipt     what has become of it, by journals and by what is seen

What is the same for all kinds belongs to the controller (`runtime.fault_controller`): conditions of the
car, moves after a failover, counting, reports. It hands itself to a kind as `RunControl`.
"""

from collections.abc import Generator, Iterable, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol, Self, TypeVar

import msgspec

from aftbed.core.brick import Brick, Effect
from aftbed.core.errors import ConfigError
from aftbed.core.graph import Graph
from aftbed.core.journal import Record
from aftbed.core.messages import Message
from aftbed.inject import targets
from aftbed.inject.grammar import ONCE, FaultWords, Persistence, Trigger, read_persistence, read_trigger
from aftbed.inject.next_words import next_words
from aftbed.inject.receipts import BusReport, RadarReport, Receipt, ReceiptState
from aftbed.inject.shared_state import SharedState, StateHit
from aftbed.inject.targets import TargetProcess
from aftbed.vehicle.condition import Condition

T = TypeVar("T")
Steps = Generator[Any, Any, T]  # a task of the runtime: what it yields is the runtime's affair


class AnyFault(msgspec.Struct, frozen=True):
    """A fault of any kind: what is done, to what, when, and how often again.

    `model.Fault` is the same for the registered kinds, which can be encoded and decoded.
    `target` is a role, a replica, a node, or another process, as the kind allows.
    Raises ValueError on a combination that means nothing.
    """

    action: "FaultKind"
    target: str
    trigger: Trigger = Trigger()
    persistence: Persistence = ONCE

    def __post_init__(self) -> None:
        self.action.validate(self)

    @property
    def event(self) -> str:
        """The label of the event that it waits for, "" for none."""
        return self.action.event(self.trigger)

    def check(self, graph: Graph) -> None:
        """Raise ConfigError, naming what is allowed, if it cannot happen in `graph`."""
        if self.trigger.nth < 1:
            raise ConfigError(f"nth {self.trigger.nth}: the first occurrence is nth 1")
        self.action.check(self, graph)

    def __str__(self) -> str:
        action = self.action
        when = self.trigger.words(counts_messages=action.counts_messages)
        words = [action.name, *action.subject(self.target), *when, str(self.persistence)]
        return " ".join(filter(None, words))


class Injection:
    """One fault of a run: where it waits, what it has struck, and what became of it so far."""

    def __init__(self, number: int, fault: AnyFault, draw: int) -> None:
        self.number, self.fault, self.draw = number, fault, draw
        self.receipt = Receipt()
        self.struck: Sequence[TargetProcess] = ()  # by the supervisor
        self.host: TargetProcess | None = None  # the process that it waits in
        self.brick = ""  # of the host: it comes to the point
        self.by_itself = False  # the host does it to itself
        self.journals: set[str] = set()  # of all hosts so far
        self.state_hit: StateHit | None = None  # what was flipped in a shared state
        self.unmet: Condition | None = fault.trigger.when  # the condition that it still waits for


class RunControl(Protocol):
    """What a kind may do to a run. The fault controller implements it."""

    def now_ns(self) -> int:
        """Monotonic."""
        ...

    def pause(self) -> None:
        """Let other processes run for a moment."""
        ...

    def log(self, injection: Injection) -> None:
        """Log the receipt."""
        ...

    def processes(self, injection: Injection) -> Sequence[TargetProcess]:
        """The living processes of its target."""
        ...

    def record_strike(self, injection: Injection) -> None:
        """Write it into the supervisor's journal, before the strike."""
        ...

    def until_dead(self, processes: Iterable[TargetProcess]) -> Steps[None]:
        """Wait until they are seen dead."""
        ...

    def slow_down(self, process: TargetProcess, number: int, by_ns: int, share: float) -> Any:
        """Order it; what comes back is for `until_answered`. Raises StepFailed if the process is gone."""
        ...

    def until_answered(self, orders: Iterable[Any]) -> Steps[None]:
        """Wait for the answers. Raises StepFailed."""
        ...

    def shared_state(self, injection: Injection) -> Steps[SharedState]:
        """Where the state of the target's function is, from now on shared. Raises StepFailed."""
        ...

    def flip_memory(self, process: TargetProcess, bit: int | None, address: int | None, draw: int) -> str:
        """Flip a bit of its memory; which it was, in words. Raises StepFailed."""
        ...

    def disturb(self, injection: Injection) -> Steps[None]:
        """Arm it on the bus or in the radar. Raises StepFailed where there is none."""
        ...

    def disturbance(self, injection: Injection) -> BusReport | RadarReport | None:
        """The latest that bus or radar has reported."""
        ...

    def records_about(self, injection: Injection) -> list[Record]:
        """What its hosts and the processes that it struck have recorded about it."""
        ...

    def records_of(self, injection: Injection, brick: str = "") -> list[Record]:
        """All records of its hosts and of what it struck, and of the process that hosts `brick` now."""
        ...

    def journal(self, path: str) -> Iterable[Record]:
        """The records there."""
        ...


class Alteration(NamedTuple):
    """What was altered: these bits of `size`, in what is about request `request_id`. No bits: nothing was."""

    request_id: int
    bits: tuple[int, ...]
    size: int


class FaultKind(msgspec.Struct, frozen=True):
    """What a fault does: the base of all kinds. An instance is one action, as `hang ... for 50ms`."""

    NAMES: ClassVar[tuple[str, ...]] = ()  # the first word of its rule
    KEYS: ClassVar[tuple[str, ...]] = ()  # of the words behind its subject
    REFUSED: ClassVar[tuple[str, ...]] = ()  # of KEYS: read only to say why they make no sense here

    stops_process: ClassVar[bool] = False  # the fault model "crash": the process no longer serves
    alters_value: ClassVar[bool] = False  # the fault model "value"
    strikes_stored_state: ClassVar[bool] = False  # the value lies in memory, in no execution's hands
    takes_real_time: ClassVar[bool] = False  # its length means nothing in lockstep, where time waits
    has_worst_instant: ClassVar[bool] = False  # it may be tried at each instant of a drive
    unsafe: ClassVar[bool] = False  # it strikes whatever is there; the user has to agree to it
    simulated: ClassVar[bool] = True
    needs_bus: ClassVar[bool] = False
    needs_car: ClassVar[bool] = False  # which has a bus, too
    repeats: ClassVar[bool] = False  # it can be permanent or intermittent
    counts_messages: ClassVar[bool] = False  # it waits for messages on a channel, not for an event
    acts_in_node: ClassVar[bool] = False  # the agent of the node does all of it
    emitter_may_act: ClassVar[bool] = False  # a node that emits the event and is the target does it to itself
    shares_state: ClassVar[bool] = False  # the state of the target's function is shared from the arming on

    # -- words ------------------------------------------------------------------------------------

    @classmethod
    def claims(cls, words: Sequence[str]) -> bool:
        """Whether these are words of this kind, right or wrong."""
        return len(words) > 1 and words[0] in cls.NAMES

    @classmethod
    def read(cls, words: Sequence[str]) -> AnyFault:
        """The fault that the words mean. Raises ConfigError naming the word that is wrong."""
        found = FaultWords(words, cls.KEYS)
        action = cls.from_words(found)
        if action.nth_event or cls.counts_messages:
            found.not_both("nth", "after")
        else:
            found.nth_needs_event()
        target = found.get("in", targets.DEFAULT) if "in" in cls.KEYS else found.subject
        return AnyFault(action, target, read_trigger(found, action.nth_event), read_persistence(found))

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        """The action in `words`. Raises ConfigError."""
        raise NotImplementedError

    @classmethod
    def subjects(cls, graph: Graph) -> Iterable[str]:
        """What may stand behind its name in a run of `graph`."""
        return (*targets.roles_in(graph), *graph.nodes)

    @classmethod
    def next_words(cls, words: Sequence[str], graph: Graph) -> Iterable[str]:
        """What may stand behind `words`, its name or more of a fault of this kind."""
        if len(words) == 1:
            return cls.subjects(graph)
        return next_words(words[2:], [key for key in cls.KEYS if key not in cls.REFUSED], graph)

    @property
    def nth_event(self) -> str:
        """The event that a `nth` counts which stands without `at`."""
        return ""

    @property
    def name(self) -> str:
        """What it is called: the first of its words."""
        return self.NAMES[0]

    def subject(self, target: str) -> list[str]:
        """The words between the name and when it strikes."""
        raise NotImplementedError

    # -- checks -----------------------------------------------------------------------------------

    def validate(self, fault: AnyFault) -> None:
        """Raise ValueError on a combination that means nothing."""
        if fault.persistence != ONCE and not self.repeats:
            raise ValueError(f"a {self.name} strikes once")

    def check(self, fault: AnyFault, graph: Graph) -> None:
        """Raise ConfigError, naming what is allowed, if it cannot happen in `graph`."""
        raise NotImplementedError

    @property
    def lasts_ms(self) -> int:
        """After this time it is undone; 0: never, or there is nothing to undo."""
        return 0

    def lasting(self, lasts_ms: int) -> Self:
        """The same with another length. Only where there is one."""
        raise NotImplementedError

    def check_state(self, shared: SharedState) -> None:
        """Raise ConfigError where the shared state has no such bits."""

    # -- where it waits ---------------------------------------------------------------------------

    def event(self, trigger: Trigger) -> str:
        """The label of the event that it waits for, "" for none."""
        return trigger.event

    def waits(self, fault: AnyFault) -> bool:
        """Whether it waits in a node, and does not strike as soon as it is armed."""
        return bool(fault.event) or self.counts_messages

    def waits_in(self, fault: AnyFault, roles: targets.Roles) -> str | None:
        """The brick that comes to its point as the roles are now; None where none does."""
        return targets.emitting_brick(roles, fault.event)

    # -- what it does -----------------------------------------------------------------------------

    def act(self, injection: Injection, run: RunControl) -> Steps[None]:
        """Do it. What it did is in the injection's receipt when the task ends."""
        raise AssertionError(f"{self.name} is done where it waits")

    @property
    def alters_step(self) -> bool:
        """In a node: it strikes within the step whose event is the one to strike at, not at its Note."""
        return False

    def alter_input(self, message: Message, draw: int) -> tuple[Message, Alteration | None]:
        """In a node: what its brick is handed in place of `message`."""
        return message, None

    def alter_output(self, effects: list[Effect], draw: int) -> tuple[list[Effect], Alteration | None]:
        """In a node: the effects of the step in place of `effects`."""
        return effects, None

    def alter_at(self, brick: Brick, effects: list[Effect], at: int, draw: int) -> Alteration:
        """In a node: the Note `effects[at]` is performed. Alter what is behind it in `effects`."""
        raise AssertionError(f"{self.name} is done by the supervisor")

    def undo(self, injection: Injection, run: RunControl) -> None:
        """End it after `lasts_ms`."""

    def receipt(self, injection: Injection, run: RunControl) -> Receipt:
        """What has become of it, by what is known now."""
        return injection.receipt


def strike(injection: Injection, run: RunControl) -> Sequence[TargetProcess]:
    """The processes to act on, with the strike recorded; none, and the receipt says so, if there are none."""
    injection.struck = found = run.processes(injection)
    if found:
        run.record_strike(injection)
    else:
        injection.receipt = Receipt(ReceiptState.NOT_ACTIVATED, "no process to hit")
        run.log(injection)
    return found


def receipt_of_car(injection: Injection, run: RunControl, when: Condition | None) -> Receipt:
    """Of a fault that bus or radar has armed: what they have reported. `when`: what it waits for first."""
    report = run.disturbance(injection)
    if report is None:
        return injection.receipt
    injection.unmet = when if report.waits else None
    return report.receipt
