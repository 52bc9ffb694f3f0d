"""The bare server of a run in which the protected function was updated: each version for its own requests.

G3 compares with the bare server over the same requests. Where `aftbed adapt update app` put another function
in place, the bare server is updated too, before the same request: the first that was answered after
the adaptation let requests through again.

An update that was rolled back may have served meanwhile. Then the version of before goes on, with the state
of the new one, behind the last request that a replica had executed, or restored the state of, which served
again. What only a lost replica had executed was executed once more, by the version of before.
"""

from collections.abc import Iterable, Iterator

from aftbed.adapt.engine import DONE
from aftbed.core.application import Application
from aftbed.core.events import Event
from aftbed.core.journal import EntryKind, History
from aftbed.functions.load import Code
from aftbed.judge.bare_server import BUILT_IN, NamedChange, ReferenceRun, Succession, executed, loaded, maker
from aftbed.judge.record import RunRecord
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.deployment import replica_of


def changes_of(history: History, adaptations: Iterable[Outcome], begun: str = BUILT_IN) -> list[NamedChange]:
    """When another version than `begun` began to serve, from the outcomes of the adaptations."""
    changes: list[NamedChange] = []
    running = begun
    for update in adaptations:
        function = update.application if update.outcome == DONE else update.tried
        if not update.opened_ns or function == running:
            continue
        stored = (r.request_id for r in history.events(Event.REPLY_STORED) if r.t_ns < update.opened_ns)
        first = 1 + max(stored, default=0)
        changes.append((first, function))
        if update.undone_ns:
            lost = update.lost.split()
            known = (
                r.request_id
                for r in history.events(Event.SERVER_EXIT, Event.STATE_RESTORED)
                if update.opened_ns <= r.t_ns < update.undone_ns and replica_of(r.node) not in lost
            )
            changes.append((max(first, 1 + max(known, default=0)), None))
        else:
            running = function
    return changes


def succession(record: RunRecord, code: Code) -> Application:
    """The bare server of a run, which this process loads. Raises ConfigError."""
    begun = record.options.application
    changes = changes_of(record.history, record.adaptations, begun)
    first = maker(begun, code)
    return Succession(first, loaded(changes, code)) if changes else first()


def requests_of(history: History) -> Iterator[tuple[int, bytes]]:
    """Id and payload of each request that was sent, in their order."""
    return ((e.request_id, e.payload) for e in history.dialogue if e.kind is EntryKind.SENT)


def reference_run(history: History, bare: Application) -> ReferenceRun:
    """`bare` is a fresh one: it executes each request that was sent, in their order."""
    return executed(requests_of(history), bare)
