"""The bare server of a run in which the protected function was updated: each version for its own requests.

G3 compares with the bare server over the same requests. Where `aftbed adapt update app` put another function
in place, the bare server is updated too, before the same request: the first that was answered after
the adaptation let requests through again.
"""

from collections.abc import Callable
from typing import Final

from aftbed.adapt.bricks import load_application
from aftbed.campaign.record import RunRecord
from aftbed.core.application import Application
from aftbed.core.event import Event
from aftbed.runtime.unix.part import load_module
from aftbed.vehicle.function import default_application

Make = Callable[[], Application]
BUILT_IN: Final = ""


class Succession:
    """`changes`: from which request on (counted from 1) which function, in order."""

    def __init__(self, changes: list[tuple[int, Make]]) -> None:
        self._function: Application = default_application()
        self._changes = list(changes)
        self._count = 0
        self.characteristics = self._function.characteristics
        versions = (self._function, *(make() for _, make in changes))
        self.deterministic = all(version.characteristics.deterministic for version in versions)

    def execute(self, request: bytes) -> bytes:
        """By the version whose turn it is."""
        self._count += 1
        while self._changes and self._count >= self._changes[0][0]:
            self._update(self._changes.pop(0)[1]())
        return self._function.execute(request)

    def _update(self, new: Application) -> None:
        state = self._function.capture()
        if state:  # as in the run: what has none to give lets its successor begin anew
            getattr(new, "migrate", new.restore)(state)
        self._function, self.characteristics = new, new.characteristics

    def capture(self) -> bytes:
        """Of the present version."""
        return self._function.capture()

    def restore(self, state: bytes) -> None:
        """Of the present version."""
        self._function.restore(state)

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        """To the present version."""
        return self._function.acceptable(request, reply)


def bare_server(record: RunRecord) -> Callable[[], Succession]:
    """Makes the bare server of this run. Raises ConfigError where a version of the function is gone."""
    changes: list[tuple[int, Make]] = []
    stored = record.history.events(Event.REPLY_STORED)
    running = BUILT_IN
    for outcome in record.adaptations:
        if outcome["outcome"] != "done" or outcome["application"] == running:
            continue
        running = str(outcome["application"])
        opened_ns = int(str(outcome["opened_ns"]))
        first = 1 + max((r.request_id for r in stored if r.t_ns < opened_ns), default=0)
        changes.append((first, load_application(running, load_module) if running else default_application))
    return lambda: Succession(changes)
