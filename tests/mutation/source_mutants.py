"""Bugs to plant in the source: right code with one thing wrong in it. `make mutants` sees what notices them.

A bug that was mended becomes one of them: what the code was before, in the place of what it is. `before`
occurs once in its file; a test of every commit sees to that, so that the list cannot rot.

Bugs that are planted in memory, and found by the explorers' own experiments, are in tests/sim.
"""

from enum import Enum
from typing import Final, NamedTuple


class Finder(Enum):
    """What looks for bugs, the cheapest first."""

    UNIT_TESTS = "unit tests"
    EXPLORERS = "explorers"
    SWARM = "swarm"
    CAMPAIGN = "real campaign"
    PROCESS_TESTS = "tests of real runs"


class SourceMutant(NamedTuple):
    """`found_by`: the cheapest finder that has to notice it; `tests`: those about it, for pytest."""

    name: str
    promise: str
    path: str
    before: str
    after: str
    found_by: Finder
    tests: tuple[str, ...]


UNIT, EXPLORERS, SWARM, CAMPAIGN, PROCESS = Finder
FTM: Final = "aftbed/ftm"
RUNTIME: Final = "aftbed/runtime"
UNIX: Final = "aftbed/runtime/unix"
JUDGE: Final = "aftbed/judge"
SCRIPTS: Final = ("tests/sim/test_failing_scripts.py",)
KILLS: Final = "tests/process/test_kill.py::"

