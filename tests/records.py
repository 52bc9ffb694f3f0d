"""Records made by hand, in the very files that a run leaves behind."""

import json
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.events import FIRST_FAULT, Event
from aftbed.core.journal import DROPPED_OFFSET, RECORD, EntryKind, header
from aftbed.ftm.compose import build
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Bit, Trigger, with_flipped
from aftbed.inject.model import Fault, FaultReport
from aftbed.inject.receipts import ReceiptState
from aftbed.inject.value import ValueFlip, ValuePlace
from aftbed.judge.record import read_record
from aftbed.judge.verdict import Verdict, judge
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.deployment import digest
from aftbed.runtime.unix.journal_files import DialogueFile
from aftbed.runtime.unix.options import CarRun, LoadRun, RunOptions, Work
from aftbed.vehicle.aeb.function import default_application, sample_requests
from aftbed.vehicle.can.hub import HubCounts
from aftbed.vehicle.plant import VehicleResult

MS: Final = 1_000_000
START_NS: Final = 10**12
CAR: Final = CarRun("ccrs-50", None, "latch")
STOPPED: Final = VehicleResult(False, None, 2.5, 2.5, 9.0, True)
CRASH: Final = Fault(Crash(), "primary", Trigger("checkpoint.sent", 2))
FLIP: Final = Fault(ValueFlip(ValuePlace.RESULT, Bit(8)), "primary", Trigger("server.exit", 2))
FIRST_GENERATION: Final = 1 << 8


def outcomes(*changes: dict[str, object]) -> str:
    """Lines of `adaptations.jsonl`: adaptations that were done, with these changes."""
    done = Outcome(1, "to lfr", "drained", "pbr", "done", asked="to lfr")
    return "".join(json.dumps(msgspec.to_builtins(done) | one) + "\n" for one in changes)


class RecordInTheMaking:
    """A run of three requests, in the directory that it leaves; `end` is what the supervisor wrote."""

    def __init__(self, path: Path, work: Work | None = None, faults: tuple[Fault, ...] = ()) -> None:
        self.path = path
        self.work = work or LoadRun(3, 0.0)
        self.options = RunOptions("abc123", "/gone", str(path), "pbr", "process", 7, self.work, faults)
        reports = (FaultReport(str(f), ReceiptState.APPLIED, number=n) for n, f in enumerate(faults))
        receipts = list(map(msgspec.to_builtins, reports))
        lives = [[b.name, b.kind] for b in build("pbr", "process").bricks]
        hosted = {"ftm": "pbr", "placement": "process", "leader": "a", "backup": "b", "bricks": lives}
        self.end: dict[str, object] | None = {
            "reason": "",
            "left": [],
            "unfinished": [],
            "lost": False,
            "leader": "a",
            "backup": "b",
            "epoch": 1,
            "seconds": 1.5,
            "faults": receipts,
            "hosted": hosted,
            "bus": None if isinstance(self.work, LoadRun) else msgspec.to_builtins(HubCounts()),
        }
        self.t_ns = START_NS
        (path / "journal").mkdir(parents=True)
        for node in ("supervisor", *build("pbr", "process").nodes):
            self._journal(f"{node.replace('/', '.')}.1")
        self._dialogue = DialogueFile(path / "journal" / "client.1.dialogue", "client")
        self._bare = default_application()
        self.sent = 0
        self.asked = 0  # requests; 0: as many as were sent

    def _journal(self, name: str) -> Path:
        """As it is cut at the end of a run. A test writes hundreds of them: no page is made ready."""
        path = self.path / "journal" / f"{name}.journal"
        if not path.exists():
            path.write_bytes(header(name.rpartition(".")[0].replace(".", "/")))
        return path

    def note(self, journal: str, event: Event, request_id: int = 0, detail: int = 0, brick: int = 0) -> None:
        self.t_ns += MS
        with self._journal(journal).open("ab") as file:
            file.write(RECORD.pack(self.t_ns, request_id, detail, brick, event.code))

    def request(
        self,
        epoch: int = 1,
        replica: int = 1,
        answers: int = 1,
        flipped_bit: int | None = None,
        late_ms: int = 0,
    ) -> None:
        """One request, served as it should be, but for `flipped_bit`; answered `answers` times."""
        self.sent += 1
        payload = sample_requests(7, self.sent)[-1]
        self.t_ns += MS
        self._dialogue.write(self.t_ns, self.sent, 0, EntryKind.SENT, payload)
        self.t_ns += late_ms * MS
        self.note(f"{'ab'[replica - 1]}.server.1", Event.SERVER_EXIT, self.sent)
        self.note("proxy.1", Event.REPLY_ACCEPTED, self.sent, epoch << 8 | replica)
        reply = self._bare.execute(payload)
        if flipped_bit is not None:
            reply = with_flipped(reply, [flipped_bit])
        for _ in range(answers):
            self._dialogue.write(self.t_ns, self.sent, epoch, EntryKind.ANSWERED, reply)

    def host(self, **changes: object) -> None:
        """What lived at the end was another graph."""
        assert self.end is not None
        self.end["hosted"] = msgspec.convert(self.end["hosted"], dict[str, object]) | changes

    def lose(self, name: str, count: int) -> None:
        """Of what belonged into this file, `count` found no room."""
        with (self.path / "journal" / name).open("r+b") as file:
            file.seek(DROPPED_OFFSET)
            file.write(count.to_bytes(4, "little"))

    def failover(self) -> None:
        self.note("a.after.1", Event.FAULT_APPLIED, detail=FIRST_FAULT)
        self.note("a.watchdog.1", Event.WATCHDOG_SUSPECT, detail=1)
        self.note("supervisor.1", Event.REPLICA_FENCED, detail=FIRST_GENERATION | 1)
        self.note("b.protocol.1", Event.REPLICA_PROMOTED, detail=2)
        assert self.end is not None
        self.end |= {"leader": "b", "backup": "", "epoch": 2}
        self.host(leader="b", backup="")

    def verdict(self) -> Verdict:
        """Write what is left to write, then read it all back and judge."""
        options = self.options
        if isinstance(self.work, LoadRun):
            work = msgspec.structs.replace(self.work, count=self.asked or self.sent)
            options = msgspec.structs.replace(options, work=work)
        about = msgspec.to_builtins(options) | {"started_ns": START_NS - 250 * MS}
        del about["private"], about["listener"]  # of a live run only
        (self.path / "run.json").write_text(json.dumps(about))
        if self.end is not None:
            states = dict.fromkeys("ab", digest(self._bare.capture()))
            self.end = {"ended_ns": self.t_ns + MS, "states": states} | self.end
            (self.path / "end.json").write_text(json.dumps(self.end))
        return judge(read_record(self.path))


def whole(path: Path, work: Work | None = None, faults: tuple[Fault, ...] = ()) -> RecordInTheMaking:
    """A run in which nothing is wrong."""
    record = RecordInTheMaking(path, work, faults)
    for _ in range(3):
        record.request()
    return record
