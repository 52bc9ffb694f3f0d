"""Bit flips of a value that a brick has in hand: a request, a result, the state, a checkpoint, a kept reply.

    bitflip PLACE [BITS] [in REPLICA] [at EVENT] [nth N] | [after 200ms] [AGAIN]     [when ttc < 1.2]

    PLACE = result | state | request | checkpoint | log
    BITS  = bit K | bits N | byte [K] | burst N [bit K] | stuck K=0|1
    AGAIN = permanent | intermittent every N | intermittent p 0.1

It strikes where the value is in hand: without a word about when, at the next such event. A fault that lasts
belongs to the process that it struck first, as a broken part of the hardware does: a process that takes its
place is sound.
"""

from collections.abc import Sequence
from enum import Enum
from typing import Final, Self

import msgspec
from msgspec import structs

from aftbed.core.brick import Brick, Effect, Note, Send
from aftbed.core.errors import ConfigError, PeerError, unknown
from aftbed.core.events import Event, event_named
from aftbed.core.graph import Graph
from aftbed.core.journal import Record
from aftbed.core.messages import (
    Checkpoint,
    Message,
    Pages,
    Reply,
    Request,
    StateCaptured,
    StoreReply,
    Trial,
    Tried,
)
from aftbed.ftm.pages import Spans, spans
from aftbed.inject import targets
from aftbed.inject.grammar import (
    PATTERN_KEYS,
    REPEAT_KEYS,
    WHEN_KEYS,
    Bit,
    BitPattern,
    Bits,
    Byte,
    FaultWords,
    StuckBit,
    Trigger,
    bit_names,
    bits_to_flip,
    check_pattern,
    lacks_bits,
    read_pattern,
    with_flipped,
)
from aftbed.inject.kind import Alteration, AnyFault, FaultKind, Injection, RunControl
from aftbed.inject.receipts import Receipt, ReceiptState, fault_and_bits, more_times
from aftbed.vehicle.aeb.function import STATE_BYTES
from aftbed.vehicle.aeb.messages import REPLY_BYTES_MAX, REQUEST_BYTES_MAX

BITFLIP: Final = "bitflip"
MEMORY: Final = "memory"  # the place of a bit flip outside of all values: see `memory`
BITFLIP_KEYS: Final = (*PATTERN_KEYS, "address", "in", *WHEN_KEYS, *REPEAT_KEYS)


class ValuePlace(Enum):
    """What is hit."""

    RESULT = "result"  # what one execution answers
    STATE = "state"  # what the function remembers
    REQUEST = "request"  # what the Server is handed
    CHECKPOINT = "checkpoint"  # the state, and behind it the reply, on their way to the backup
    LOG = "log"  # the reply that a Protocol keeps, to answer with once more


PLACES: Final = tuple(place.value for place in ValuePlace)
EXECUTED: Final = (ValuePlace.RESULT, ValuePlace.STATE)  # what one execution leaves behind: what TR compares
FLIPPED_AT: Final = {  # the events at which the value is in hand; the first is meant where none is named
    ValuePlace.RESULT: (Event.SERVER_EXIT,),
    ValuePlace.STATE: (Event.SERVER_EXIT, Event.STATE_CAPTURED, Event.STATE_RESTORED),
    ValuePlace.REQUEST: (Event.SERVER_ENTER,),
    ValuePlace.CHECKPOINT: (Event.CHECKPOINT_SENT,),
    ValuePlace.LOG: (Event.REPLY_STORED, Event.DEDUPE_HIT, Event.CHECKPOINT_APPLIED),
}
LoggedReplies = tuple[int, list[tuple[int, bytes]]]  # as a Protocol captures it: the last id, ids and replies
_BRAKE_BYTES_MAX: Final = {  # of the built-in function
    ValuePlace.RESULT: REPLY_BYTES_MAX,
    ValuePlace.STATE: STATE_BYTES,
    ValuePlace.REQUEST: REQUEST_BYTES_MAX,
    ValuePlace.LOG: REPLY_BYTES_MAX,
}
_USES: Final = (Event.SERVER_ENTER, Event.STATE_CAPTURED)  # of a state that was hit


