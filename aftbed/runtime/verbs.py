"""The verbs of a script on real processes: each one a generator that waits for its answers.

What a script promises is checked before it runs (`core.script.problems`); here it is carried out, and
where a step fails, what serves is left serving: whoever is suspended is resumed, a replica that was
half made is killed.
"""

import contextlib
from typing import Final

from aftbed.core import messages, script
from aftbed.core.errors import StepFailed
from aftbed.core.events import Event
from aftbed.core.graph import Link
from aftbed.ftm.compose import STATEFUL, replication_of
from aftbed.runtime import control
from aftbed.runtime.cores import BESIDE_LEADER
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.interface import Channel, ProcessKind
from aftbed.runtime.jobs import Wait

FIRST_REPLY_SECONDS: Final = 0.001


class Executor:
    """Carries out scripts, one at a time."""

    def __init__(self, deployment: Deployment) -> None:
        self._deployment, self._support = deployment, deployment.support
        self._running = False
        self.held = False  # an adaptation acts on what serves
        self._promoting: Wait | None = None  # what Promote has yet to come to
        self._last_words: Channel | None = None  # from a fenced leader to the Proxy

    @property
    def busy(self) -> bool:
        """No other script may begin."""
        return self._running or self.held

    def execute(self, todo: script.Script) -> Keys:
        """Prepare, then commit. Raises StepFailed, having undone what hurts."""
        found = script.problems(todo)
        if found:
            raise StepFailed("; ".join(found))
        self._running = True
        held: list[str] = []
        try:
            for verb in (*todo.prepare, *todo.commit):
                yield from self._do(verb)
                if isinstance(verb, script.Suspend):
                    held.append(verb.brick)
                elif isinstance(verb, script.Resume):
                    held.remove(verb.brick)
        except StepFailed:
            self._undo(todo, held)
            raise
        finally:
            self._running = False

    def stale(self, todo: script.Script) -> bool:
        """Whether `todo` was ordered before Recovery heard of what has changed since.

        The word of that is on its way to it, and will make it decide anew.
        """
        deployment = self._deployment
        epochs = [verb.epoch for verb in todo.commit if isinstance(verb, script.Promote)]
        if any(epoch != deployment.epoch + 1 for epoch in epochs):
            return True
        match todo.kind:
            case script.ScriptKind.FAILOVER:
                return todo.replica != deployment.leader or not deployment.backup
            case script.ScriptKind.DROP_BACKUP:
                return todo.replica != deployment.backup
            case _:
                return bool(deployment.backup) or not deployment.leader

    def situation(self, *, failed: bool) -> messages.Situation:
        """What Recovery must know to order the next script."""
        deployment = self._deployment
        slots, leader, backup = deployment.slots, deployment.leader, deployment.backup
        return messages.Situation(
            leader,
            slots[leader].generation if leader else 0,
            backup,
            slots[backup].generation if backup else 0,
            deployment.epoch,
            tuple(s.name for s in slots.values() if not s.nodes),
            failed,
            replication_of(deployment.graph.ftm),
            STATEFUL,
            tuple(sorted(deployment.lost)),
        )

    def _undo(self, todo: script.Script, held: list[str]) -> None:
        deployment = self._deployment
        if todo.kind is script.ScriptKind.FAILOVER:  # the backup failed while it took over: nobody is left
            for slot in deployment.slots.values():
                self._kill(slot.name)
            deployment.leader = deployment.backup = ""
        if todo.kind is script.ScriptKind.NEW_BACKUP and deployment.backup != todo.replica:
            self._kill(todo.replica)
        for brick in held:
            node = deployment.graph.node_of(brick)
            if deployment.lives(node):
                deployment.order(node, control.Resume)

    def _do(self, verb: script.Step) -> Keys:
        match verb:
            case script.Spawn(replica):
                yield from self._deployment.spawn(self._deployment.slots[replica])
            case script.Fence(replica):
                self._fence(replica)
            case script.Kill(replica):
                self._kill(replica)
            case script.Promote(replica, epoch):
                self._promote(replica, epoch)
            case script.Attach(replica, epoch):
                yield from self._attach(replica, epoch)
            case script.Suspend(brick):
                yield from self._deployment.ask(self._node(brick), control.Suspend)
            case script.Resume(brick):
                yield from self._deployment.ask(self._node(brick), control.Resume)
            case script.Transfer(source, sink):
                yield from self._transfer(source, sink)
            case script.Bind():
                yield from self._bind(verb.link)
            case script.Unbind(brick, port):
                yield from self._unbind(brick, port)
            case _:
                raise StepFailed(f"{type(verb).__name__} belongs into an adaptation")

    def _node(self, brick: str) -> str:
        return self._deployment.graph.node_of(brick)

    def _note(self, event: Event, replica: str) -> None:
        slot = self._deployment.slots[replica]
        self._support.journal.write(self._support.loop.now_ns(), event, 0, slot.generation << 8 | slot.number)

    def _fence(self, replica: str) -> None:
        deployment = self._deployment
        slot = deployment.slots[replica]
        leads = replica == deployment.leader
        self._last_words = None
        if leads:
            # Move Proxy and Client while they sleep: the fence wakes them, and a core that takes dead
            # processes down neither runs them nor lets them go for some milliseconds.
            deployment.leader = ""
            deployment.pin(BESIDE_LEADER)
        for channel in deployment.channels.touching(slot.bricks):
            link = channel.link
            if leads and link.source in slot.bricks and link.sink == "proxy":
                self._last_words = channel
            elif link.source in slot.bricks and link.sink not in slot.bricks:
                channel.fence()
            elif "/" in link.source and link.source not in slot.bricks:
                channel.refuse()  # a leader that waits for a dead backup to read must not wait on
        # A reply is on its way to the Proxy only if its checkpoint was on its way to the backup before,
        # so the shut checkpoint channel is what counts. The other one is shut as soon as the Proxy
        # follows the new leader: to wake it twice costs 0.1 ms of the blackout.
        self._note(Event.REPLICA_FENCED, replica)

    def _kill(self, replica: str) -> None:
        """The nodes of the slot die; their deaths are reaped later, the slot is free at once."""
        deployment = self._deployment
        slot = deployment.slots[replica]
        for node in slot.nodes:
            process = deployment.nodes.pop(node, None)
            if process is not None:
                process.kind = ProcessKind.KILLED
                process.kill()
        for channel in deployment.channels.touching(slot.bricks):
            deployment.channels.drop(channel)
        slot.nodes = []
        deployment.lost.discard(replica)
        if deployment.backup == replica:
            deployment.backup = ""

    def _promote(self, replica: str, epoch: int) -> None:
        """Say so, and go on: until it leads, its Protocol takes no request. Attach waits for it."""
        deployment = self._deployment
        slot = deployment.slots[replica]
        part, _ = replication_of(deployment.graph.ftm)[0]  # who hears of the leader first
        brick = f"{replica}/{part}"
        # The end of the channel from the leader, which the fence made, wakes it.
        deployment.leave(self._node(brick), control.Tell(control.UNANSWERED, brick, messages.Promote(epoch)))
        promoted = ("promoted", f"{replica}/protocol", epoch)
        self._promoting = Wait(frozenset({promoted}), frozenset(slot.nodes))

    def _attach(self, replica: str, epoch: int) -> Keys:
        """A Proxy that is being replaced needs nothing: the new one is bound to whoever leads."""
        deployment = self._deployment
        deployment.leader, deployment.backup, deployment.epoch = replica, "", epoch
        into = deployment.channels.get("proxy", "pxy2pro", f"{replica}/protocol")
        back = deployment.channels.get(f"{replica}/protocol", "pro2pxy", "proxy")
        assert into is not None and back is not None, replica
        with contextlib.suppress(StepFailed):
            deployment.leave(
                "proxy",
                control.Follow(control.UNANSWERED, "proxy", "pro2pxy", "pxy2pro", epoch),
                (back.read.fileno(), into.write.fileno()),
            )
        if self._last_words is not None:
            self._last_words.fence()  # wakes a Proxy that waits for a reply
        for channel in deployment.channels.into("proxy"):
            if channel.link.source == "client":
                channel.nudge()  # wakes one that waits for a request
        # The new leader's core is for the first reply now: nothing is urgent here, and to wake up for
        # each word from there would take it 0.1 ms.
        self._support.loop.rest(FIRST_REPLY_SECONDS)
        promoting, self._promoting = self._promoting, None
        if promoting is not None:
            deployment.assert_whole(deployment.slots[replica])
            yield promoting
        deployment.graph = deployment.graph.led_by(replica)
        deployment.pin_watchers()

    def _transfer(self, source: str, sink: str) -> Keys:
        state = yield from self._deployment.ask(
            self._node(source), lambda token: control.Capture(token, source)
        )
        yield from self._deployment.ask(self._node(sink), lambda token: control.Restore(token, sink, state))

    def _bind(self, link: Link) -> Keys:
        deployment = self._deployment
        channel = deployment.channels.renew(link)
        if link.source.partition("/")[0] == deployment.leader != link.sink.partition("/")[0]:
            # From here on, the other replica holds all that the leader holds.
            deployment.backup = link.sink.partition("/")[0]
        yield from deployment.all_of(deployment.rebind(channel))

    def _unbind(self, brick: str, port: str) -> Keys:
        deployment = self._deployment
        part = brick.partition("/")[2]
        if (part, port) in replication_of(deployment.graph.ftm):
            deployment.backup = ""
        yield from deployment.ask(
            self._node(brick), lambda token: control.BindOutput(token, brick, port, deployment.epoch)
        )
