"""Adaptation Engine: exchanges bricks while the service runs, as a transaction (paper, III-B; design 4).

It plans (graph difference to script), has the runtime carry out one phase after the other, and decides
after each. Nothing that it must remember is only here: the runtime tells a new Engine what its dead
predecessor had ordered last, and the table below goes on from there.

| phase that ended | well                                   | not well                     |
|------------------|----------------------------------------|------------------------------|
| prepare          | commit                                 | undo, then `refused`         |
| commit           | observe for `WINDOW_NS`, then finish   | undo, then `rolled back`     |
| ... by the paper | the same                               | `failed`: it has no way back |
| finish           | `done`                                 | `done`: it serves, said so   |
| undo             | `refused` or `rolled back`             | the same, with both reasons  |

While it observes, and until the old bricks are gone, a failure of what is new is told as the failure of its
commit: undo. The paper's recipe kills first; there is nothing to go back to.
"""

from enum import auto
from typing import Final

from aftbed.adapt.plan import plan, target, updated
from aftbed.adapt.scriptcheck import refusals
from aftbed.core.brick import CONTROL, Brick, BrickState, Effect, Note, Order, Send
from aftbed.core.errors import ConfigError, PeerError
from aftbed.core.events import Event
from aftbed.core.graph import Graph
from aftbed.core.messages import Adapt, Adapted, AnyMessage, Goal, Progress, Rebound, TakeUp
from aftbed.core.script import RECIPES, Phase, Script, after, problems
from aftbed.ftm.registry import KINDS

WINDOW_NS: Final = 100_000_000
DONE: Final = "done"
REFUSED: Final = "refused"
ROLLED_BACK: Final = "rolled back"
FAILED: Final = "failed"


class EngineState(BrickState):
    IDLE = auto()
    PREPARING = auto()
    COMMITTING = auto()
    OBSERVING = auto()  # committed; the old bricks are still there
    FINISHING = auto()
    UNDOING = auto()


_BY_PHASE: Final = {
    Phase.PREPARE: EngineState.PREPARING,
    Phase.COMMIT: EngineState.COMMITTING,
    Phase.FINISH: EngineState.FINISHING,
    Phase.UNDO: EngineState.UNDOING,
}


def script_for(graph: Graph, goal: Goal) -> Script:
    """The script that leads from `graph` to `goal`, checked whole. Raises ConfigError."""
    if goal.script is not None:
        found = refusals(graph, goal.script)
        if found:
            raise ConfigError(f"the script {goal.script.purpose!r} is refused: {'; '.join(found)}")
        return goal.script
    if goal.part:
        script = plan(graph, updated(graph, goal.part, goal.source), goal.recipe).script
    else:
        script = plan(graph, target(graph, goal.expression), goal.recipe).script
    found = [*problems(script), *after(graph, script, KINDS).problems(KINDS)]
    assert not found, f"a plan that cannot be carried out: {found}"
    return script


class AdaptationEngine(Brick):
    """`number` and `script` are those of the adaptation under way."""

    def __init__(self) -> None:
        self.state = EngineState.IDLE
        self.number = 0
        self.script: Script | None = None
        self.reason = ""  # of what is being undone
        self.outcome = REFUSED
        self._until_ns: int | None = None

    def open_ports(self) -> tuple[str, ...]:
        """None: only the runtime speaks to it."""
        return ()

    def quiescent(self) -> bool:
        """Nothing under way."""
        return self.state is EngineState.IDLE

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Begin, go on, or take up what another has begun."""
        match msg:
            case Adapt() if self.state is EngineState.IDLE:
                return self._begin(msg)
            case Progress() if msg.number == self.number and self._waits_for(msg.phase):
                return self._went(msg.phase, msg.failure, now_ns)
            case TakeUp() if self.state is EngineState.IDLE:
                self.number, self.script, self.state = msg.number, msg.script, _BY_PHASE[msg.phase]
                self.outcome = REFUSED if msg.phase is Phase.PREPARE else ROLLED_BACK
                return self._went(msg.phase, msg.failure, now_ns) if msg.ended else []
            case Rebound():
                return []
            case _:
                raise PeerError(f"{type(msg).__name__} on {port} while {self.state.name}")

    def _waits_for(self, phase: Phase) -> bool:
        if self.state in (EngineState.OBSERVING, EngineState.FINISHING) and phase is Phase.COMMIT:
            return True  # what is new may still fail
        return _BY_PHASE.get(phase) is self.state

    def _begin(self, msg: Adapt) -> list[Effect]:
        try:
            self.script = script_for(msg.graph, msg.goal)
        except ConfigError as error:
            return [Send(CONTROL, Adapted(msg.number, REFUSED, str(error)))]
        self.number, self.reason = msg.number, ""
        return [Note(Event.ADAPT_PLAN, detail=msg.number), *self._order(Phase.PREPARE)]

    def _order(self, phase: Phase) -> list[Effect]:
        assert self.script is not None
        self.state = _BY_PHASE[phase]
        return [Order(self.script, phase, self.number)]

    def _went(self, phase: Phase, failure: str, now_ns: int) -> list[Effect]:
        """The table of the module."""
        self._until_ns = None
        match phase:
            case Phase.COMMIT if failure and self.script is not None and self.script.recipe != RECIPES[0]:
                return self._end(FAILED, failure)
            case Phase.PREPARE | Phase.COMMIT if failure:
                self.reason = failure
                self.outcome = REFUSED if phase is Phase.PREPARE else ROLLED_BACK
                return [Note(Event.ADAPT_ROLLBACK, detail=self.number), *self._order(Phase.UNDO)]
            case Phase.PREPARE:
                return self._order(Phase.COMMIT)
            case Phase.COMMIT:
                self.state, self._until_ns = EngineState.OBSERVING, now_ns + WINDOW_NS
                return [Note(Event.ADAPT_COMMIT, detail=self.number)]
            case Phase.FINISH:
                return self._end(DONE, failure)
            case _:
                return self._end(self.outcome, "; ".join(r for r in (self.reason, failure) if r))

    def _end(self, outcome: str, reason: str) -> list[Effect]:
        self.state, self.script = EngineState.IDLE, None
        return [Send(CONTROL, Adapted(self.number, outcome, reason))]

    def deadline_ns(self) -> int | None:
        """The end of the observation."""
        return self._until_ns

    def wake(self, now_ns: int) -> list[Effect]:
        """Nothing broke: the old bricks may go."""
        self._until_ns = None
        return self._order(Phase.FINISH)