MUTANTS: Final = (
    SourceMutant(
        "After takes over while a checkpoint is half applied",
        "G1",
        f"{FTM}/pbr.py",
        "(_S.APPLYING, CONTROL, Promotion): (promote, _S.PROMOTED_APPLYING)",
        "(_S.APPLYING, CONTROL, Promotion): (promote_at_once('aft2pro'), _S.IDLE)",
        UNIT,
        ("tests/ftm/test_pbr.py",),
    ),
    SourceMutant(
        "a death is waited for by a name that an exchange takes from the process",
        "G7",
        f"{RUNTIME}/run_controller.py",
        "self._loop.tasks.settle(death_of(process.pid))",
        'process.name.endswith("\'") or self._loop.tasks.settle(death_of(process.pid))',
        UNIT,
        ("tests/sim/test_injectors.py",),
    ),
    SourceMutant(
        "a page that the end of a state cuts counts as equal",
        "G3",
        f"{FTM}/pages.py",
        "common = min(len(old), common) // page_bytes * page_bytes",
        "common = min(len(old), common)",
        UNIT,
        ("tests/ftm/test_pages.py",),
    ),
    SourceMutant(
        "of a block with several changed pages the first one travels",
        "G3",
        f"{FTM}/pages.py",
        "                found.append(at // page_bytes)\n",
        "                found.append(at // page_bytes)\n                break\n",
        UNIT,
        ("tests/ftm/test_pages.py",),
    ),
    SourceMutant(
        "pages are put on whatever base the backup has",
        "G3",
        f"{FTM}/pages.py",
        "elif state.base != self._number:",
        "elif not self._number:",
        UNIT,
        ("tests/ftm/test_pages.py",),
    ),
    SourceMutant(
        "a backup keeps the number of a checkpoint, and not its state",
        "G3",
        f"{FTM}/pages.py",
        "            application.restore(whole)\n            self._number, self._state = number, whole\n",
        "            application.restore(whole)\n            self._number = number\n",
        UNIT,
        ("tests/ftm/test_pages.py",),
    ),
    SourceMutant(
        "the checksum of pages is not looked at",
        "G3",
        f"{FTM}/pages.py",
        "if state.check != _check(state):",
        "if not state.check:",
        UNIT,
        ("tests/ftm/test_pages.py",),
    ),
    SourceMutant(
        "a replaced state is compared with the one before",
        "G3",
        f"{FTM}/server.py",
        "        self.application.restore(state)\n        self._base.replaced()\n",
        "        self.application.restore(state)\n",
        UNIT,
        ("tests/ftm/test_server.py",),
    ),
    SourceMutant(
        "what a backup was given and what it gave are taken for one",
        "G3",
        f"{FTM}/pages.py",
        "        self._left = 0\n\n    def _keep",
        "\n    def _keep",
        UNIT,
        ("tests/ftm/test_pages.py",),
    ),
    SourceMutant(
        "a state is never whole again",
        "G3",
        f"{FTM}/pages.py",
        "        self._left -= 1\n",
        "",
        UNIT,
        ("tests/ftm/test_pages.py",),
    ),
    SourceMutant(
        "a checkpoint that a backup never got is its base",
        "G3",
        f"{FTM}/pbr.py",
        '            return [Send("aft2pro", reply)]\n        self.base = reply.request_id\n',
        '            self.base = reply.request_id\n            return [Send("aft2pro", reply)]\n'
        "        self.base = reply.request_id\n",
        UNIT,
        ("tests/ftm/test_pbr.py",),
    ),
    SourceMutant(
        "a new Client takes the next request for one that was sent",
        "G5",
        f"{FTM}/client.py",
        "if number < self.next_id]",
        "if number <= self.next_id]",
        UNIT,
        ("tests/ftm/test_client.py",),
    ),
    SourceMutant(
        "the last words of a fenced leader are not fenced",
        "G6",
        f"{RUNTIME}/script_executor.py",
        "            self._last_replies.fence()  #",
        "            pass  #",
        UNIT,
        SCRIPTS,
    ),
    SourceMutant(
        "the leader stays suspended when a new backup fails",
        "G2",
        f"{RUNTIME}/script_executor.py",
        "done = [step for step in done if isinstance(step, Suspend)]",
        "done = []",
        UNIT,
        SCRIPTS,
    ),
    SourceMutant(
        "a dead replica is waited for as the next leader",
        "G2",
        f"{RUNTIME}/script_executor.py",
        "            deployment.assert_whole(deployment.slots[replica])\n            yield promoting\n",
        "            yield promoting\n",
        UNIT,
        SCRIPTS,
    ),
    SourceMutant(
        "a failover to a backup that is gone is not refused",
        "G2",
        f"{RUNTIME}/script_executor.py",
        "return script.replica != deployment.leader or not deployment.backup",
        "return script.replica != deployment.leader",
        UNIT,
        SCRIPTS,
    ),
    SourceMutant(
        "a new backup is of the generation of the dead one",
        "G5",
        f"{RUNTIME}/deployment.py",
        "        slot.generation += 1\n",
        "",
        UNIT,
        SCRIPTS,
    ),
    SourceMutant(
        "Recovery acts before the way back of an adaptation",
        "G5",
        f"{RUNTIME}/adaptations.py",
        "            self._executor.held = True\n            now.lost = replica\n",
        "            now.lost = replica\n",
        UNIT,
        SCRIPTS,
    ),
    SourceMutant(
        "a Watchdog that dies while it is put in place stays away",
        "G5",
        f"{RUNTIME}/run_controller.py",
        "                self._loop.after(SETTLE_SECONDS, self._replace_missing)\n",
        "",
        UNIT,
        ("tests/sim/test_found.py",),
    ),
    SourceMutant(
        "a replacement that dies is taken as told",
        "G5",
        f"{RUNTIME}/run_controller.py",
        "elif not serves and not self.ending:",
        "elif failure and not self.ending:",
        UNIT,
        ("tests/sim/test_replacements.py",),
    ),
    SourceMutant(
        "a fault that waits in a replaced node is lost",
        "G8",
        f"{RUNTIME}/run_controller.py",
        "            if serves:  # faults that waited",
        "            if False:  # faults that waited",
        UNIT,
        ("tests/sim/test_injectors.py",),
    ),
    SourceMutant(
        "a fault that waits in an exchanged brick comes late",
        "G8",
        f"{RUNTIME}/adaptations.py",
        "if now.phase is Phase.COMMIT and not failure:  # faults that waited",
        "if False:  # faults that waited",
        UNIT,
        ("tests/sim/test_injectors.py",),
    ),
    SourceMutant(
        "a node that is stuck in a brick is seen alive",
        "G2",
        f"{UNIX}/liveness.py",
        'self.idle = state == "S" and waits and',
        'self.idle = state == "S" and',
        UNIT,
        ("tests/runtime/test_liveness.py",),
    ),
    SourceMutant(
        "a write without a reader is given up silently",
        "G3",
        f"{UNIX}/node_io.py",
        '        raise BrokenPipeError(f"{hosted.name}',
        '        assert (f"{hosted.name}',
        UNIT,
        ("tests/runtime/test_node_loops.py",),
    ),
    SourceMutant(
        "anybody may ask the control socket",
        "G8",
        f"{UNIX}/control_client.py",
        '    return bool(struct.unpack("3i", raw)[1] == uid)\n',
        '    return bool(struct.unpack("3i", raw))\n',
        UNIT,
        ("tests/runtime/test_control_server.py",),
    ),
    SourceMutant(
        "a full disk looks like a crash of a node",
        "G8",
        f"{UNIX}/process_pool.py",
        "    if code == -signal.SIGBUS and process.journal:",
        "    if code == -signal.SIGBUS and not process.journal:",
        UNIT,
        ("tests/runtime/test_reap.py",),
    ),
    SourceMutant(
        "a function that returns no bytes passes the self-test",
        "G8",
        "aftbed/functions/load.py",
        "            return _checked(_application_class(named, code))\n",
        "            return _application_class(named, code)\n",
        UNIT,
        ("tests/runtime/test_selftest.py",),
    ),
    SourceMutant(
        "the lifeline is never held",
        "G2",
        f"{UNIX}/zygote.py",
        "    io.lifeline = Lifeline(Path(order.journal))\n",
        "",
        PROCESS,
        (KILLS + "test_there_are_the_seventeen_processes_of_the_paper",),
    ),
    SourceMutant(
        "the warden leaves the run's directory",
        "G7",
        f"{UNIX}/cleanup.py",
        "    kill_open(reader, private)\n    run_directory.remove(private)\n",
        "    kill_open(reader, private)\n",
        PROCESS,
        (KILLS + "test_a_killed_command_leaves_nothing_whatever_its_keepers_suffer",),
    ),
    SourceMutant(
        "a stopped supervisor is not continued when its command dies",
        "G7",
        f"{UNIX}/supervisor_process.py",
        "    linux.continue_at_parents_death()\n",
        "",
        PROCESS,
        (KILLS + "test_a_killed_command_leaves_nothing_whatever_its_keepers_suffer",),
    ),
    SourceMutant(
        "a stopped warden is not continued when its command dies",
        "G7",
        f"{UNIX}/launch.py",
        "            try:\n                linux.continue_at_parents_death()\n",
        "            try:\n",
        PROCESS,
        (KILLS + "test_a_killed_command_leaves_nothing_whatever_its_keepers_suffer",),
    ),
    SourceMutant(
        "what is left at the end is not told",
        "G7",
        f"{UNIX}/supervisor.py",
        "for p in dying]\n",
        "for p in []]\n",
        PROCESS,
        (KILLS + "test_what_does_not_end_in_time_is_named",),
    ),
    SourceMutant(
        "a reply is late after ten times as long",
        "G8",
        f"{JUDGE}/checks.py",
        "LATE_NS: Final = 60_000_000",
        "LATE_NS: Final = 600_000_000",
        UNIT,
        ("tests/judge/test_figures.py",),
    ),
    SourceMutant(
        "states are not compared in the classification",
        "G8",
        f"{JUDGE}/outcome.py",
        "or len(states) > 1:",
        "or not isinstance(states, set):",
        UNIT,
        ("tests/judge/test_outcome.py",),
    ),
    SourceMutant(
        "a failover is counted from any fault before it",
        "G8",
        f"{JUDGE}/checks.py",
        "        if not fault.action.stops_process or (",
        "        if False and (",
        UNIT,
        ("tests/judge/test_figures.py",),
    ),
    SourceMutant(
        "a fault of an earlier leader is the cause of a failover",
        "G8",
        f"{JUDGE}/checks.py",
        "and since_ns <= strike.t_ns <= alarm.t_ns",
        "and strike.t_ns <= alarm.t_ns",
        UNIT,
        ("tests/judge/test_figures.py",),
    ),
    SourceMutant(
        "a new Watchdog watches a replica that is being made",
        "G2",
        "aftbed/runtime/deployment.py",
        "or not slot.nodes or not slot.complete:",
        "or not slot.nodes:",
        UNIT,
        ("tests/sim/test_failing_scripts.py",),
    ),
    SourceMutant(
        "an adaptation that was not done passes",
        "G8",
        f"{JUDGE}/asked.py",
        "if one.outcome != DONE and not one.may_fail]",
        "if False]",
        UNIT,
        ("tests/judge/test_asked.py",),
    ),
    SourceMutant(
        "sources that contradict each other pass",
        "G8",
        f"{JUDGE}/checks.py",
        'Finding = "fail" if wrong else "unknown"',
        'Finding = "unknown"',
        PROCESS,
        ("tests/process/test_tampered.py",),
    ),
    SourceMutant(
        "what found no room in a journal is a contradiction",
        "G8",
        f"{JUDGE}/sources.py",
        "    if record.history.dropped:\n        return\n",
        "",
        UNIT,
        ("tests/judge/test_verdict.py",),
    ),
    SourceMutant(
        "a record's function is executed without trust",
        "G8",
        f"{UNIX}/trust.py",
        "        if strangers:\n",
        "        if strangers and not files:\n",
        UNIT,
        ("tests/judge/test_trust.py",),
    ),
    SourceMutant(
        "the hub is killed before its clients at the end of a run",
        "G7",
        f"{UNIX}/process_pool.py",
        "return 2 if self.name == control.HUB else 1",
        "return 1",
        UNIT,
        ("tests/runtime/test_reap.py",),
    ),
    SourceMutant(
        "a server that came after the last request is missed",
        "G8",
        f"{JUDGE}/sources.py",
        "max(came_ns) <= sent_ns",
        "max(came_ns) > 0",
        UNIT,
        ("tests/judge/test_damaged.py",),
    ),
    SourceMutant(
        "an experiment of which nothing is known counts as expected",
        "G8",
        "aftbed/campaign/summary.py",
        "r.activated and r.outcome not in UNKNOWN",
        "r.activated",
        UNIT,
        ("tests/campaign/test_summary.py",),
    ),
    SourceMutant(
        "a stratum of which nothing is known passes",
        "G8",
        "aftbed/campaign/summary.py",
        "elif spec.unknown_max < 1 and all(r.outcome in UNKNOWN for r in group):",
        "elif not group:",
        UNIT,
        ("tests/campaign/test_summary.py",),
    ),
    SourceMutant(
        "a new backup gets a function that was edited since the others loaded it",
        "G3",
        f"{UNIX}/zygote.py",
        "        before = trust.loaded_before(self._record, source)\n",
        "        before = None\n",
        PROCESS,
        ("tests/process/test_exchange_live.py",),
    ),
    SourceMutant(
        "an update to new content of the same file does nothing",
        "G5",
        f"{UNIX}/trust.py",
        "    if all(_has(Path(path), digest) for path, digest in before.items()):\n",
        "    if before is not None:\n",
        UNIT,
        ("tests/judge/test_trust.py",),
    ),
    SourceMutant(
        "a flip at which a function fails leaves no receipt",
        "G8",
        "aftbed/inject/agent.py",
        "        refused = False\n",
        "        refused = True\n",
        UNIT,
        ("tests/functions/test_fmu.py",),
    ),
    SourceMutant(
        "no fault strikes at the commit of an adaptation",
        "G8",
        "aftbed/inject/targets.py",
        "    if event_named(event) in STEP_EVENTS:\n",
        "    if event_named(event) in ADAPTATION:\n",
        UNIT,
        ("tests/cli/test_sim.py",),
    ),
    SourceMutant(
        "a function that refuses all requests takes the place of one that does not",
        "G5",
        f"{RUNTIME}/assembly.py",
        "        if server.application and server in order.bricks:\n",
        "        if server.application and server not in order.bricks:\n",
        UNIT,
        ("tests/cli/test_sim.py",),
    ),
    SourceMutant(
        "a step of a commit is not told that what it waits for has failed",
        "G5",
        f"{RUNTIME}/tasks.py",
        "        except StepFailed as error:\n            failure = error\n",
        "        except StepFailed:\n            raise\n",
        UNIT,
        ("tests/runtime/test_tasks.py",),
    ),
    SourceMutant(
        "a capture that changes the state is not refused before a run",
        "G3",
        f"{JUDGE}/execution.py",
        "    begun = _captured(function, 0)\n",
        '    begun = _did("capture", function.capture)\n',
        UNIT,
        ("tests/judge/test_trust.py",),
    ),
    SourceMutant(
        "a function whose process crashes is not told",
        "G8",
        f"{UNIX}/process_pool.py",
        "any(kind == SERVER for _, kind in process.bricks)",
        "not process.bricks",
        PROCESS,
        (
            "tests/process/test_own_functions.py::test_a_function_that_fails_by_itself_is_failed_over_and_told",
        ),
    ),
)


def planted(mutant: SourceMutant, text: str) -> str:
    """`text`, with the bug in it."""
    count = text.count(mutant.before)
    assert count == 1, f"{mutant.name}: its text is {count} times in {mutant.path}"
    return text.replace(mutant.before, mutant.after)
