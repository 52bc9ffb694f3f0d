"""Bit flips of one field of the function's state, in memory, at any moment.

    bitflip state.FIELD [BITS] [in REPLICA] [at EVENT] [nth N] | [after 200ms] | [when ttc < 1.2]

Unlike a flip of the whole state (`value`), it needs no moment at which a brick has the state in hand: the
state is in memory that the supervisor shares (`shared_state`). Without a word about when, it strikes at
once.
"""

import re
from collections.abc import Sequence
from typing import Final, Self

from aftbed.core.application import fields_of
from aftbed.core.errors import ConfigError, StepFailed, unknown
from aftbed.core.events import Event
from aftbed.core.graph import Graph
from aftbed.inject import targets
from aftbed.inject.grammar import REPEAT_KEYS, Bit, BitPattern, FaultWords, check_pattern, read_pattern
from aftbed.inject.kind import AnyFault, FaultKind, Injection, RunControl, Steps
from aftbed.inject.receipts import Receipt, ReceiptState
from aftbed.inject.shared_state import SharedState, field_with_bits
from aftbed.inject.value import BITFLIP, BITFLIP_KEYS, MEMORY, PLACES, no_address
from aftbed.vehicle.aeb.function import AebFunction

STATE: Final = "state"
FIELD_CHARACTERS_MAX: Final = 60
_FIELD: Final = re.compile(r"[A-Za-z0-9_]+(\.[A-Za-z0-9_]+)*")


class StateFlip(FaultKind, frozen=True, tag="state"):
    """Bits of the field of that name are flipped, as `pattern` says."""

    field: str
    pattern: BitPattern = Bit()

    NAMES = (BITFLIP,)
    KEYS = BITFLIP_KEYS
    REFUSED = ("address", *REPEAT_KEYS)

    alters_value = True
    strikes_stored_state = True
    shares_state = True

    @classmethod
    def claims(cls, words: Sequence[str]) -> bool:
        return super().claims(words) and "." in words[1]

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        place, _, field = words.subject.partition(".")
        if place not in PLACES:
            raise unknown("place of a bitflip", place, (*PLACES, MEMORY))
        no_address(words)
        if place != STATE:
            raise ConfigError(f"{place + '.' + field[:40]!r}: only the state has fields, as state.ego_ms")
        if not _FIELD.fullmatch(field) or len(field) > FIELD_CHARACTERS_MAX:
            named = f"letters, digits, _ and . are allowed, {FIELD_CHARACTERS_MAX} at most"
            raise ConfigError(f"field {field[:40]!r} of the state: {named}")
        lasting = words.first_of(REPEAT_KEYS)
        if lasting is not None:
            raise ConfigError(
                f"{lasting!r}: a bitflip of a field strikes once; that of a whole state can last"
            )
        return cls(field, read_pattern(words))

    @property
    def nth_event(self) -> str:
        return Event.SERVER_EXIT.label

    @classmethod
    def subjects(cls, graph: Graph) -> tuple[str, ...]:
        """The fields of the built-in function; those of another one are known only in its node."""
        if any(brick.application for brick in graph.bricks):
            return ()
        return tuple(f"{STATE}.{field.name}" for field in fields_of(AebFunction))

    def subject(self, target: str) -> list[str]:
        return [f"{STATE}.{self.field}", str(self.pattern), "in", target]

    def check(self, fault: AnyFault, graph: Graph) -> None:
        """The fields of a function that was written off line are known only in its node."""
        check_pattern(self.pattern)
        targets.possible_roles(fault.target, graph)
        targets.check_event(fault.event, graph)
        if not any(brick.application for brick in graph.bricks):
            field_with_bits(self.field, self.pattern, fields_of(AebFunction))

    def check_state(self, shared: SharedState) -> None:
        """The function declares its fields once it is there."""
        field_with_bits(self.field, self.pattern, shared.fields)

    def act(self, injection: Injection, run: RunControl) -> Steps[None]:
        """Flip the bits where the state is now: another replica may lead since the arming."""
        try:
            shared = yield from run.shared_state(injection)
            run.record_strike(injection)
            hit = shared.flip(self.field, self.pattern, run.now_ns(), injection.draw)
        except (StepFailed, ConfigError) as error:
            injection.receipt = Receipt(ReceiptState.NOT_ACTIVATED, str(error))
        else:
            injection.state_hit = hit
            injection.receipt = hit.receipt(())
        run.log(injection)

    def receipt(self, injection: Injection, run: RunControl) -> Receipt:
        """Activated when the function has used the bits, or refused them."""
        hit = injection.state_hit
        return injection.receipt if hit is None else hit.receipt(run.journal(hit.journal))
