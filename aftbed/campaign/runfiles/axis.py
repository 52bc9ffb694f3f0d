"""One axis of time for the car and for the processes: bus time, in ns since the car's run began.

The bus log knows bus time, the journals know the host's monotonic clock. A request has both: the time of
its radar cycle in its bytes, and in the dialogue when it was sent.

In real time, and at any other pace, the two differ by one offset. A request is never sent before its cycle,
so the smallest difference that was seen is the offset, and no less than the truth: it is exact to how long
the fastest request took, and to the ms in which a request gives its time.

In lockstep virtual time stands still while the function works. So what the processes do lies at the cycle
of the last request that had been sent: the order is told, how long it took is not, and for that each
message has the time of the processes too. What was before the car's run lies at its beginning.

Without a bus the axis is the monotonic clock, from the launch of the run.
"""

from bisect import bisect_right
from collections.abc import Iterator
from typing import NamedTuple

from aftbed.core.errors import PeerError
from aftbed.core.journal import EntryKind
from aftbed.judge.record import RunRecord
from aftbed.runtime.unix.options import LoadRun
from aftbed.vehicle.aeb.messages import AebInput, decode_request


class Asked(NamedTuple):
    """A request that was sent at `t_ns`, by the monotonic clock."""

    t_ns: int
    request: AebInput


def asked_in(record: RunRecord) -> Iterator[Asked]:
    """Every request that can be read, in the order of the dialogue."""
    for entry in record.history.dialogue:
        if entry.kind is EntryKind.SENT:
            try:
                yield Asked(entry.t_ns, decode_request(entry.payload))
            except PeerError:  # struck by a fault, or of another function
                continue


class Axis:
    """Turns monotonic times into times on the axis."""

    def __init__(self, record: RunRecord) -> None:
        work = record.options.work
        self._pace: float | None = 1.0
        self._start_ns = record.started_ns
        self._anchors: list[tuple[int, int]] = []  # in lockstep: when, and what bus time it was then
        if isinstance(work, LoadRun):
            return
        self._pace = work.pace
        pairs = [(one.t_ns, one.request.t_ms * 1_000_000) for one in asked_in(record)]
        if work.pace is not None:
            self._start_ns = min((t - int(bus / work.pace) for t, bus in pairs), default=self._start_ns)
            return
        latest = 0
        for t_ns, bus_ns in pairs:
            latest = max(latest, bus_ns)
            self._anchors.append((t_ns, latest))

    def at(self, t_ns: int) -> int:
        """Where the monotonic time `t_ns` lies: ns, 0 or more."""
        if self._pace is not None:
            return max(0, int((t_ns - self._start_ns) * self._pace))
        at = bisect_right(self._anchors, t_ns, key=lambda anchor: anchor[0])
        return self._anchors[at - 1][1] if at else 0
