"""What a closed loop sees of its run: what is new in files that others write, and the resources of the host.

Journals grow while they are read. A record is committed by its event code, which is written last, so whatever
stands before the first record without one is whole, and is read once.
"""

import os
from collections import deque
from pathlib import Path
from typing import Final

import msgspec

from aftbed.adapt.policy import Beyond, Policy, Resource, Seen
from aftbed.core import journal
from aftbed.core.journal import Record
from aftbed.runtime.adaptations import Outcome

FIRST_BYTES: Final = journal.HEADER_BYTES + journal.RECORD.size
CODE_BYTES: Final = 4  # at the end of a record
CHUNK_BYTES: Final = 2048 * journal.RECORD.size
LINES_BYTES_MAX: Final = 1 << 20  # of the history, at one look
INCARNATIONS: Final = 2
LOAD_SAMPLES: Final = 10  # CPU load is that of the last second
REPLICA_NODES: Final = ("a", "b", "single")
MEASURED: Final[tuple[Resource, ...]] = ("cpus", "cpu_load")


class Tail:
    """What was committed to a journal since the last look: each record once, and whole."""

    def __init__(self, path: Path) -> None:
        self._path, self._at, self._header = path, journal.HEADER_BYTES, b""

    def new(self) -> list[Record]:
        """The new records. Raises PeerError on what is no journal."""
        found: list[Record] = []
        with open(self._path, "rb") as file:
            if not self._header and not self._read_header(file.read(FIRST_BYTES)):
                return found
            file.seek(self._at)
            full = True
            while full:
                data = file.read(CHUNK_BYTES)
                some = list(journal.records(self._header + data))
                found += some
                self._at += len(some) * journal.RECORD.size
                full = len(some) * journal.RECORD.size == CHUNK_BYTES
        return found

    def _read_header(self, data: bytes) -> bool:
        """False before the first record is committed: until then its node may still write the header."""
        if len(data) < FIRST_BYTES or not any(data[-CODE_BYTES:]):
            return False
        self._header = data[: journal.HEADER_BYTES]
        return True


class Journals:
    """The tails of all journals in which a symptom can stand."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._tails: dict[Path, Tail] = {}

    def new(self) -> list[Record]:
        """What is new in them, by time. Raises PeerError."""
        wanted = self._wanted()
        self._tails = {path: self._tails.get(path) or Tail(path) for path in wanted}
        found = [record for tail in self._tails.values() for record in tail.new()]
        return sorted(found, key=lambda record: record.t_ns)

    def _wanted(self) -> list[Path]:
        """The newest of each node that hosts an After."""
        nodes: dict[str, list[tuple[int, Path]]] = {}
        for path in self._folder.glob("*.journal"):
            node, _, incarnation = path.name.removesuffix(".journal").rpartition(".")
            if node in REPLICA_NODES or node.endswith("after"):
                nodes.setdefault(node, []).append((int(incarnation), path))
        return [path for found in nodes.values() for _, path in sorted(found)[-INCARNATIONS:]]


class Lines:
    """The history of adaptations: what ended since the last look."""

    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0

    def new(self) -> list[Outcome]:
        """The lines that are whole."""
        if not self._path.exists():
            return []
        with open(self._path, "rb") as file:
            file.seek(self._at)
            whole, end, _ = file.read(LINES_BYTES_MAX).rpartition(b"\n")
        self._at += len(whole) + len(end)
        return [msgspec.json.decode(line, type=Outcome) for line in whole.splitlines()]


def lost(event: str, text: str) -> Seen | None:
    """A replica's loss, by its cause, if that is what the supervisor tells: `alarm`, `a: crash`."""
    if event != "alarm":
        return None
    return Seen("crash") if text.endswith(": crash") else Seen("hang")


class Meter:
    """Measures the resources that a policy names, and no others."""

    def __init__(self, policy: Policy) -> None:
        self._wanted = {rule.when.resource for rule in policy.rules if isinstance(rule.when, Beyond)}
        self._samples: deque[tuple[float, float]] = deque(maxlen=LOAD_SAMPLES + 1)  # busy, all; seconds

    def values(self) -> dict[Resource, float]:
        """As they are now; CPU load is not known at the first look."""
        found: dict[Resource, float] = {}
        if "cpus" in self._wanted:
            found["cpus"] = float(len(os.sched_getaffinity(0)))
        if "cpu_load" in self._wanted:
            self._samples.append(_cpu_seconds())
            (busy_s, all_s), (busy_now_s, now_s) = self._samples[0], self._samples[-1]
            if now_s > all_s:
                found["cpu_load"] = (busy_now_s - busy_s) / (now_s - all_s)
        return found


def _cpu_seconds() -> tuple[float, float]:
    """Busy and all, of all CPUs, since the boot. Guests are in `user` already."""
    import psutil  # noqa: PLC0415 - 15 ms, where a policy asks for it

    t = psutil.cpu_times()
    busy = t.user + t.nice + t.system + t.irq + t.softirq + t.steal
    return busy, busy + t.idle + t.iowait
