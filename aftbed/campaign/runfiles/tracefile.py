"""A run as a trace in Chrome's JSON format, which https://ui.perfetto.dev and chrome://tracing open.

Processes of the trace are the sides of a run: the client's, replica a, replica b, the executive. Their
threads are its nodes; who takes the place of a dead process is a thread of its own. On them: a slice for
each step on the path of a request, arrows for the messages between (see `steps`), and as instants faults,
failures, recovery and the steps of an adaptation. A request as a whole, and an adaptation, is an
asynchronous slice beside the client or the engine.

Times are those of the host's monotonic clock, in us since the launch of the run, with the ns behind the
point. In lockstep, that is the time that the processes took, not the car's.
"""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from aftbed.campaign.runfiles.happened import Kind, journals, kind_of, told_in, words_of
from aftbed.campaign.runfiles.steps import Step, between_processes, ends_ns, followed, steps_of
from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.judge.record import RunRecord

Value = str | int | float | dict[str, "Value"] | list["Value"]
TraceEvent = dict[str, Value]
SIDES: Final = ("client", "replica a", "replica b", "executive")
TOLD: Final = "told"  # the thread of what was told to people
_CLIENTS: Final = ("client", "proxy")


class _Tracks:
    """The number of each process and thread of the trace."""

    def __init__(self, record: RunRecord) -> None:
        found = [(node, life) for node, life, _ in journals(record)]
        order = sorted(
            {*found, ("client", 1), ("engine", 1), (TOLD, 1)},
            key=lambda p: (self.side(p[0]), p[0] != "client", p),
        )
        self._threads = {process: number for number, process in enumerate(order, 1)}

    @staticmethod
    def side(node: str) -> int:
        """From 1, as Perfetto has something else at 0."""
        if node in _CLIENTS:
            return 1
        return {"a": 2, "b": 3}.get(node.partition("/")[0], 4)

    def of(self, node: str, life: int = 1) -> TraceEvent:
        """`pid` and `tid`."""
        return {"pid": self.side(node), "tid": self._threads[node, life]}

    def named(self) -> Iterator[TraceEvent]:
        """The names of all."""
        for pid, side in enumerate(SIDES, 1):
            yield {"ph": "M", "name": "process_name", "pid": pid, "args": {"name": side}}
            yield {"ph": "M", "name": "process_sort_index", "pid": pid, "args": {"sort_index": pid}}
        for (node, life), tid in self._threads.items():
            track = self.of(node, life)
            name = node if life == 1 else f"{node} ({life})"
            yield {"ph": "M", "name": "thread_name", **track, "args": {"name": name}}
            yield {"ph": "M", "name": "thread_sort_index", **track, "args": {"sort_index": tid}}


def write(record: RunRecord, path: Path) -> int:
    """The trace of `record`; how many events it has. Raises OSError."""
    events = trace_events(record)
    about: dict[str, Value] = {
        "ftm": record.options.ftm,
        "placement": record.options.placement,
        "seed": record.options.seed,
        "faults": [str(fault) for fault in record.options.faults],
    }
    with path.open("w", encoding="utf-8") as file:
        file.write('{"displayTimeUnit": "ns", "otherData": ' + json.dumps(about) + ', "traceEvents": [\n')
        file.write(",\n".join(json.dumps(event, separators=(",", ":")) for event in events))
        file.write("\n]}\n")
    return len(events)


def trace_events(record: RunRecord) -> list[TraceEvent]:
    """Names first, then all else by time."""
    tracks = _Tracks(record)
    timed = [
        *_steps(record, tracks),
        *_instants(record, tracks),
        *_requests(record, tracks),
        *_adaptations(record, tracks),
    ]
    return [*tracks.named(), *sorted(timed, key=_place)]


def _place(event: TraceEvent) -> tuple[float, int]:
    """Of what is at one time, slices come before what is bound to them, and what ends before what begins."""
    ts = event["ts"]
    assert isinstance(ts, float)
    return ts, "eXsfibn".index(str(event["ph"]))


