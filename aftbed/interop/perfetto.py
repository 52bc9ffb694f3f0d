"""Writes a run as a trace in Chrome's JSON format, which https://ui.perfetto.dev and chrome://tracing open.

The processes of the trace are the sides of a run: client, replica a, replica b, executive. Their threads are
its nodes; a process that replaces a dead one is a thread of its own. They show: a slice for each step on the
path of a request, arrows for the messages between steps (see `judge.timeline`), and instants for faults,
failures, recovery and the steps of an adaptation. A whole request, and a whole adaptation, is an asynchronous
slice beside the client or the engine.

Times are those of the host's monotonic clock, in us since the launch of the run, with ns as decimals. In
lockstep that is the time of the processes, not of the car.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.judge.record import RunRecord
from aftbed.judge.timeline import (
    Category,
    between_processes,
    category_of,
    describe,
    ends_ns,
    links_of,
    logged_events,
    node_journals,
    steps_of,
)

Value = str | int | float | dict[str, "Value"] | list["Value"]
TraceEvent = dict[str, Value]
SIDES: Final = ("client", "replica a", "replica b", "executive")
EVENT_LOG: Final = "told"  # thread and category of the lines that the run printed
_CLIENTS: Final = ("client", "proxy")


class _Tracks:
    """The numbers of the processes and threads of the trace."""

    def __init__(self, run: RunRecord) -> None:
        found = [(node, incarnation) for node, incarnation, _ in node_journals(run)]
        order = sorted(
            {*found, ("client", 1), ("engine", 1), (EVENT_LOG, 1)},
            key=lambda p: (self.side(p[0]), p[0] != "client", p),
        )
        self._threads = {process: number for number, process in enumerate(order, 1)}

    @staticmethod
    def side(node: str) -> int:
        """The process of a node, counted from 1: Perfetto uses 0 otherwise."""
        if node in _CLIENTS:
            return 1
        return {"a": 2, "b": 3}.get(node.partition("/")[0], 4)

    def of(self, node: str, incarnation: int = 1) -> TraceEvent:
        return {"pid": self.side(node), "tid": self._threads[node, incarnation]}

    def named(self) -> Iterator[TraceEvent]:
        for pid, side in enumerate(SIDES, 1):
            yield {"ph": "M", "name": "process_name", "pid": pid, "args": {"name": side}}
            yield {"ph": "M", "name": "process_sort_index", "pid": pid, "args": {"sort_index": pid}}
        for (node, incarnation), tid in self._threads.items():
            track = self.of(node, incarnation)
            name = node if incarnation == 1 else f"{node} ({incarnation})"
            yield {"ph": "M", "name": "thread_name", **track, "args": {"name": name}}
            yield {"ph": "M", "name": "thread_sort_index", **track, "args": {"sort_index": tid}}


def write(run: RunRecord, path: Path) -> int:
    """Write the trace of `run`; its number of events. Raises OSError."""
    events = trace_events(run)
    about: dict[str, Value] = {
        "ftm": run.options.ftm,
        "placement": run.options.placement,
        "seed": run.options.seed,
        "faults": [str(fault) for fault in run.options.faults],
    }
    with path.open("w", encoding="utf-8") as file:
        file.write('{"displayTimeUnit": "ns", "otherData": ' + json.dumps(about) + ', "traceEvents": [\n')
        file.write(",\n".join(json.dumps(event, separators=(",", ":")) for event in events))
        file.write("\n]}\n")
    return len(events)


def trace_events(run: RunRecord) -> list[TraceEvent]:
    """The names of processes and threads, then all other events by time."""
    tracks = _Tracks(run)
    timed = [
        *_steps(run, tracks),
        *_instants(run, tracks),
        *_requests(run, tracks),
        *_adaptations(run, tracks),
    ]
    return [*tracks.named(), *sorted(timed, key=_place)]


def _place(event: TraceEvent) -> tuple[float, int]:
    """Sort key. At the same time, slices come before the events bound to them, and ends before beginnings."""
    ts = event["ts"]
    assert isinstance(ts, float)
    return ts, "eXsfibn".index(str(event["ph"]))


def _ts(t_ns: int, run: RunRecord) -> float:
    return (t_ns - run.started_ns) / 1e3


def _steps(run: RunRecord, tracks: _Tracks) -> Iterator[TraceEvent]:
    steps = steps_of(run)
    links = links_of(steps)
    for step, end_ns in zip(steps, ends_ns(steps, links), strict=True):
        yield {
            "ph": "X",
            "cat": "step",
            "name": ", ".join(map(str, step.events)),
            "ts": _ts(step.t_ns, run),
            "dur": (end_ns - step.t_ns) / 1e3,
            **tracks.of(step.node, step.incarnation),
            "args": {"request": step.request_id},
        }
    for number, arrow in enumerate(between_processes(steps, links), 1):
        about: TraceEvent = {"cat": "message", "name": arrow.channel, "id": number}
        for ends, step in (({"ph": "s"}, steps[arrow.cause]), ({"ph": "f", "bp": "e"}, steps[arrow.effect])):
            yield {**ends, **about, "ts": _ts(step.t_ns, run), **tracks.of(step.node, step.incarnation)}


def _instants(run: RunRecord, tracks: _Tracks) -> Iterator[TraceEvent]:
    for node, incarnation, records in node_journals(run):
        for one in records:
            category = category_of(one)
            if category is not Category.REQUEST:
                track = tracks.of(node, incarnation)
                yield _instant(category.value, describe(one, run.faults), _ts(one.t_ns, run), track)
    for logged in logged_events(run):
        yield _instant(
            EVENT_LOG, f"{logged.event}: {logged.text}", _ts(logged.t_ns, run), tracks.of(EVENT_LOG)
        )


def _instant(category: str, name: str, ts: float, track: TraceEvent) -> TraceEvent:
    return {"ph": "i", "s": "t", "cat": category, "name": name, "ts": ts, **track}


def _requests(run: RunRecord, tracks: _Tracks) -> Iterator[TraceEvent]:
    """From sending a request to its first reply. Requests without a reply have no end and are left out."""
    sent: dict[int, int] = {}
    for entry in run.history.dialogue:
        if entry.kind is EntryKind.SENT:
            sent.setdefault(entry.request_id, entry.t_ns)
        elif (t_ns := sent.pop(entry.request_id, None)) is not None:
            yield from _slice("request", entry.request_id, t_ns, entry.t_ns, run, tracks.of("client"))


def _adaptations(run: RunRecord, tracks: _Tracks) -> Iterator[TraceEvent]:
    """From `adapt.plan` to `adapt.commit` or `adapt.rollback`."""
    begun: dict[int, int] = {}
    for one in run.history.events(Event.ADAPT_PLAN, Event.ADAPT_COMMIT, Event.ADAPT_ROLLBACK):
        if one.event is Event.ADAPT_PLAN:
            begun.setdefault(one.detail, one.t_ns)
        elif (t_ns := begun.pop(one.detail, None)) is not None:
            yield from _slice("adaptation", one.detail, t_ns, one.t_ns, run, tracks.of("engine"))


def _slice(
    kind: str, number: int, begin_ns: int, end_ns: int, run: RunRecord, track: TraceEvent
) -> Iterator[TraceEvent]:
    """An asynchronous slice."""
    for phase, t_ns in (("b", begin_ns), ("e", end_ns)):
        about: TraceEvent = {"cat": kind, "name": f"{kind} {number}", "id": number}
        yield {"ph": phase, **about, "ts": _ts(t_ns, run), **track}