class ValueFlip(FaultKind, frozen=True, tag=BITFLIP):
    """Bits of the value at `place` are flipped, as `pattern` says."""

    place: ValuePlace
    pattern: BitPattern = Bit()

    NAMES = (BITFLIP,)
    KEYS = BITFLIP_KEYS
    REFUSED = ("address",)

    alters_value = True
    repeats = True
    acts_in_node = True

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        if words.subject not in PLACES:
            raise unknown("place of a bitflip", words.subject, (*PLACES, MEMORY))
        no_address(words)
        return cls(ValuePlace(words.subject), read_pattern(words))

    @property
    def nth_event(self) -> str:
        """The first at which the value is in hand."""
        return FLIPPED_AT[self.place][0].label

    @classmethod
    def subjects(cls, graph: Graph) -> tuple[str, ...]:
        return PLACES

    def subject(self, target: str) -> list[str]:
        return [self.place.value, str(self.pattern), "in", target]

    def event(self, trigger: Trigger) -> str:
        return trigger.event or self.nth_event

    def check(self, fault: AnyFault, graph: Graph) -> None:
        """The target has to have the value in hand at the event, in the roles that it can have."""
        check_pattern(self.pattern)
        if not any(brick.application for brick in graph.bricks):  # of others the sizes are not known here
            self._check_size()
        roles = targets.possible_roles(fault.target, graph)
        event = event_named(fault.event)
        places = FLIPPED_AT[self.place]
        emitted = {e.label for e in places for role in roles if targets.emits(graph, e, role)}
        if not emitted:
            executes = f"the Server of a {fault.target} executes nothing"
            all_of_server = all(targets.emitting_part(e) == "server" for e in places)
            nothing = executes if all_of_server else f"{fault.target} has none"
            raise ConfigError(f"{fault}: under --ftm {graph.ftm} {nothing}")
        if event.label not in emitted:
            raise unknown(
                f"event for a bit of the {self.place.value} in {fault.target}:", event.label, emitted
            )

    def _check_size(self) -> None:
        bytes_max = _BRAKE_BYTES_MAX.get(self.place)
        if bytes_max is not None and lacks_bits(self.pattern, 8 * bytes_max):
            has = f"bytes 0 to {bytes_max - 1} at most, bits 0 to {8 * bytes_max - 1}"
            raise ConfigError(f"{self.pattern} of {self.place.value}: the brake's has {has}")

    def waits_in(self, fault: AnyFault, roles: targets.Roles) -> str | None:
        return targets.emitting_brick_of(roles, fault.event, roles.replica(fault.target))

    # -- in the node ------------------------------------------------------------------------------

    @property
    def alters_step(self) -> bool:
        """A Note comes too late for what the Server was handed, and for what has gone to the backup."""
        return self.place in (ValuePlace.REQUEST, ValuePlace.CHECKPOINT)

    def alter_input(self, message: Message, draw: int) -> tuple[Message, Alteration | None]:
        if self.place is not ValuePlace.REQUEST or not isinstance(message, Request | Trial):
            return message, None
        payload, bits = self._flip(message.payload, draw)
        handed = structs.replace(message, payload=payload) if bits else message
        return handed, Alteration(message.request_id, bits, 8 * len(payload))

    def alter_output(self, effects: list[Effect], draw: int) -> tuple[list[Effect], Alteration | None]:
        if self.place is not ValuePlace.CHECKPOINT:
            return effects, None
        for at, effect in enumerate(effects):
            if isinstance(effect, Send) and isinstance(effect.message, Checkpoint):
                altered, hit = self._alter_checkpoint(effect.message, draw)
                return [*effects[:at], Send(effect.port, altered), *effects[at + 1 :]], hit
        return effects, None

    def _alter_checkpoint(self, sent: Checkpoint, draw: int) -> tuple[Checkpoint, Alteration]:
        """Bits count in the whole state and the reply behind it, though only pages of it may travel.

        Their checksum stays as it is: it was made before.
        """
        state, reply = sent.state, sent.reply
        if isinstance(state, Pages):
            travels, parts, state_bytes = state.data, spans(state), state.state_bytes
        else:
            travels, parts, state_bytes = state, [(0, len(state))], len(state)
        parts = [*parts, (state_bytes, state_bytes + len(reply))]
        pattern = _in_parts(self.pattern, parts)
        bits = () if pattern is None else bits_to_flip(pattern, travels + reply, draw) or ()
        data = with_flipped(travels + reply, bits)
        travels, reply = data[: len(travels)], data[len(travels) :]
        altered = structs.replace(state, data=travels) if isinstance(state, Pages) else travels
        in_whole = tuple(_in_whole(bit, parts) for bit in bits)
        hit = Alteration(sent.request_id, in_whole, 8 * (state_bytes + len(reply)))
        return structs.replace(sent, state=altered, reply=reply), hit

    def alter_at(self, brick: Brick, effects: list[Effect], at: int, draw: int) -> Alteration:
        """What the brick has in hand, and the message behind the Note that carries it away."""
        note = effects[at]
        assert isinstance(note, Note)
        index, send = next((i, e) for i, e in enumerate(effects) if i > at and isinstance(e, Send))
        data = self._in_hand(brick, send.message, note)
        altered, bits = self._flip(data, draw)
        message = self._with(brick, send.message, note, altered) if bits else None
        if message is not None:
            effects[index] = Send(send.port, message)
        return Alteration(note.request_id, bits if message is not None else (), 8 * len(data))

    def _flip(self, data: bytes, draw: int) -> tuple[bytes, tuple[int, ...]]:
        """The data with its bits flipped, and which; none where there are none, or they are so already."""
        bits = bits_to_flip(self.pattern, data, draw) or ()
        return with_flipped(data, bits), bits

    def _in_hand(self, brick: Brick, message: Message, note: Note) -> bytes:
        """The bytes that have the bits; none where the brick does not hand them out."""
        if self.place is ValuePlace.LOG and note.event is Event.REPLY_STORED:
            log = _logged(brick)
            return dict(log[1]).get(note.request_id, b"") if log is not None else b""
        if self.place is not ValuePlace.STATE:
            assert isinstance(message, Reply | Tried | StoreReply), message
            return message.payload
        try:
            return brick.capture()
        except PeerError:
            return b""

    def _with(self, brick: Brick, message: Message, note: Note, data: bytes) -> Message | None:
        """What `message` is with `data`; None where the brick refuses such a state, or ignores the bits."""
        if self.place is ValuePlace.LOG:
            if note.event is not Event.CHECKPOINT_APPLIED and not _relog(brick, note, data):
                return None
            if note.event is Event.REPLY_STORED:
                return message  # the reply itself is as it should be
        if self.place is not ValuePlace.STATE:
            return structs.replace(message, payload=data)
        before = brick.capture()
        try:
            brick.restore(data)
        except PeerError:
            return None
        state = brick.capture()
        if state == before:
            return None
        carries_state = isinstance(message, Tried | StateCaptured)
        return structs.replace(message, state=state) if carries_state else message

    # -- what became of it ------------------------------------------------------------------------

    def receipt(self, injection: Injection, run: RunControl) -> Receipt:
        """Activated when a brick worked with what was hit: see `docs/faults.md`."""
        about = run.records_about(injection)
        if not about:
            return injection.receipt
        strikes = [r for r in about if r.event is Event.FAULT_APPLIED]
        if not strikes:
            return self._missed(injection, about[0])
        request = strikes[0].request_id
        bits = sorted({fault_and_bits(r.detail)[1] for r in strikes if r.request_id == request})
        keeper = f"{injection.brick.partition('/')[0]}/protocol" if self.place is ValuePlace.LOG else ""
        journal = run.records_of(injection, keeper)
        used = any(self._is_used(injection.fault, record, journal) for record in strikes)
        state = ReceiptState.ACTIVATED if used else ReceiptState.APPLIED
        where = self._where(injection, request)
        return Receipt(state, f"{bit_names(bits)} {where}{more_times(len(strikes) // len(bits))}")

    def _is_used(self, fault: AnyFault, struck: Record, journal: Sequence[Record]) -> bool:
        """Whether a brick worked with what was hit. Most values leave with the message that shows them."""
        if self.place is ValuePlace.STATE and fault.event != Event.STATE_CAPTURED.label:
            after = (r for r in journal if r.t_ns >= struck.t_ns and r.node == struck.node)
            next_ = (r for r in after if r.event in (*_USES, Event.STATE_RESTORED))
            first = next((r for r in next_ if r.t_ns > struck.t_ns or r.event in _USES), None)
            return first is not None and first.event in _USES
        if self.place is ValuePlace.LOG and fault.event != Event.DEDUPE_HIT.label:
            hits = (r for r in journal if r.event is Event.DEDUPE_HIT and r.request_id == struck.request_id)
            return any(r.t_ns >= struck.t_ns for r in hits)
        return True

    def _missed(self, injection: Injection, record: Record) -> Receipt:
        """Nothing was hit: no such bits, a bit stuck at its value, or a state that the function refuses."""
        _, size = fault_and_bits(record.detail)
        where = self._where(injection, record.request_id)
        if isinstance(self.pattern, StuckBit) and self.pattern.at < size:
            detail = f"bit {self.pattern.at} {where} is {self.pattern.value} as it is, or was refused"
            return Receipt(ReceiptState.NOT_ACTIVATED, detail)
        bits = bits_to_flip(self.pattern, bytes(size // 8), injection.draw)
        if bits is None:
            unit, count = ("bytes", size // 8) if isinstance(self.pattern, Byte) else ("bits", size)
            return Receipt(ReceiptState.NOT_ACTIVATED, f"there are {count} {unit} {where}")
        if self.place is ValuePlace.CHECKPOINT:
            detail = f"{bit_names(bits)} {where} did not travel: nothing has changed there"
            return Receipt(ReceiptState.NOT_ACTIVATED, detail)
        return Receipt(ReceiptState.NOT_ACTIVATED, f"the function refused {bit_names(bits)} {where}")

    def _where(self, injection: Injection, request_id: int) -> str:
        return f"of the {self.place.value} of request {request_id} in {injection.brick}"


def _in_parts(pattern: BitPattern, parts: Spans) -> BitPattern | None:
    """The pattern in what travels, laid end to end; None where its place does not travel."""
    if isinstance(pattern, Bits) or pattern.at is None:
        return pattern
    unit, begins = 1 if isinstance(pattern, Byte) else 8, 0
    for begin, end in parts:
        if unit * begin <= pattern.at < unit * end:
            return structs.replace(pattern, at=unit * (begins - begin) + pattern.at)
        begins += end - begin
    return None


def _in_whole(bit: int, parts: Spans) -> int:
    """The bit of the whole that is bit `bit` of what travels."""
    left = bit
    for begin, end in parts:
        if left < 8 * (end - begin):
            return 8 * begin + left
        left -= 8 * (end - begin)
    raise AssertionError(f"bit {bit} of {parts}")


def _logged(brick: Brick) -> LoggedReplies | None:
    """The replies that a Protocol keeps; None where the brick captures something else."""
    try:
        log: LoggedReplies = msgspec.msgpack.decode(brick.capture(), type=LoggedReplies)
    except (msgspec.DecodeError, PeerError):
        return None
    return log


def _relog(brick: Brick, note: Note, reply: bytes) -> bool:
    """Keep `reply` for the request of `note`; False if the Protocol does not take it."""
    log = _logged(brick)
    if log is None:
        return False
    kept = [(number, reply if number == note.request_id else payload) for number, payload in log[1]]
    try:
        brick.restore(msgspec.msgpack.encode((log[0], kept)))
    except PeerError:
        return False
    return True


def no_address(words: FaultWords) -> None:
    """Raise ConfigError where an address is given."""
    if "address" in words:
        raise ConfigError(f"'address {words['address'][:40]}': only memory has addresses: 'bitflip {MEMORY}'")
