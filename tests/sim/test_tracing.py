"""Two runs of one seed are equal byte for byte, whatever Python hashes by; tracing a run changes nothing."""

import hashlib
import os
import subprocess
import sys

import pytest

from aftbed.core.messages import Checkpoint, Goal, Scheduled, Trials, Tried
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault
from aftbed.runtime.sim.trace import Sent, brief, lines, milliseconds, traced
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.search.swarm import drawn

CRASH = Fault(Crash(), "primary", Trigger("checkpoint.sent", 5))
FAILOVER = Setup("pbr", "process", 3, 30, 1000.0, (CRASH,), (Scheduled(Goal(expression="lfr+tr"), 20),))
SWARM = range(5)
HASHED = f"""
import hashlib
from aftbed.runtime.sim.trace import lines, traced
from aftbed.search.swarm import drawn
found = hashlib.sha256()
for seed in {SWARM!r}:
    for line in lines(traced(drawn(seed))):
        found.update(line.encode() + b"\\n")
print(found.hexdigest())
"""


def trace_of(setup: Setup) -> list[str]:
    return list(lines(traced(setup)))


def hashed(setups: list[Setup]) -> str:
    found = hashlib.sha256()
    for setup in setups:
        for line in trace_of(setup):
            found.update(f"{line}\n".encode())
    return found.hexdigest()


def test_two_runs_of_one_seed_are_equal() -> None:
    assert trace_of(FAILOVER) == trace_of(FAILOVER)


def test_two_seeds_are_not() -> None:
    traces = {tuple(trace_of(Setup("pbr", seed=seed, count=5))) for seed in range(10)}
    assert len(traces) == 10


def test_the_hash_seed_of_python_has_no_part_in_it() -> None:
    other = "12345" if os.environ.get("PYTHONHASHSEED") == "0" else "0"
    done = subprocess.run(
        [sys.executable, "-c", HASHED],
        env=os.environ | {"PYTHONHASHSEED": other},
        capture_output=True,
        text=True,
        timeout=100,
        check=True,
    )
    assert done.stdout.strip() == hashed([drawn(seed) for seed in SWARM])


@pytest.mark.parametrize("seed", SWARM)
def test_to_trace_a_run_changes_nothing(seed: int) -> None:
    with_trace, without = traced(drawn(seed)).run, simulate(drawn(seed))
    assert with_trace.history.journals == without.history.journals
    assert with_trace.history.dialogue == without.history.dialogue
    assert (with_trace.rest, with_trace.logged) == (without.rest, without.logged)


def test_a_trace_has_all_that_happened_by_time() -> None:
    trace = traced(FAILOVER)
    run, found = trace.run, trace_of(FAILOVER)
    records = sum(map(len, run.history.journals.values()))
    messages = sum(isinstance(one, Sent) for one in trace.happened)
    others = len(run.history.dialogue) + len(run.logged) + len(run.struck)
    assert len(trace.happened) == records + messages + others == len(found) - 1
    times = [float(line.split()[0]) for line in found]
    assert times == sorted(times) and times[-1] == pytest.approx(milliseconds(run.rest.ended_ns), abs=1e-6)
    assert found[-1].endswith("end leader=b")


def test_what_happens_in_one_instant_is_in_its_order() -> None:
    found = [line.split(" ", 1)[1] for line in trace_of(Setup("pbr", count=1))]
    sent = next(
        i for i, line in enumerate(found) if line.startswith("sent a/after aft2aft b/after Checkpoint")
    )
    assert found[sent + 1 : sent + 3] == [
        "note a/after checkpoint.sent #1 0",
        next(line for line in found if line.startswith("sent a/after aft2pro a/protocol Reply e1 #1")),
    ]


def test_a_message_in_a_few_words() -> None:
    assert brief(Checkpoint(2, 7, b"ab", b"")) == "Checkpoint e2 #7 reply=2B/9e83486d"
    tried = Tried(1, 3, 2, b"x", b"")
    assert brief(Trials(1, 3, (tried,))) == "Trials e1 #3 (Tried e1 #3 replica=2 payload=1B/8cdc1683)"
