"""What disturbs a channel, at its sender. Pure: time comes in, what is to be sent goes out.

While a fault waits for its message, what the sender puts into the channel goes through its *diversion*
first. Several faults of one channel stand one behind the other in it. Whatever they do, order is kept but
where it is the fault to break it, and nothing that is held back stays so for ever.
"""

from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple, assert_never

from aftbed.core.fault import Disturb, How
from aftbed.core.messages import Message
from aftbed.core.persistence import gap
from aftbed.runtime import control

STRUCK: Final = 0  # the detail of a record: a message was hit
BITTEN: Final = 1  # and what was sent is not what should have been

Sender = tuple[str, str]  # a brick and its port
Note = Callable[[int, int], None]  # STRUCK or BITTEN, and the request that it was about


class _Held(NamedTuple):
    """A message, until when it is held back, and whether for its own sake."""

    due_ns: int
    message: Message
    struck: bool


class Meddler:
    """One fault of one channel; `note` writes down what it did."""

    def __init__(self, blow: control.Blow, note: Note) -> None:
        assert isinstance(blow.action, Disturb)
        self._blow, self._note = blow, note
        self._how, self._by_ns = blow.action.how, round(blow.action.by_ms * 1e6)
        self._left, self._struck = blow.nth, 0
        self._held: deque[_Held] = deque()

    @property
    def over(self) -> bool:
        """It will do nothing any more."""
        return self._left <= 0 and not self._held

    def due_ns(self) -> int | None:
        """When what it holds back has to be sent."""
        return self._held[0].due_ns if self._held else None

    def stop(self) -> None:
        """Strike no more."""
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
            if held.struck and self._how is How.DELAY:
                self._note(BITTEN, request_of(held.message))
        return found

    def flush(self) -> list[Message]:
        """All that is held back: the channel is another one from now on."""
        return self.release(self._held[-1].due_ns) if self._held else []

    def _is_hit(self) -> bool:
        if self._how is How.REORDER and self._held:
            return False  # a successor goes ahead, whatever else is due
        if self._left <= 0:
            return False
        self._left -= 1
        if self._left:
            return False
        self._struck += 1
        self._left = gap(self._blow.persistence, self._blow.draw, self._struck)
        return True

    def _strike(self, message: Message, now_ns: int) -> list[Message]:
        about = request_of(message)
        match self._how:
            case How.OMISSION:
                self._note(BITTEN, about)
                return []
            case How.DUPLICATE:
                self._note(BITTEN, about)
                return [message, message]
            case How.DELAY | How.REORDER:
                last_ns = self._held[-1].due_ns if self._held else 0
                self._held.append(_Held(max(last_ns, now_ns + self._by_ns), message, struck=True))
                self._note(STRUCK, about)
                return []
            case _:
                assert_never(self._how)

    def _pass(self, message: Message) -> list[Message]:
        if not self._held:
            return [message]
        if self._how is How.DELAY:  # behind what is held back, at once
            self._held.append(_Held(self._held[-1].due_ns, message, struck=False))
            return []
        overtaken = self._held.popleft().message
        self._note(BITTEN, request_of(overtaken))
        return [message, overtaken]


class Diversion:
    """All faults of one channel; what one lets through comes to the next."""

    def __init__(self) -> None:
        self._meddlers: dict[int, Meddler] = {}

    def add(self, fault: int, meddler: Meddler) -> None:
        """One more, behind the others; one that is there already begins anew."""
        self._meddlers[fault] = meddler

    def stop(self, fault: int) -> None:
        """`fault` strikes no more; what it holds back is sent in its time."""
        if fault in self._meddlers:
            self._meddlers[fault].stop()

    @property
    def over(self) -> bool:
        """Nothing will be disturbed any more."""
        return all(meddler.over for meddler in self._meddlers.values())

    def due_ns(self) -> int | None:
        """When something has to be sent."""
        dues = (meddler.due_ns() for meddler in self._meddlers.values())
        return min((due for due in dues if due is not None), default=None)

    def take(self, message: Message, now_ns: int) -> list[Message]:
        """What is sent when the sender sends `message`."""
        return self._through(0, [message], now_ns)

    def release(self, now_ns: int) -> list[Message]:
        """What is due."""
        return self._let(lambda meddler: meddler.release(now_ns), now_ns)

    def flush(self, now_ns: int) -> list[Message]:
        """All that is held back, in its order."""
        found = self._let(lambda meddler: meddler.flush(), now_ns)
        while self.due_ns() is not None:  # what one has let go, the next one has held back
            found += self._let(lambda meddler: meddler.flush(), now_ns)
        return found

    def _let(self, what: Callable[[Meddler], list[Message]], now_ns: int) -> list[Message]:
        found: list[Message] = []
        for place, meddler in reversed(list(enumerate(self._meddlers.values()))):
            found += self._through(place + 1, what(meddler), now_ns)
        return found

    def _through(self, place: int, messages: list[Message], now_ns: int) -> list[Message]:
        """What comes out of the meddlers from `place` on."""
        for meddler in list(self._meddlers.values())[place:]:
            messages = [out for message in messages for out in meddler.take(message, now_ns)]
        return messages


def request_of(message: Message) -> int:
    """The request that `message` is about, or 0."""
    found = getattr(message, "request_id", 0)
    assert isinstance(found, int)
    return found
