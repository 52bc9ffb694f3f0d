"""A load that waits for a reply which was lost ends; one that waits for a failover does not."""

from collections.abc import Iterator
from typing import Final, cast

import msgspec
import pytest

from aftbed.runtime.deployment import Deployment
from aftbed.runtime.tasks import Key, Task, Wait
from aftbed.runtime.unix import workload
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.options import LoadRun, RunOptions
from aftbed.runtime.unix.process_pool import UnixProcessPool
from aftbed.runtime.unix.workload import Workload

FAILED_OVER: Final[Key] = ("promoted", "b/protocol", 2)
LOST_ONE: Final = {"sent": 9, "answered": 8, "unanswered": 1, "done": False}
LOOKS: Final = 3
LOOK_SECONDS: Final = 0.01


class Client:
    """Answers what it is asked, always the same."""

    def __init__(self, stats: dict[str, object]) -> None:
        self.stats, self.asked = stats, 0

    def ask(self, *_: object) -> Iterator[Wait]:
        self.asked += 1
        yield Wait(frozenset())
        return msgspec.msgpack.encode(self.stats)


def failover() -> Task:
    yield Wait(frozenset({FAILED_OVER}), seconds=60)


def test_a_load_is_not_given_up_while_a_failover_is_under_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workload, "STALL_SECONDS_MAX", 0.0)
    monkeypatch.setattr(workload, "LOAD_POLL_SECONDS", (LOOK_SECONDS, LOOK_SECONDS))
    loop, client, ends = EventLoop(), Client(LOST_ONE), list[str]()

    def finish(reason: str) -> None:
        ends.append(f"{reason} after {client.asked}")
        loop.end()

    options = RunOptions("", "", "", "pbr", "process", 0, LoadRun(9, 100.0))
    ignored = lambda *_: None  # noqa: E731
    work = Workload(options, cast("UnixProcessPool", None), loop, ignored, finish, ignored, ignored)
    work.deployment = cast("Deployment", client)
    loop.tasks.start("failover", failover(), lambda _: None)
    work._watch_load()

    def look() -> None:
        if client.asked < LOOKS:
            loop.after(LOOK_SECONDS, look)
        else:
            assert ends == []
            loop.tasks.settle(FAILED_OVER)

    look()
    loop.run()
    assert len(ends) == 1 and client.asked > LOOKS
