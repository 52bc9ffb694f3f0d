"""Adaptations under load, there and back: how long nobody is served, and what becomes of the requests.

The load is at a fixed rate, since a closed loop would hide what waits. `blackout_ms` is the time between the
order to stop taking requests and the last word that they are taken again: what a request meets that
comes at the worst moment. What a client saw is in `worst_request_ms`, from the journals.

The paper's recipe may leave a request in a brick that is killed, and then nothing is served any more: each of
its adaptations has a run of its own, and those that never answer again are counted as `stuck`.
"""

import itertools
import time
from pathlib import Path
from typing import Final

from aftbed.bench.ring import ring_us
from aftbed.bench.runs import cycles_us, finish, start
from aftbed.bench.statistics import summary
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.journal import EntryKind
from aftbed.core.messages import Goal
from aftbed.core.script import RECIPES
from aftbed.judge import checks
from aftbed.judge.record import RunRecord
from aftbed.judge.reference import reference_of
from aftbed.runtime.unix import control_client
from aftbed.runtime.unix.options import LoadRun
from aftbed.vehicle.aeb.function import default_application

RATE_HZ: Final = 200.0
REQUESTS_ENDLESS: Final = 10_000_000
READY_SECONDS_MAX: Final = 10.0
POLL_SECONDS: Final = 0.005
PAUSE_SECONDS: Final = 0.05  # of undisturbed service between two adaptations
RING_COUNT: Final = 500

Outcomes = list[dict[str, object]]


def bench_adapt(
    old: str, new: str, placement: str, recipe: str, count: int, *, pin: bool = True
) -> dict[str, object]:
    """`prepare_ms, blackout_ms{p50,p99,max}, total_ms, bricks_changed, bricks_total, requests{...}`."""
    ring = ring_us(12, 64, RING_COUNT, None)
    if recipe == RECIPES[0]:
        there, back, records = _there_and_back(old, new, placement, count, pin)
    else:
        there, back, records = _one_by_one(old, new, placement, recipe, count, pin)
    ring += ring_us(12, 64, RING_COUNT, None)
    found: dict[str, object] = {
        "from": old,
        "to": new,
        "placement": placement,
        "recipe": recipe,
        "adaptations": len(there) + len(back),
        "rate_hz": RATE_HZ,
    }
    found |= _times(there)
    if back:
        found["back"] = _times(back)
    found["requests"] = _requests(records)
    found["stuck"] = sum(_is_stuck(record) for record in records)
    found["worst_request_ms"] = round(max(max(cycles_us(r, 0), default=0.0) for r in records) / 1e3, 3)
    found["ring_us"] = summary(ring)
    return found


def _times(outcomes: Outcomes) -> dict[str, object]:
    def of(name: str) -> list[float]:
        return [float(str(o[name])) for o in outcomes]

    first = outcomes[0]
    return {
        "prepare_ms": summary(of("prepare_ms"), 3),
        "blackout_ms": summary(of("blackout_ms"), 3),
        "total_ms": summary(of("total_ms"), 3),
        "bricks_changed": first["bricks_changed"],
        "bricks_total": first["bricks_total"],
    }


def _requests(records: list[RunRecord]) -> dict[str, int]:
    counts = [checks.requests(r.history, reference_of(r, default_application)) for r in records]
    return {
        "sent": sum(c.sent for c in counts),
        "lost": sum(c.lost for c in counts),
        "duplicated": sum(c.duplicated for c in counts),
        "reordered": sum(_reordered(r) for r in records),
        "late": sum(c.late for c in counts),
        "wrong": sum(c.wrong for c in counts),
    }


def _reordered(record: RunRecord) -> int:
    """How many replies came behind one of a later request."""
    ids = [e.request_id for e in record.history.dialogue if e.kind is EntryKind.ANSWERED]
    return sum(after < before for before, after in itertools.pairwise(ids))


def _is_stuck(record: RunRecord) -> bool:
    return checks.requests(record.history, reference_of(record, default_application)).lost > 0


def _there_and_back(
    old: str, new: str, placement: str, count: int, pin: bool
) -> tuple[Outcomes, Outcomes, list[RunRecord]]:
    launched = start(old, placement, LoadRun(REQUESTS_ENDLESS, RATE_HZ), pin=pin)
    there: Outcomes = []
    back: Outcomes = []
    try:
        ready(launched.private)
        for _ in range(count):
            for expression, outcomes in ((new, there), (old, back)):
                outcomes.append(adapted(launched.private, Goal(expression=expression)))
                time.sleep(PAUSE_SECONDS)
        launched.stop()
    except BaseException:
        launched.stop()
        finish(launched, ends=("", "interrupted"))
        raise
    return there, back, [finish(launched, ends=("interrupted",))]


def _one_by_one(
    old: str, new: str, placement: str, recipe: str, count: int, pin: bool
) -> tuple[Outcomes, Outcomes, list[RunRecord]]:
    there: Outcomes = []
    records = []
    for _ in range(count):
        launched = start(old, placement, LoadRun(REQUESTS_ENDLESS, RATE_HZ), pin=pin)
        try:
            ready(launched.private)
            there.append(adapted(launched.private, Goal(expression=new, recipe=recipe)))
            time.sleep(PAUSE_SECONDS)
        finally:
            launched.stop()
            records.append(finish(launched, ends=("interrupted",)))
    return there, [], records


def adapted(private: Path, goal: Goal) -> dict[str, object]:
    """How the adaptation ended. Raises HarnessError unless it is done."""
    outcome = control_client.ask(private, control_client.Adapt(goal), control_client.ADAPT_SECONDS_MAX)
    if outcome["outcome"] != "done":
        raise HarnessError(f"an adaptation of the bench ended {outcome['outcome']}: {outcome['reason']}")
    return outcome


def ready(private: Path) -> None:
    """Until the run serves with all its replicas."""
    limit = time.monotonic() + READY_SECONDS_MAX
    while time.monotonic() < limit:
        try:
            status = control_client.ask(private, control_client.Status())
        except ConfigError:
            status = {"busy": True}  # still starting
        if not status["busy"]:
            time.sleep(PAUSE_SECONDS)
            return
        time.sleep(POLL_SECONDS)
    raise HarnessError(f"no service within {READY_SECONDS_MAX:.0f} s")
