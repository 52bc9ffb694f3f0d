"""Adaptations of a run: requests for them, their plans, the orders of the Engine, how they ended.

An adaptation is planned and checked once, when it begins. The Engine decides, phase by phase; its orders are
executed here, and what it must not forget is kept: a new Engine gets what the dead one had ordered last.
While a phase acts on what serves, Recovery waits; a replica that is lost before the end of the observation
undoes the adaptation, then it fails over.
"""

import contextlib
import functools
from collections.abc import Callable
from typing import Final, NamedTuple

import msgspec

from aftbed.adapt.commands import plan_goal
from aftbed.adapt.engine import REFUSED
from aftbed.adapt.planner import Plan
from aftbed.core import messages
from aftbed.core.errors import ConfigError, StepFailed
from aftbed.core.events import Event
from aftbed.core.script import Phase, Script, bricks_changed
from aftbed.ftm.compose import protected_by
from aftbed.runtime import control
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.fault_controller import FaultController
from aftbed.runtime.script_executor import Execution, ScriptExecutor
from aftbed.runtime.tasks import Wait

CLIENT: Final = "client"
ENGINE: Final = "engine"
REPLACE: Final = "replace "  # begins the names of tasks that hand channels out
RETRY_SECONDS: Final = 0.01
RETRIES_MAX: Final = 100

Answer = Callable[["Outcome"], None]


class Outcome(msgspec.Struct):
    """An adaptation as it is shown and recorded; times in ms."""

    number: int
    purpose: str
    recipe: str
    ftm: str  # that runs after it
    outcome: str = ""
    reason: str = ""
    asked_ms: float = 0.0  # since the start of the run
    prepare_ms: float = 0.0
    blackout_ms: float = 0.0
    total_ms: float = 0.0
    bricks_changed: int = 0
    bricks_total: int = 0
    application: str = ""  # the function that is protected after it, "" for the built-in one
    tried: str = ""  # the function of the new graph, kept or not
    tried_ftm: str = ""  # the mechanism of the new graph, kept or not
    opened_ns: int = 0  # from when on the new graph served (monotonic), 0 if it never did
    undone_ns: int = 0  # from when on the old one served again
    lost: str = ""  # the replicas that did not serve again, and were left to Recovery, as "a" or "a b"
    asked: str = ""  # the words of the request, with the time for which it was scheduled
    scheduled: int = 0  # its place among those of the run's options, from 1 on; 0: asked for while it ran
    may_fail: bool = False  # see `core.messages.Goal`


def _named(goal: messages.Goal) -> str:
    return goal.expression or goal.part or "script"


def _unanswered(outcome: Outcome) -> None:
    """The answer of an adaptation that was scheduled with the run: the history has it."""


class _Request(NamedTuple):
    """`asked`: its words. `scheduled`: as in `Outcome`."""

    goal: messages.Goal
    answer: Answer
    asked: str
    scheduled: int = 0


def _spoiled(reason: str) -> Keys:
    yield Wait(frozenset())
    raise StepFailed(reason)


class _Current:
    """The adaptation under way."""

    def __init__(self, outcome: Outcome, answer: Answer, began_ns: int, epoch: int, plan: Plan) -> None:
        self.outcome, self.answer, self.began_ns, self.epoch = outcome, answer, began_ns, epoch
        self.plan = plan
        self.phase_ns = 0
        self.phase = Phase.PREPARE
        self.ended, self.failure = False, ""
        self.lost = ""  # a replica
        self.spoiled = ""  # why what has been prepared must not be committed
        self.execution: Execution | None = None


