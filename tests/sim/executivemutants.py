"""Seeded bugs in the executive: in who watches and orders, in the verbs of a failover, in an adaptation.

See `mutants` for what `explorer` says.
"""

from collections.abc import Callable, Iterable
from typing import Final

from msgspec.structs import replace
from planting import (
    ADAPT,
    CLEAN,
    CRASH,
    OWN,
    PAIRS,
    Mutant,
    adapted,
    adapts,
    answer,
    clean,
    crash,
    crash_after,
    crashes,
    flip,
    hang,
    instead,
    nothing,
    pairs,
    skipped,
    wrapped,
)

from aftbed.adapt.engine import AdaptationEngine
from aftbed.core import script
from aftbed.core.events import Event
from aftbed.core.graph import Graph
from aftbed.core.messages import Rebound, TakeUp
from aftbed.ftm import failover
from aftbed.ftm.failover import Recovery, Watchdog
from aftbed.inject.value import ValuePlace
from aftbed.runtime import script_executor
from aftbed.runtime.adaptations import Adaptations
from aftbed.runtime.control import NOWHERE
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.interface import Process
from aftbed.runtime.script_executor import Changes, Execution, Rebinding
from aftbed.runtime.sim import world
from aftbed.runtime.sim.world import Setup

BEHIND: Final = (Event.ADAPT_STEP_EXIT,)  # a step: what takes part dies when it is done


def _unfenced(self: Execution, replica: str) -> None:
    if replica == self._deployment.leader:
        self._deployment.leader = ""


def _of(part: str) -> Callable[..., bool]:
    """Transfers of that part's state."""
    return lambda self, source, sink: source.endswith(part)


def _is(*verbs: type) -> Callable[..., bool]:
    return lambda self, verb: any(isinstance(one, verbs) for one in script.flat((verb,)))


def _log_left_behind(right: Callable[..., object]) -> object:
    def migrate(
        self: Execution, given: Graph, taken: Graph, nodes: list[str], takers: dict[str, Process]
    ) -> object:
        others = {n: tuple(b for b in given.nodes[n] if not b.endswith("/protocol")) for n in nodes}
        return right(self, replace(given, nodes=given.nodes | others), taken, nodes, takers)

    return migrate


def _unnoticed(right: Callable[..., Keys]) -> object:
    def resume(self: Execution, steps: Iterable[script.Resume]) -> Keys:
        try:
            yield from right(self, steps)
        finally:
            self.done = [step for step in self.done if not isinstance(step, script.Resume)]

    return resume


def _without(kind: type) -> Callable[..., object]:
    """The inverse of what was done, less the steps of that type."""

    def make(right: Callable[..., list[script.Step]]) -> object:
        return lambda *args: [
            step for step in right(*args) if not any(isinstance(one, kind) for one in script.flat((step,)))
        ]

    return make


def _of_the_old_graph(right: Callable[..., object]) -> object:
    def stage(self: Deployment, node: str, graph: Graph, *, held: bool) -> object:
        return right(self, node, self.graph if node == "a/before" else graph, held=held)

    return stage


def _not_rebound(right: Callable[..., Changes]) -> object:
    def changes(self: Rebinding, steps: object, *, committing: bool) -> Changes:
        return right(self, steps, committing=committing) if self._lost is None else {}

    return changes


def _bound_still(right: Callable[..., None]) -> object:
    def change(self: Rebinding, changes: Changes, brick: str, port: str, side: str, fd: int) -> None:
        if fd != NOWHERE:
            right(self, changes, brick, port, side, fd)

    return change


def _same_epoch(right: Callable[..., script.Script]) -> object:
    return lambda dead, backup, epoch: right(dead, backup, epoch - 1)


def _reply_under_way() -> list[Setup]:
    """A reply waits for the Proxy, which is stopped, while a new backup is made; then that has to lead."""
    return [
        Setup(
            ftm,
            count=40,
            faults=(
                crash("b/server", "request.received", 3),
                hang("proxy", 30, "reply.stored", nth),
                crash_after("primary", 15),
            ),
        )
        for ftm in ("pbr", "lfr")
        for nth in (8, 12)
    ]


