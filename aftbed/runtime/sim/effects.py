"""The effects of a step, one after the other: all at once, up to a death between two of them, or in parts.

A write into a channel without room, and a fault that the executive must see applied, hold up what is behind
them; it is gone on with later, before anything else is handled.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple

from aftbed.core.brick import Brick, Effect, Note, Send
from aftbed.core.journal import Record
from aftbed.core.messages import Message
from aftbed.runtime.blows import fire
from aftbed.runtime.orders import order_or_halt
from aftbed.runtime.sim.channels import Channel
from aftbed.runtime.sim.clock import Clock

if TYPE_CHECKING:
    from aftbed.runtime.sim.node import Node

NEVER: Final = 1 << 62
WRITE_NS_MAX: Final = 2_000_000_000  # as a real node waits for room, or for word of another channel


class Died(BaseException):
    """The node has died in the middle of a step. Not an Exception: nothing may take it for an error."""


class Hosted:
    """A brick, its inlets, and where its outputs lead: a channel, or a function."""

    __slots__ = ("brick", "effects", "index", "inlets", "name", "outs", "timed")

    def __init__(self, name: str, brick: Brick, index: int) -> None:
        self.name, self.brick, self.index = name, brick, index
        self.inlets: dict[str, Channel] = {}
        self.outs: dict[str, Channel | Callable[[Message], None]] = {}
        self.timed = type(brick).deadline_ns is not Brick.deadline_ns
        self.effects = 0  # performed so far


class _Held(NamedTuple):
    """Effects from `at` on that could not be performed: by `out`, until `limit_ns` at most."""

    hosted: Hosted
    effects: list[Effect]
    at: int
    out: Channel | None
    limit_ns: int


def _way(tried: Channel, now: Channel | Callable[[Message], None]) -> Channel | None:
    """Where to send what had no room in `tried`, since the port leads `now`; None where that is elsewhere.

    A fault that was armed at the channel meanwhile strikes what is sent later.
    """
    if not isinstance(now, Channel) or now.beneath is not tried.beneath:
        return None
    return tried if tried.beneath is tried else now


class Performer:
    """Of one node. `doom`: a brick, and before which of its effects it dies; `held_by`: a fault, or 0."""

    def __init__(self, node: "Node", clock: Clock) -> None:
        self._node, self._clock = node, clock
        self.left: list[_Held] = []  # what a write or a fault holds up; the last one first
        self.doom: tuple[str, int] | None = None
        self.held_by = 0

    def perform(self, hosted: Hosted, effects: list[Effect], start: int) -> None:
        """The effects from `start` on, in their order."""
        node = self._node
        if self.doom is not None or node.armed or start:
            self._carefully(hosted, effects, start)
            return
        hosted.effects += len(effects)
        outs, now_ns = hosted.outs, self._clock.ns
        for at, effect in enumerate(effects):
            if type(effect) is Send:
                out = outs[effect.port]
                if isinstance(out, Channel):
                    if not out.put(effect.message):
                        hosted.effects -= len(effects) - at
                        self._hold(hosted, effects, at, out)
                        return
                else:
                    out(effect.message)
            elif type(effect) is Note:
                node.records.append(
                    Record(now_ns, effect.event, effect.request_id, effect.detail, node.name, hosted.index)
                )
            else:
                order_or_halt(node, hosted, effect)

    def _carefully(self, hosted: Hosted, effects: list[Effect], start: int) -> None:
        """The same, where it may end before the last one."""
        node = self._node
        for at in range(start, len(effects)):
            if self.held_by or node.frozen_ns:
                self._hold(hosted, effects, at, None)
                return
            if self.doom == (hosted.name, hosted.effects):
                raise Died
            out = self._one(hosted, effects, at)
            if out is not None:
                self._hold(hosted, effects, at, out)
                return
            hosted.effects += 1
        if self.doom == (hosted.name, hosted.effects):
            raise Died

    def _one(self, hosted: Hosted, effects: list[Effect], at: int) -> Channel | None:
        """The channel that has no room for it, if it has to wait."""
        node = self._node
        effect = effects[at]
        if isinstance(effect, Send):
            out = hosted.outs[effect.port]
            if isinstance(out, Channel):
                return None if out.put(effect.message) else out
            out(effect.message)
        elif isinstance(effect, Note):
            node.records.append(
                Record(
                    self._clock.ns, effect.event, effect.request_id, effect.detail, node.name, hosted.index
                )
            )
            if node.armed:
                fire(node, hosted, effects, effect)
        else:
            order_or_halt(node, hosted, effect)
        return None

    def _hold(self, hosted: Hosted, effects: list[Effect], at: int, out: Channel | None) -> None:
        """Go on from there later. A write that is held up too long ends the node."""
        limit_ns = self._clock.ns + WRITE_NS_MAX if out is not None else NEVER
        self.left.append(_Held(hosted, effects, at, out, limit_ns))
        if out is not None:
            self._clock.at(limit_ns, self._node.run)

    def go_on(self) -> bool:
        """With what was left. True if all is done."""
        while self.left:
            held = self.left[-1]
            at, effect = held.at, held.effects[held.at]
            if held.out is not None:
                assert isinstance(effect, Send)
                way = _way(held.out, held.hosted.outs[effect.port])
                if way is not None and not way.put(effect.message):
                    if self._clock.ns >= held.limit_ns:
                        raise Died("fenced")
                    return False
                at += 1  # sent; or bound elsewhere: the brick has heard of it, and has asked again
                held.hosted.effects += 1
            self.left.pop()
            before = len(self.left)
            self._carefully(held.hosted, held.effects, at)
            if len(self.left) > before:
                return False
        return True