class Adaptations:
    """`inform_recovery` is called whenever Recovery may act again."""

    def __init__(
        self,
        deployment: Deployment,
        executor: ScriptExecutor,
        faults: FaultController,
        inform_recovery: Callable[[], None],
    ) -> None:
        self._deployment, self._executor, self._faults = deployment, executor, faults
        self._runtime, self._loop = deployment.runtime, deployment.runtime.loop
        self._log = self._runtime.log
        self._inform_recovery = inform_recovery
        self._started_ns = self._loop.now_ns()
        self._current: _Current | None = None
        self._count = 0
        self.history: list[Outcome] = []
        self._delayed = 0  # requests for adaptations that wait for redundancy, and are asked again
        self._scheduled = 0  # how many
        self._waiting: list[tuple[int, _Request]] = []  # of those, with the requests that they wait for

    @property
    def busy(self) -> bool:
        """Whether an adaptation is under way."""
        return self._current is not None

    @property
    def preparing(self) -> bool:
        """Whether new nodes are staged, which import and test what is the user's."""
        now = self._current
        return now is not None and now.phase is Phase.PREPARE and not now.ended

    @property
    def delayed(self) -> bool:
        """Whether an adaptation was requested that waits for redundancy, and has not begun."""
        return self._delayed > 0

    @property
    def awaited(self) -> tuple[int, ...]:
        """The requests that scheduled adaptations wait for."""
        return tuple(sorted({at_request for at_request, _ in self._waiting}))

    @property
    def scheduled(self) -> tuple[Outcome | None, ...]:
        """What became of each scheduled adaptation, in the order of the run's options.

        None: it has not begun. An empty `outcome`: it is under way.
        """
        ended = {one.scheduled: one for one in self.history}
        if self._current is not None:
            ended[self._current.outcome.scheduled] = self._current.outcome
        return tuple(ended.get(place) for place in range(1, self._scheduled + 1))

    @property
    def acting(self) -> bool:
        """Whether a phase that acts on serving nodes is under way."""
        now = self._current
        return now is not None and now.phase in (Phase.COMMIT, Phase.UNDO) and not now.ended

    def give_up_preparing(self, reason: str) -> None:
        """Abandon the preparation: the staged nodes have ends of channels that are being renewed."""
        now = self._current
        if now is not None and now.phase is Phase.PREPARE:
            now.spoiled = reason
            if not now.ended:
                self._loop.tasks.cancel(f"adapt {now.phase.value}", reason)

    # -- asked for ----------------------------------------------------------------------------

    def ask(self, goal: messages.Goal, answer: Answer) -> None:
        """Begin an adaptation, after a short wait for redundancy. Raises ConfigError where it is refused."""
        self._ask(_Request(goal, answer, str(goal)), RETRIES_MAX)

    def _ask(self, request: _Request, retries: int) -> None:
        deployment = self._deployment
        if self._current is not None:
            raise ConfigError(
                f"adaptation {self._current.outcome.number} ({self._current.outcome.purpose}) is under way:"
                " wait for its end (aftbed adapt history)"
            )
        alone = len(deployment.slots) > 1 and not deployment.backup
        replacing = any(job.startswith(REPLACE) for job in self._loop.tasks.names())
        if self._executor.busy or alone or replacing or not deployment.lives(ENGINE):
            if deployment.graph.ftm == "none" or not retries or not deployment.leader:
                raise ConfigError(
                    f"{deployment.graph.ftm}: no adaptation now: leader {deployment.leader or 'none'},"
                    f" backup {deployment.backup or 'none'}, engine"
                    f" {'there' if deployment.lives(ENGINE) else 'not there'}"
                )
            self._delayed += 1
            self._loop.after(RETRY_SECONDS, lambda: self._ask_delayed(request, retries - 1))
            return
        plan = plan_goal(deployment.graph, request.goal)
        outcome = self._asked(request)
        self._current = _Current(outcome, request.answer, self._loop.now_ns(), deployment.epoch, plan)
        self._send(messages.Adapt(outcome.number, plan.script))

    def plan(self, goal: messages.Goal) -> Plan:
        """Plan an adaptation of the graph that runs now. Raises ConfigError."""
        return plan_goal(self._deployment.graph, goal)

    def _asked(self, request: _Request) -> Outcome:
        self._count += 1
        goal = request.goal
        outcome = Outcome(self._count, _named(goal), goal.recipe, self._deployment.graph.ftm)
        outcome.asked, outcome.scheduled, outcome.may_fail = request.asked, request.scheduled, goal.may_fail
        outcome.asked_ms = round((self._loop.now_ns() - self._started_ns) / 1e6, 3)
        return outcome

    def schedule(self, scheduled: tuple[messages.Scheduled, ...]) -> Keys:
        """Begin the adaptations requested with the run, each when the Client reaches its request."""
        self._scheduled = len(scheduled)
        for place, later in enumerate(scheduled, 1):
            request = _Request(later.goal, _unanswered, str(later), place)
            if later.at_request:
                self._waiting.append((later.at_request, request))
            else:
                begin = functools.partial(self._ask_again, request, RETRIES_MAX)
                self._loop.after(later.after_ms / 1e3, begin)
        yield from self._hold_requests()

    def client_is_new(self) -> Keys:
        """Have the new Client, which takes no mail yet, hold the requests that adaptations wait for."""
        yield from self._hold_requests()
        yield from self._deployment.ask(CLIENT, control.ResumeNode)

    def _hold_requests(self) -> Keys:
        if self.awaited:
            hold = messages.HoldAt(self.awaited)
            yield from self._deployment.ask(CLIENT, lambda token: control.Deliver(token, CLIENT, hold))

    def request_held(self, request_id: int) -> None:
        """The Client has reached `request_id`: begin the adaptations that wait for it, then release the
        request.
        """
        due = [request for at_request, request in self._waiting if at_request == request_id]
        self._waiting = [one for one in self._waiting if one[0] != request_id]
        for request in due:
            self._ask_again(request, RETRIES_MAX)
        release = messages.Release(request_id)
        with contextlib.suppress(StepFailed):  # the Client is dead; its successor sends the request again
            self._deployment.order(CLIENT, lambda token: control.Deliver(token, CLIENT, release))

    def _ask_delayed(self, request: _Request, retries: int) -> None:
        self._delayed -= 1
        self._ask_again(request, retries)

    def _ask_again(self, request: _Request, retries: int) -> None:
        try:
            self._ask(request, retries)
        except ConfigError as error:
            outcome = self._asked(request)
            outcome.outcome, outcome.reason = REFUSED, str(error)
            self._keep(outcome)
            request.answer(outcome)

    def _send(self, message: messages.Adapt | messages.Progress | messages.TakeUp) -> None:
        try:
            self._deployment.order(ENGINE, lambda token: control.Deliver(token, ENGINE, message))
        except StepFailed:
            return  # it is dead: `engine_is_new` informs its successor

    # -- what the Engine orders ---------------------------------------------------------------

    def ordered(self, todo: Script, phase: Phase, number: int) -> None:
        """Carry out a phase, and report its result to the Engine."""
        now = self._current
        if now is None or now.outcome.number != number:
            return
        if phase is Phase.FINISH and now.lost:
            return  # ordered before the Engine knew of the loss
        if now.execution is None and (now.epoch != self._deployment.epoch or self._executor.busy):
            now.spoiled = now.spoiled or "the leader has changed since it was planned"
        if now.execution is None and now.spoiled:
            now.phase, now.ended = phase, True
            now.failure = "" if phase is Phase.UNDO else now.spoiled
            self._send(messages.Progress(number, phase, now.failure))
            return
        if now.execution is None:
            now.execution = Execution(self._deployment, todo, now.plan.new, self._step)
            now.outcome.purpose, now.outcome.ftm = todo.purpose, todo.ftm or self._deployment.graph.ftm
            now.outcome.bricks_total = max(len(g.bricks) for g in (now.execution.old, now.execution.new))
            self._log("adapt", f"{number}: {todo.purpose} ({todo.recipe})")
        now.phase, now.ended, now.phase_ns = phase, False, self._loop.now_ns()
        execution = now.execution
        phases: dict[Phase, Callable[[], Keys]] = {
            Phase.PREPARE: execution.prepare,
            Phase.COMMIT: functools.partial(_spoiled, now.spoiled) if now.spoiled else execution.commit,
            Phase.FINISH: execution.finish,
            Phase.UNDO: functools.partial(execution.undo, now.lost),
        }
        if phase in (Phase.COMMIT, Phase.UNDO):
            self._executor.held = True
        self._loop.tasks.start(
            f"adapt {phase.value}", phases[phase](), lambda failure: self._ended(now, failure)
        )

    def _step(self, event: Event, number: int) -> Keys:
        """Record a step before it acts; a fault that waits for it strikes first."""
        self._runtime.journal.write(self._loop.now_ns(), event, 0, number)
        yield from self._faults.at(event)

    def _ended(self, now: _Current, failure: str) -> None:
        took_ms = round((self._loop.now_ns() - now.phase_ns) / 1e6, 3)
        now.ended, now.failure = True, failure
        self._log("adapt.phase", f"{now.phase.value}: {failure or f'{took_ms:.2f} ms'}")
        assert now.execution is not None
        if now.phase is Phase.PREPARE:
            now.outcome.prepare_ms = took_ms
        if now.phase is Phase.COMMIT and not failure:
            closed = now.execution.opened_ns - now.execution.closed_ns
            now.outcome.blackout_ms = round(closed / 1e6, 3)
        if not (now.phase is Phase.COMMIT and failure):
            self._executor.held = False
        self._send(messages.Progress(now.outcome.number, now.phase, failure))
        if now.phase is Phase.COMMIT and not failure:  # faults that waited in what was exchanged
            self._loop.tasks.start("rearm", self._faults.rearm(), lambda _: None)
        if now.phase in (Phase.COMMIT, Phase.UNDO) and not self._executor.busy:
            self._inform_recovery()

    def adapted(self, ended: messages.Adapted) -> None:
        """The Engine has ended the adaptation under way."""
        now, self._current = self._current, None
        if now is None:
            return
        if self._executor.held and now.phase is Phase.COMMIT:  # it failed, and there is no way back
            self._executor.held = False
            self._inform_recovery()
        outcome = now.outcome
        outcome.outcome, outcome.reason = ended.outcome, ended.reason
        outcome.total_ms = round((self._loop.now_ns() - now.began_ns) / 1e6, 3)
        outcome.ftm = self._deployment.graph.ftm
        outcome.application = protected_by(self._deployment.graph)
        if now.execution is not None:
            outcome.bricks_changed = bricks_changed(now.execution.old, now.execution.new, now.plan.script)
            new = now.execution.new
            outcome.tried, outcome.tried_ftm = protected_by(new), new.ftm
            outcome.opened_ns = now.execution.turned_ns
            outcome.undone_ns, outcome.lost = now.execution.undone_ns, " ".join(sorted(now.execution.lost))
        self._keep(outcome)
        now.answer(outcome)

    def _keep(self, outcome: Outcome) -> None:
        self.history.append(outcome)
        self._runtime.record_adaptation(msgspec.json.encode(outcome))
        ended = f"{outcome.number}: {outcome.purpose}: {outcome.outcome} {outcome.reason}"
        self._log("adapted", ended.rstrip())

    # -- what happens meanwhile ---------------------------------------------------------------

    def engine_is_new(self) -> None:
        """Send the new Engine the last order of its predecessor, if there was one."""
        now = self._current
        if now is None:
            return
        number, script = now.outcome.number, now.plan.script
        if now.execution is None and not now.ended:  # it had ordered nothing
            self._send(messages.Adapt(number, script))
            return
        self._send(messages.TakeUp(number, script, now.phase, now.ended, now.failure))

    def interrupted(self, replica: str) -> bool:
        """Recovery wants to act on `replica`. True if it must wait: `inform_recovery` follows."""
        now = self._current
        if now is None or now.execution is None:
            return False
        self.give_up_preparing(f"replica {replica} is lost")  # its undoing touches nothing that serves
        if now.phase is Phase.COMMIT and now.ended and not now.failure:
            if not now.execution.can_go_back(replica):
                return False  # what is new is all that there is
            self._executor.held = True
            now.lost = replica
            now.failure = f"replica {replica} was lost within the observation window"
            self._send(messages.Progress(now.outcome.number, Phase.COMMIT, now.failure))
            return True
        return False

    def to_json(self) -> bytes:
        return msgspec.json.encode({"adaptations": self.history})