def _backup_behind() -> list[Setup]:
    """Requests wait in front of the follower while it is exchanged; later it has to lead."""
    return [
        adapted(
            "lfr", "lfr+tr", hang("b/server", 40, "server.exit", nth), crash_after("primary", 150), count=80
        )
        for nth in (2, 3)
    ]


def _backup_wrong() -> list[Setup]:
    """A bit of the backup's state is wrong when it becomes a follower; later it has to lead."""
    return [
        adapted(
            "pbr",
            "lfr",
            flip(ValuePlace.STATE, bit, "state.restored", nth, "backup"),
            crash_after("primary", 150),
            count=80,
        )
        for nth in (4, 5, 6)
        for bit in range(0, 400, 50)
    ]


EXECUTIVE: Final = (
    Mutant(
        "hangs not told",
        "Watchdog never looks at the pulses",
        instead(Watchdog, "_judge", lambda self, pulses, now_ns: []),
        PAIRS,
        pairs("pbr", ("client",), (9.0,)),
        "G2",
    ),
    Mutant(
        "suspicion not repeated",
        "Watchdog does not tell a new Recovery what it had told the dead one",
        answer(Watchdog, Rebound, lambda effects: []),
        PAIRS,
        pairs("pbr", ("recovery",), (0.05, 0.15, 0.25, 0.35)),
        "G2",
    ),
    Mutant(
        "no second try",
        "Recovery gives up a new backup after one failure",
        instead(Recovery, "deadline_ns", lambda self: None),
        PAIRS,
        pairs("pbr", ("b/server", "a/server"), (2.0, 3.0, 4.0)),
        "at_rest",
    ),
    Mutant(
        "no fencing",
        "ScriptExecutor does not shut the channels of a replica that was declared dead",
        instead(Execution, "_fence", _unfenced),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G2",
    ),
    Mutant(
        "same epoch again",
        "Recovery has a backup lead under the epoch of the dead leader",
        wrapped(failover, "failover", _same_epoch),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G2",
    ),
    Mutant(
        "proxy not told",
        "ScriptExecutor does not bind the Proxy to the new leader",
        skipped(Execution, "_attach"),
        CRASH,
        crashes("pbr", "a/proceed"),
        "G2",
    ),
    Mutant(
        "dead replica not buried",
        "ScriptExecutor leaves the other nodes of a dead replica alive, in its slot",
        instead(Execution, "_kill", lambda self, replica: None),
        CRASH,
        crashes("pbr", "a/proceed"),
        "at_rest",
    ),
    Mutant(
        "leader not resumed",
        "ScriptExecutor forgets to resume the leader's Protocol when the new backup has its state",
        skipped(Execution, "do", _is(script.Resume)),
        PAIRS,
        pairs("pbr", ("client",), (9.0,)),
        "G2",
    ),
    Mutant(
        "new backup without state",
        "ScriptExecutor binds a new backup, and transfers nothing to it",
        skipped(Execution, "_transfer"),
        PAIRS,
        pairs("lfr", ("b/server",), (6.0, 9.0)),
        "G3",
    ),
    Mutant(
        "new backup without the reply log",
        "ScriptExecutor transfers the Server's state to a new backup, and not the replies",
        skipped(Execution, "_transfer", _of("/protocol")),
        OWN,
        _reply_under_way,
        "G3",
    ),
    Mutant(
        "client without memory",
        "a new Client does not read what its predecessor has asked",
        instead(world, "resume_client", lambda client, history: None),
        CRASH,
        crashes("pbr", "client"),
        "G3",
    ),
    Mutant(
        "reply log lost in a switch",
        "a Protocol that is exchanged starts with an empty log",
        wrapped(Execution, "_migrate", _log_left_behind),
        ADAPT,
        adapts("pbr", "lfr", "proxy", placement="replica", load=(150, 0.0), seeds=6),
        "G3",
    ),
    Mutant(
        "state lost in a switch",
        "what is exchanged starts without the state of its predecessor",
        skipped(Execution, "do", _is(script.Migrate)),
        CLEAN,
        clean(adapted("pbr", "lfr", placement="replica")),
        "G3",
    ),
    Mutant(
        "switch never resumed",
        "ScriptExecutor does not resume a node that it suspended",
        instead(Execution, "_resume", lambda self, steps: nothing()),
        CLEAN,
        clean(adapted("pbr", "lfr"), adapted("pbr", "pbr+tr")),
        "G2",
    ),
    Mutant(
        "undone and not resumed",
        "ScriptExecutor does not resume a node that it suspended, on the way back",
        instead(Execution, "_resume_living", lambda self, bricks: None),
        ADAPT,
        adapts("pbr", "lfr", "b/after"),
        "G2",
    ),
    Mutant(
        "undone and not rebound",
        "ScriptExecutor forgets to give the old bricks their channels back",
        wrapped(Rebinding, "changes", _not_rebound),
        ADAPT,
        adapts("pbr", "lfr", "b/after"),
        "G2",
    ),
    Mutant(
        "undone without the state",
        "ScriptExecutor goes back to the bricks of before, and leaves them the state of before",
        wrapped(script_executor, "inverse", _without(script.Migrate)),
        ADAPT,
        adapts("pbr", "pbr+tr", "a", placement="replica", when=BEHIND, seeds=4),
        "G3",
    ),
    Mutant(
        "not adopted once it serves",
        "ScriptExecutor goes back as if no request had passed, where a commit fails after it let them on",
        wrapped(Execution, "_resume", _unnoticed),
        ADAPT,
        adapts("pbr", "pbr+tr", "a", placement="replica", when=BEHIND, seeds=4),
        "G3",
    ),
    Mutant(
        "committed over the dead",
        "ScriptExecutor does not look whether all that is to serve is alive",
        instead(Execution, "_assert_whole", lambda self: None),
        ADAPT,
        adapts("pbr", "lfr", "a/before", when=BEHIND),
        "G5",
    ),
    Mutant(
        "prepared over the dead",
        "Adaptations goes on with what is staged, though what it is bound to is being replaced",
        instead(Adaptations, "give_up_preparing", lambda self, reason: None),
        ADAPT,
        adapts("pbr", "lfr", "a/before"),
        "G2",
    ),
    Mutant(
        "failover in the middle of a switch",
        "Adaptations lets Recovery act on a replica before the way back is gone",
        instead(Adaptations, "interrupted", lambda self, replica: False),
        ADAPT,
        adapts("pbr", "lfr", "a/before"),
        "G2",
    ),
    Mutant(
        "undone in word only",
        "ScriptExecutor leaves everything as far as it has come, and says that it has gone back",
        instead(Execution, "undo", lambda self, lost="": nothing()),
        ADAPT,
        adapts("pbr", "pbr+tr", "b/after"),
        "G5",
    ),
    Mutant(
        "not drained",
        "ScriptExecutor replaces bricks of the backup while requests wait in front of them",
        skipped(Execution, "do", _is(script.Drain)),
        OWN,
        _backup_behind,
        "G3",
    ),
    Mutant(
        "not aligned",
        "ScriptExecutor switches to another replication over two Servers that differ",
        skipped(Execution, "do", _is(script.Align)),
        OWN,
        _backup_wrong,
        "G4",
    ),
    Mutant(
        "engine forgets",
        "AdaptationEngine does not go on with what its predecessor had ordered",
        answer(AdaptationEngine, TakeUp, lambda effects: []),
        ADAPT,
        adapts("pbr", "pbr+tr", "engine"),
        "at_rest",
    ),
    Mutant(
        "unbind forgotten",
        "ScriptExecutor leaves a brick that stays bound to one that goes",
        wrapped(Rebinding, "_change", _bound_still),
        CLEAN,
        clean(adapted("pbr", "lfr")),
        "G2",
    ),
    Mutant(
        "redundancy not restored",
        "Recovery is content with a leader alone",
        instead(failover, "new_backup", lambda *args: None),
        CRASH,
        crashes("pbr", "b/after"),
        "at_rest",
    ),
    Mutant(
        "staged not ended",
        "ScriptExecutor leaves alive what it does not need any more",
        instead(script_executor, "end", lambda process: None),
        ADAPT,
        adapts("pbr", "pbr+tr", "a/tr.before'"),
        "G5",
    ),
    Mutant(
        "old class staged",
        "ScriptExecutor stages a Before of the old mechanism where the new one's should be",
        wrapped(Deployment, "stage", _of_the_old_graph),
        CLEAN,
        clean(adapted("pbr", "lfr")),
        "G5",
    ),
)
