"""A simulated run as the record of a real one: complete, sealed, small enough to be judged quickly."""

import json
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.events import Event
from aftbed.core.journal import ENTRY, RECORD, EntryKind, header
from aftbed.core.messages import Goal, Scheduled
from aftbed.inject.model import parse
from aftbed.judge.record import RunRecord, read_record
from aftbed.judge.simulated import record_of
from aftbed.runtime.sim.clock import START_NS
from aftbed.runtime.sim.world import Setup, World
from aftbed.runtime.unix import seal
from aftbed.runtime.unix.devices import LOAD_REQUESTS
from aftbed.runtime.unix.run_directory import HISTORY_NAME
from aftbed.vehicle.aeb.function import sample_requests

SEED: Final = 3


def setup(seed: int = SEED, crash_at: int = 4, adapt_at: int = 8) -> Setup:
    """Twelve requests, a crash and an adaptation (0: none), so that nothing in the record is empty."""
    faults = (parse(f"crash primary at server.exit nth {crash_at}"),) if crash_at else ()
    adaptations = (Scheduled(Goal(expression="lfr"), at_request=adapt_at),) if adapt_at else ()
    return Setup(seed=seed, count=12, rate_hz=400.0, faults=faults, adaptations=adaptations)


def write_run(path: Path, given: Setup) -> Path:
    """Simulate it, and write the files that a real run would have left."""
    run = World(given, requests=sample_requests(given.seed, LOAD_REQUESTS)).run()
    record = record_of(run)
    assert record.end is not None
    (path / "journal").mkdir(parents=True)
    for name, records in run.history.journals.items():
        node = name.rpartition(".")[0].replace(".", "/")
        packed = [RECORD.pack(r.t_ns, r.request_id, r.detail, r.brick, r.event.code) for r in records]
        (path / "journal" / f"{name}.journal").write_bytes(header(node) + b"".join(packed))
    dialogue = [
        ENTRY.pack(e.t_ns, e.request_id, len(e.payload), e.epoch, e.kind) + e.payload
        for e in run.history.dialogue
    ]
    (path / "journal" / "client.1.dialogue").write_bytes(header("client") + b"".join(dialogue))
    about = msgspec.to_builtins(record.options) | {"run": "5ea1ed", "started_ns": START_NS, "kept": True}
    del about["private"], about["listener"]
    (path / "run.json").write_text(json.dumps(about))
    end = msgspec.to_builtins(record.end) | {"ended_ns": run.rest.ended_ns, "backup": "b", "epoch": 2}
    end |= {"client": {"sent": given.count}, "backup": record.end.hosted.backup if record.end.hosted else ""}
    del end["absent"]
    (path / "end.json").write_text(json.dumps(end))
    outcomes = [msgspec.json.encode(one) + b"\n" for one in run.adaptations]
    (path / HISTORY_NAME).write_bytes(b"".join(outcomes))
    (path / "events.jsonl").write_text('{"t_ms": 1.0, "event": "started", "text": "16 nodes"}\n')
    (path / "processes.log").write_text("")
    seal.write(path)
    return path


def meaning(record: RunRecord) -> object:
    """What a verdict is about: what was asked for, what was sent, replied and done, how it ended."""
    options, end = record.options, record.end
    effects = [
        (name, one.event, one.request_id)
        for name, records in record.history.journals.items()
        for one in records
        if one.event in (Event.SERVER_EXIT, Event.STATE_RESTORED)
    ]
    return (
        (options.ftm, options.placement, options.seed, getattr(options.work, "count", 0)),
        (list(map(str, options.faults)), list(map(str, options.adaptations)), options.policy),
        [
            (e.kind, e.request_id, e.epoch if e.kind is EntryKind.ANSWERED else 0, e.payload)
            for e in record.history.dialogue
        ],
        effects,
        record.faults,
        [(one.asked, one.outcome, one.reason, one.ftm, one.may_fail) for one in record.adaptations],
        end and (end.reason, end.lost, end.leader, end.backup, end.hosted, end.states),
    )


__all__ = ["meaning", "read_record", "setup", "write_run"]
