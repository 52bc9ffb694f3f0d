"""Adaptations under load, there and back: how long no request is served, and what becomes of the requests.

The load has a fixed rate, because a closed loop would hide requests that wait. `blackout_ms` is the time
from the order to stop taking requests to the last acknowledgement that they are taken again: what a request
meets that arrives at the worst moment. `worst_request_ms` is what the client saw, from the journals.

The paper's recipe may leave a request in a brick that is killed, and then nothing is served any more. So
each of its adaptations has a run of its own; those that never answer again are counted as `stuck`.
"""

import itertools
import time
from pathlib import Path
from typing import Final

from aftbed.bench.cycle import ring_us
from aftbed.bench.runs import PAUSE_SECONDS, endless_run, latencies_us, summary, wait_until_ready
from aftbed.core.errors import HarnessError
from aftbed.core.journal import EntryKind
from aftbed.core.messages import Goal
from aftbed.core.script import RECIPES
from aftbed.judge import checks
from aftbed.judge.record import RunRecord
from aftbed.judge.reference import reference_of
from aftbed.runtime.unix import control_client
from aftbed.vehicle.aeb.function import default_application

RATE_HZ: Final = 200.0
RING_COUNT: Final = 500

Outcomes = list[dict[str, object]]


def bench_adapt(
    old: str, new: str, placement: str, recipe: str, count: int, *, pin: bool = True
) -> dict[str, object]:
    """`prepare_ms, blackout_ms{p50,p99,max}, total_ms, bricks_changed, bricks_total, requests{...}`."""
    ring = ring_us(12, 64, RING_COUNT, None)
    there: Outcomes = []
    back: Outcomes = []
    records: list[RunRecord] = []
    drained = recipe == RECIPES[0]
    for _ in range(1 if drained else count):
        with endless_run(old, placement, RATE_HZ, pin=pin) as run:
            wait_until_ready(run.private)
            for _ in range(count if drained else 1):
                there.append(adapted(run.private, Goal(expression=new, recipe=recipe)))
                time.sleep(PAUSE_SECONDS)
                if drained:
                    back.append(adapted(run.private, Goal(expression=old)))
                    time.sleep(PAUSE_SECONDS)
        records.append(run.record)
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
    requests = _requests(records)
    found["requests"] = requests
    found["stuck"] = sum(_counts(record).lost > 0 for record in records)
    found["worst_request_ms"] = round(max(max(latencies_us(r), default=0.0) for r in records) / 1e3, 3)
    found["ring_us"] = summary(ring)
    return found


def _times(outcomes: Outcomes) -> dict[str, object]:
    parts = ("prepare_ms", "blackout_ms", "total_ms")
    found: dict[str, object] = {
        part: summary([float(str(outcome[part])) for outcome in outcomes], 3) for part in parts
    }
    return found | {name: outcomes[0][name] for name in ("bricks_changed", "bricks_total")}


def _counts(record: RunRecord) -> checks.Requests:
    return checks.requests(record.history, reference_of(record, default_application))


def _requests(records: list[RunRecord]) -> dict[str, int]:
    counts = [_counts(record) for record in records]
    return {
        "sent": sum(c.sent for c in counts),
        "lost": sum(c.lost for c in counts),
        "duplicated": sum(c.duplicated for c in counts),
        "reordered": sum(map(_reordered, records)),
        "late": sum(c.late for c in counts),
        "wrong": sum(c.wrong for c in counts),
    }


def _reordered(record: RunRecord) -> int:
    """The number of replies that came after one of a later request."""
    ids = [e.request_id for e in record.history.dialogue if e.kind is EntryKind.ANSWERED]
    return sum(after < before for before, after in itertools.pairwise(ids))


def adapted(private: Path, goal: Goal) -> dict[str, object]:
    """How the adaptation ended. Raises HarnessError unless it is done."""
    outcome = control_client.ask(private, control_client.AdaptCommand(goal), control_client.ADAPT_SECONDS_MAX)
    if outcome["outcome"] != "done":
        raise HarnessError(f"an adaptation of the bench ended {outcome['outcome']}: {outcome['reason']}")
    return outcome
