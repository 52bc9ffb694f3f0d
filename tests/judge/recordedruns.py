"""Records of runs under PBR, with the whole path of each request in their journals."""

from pathlib import Path
from typing import Final

from records import CRASH, RecordInTheMaking

from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.judge.record import RunRecord, read_record
from aftbed.runtime.unix.journal_files import DialogueFile
from aftbed.runtime.unix.options import Work
from aftbed.vehicle.aeb.messages import AebInput, AebTarget, encode_request

PBR_PATH: Final = (  # journal, event: one request under PBR, as it happens
    ("client.1", Event.REQUEST_SENT),
    ("a.protocol.1", Event.REQUEST_RECEIVED),
    ("a.before.1", Event.BEFORE_EXIT),
    ("a.proceed.1", Event.PROCEED_ENTER),
    ("a.server.1", Event.SERVER_ENTER),
    ("a.server.1", Event.SERVER_EXIT),
    ("a.server.1", Event.STATE_CAPTURED),
    ("a.after.1", Event.CHECKPOINT_SENT),
    ("b.server.1", Event.STATE_RESTORED),
    ("a.protocol.1", Event.REPLY_STORED),
    ("b.after.1", Event.CHECKPOINT_APPLIED),
    ("a.protocol.1", Event.REPLY_SENT),
    ("proxy.1", Event.REPLY_ACCEPTED),
    ("client.1", Event.REPLY_DELIVERED),
)


def run_of(path: Path, work: Work | None = None, requests: int = 2) -> RecordInTheMaking:
    """A run whose journals have the whole path of each request; it has to be `finished`."""
    run = RecordInTheMaking(path, work, (CRASH,))
    for number in range(1, requests + 1):
        for journal, event in PBR_PATH:
            run.note(journal, event, number)
    return run


def finished(run: RecordInTheMaking) -> RunRecord:
    run.verdict()
    return read_record(run.path)


def asking(path: Path, work: Work, *pairs: tuple[int, int]) -> RunRecord:
    """A run with a request at each (t_ns, t_ms)."""
    run = RecordInTheMaking(path, work)
    dialogue = DialogueFile(path / "journal" / "client.2.dialogue", "client")
    for number, (t_ns, t_ms) in enumerate(pairs, 1):
        target = AebTarget(0, 40.0, -10.0)
        payload = encode_request(AebInput(t_ms, 14.0, True, True, (target,)))
        dialogue.write(t_ns, number, 0, EntryKind.SENT, payload)
    dialogue.write(pairs[-1][0], 99, 0, EntryKind.SENT, b"\xff struck by a fault")
    return finished(run)
