"""A run ends at rest: all that was sent is answered, and both replicas are behind the last request."""

import time
from collections.abc import Container
from functools import partial

import msgspec
import pytest
from liveruns import Home, Started, until

from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.core.messages import Goal, Scheduled
from aftbed.core.script import LOSSES, ScriptKind
from aftbed.inject.model import parse
from aftbed.runtime import adaptations, control
from aftbed.runtime.adaptations import Adaptations
from aftbed.runtime.interface import Process
from aftbed.runtime.run_controller import RunController
from aftbed.runtime.script_executor import ScriptExecutor
from aftbed.runtime.unix import workload
from aftbed.runtime.unix.options import LoadRun
from aftbed.runtime.unix.process_pool import UnixProcess

pytestmark = pytest.mark.process

COUNT = 30
LATE_SECONDS = 1.0  # longer than the states of the replicas are looked at
NEW_BACKUP_SECONDS = 0.25  # until it is begun


def delay_orders(monkeypatch: pytest.MonkeyPatch, kinds: Container[ScriptKind], seconds: float) -> None:
    """Have the supervisors of this test, which are forks of this process, read scripts of `kinds` late."""
    on_report = RunController.on_report

    def late(controller: RunController, process: Process, report: msgspec.Struct) -> None:
        call = partial(on_report, controller, process, report)
        if isinstance(report, control.Ordered) and report.script.kind in kinds:
            controller.deployment.runtime.loop.after(seconds, call)
        else:
            call()

    monkeypatch.setattr(RunController, "on_report", late)


def test_a_follower_that_is_behind_is_waited_for(home: Home) -> None:
    """Its last requests take it a tenth of a second, the leader has answered long before."""
    fault = parse(f"slow backup by 20ms at server.exit nth {COUNT - 2}")
    outcome = Started(home, LoadRun(COUNT, 200.0), ftm="lfr", faults=(fault,)).finish()
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert outcome.verdict.faults[0].receipt.value in ("applied", "activated")
    assert outcome.record.end is not None
    states = outcome.record.end.states
    assert isinstance(states, dict) and set(states) == {"a", "b"}
    assert states["a"] == states["b"]


def test_what_is_under_way_when_it_is_stopped_is_answered(home: Home) -> None:
    """Each takes 80 ms here; the last count of requests is older than that."""
    fault = parse("delay pxy2pro by 80ms permanent")
    with Started(home, LoadRun(1000, 5.2), faults=(fault,)) as run:
        run.wait_for_answers(1)
        sent = run.entries(EntryKind.SENT)
        until(lambda: run.entries(EntryKind.SENT) > sent, "another request")
        outcome = run.stop()
    requests = outcome.verdict.requests
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert requests.sent == requests.answered > 1


def test_a_load_has_ended_when_the_client_says_so(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workload, "LOAD_POLL_SECONDS", (3600.0, 3600.0))  # the supervisor is a fork
    outcome = Started(home, LoadRun(COUNT, 0.0)).finish()
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert outcome.verdict.requests.answered == COUNT


@pytest.mark.parametrize(
    "crash",
    [
        f"primary at reply.sent nth {COUNT}",
        # Not the last checkpoint, which is applied when all has ended as far as is known.
        f"backup at checkpoint.applied nth {COUNT - 1}",
    ],
)
def test_redundancy_is_back_behind_a_crash_at_the_end(
    home: Home, monkeypatch: pytest.MonkeyPatch, crash: str
) -> None:
    """Where a machine is busy, all replies can have come long before Recovery acts on the death."""
    delay_orders(monkeypatch, LOSSES, LATE_SECONDS)
    outcome = Started(home, LoadRun(COUNT, 0.0), faults=(parse(f"crash {crash}"),)).finish()
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert outcome.record.end is not None and outcome.record.end.backup
    assert outcome.told("script.done")[-1].startswith("new backup")


def test_an_adaptation_that_waits_for_redundancy_is_done_before_the_end(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is asked for when the backup is lost, and again when the new one is there and all is answered."""
    request_held = Adaptations.request_held

    def held_without_backup(asked: Adaptations, request_id: int) -> None:
        held = held_without_backup if asked._deployment.backup else request_held
        asked._loop.after(0.001, partial(held, asked, request_id))

    monkeypatch.setattr(Adaptations, "request_held", held_without_backup)
    monkeypatch.setattr(adaptations, "RETRY_SECONDS", 2 * NEW_BACKUP_SECONDS)
    delay_orders(monkeypatch, {ScriptKind.NEW_BACKUP}, NEW_BACKUP_SECONDS)
    fault = parse(f"crash backup at checkpoint.applied nth {COUNT - 2}")
    change = Scheduled(Goal(expression="lfr"), at_request=COUNT)
    outcome = Started(home, LoadRun(COUNT, 0.0), faults=(fault,), adaptations=(change,)).finish()
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert [one.outcome for one in outcome.record.adaptations] == ["done"]
    assert outcome.record.end is not None
    assert outcome.record.end.hosted is not None and outcome.record.end.hosted.ftm == "lfr"


@pytest.mark.parametrize("ftm", ["pbr", "lfr"])
def test_the_end_of_a_run_is_nothing_to_recover_from(
    home: Home, monkeypatch: pytest.MonkeyPatch, ftm: str
) -> None:
    """Nobody acts on the deaths, though the supervisor is held up after each kill."""
    kill = UnixProcess.kill

    def slowly(process: UnixProcess) -> bool:
        killed = kill(process)
        time.sleep(0.005)  # not to wait for anything: it is what happens here
        return killed

    monkeypatch.setattr(UnixProcess, "kill", slowly)  # the supervisor is a fork of this process
    outcome = Started(home, LoadRun(COUNT, 0.0), ftm=ftm).finish()
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert not outcome.record.history.events(Event.WATCHDOG_SUSPECT, Event.RECOVERY_ENTER)


def test_a_run_that_ends_without_redundancy_is_no_pass(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    """Recovery orders a new backup, and the supervisor, a fork of this process, does not make it."""
    monkeypatch.setattr(ScriptExecutor, "stale", lambda _, script: script.kind is ScriptKind.NEW_BACKUP)
    fault = parse("crash backup at checkpoint.applied nth 5")
    outcome = Started(home, LoadRun(COUNT, 0.0), faults=(fault,)).finish()
    assert outcome.verdict.verdict == "inconclusive"
    missing = "; ".join(
        f"b/{part} is missing" for part in ("after", "before", "proceed", "protocol", "server")
    )
    assert outcome.verdict.reasons == [f"whole_graph: the run ended before it was at rest: {missing}"]