def _ts(t_ns: int, record: RunRecord) -> float:
    return (t_ns - record.started_ns) / 1e3


def _steps(record: RunRecord, tracks: _Tracks) -> Iterator[TraceEvent]:
    steps = steps_of(record)
    all_followed = followed(steps)
    for step, end_ns in zip(steps, ends_ns(steps, all_followed), strict=True):
        yield {
            "ph": "X",
            "cat": "step",
            "name": ", ".join(map(str, step.events)),
            "ts": _ts(step.t_ns, record),
            "dur": (end_ns - step.t_ns) / 1e3,
            **tracks.of(step.node, step.life),
            "args": {"request": step.request_id},
        }
    for number, arrow in enumerate(between_processes(steps, all_followed), 1):
        about: TraceEvent = {"cat": "message", "name": arrow.channel, "id": number}
        cause, effect = steps[arrow.cause], steps[arrow.effect]
        yield {"ph": "s", **about, **_at(cause, record, tracks)}
        yield {"ph": "f", "bp": "e", **about, **_at(effect, record, tracks)}


def _at(step: Step, record: RunRecord, tracks: _Tracks) -> TraceEvent:
    return {"ts": _ts(step.t_ns, record), **tracks.of(step.node, step.life)}


def _instants(record: RunRecord, tracks: _Tracks) -> Iterator[TraceEvent]:
    for node, life, records in journals(record):
        for one in records:
            kind = kind_of(one)
            if kind is not Kind.REQUEST:
                track = tracks.of(node, life)
                yield _instant(kind.value, words_of(one, record), _ts(one.t_ns, record), track)
    for told in told_in(record):
        yield _instant(TOLD, f"{told.event}: {told.text}", _ts(told.t_ns, record), tracks.of(TOLD))


def _instant(category: str, name: str, ts: float, track: TraceEvent) -> TraceEvent:
    return {"ph": "i", "s": "t", "cat": category, "name": name, "ts": ts, **track}


def _requests(record: RunRecord, tracks: _Tracks) -> Iterator[TraceEvent]:
    """From when a request was sent to its first reply. One that was never answered has no end to show."""
    sent: dict[int, int] = {}
    for entry in record.history.dialogue:
        if entry.kind is EntryKind.SENT:
            sent.setdefault(entry.request_id, entry.t_ns)
        elif (t_ns := sent.pop(entry.request_id, None)) is not None:
            about: Iterable[tuple[str, int]] = (("b", t_ns), ("e", entry.t_ns))
            yield from _asynchronous(
                "request", f"request {entry.request_id}", entry.request_id, about, record, tracks.of("client")
            )


def _adaptations(record: RunRecord, tracks: _Tracks) -> Iterator[TraceEvent]:
    """From `adapt.plan` to `adapt.commit`, or to where it was undone."""
    begun: dict[int, int] = {}
    found = record.history.events(Event.ADAPT_PLAN, Event.ADAPT_COMMIT, Event.ADAPT_ROLLBACK)
    for one in found:
        if one.event is Event.ADAPT_PLAN:
            begun.setdefault(one.detail, one.t_ns)
        elif (t_ns := begun.pop(one.detail, None)) is not None:
            ends: Iterable[tuple[str, int]] = (("b", t_ns), ("e", one.t_ns))
            yield from _asynchronous(
                "adaptation", f"adaptation {one.detail}", one.detail, ends, record, tracks.of("engine")
            )


def _asynchronous(
    category: str,
    name: str,
    number: int,
    ends: Iterable[tuple[str, int]],
    record: RunRecord,
    track: TraceEvent,
) -> Iterator[TraceEvent]:
    for phase, t_ns in ends:
        yield {"ph": phase, "cat": category, "name": name, "id": number, "ts": _ts(t_ns, record), **track}
