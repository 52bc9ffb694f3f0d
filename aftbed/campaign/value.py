"""G4: a value fault never reaches the client. And where one does: what it asks the brakes for.

Judged by the replies alone, whatever mechanism there was: only TR promises it, without TR a flipped bit
is expected to come through, as silent data corruption (sdc). A run without a flipped bit proves nothing.
"""

from collections import defaultdict
from itertools import starmap

from aftbed.core.application import Application
from aftbed.core.check import REASONS_MAX, Check, History
from aftbed.core.errors import PeerError
from aftbed.core.fault import FIRED
from aftbed.core.journal import EntryKind
from aftbed.core.valuefault import BITFLIP
from aftbed.vehicle.aeb.messages import AebOutput, decode_reply


def value(history: History, bare: Application, faults: list[dict[str, str]]) -> Check | None:
    """The check, by the receipts of a run; None where no value fault was asked for. `bare` is a fresh one."""
    flips = [f for f in faults if f["fault"].split()[0] == BITFLIP]
    if not flips:
        return None
    wrong = corruptions(history, bare)
    if wrong:
        return Check("fail", tuple(wrong[:REASONS_MAX]))
    if not any(f["receipt"] in FIRED for f in flips):
        return Check("unknown", ("no value fault was applied",))
    return Check("pass")


def corruptions(history: History, bare: Application) -> list[str]:
    """Each reply that is not the bare server's, and what it says instead; in the order of the requests."""
    answers: dict[int, list[bytes]] = defaultdict(list)
    for entry in history.dialogue:
        if entry.kind is EntryKind.ANSWERED:
            answers[entry.request_id].append(entry.payload)
    found = []
    for entry in history.dialogue:
        if entry.kind is EntryKind.SENT:
            try:
                right = bare.execute(entry.payload)
            except PeerError:
                right = b""
            wrong = next((a for a in answers[entry.request_id] if a != right), None)
            if wrong is not None:
                found.append(f"request {entry.request_id}: sdc: {_difference(wrong, right)}")
    return found


def _difference(wrong: bytes, right: bytes) -> str:
    """What the brake ECU is asked for, and what it should have been asked for."""
    expected, found = _read(right), _read(wrong)
    if expected is None or found is None:
        return f"{_text(found, wrong)} instead of {_text(expected, right)}"
    fields = [(f, getattr(found, f), getattr(expected, f)) for f in AebOutput.__struct_fields__]
    differing = [(f, a, b) for f, a, b in fields if a != b]
    said = starmap("{} {} instead of {}".format, differing)
    return ", ".join(said) or f"the same demand in other bytes ({wrong.hex()})"


def _read(reply: bytes) -> AebOutput | None:
    try:
        return decode_reply(reply)
    except PeerError:
        return None


def _text(output: AebOutput | None, reply: bytes) -> str:
    if output is None:
        return f"what is no demand ({reply.hex() or 'empty'})"
    return f"stage {output.stage} at {output.deceleration_ms2} m/s2"
