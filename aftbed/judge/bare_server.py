"""The bare server: the function without any mechanism, or its versions in turn, and how replies are compared.

This is executed in processes of their own too (`execution`): it imports nothing of the runtime, which would
take most of their time.
"""

import contextlib
from collections.abc import Callable, Iterable
from typing import Final

import msgspec

from aftbed.core.application import Application, Characteristics, Field, close, difference, reply_fields_of
from aftbed.core.errors import FunctionFailedError, PeerError
from aftbed.functions.load import Code, load_application
from aftbed.vehicle.aeb.function import default_application

Make = Callable[[], Application]
Change = tuple[int, Make | None]  # from which request on, counted from 1; None: the version of before
NamedChange = tuple[int, str | None]  # the same, by `MODULE:CLASS` or `FILE.py:CLASS`; "": the built-in one
BUILT_IN: Final = ""


class Succession:
    """An application whose requests are executed by several versions in turn, as `changes` have it."""

    def __init__(self, first: Make, changes: list[Change]) -> None:
        self._function = first()
        self._before: list[Application] = []
        self._changes = list(changes)
        self._count = 0
        self.characteristics = self._function.characteristics
        self.rules = [rule_of(self._function)]

    def _serve(self, function: Application) -> None:
        self._function = function
        self.characteristics = function.characteristics
        self.rules.append(rule_of(function, self._count, self.rules[-1]))

    def execute(self, request: bytes) -> bytes:
        self._count += 1
        while self._changes and self._count >= self._changes[0][0]:
            _, make = self._changes.pop(0)
            if make is not None:
                self._update(make())
            else:
                self._go_back()
        return self._function.execute(request)

    def _update(self, new: Application) -> None:
        state = self._function.capture()
        if state:  # as in the run: without a state the next version begins anew
            getattr(new, "migrate", new.restore)(state)
        self._before.append(self._function)
        self._serve(new)

    def _go_back(self) -> None:
        """The version of before was kept as it was; it takes the state of the other, if there is one."""
        state, old = self._function.capture(), self._before.pop()
        with contextlib.suppress(PeerError):  # no replica went on that refused it
            if state:
                getattr(old, "migrate", old.restore)(state)
        self._serve(old)

    def close(self) -> None:
        for version in (*self._before, self._function):
            close(version)

    def capture(self) -> bytes:
        return self._function.capture()

    def restore(self, state: bytes) -> None:
        self._function.restore(state)

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        return self._function.acceptable(request, reply)


def loaded(changes: Iterable[NamedChange], code: Code) -> list[Change]:
    """The same with the versions, which are executed for that. Raises ConfigError where one is no good."""

    return [(n, None if function is None else maker(function, code)) for n, function in changes]


def maker(function: str, code: Code) -> Make:
    """Of the function that a record names. Raises ConfigError."""
    return load_application(function, code) if function else default_application


class ReplyRule(msgspec.Struct, frozen=True):
    """How replies are compared, from request `first` on: by so much their numbers may differ.

    Where the function is not `deterministic`, they are not compared.
    """

    first: int = 1
    deterministic: bool = True
    tolerance: float = 0.0
    fields: tuple[Field, ...] = ()


EXACT_REPLIES: Final = ReplyRule()


def rule_of(function: Application, first: int = 1, before: ReplyRule = EXACT_REPLIES) -> ReplyRule:
    """From request `first` on, with which `function` begins to serve, with the state of the one before."""
    declared = getattr(function, "characteristics", Characteristics())
    return ReplyRule(
        first,
        before.deterministic and declared.deterministic,
        max(before.tolerance, declared.state_access.tolerance),
        reply_fields_of(function),
    )


class ReferenceRun(msgspec.Struct, frozen=True):
    """What the bare server makes of the requests of a run: its replies, by id, and its state behind them.

    A request that it refuses has an empty reply. `unknown`: why nothing is known of them, "" where they are.
    `rules`: how they are compared with those of the run; one for each version of the function that served.
    """

    replies: tuple[tuple[int, bytes], ...]
    state: bytes
    unknown: str = ""
    rules: tuple[ReplyRule, ...] = (EXACT_REPLIES,)

    @property
    def deterministic(self) -> bool:
        """To the end: each rule has what those before have."""
        return self.rules[-1].deterministic

    @property
    def tolerance(self) -> float:
        """The greatest one."""
        return self.rules[-1].tolerance

    def rule(self, number: int) -> ReplyRule:
        """By which the reply to request `number` is compared."""
        return next((rule for rule in reversed(self.rules) if rule.first <= number), self.rules[0])

    def is_wrong(self, number: int, reply: bytes, expected: bytes) -> bool:
        """Whether `reply` cannot be taken for the one that is expected to request `number`."""
        if reply == expected:
            return False
        rule = self.rule(number)
        return rule.deterministic and difference(rule.fields, reply, expected) > rule.tolerance


def executed(requests: Iterable[tuple[int, bytes]], bare: Application) -> ReferenceRun:
    """`bare` is a fresh one: it executes each request, in their order."""
    replies, number = list[tuple[int, bytes]](), 0
    try:
        for number, payload in requests:
            try:
                replies.append((number, bare.execute(payload)))
            except PeerError:
                replies.append((number, b""))
        state = bare.capture()
    except FunctionFailedError as error:
        return ReferenceRun((), b"", unknown=f"the bare function fails at request {number}: {error}")
    rules = bare.rules if isinstance(bare, Succession) else (rule_of(bare),)
    return ReferenceRun(tuple(replies), state, rules=tuple(rules))
