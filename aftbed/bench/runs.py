"""Runs for a bench: a synthetic load, no car, and the record of it."""

from aftbed.core.errors import HarnessError
from aftbed.core.events import Event
from aftbed.inject.model import Fault
from aftbed.judge.record import RunRecord, read_record
from aftbed.runtime.unix.launch import Launched, launch, options_for
from aftbed.runtime.unix.options import LoadRun


def start(
    ftm: str, placement: str, load: LoadRun, faults: tuple[Fault, ...] = (), pin: bool = True
) -> Launched:
    """Start a run under `load`."""
    options, listener = options_for(ftm=ftm, placement=placement, work=load, faults=faults, pin=pin)
    return launch(options, listener)


def finish(launched: Launched, ends: tuple[str, ...] = ("",)) -> RunRecord:
    """Follow the run to its end; its record. Raises HarnessError where it did not end well."""
    try:
        for _ in launched.reports():
            pass
        launched.wait()
        record = read_record(launched.record)
        if record.end is None or record.end.reason not in ends:
            reason = "the supervisor died" if record.end is None else record.end.reason
            raise HarnessError(f"a run of the bench ended early: {reason}")
        return record
    finally:
        launched.remove()


def cycles_us(record: RunRecord, skip: int) -> list[float]:
    """From request.sent to reply.delivered at the client (us), without the first `skip` requests."""
    sent: dict[int, int] = {}
    times = []
    for event in record.history.events(Event.REQUEST_SENT, Event.REPLY_DELIVERED):
        if event.event is Event.REQUEST_SENT:
            sent[event.request_id] = event.t_ns
        elif event.request_id > skip:
            times.append((event.t_ns - sent[event.request_id]) / 1e3)
    return times
