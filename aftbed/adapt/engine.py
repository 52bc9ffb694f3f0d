"""Adaptation Engine: exchanges bricks while the service runs, as a transaction (paper, III-B).

It is given a plan that was checked (`commands.plan_goal`), orders one phase after the other from the runtime,
and decides after each. It keeps nothing that only it knows: the runtime sends a new Engine what the dead one
had ordered last, and the table goes on from there.

| phase that ended | well                                   | not well                     |
|------------------|----------------------------------------|------------------------------|
| prepare          | commit                                 | undo, then `refused`         |
| commit           | observe for `WINDOW_NS`, then finish   | undo, then `rolled back`     |
| ... by the paper | the same                               | `failed`: it has no way back |
| finish           | `done`                                 | `done`, with the reason      |
| undo             | `refused` or `rolled back`             | the same, with both reasons  |

While the Engine observes, and until the old bricks are gone, the runtime reports a failure of a new brick as
the failure of the commit: undo. The paper's recipe kills first, so there is nothing to go back to.
"""

from enum import auto
from typing import ClassVar, Final

from aftbed.core.brick import (
    CONTROL,
    DEADLINE_PASSED,
    BrickAnswer,
    BrickState,
    Choice,
    DeadlinePassed,
    Effect,
    Machine,
    Move,
    Moves,
    Note,
    Order,
    Send,
)
from aftbed.core.events import Event
from aftbed.core.messages import Adapt, Adapted, AnyMessage, Progress, TakeUp
from aftbed.core.script import RECIPES, Phase, Script

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


class PhaseEnd(BrickAnswer):
    """How a phase ended, as far as the next one depends on it."""

    PREPARED = auto()
    NOT_PREPARED = auto()
    COMMITTED = auto()
    NOT_COMMITTED = auto()
    LOST = auto()  # not committed, by a recipe that has no way back
    FINISHED = auto()
    UNDONE = auto()
    OF_ANOTHER = auto()  # of another adaptation


_S: Final = EngineState
_WELL: Final = {
    Phase.PREPARE: PhaseEnd.PREPARED,
    Phase.COMMIT: PhaseEnd.COMMITTED,
    Phase.FINISH: PhaseEnd.FINISHED,
    Phase.UNDO: PhaseEnd.UNDONE,
}
_FAILED: Final = _WELL | {Phase.PREPARE: PhaseEnd.NOT_PREPARED, Phase.COMMIT: PhaseEnd.NOT_COMMITTED}


class AdaptationEngine(Machine):
    """`number` and `script` are those of the adaptation under way."""

    AT_REST = (_S.IDLE,)

    def __init__(self) -> None:
        super().__init__()
        self.number = 0
        self.script: Script | None = None
        self.reason = ""  # of what is being undone
        self.outcome = REFUSED
        self._until_ns: int | None = None

    def step(self, port: str, msg: AnyMessage | DeadlinePassed, now_ns: int) -> list[Effect]:
        """As every Machine; the observation begins with its state.

        A phase of which the dead Engine did not see the end is taken up as under way, then ended.
        """
        effects = super().step(port, msg, now_ns)
        if isinstance(msg, TakeUp) and msg.ended:
            effects += super().step(port, Progress(msg.number, msg.phase, msg.failure), now_ns)
        if self.state is _S.OBSERVING:
            if self._until_ns is None:
                self._until_ns = now_ns + WINDOW_NS
        else:
            self._until_ns = None
        return effects

    # -- questions ----------------------------------------------------------------------------

    def phase_end(self, msg: Progress) -> PhaseEnd | None:
        """None for what is no phase of an adaptation."""
        if msg.number != self.number:
            return PhaseEnd.OF_ANOTHER
        assert self.script is not None
        if msg.failure and msg.phase is Phase.COMMIT and self.script.recipe != RECIPES[0]:
            return PhaseEnd.LOST
        return (_FAILED if msg.failure else _WELL).get(msg.phase)

    def phase(self, msg: TakeUp) -> Phase:
        """The one that was ordered last."""
        return msg.phase

    # -- handlers -----------------------------------------------------------------------------

    def prepare(self, msg: Adapt) -> list[Effect]:
        """Begin adaptation `msg.number`."""
        self.number, self.script, self.reason = msg.number, msg.script, ""
        return [Note(Event.ADAPT_PLAN, detail=msg.number), *self._order(Phase.PREPARE)]

    def wait(self, msg: TakeUp) -> list[Effect]:
        """Go on where the dead Engine ended."""
        self.number, self.script = msg.number, msg.script
        self.outcome = REFUSED if msg.phase is Phase.PREPARE else ROLLED_BACK
        return []

    def commit(self, msg: Progress) -> list[Effect]:
        return self._order(Phase.COMMIT)

    def observe(self, msg: Progress) -> list[Effect]:
        """The new graph serves; the old bricks stay for `WINDOW_NS`."""
        self._until_ns = None
        return [Note(Event.ADAPT_COMMIT, detail=self.number)]

    def finish(self, msg: DeadlinePassed) -> list[Effect]:
        """Nothing failed: the old bricks may go."""
        return self._order(Phase.FINISH)

    def undo(self, msg: Progress) -> list[Effect]:
        """Go back to the graph that was there."""
        self.reason = msg.failure
        self.outcome = REFUSED if msg.phase is Phase.PREPARE else ROLLED_BACK
        return [Note(Event.ADAPT_ROLLBACK, detail=self.number), *self._order(Phase.UNDO)]

    def end_lost(self, msg: Progress) -> list[Effect]:
        """Neither the old graph nor the new one."""
        return self._end(FAILED, msg.failure)

    def end_done(self, msg: Progress) -> list[Effect]:
        """The new graph serves, even if an old brick could not be ended."""
        return self._end(DONE, msg.failure)

    def end_undone(self, msg: Progress) -> list[Effect]:
        """With the reason of the undo, and that of its failure."""
        return self._end(self.outcome, "; ".join(r for r in (self.reason, msg.failure) if r))

    def _order(self, phase: Phase) -> list[Effect]:
        assert self.script is not None
        return [Order(self.script, phase, self.number)]

    def _end(self, outcome: str, reason: str) -> list[Effect]:
        self.script = None
        return [Send(CONTROL, Adapted(self.number, outcome, reason))]

    def deadline_ns(self) -> int | None:
        return self._until_ns

    def wake(self, now_ns: int) -> list[Effect]:
        return self.step(CONTROL, DEADLINE_PASSED, now_ns)

    # -- the table ----------------------------------------------------------------------------

    _PREPARED: ClassVar[dict[object, Move]] = {
        PhaseEnd.PREPARED: (commit, _S.COMMITTING),
        PhaseEnd.NOT_PREPARED: (undo, _S.UNDOING),
    }
    _COMMITTED: ClassVar[dict[object, Move]] = {
        PhaseEnd.COMMITTED: (observe, _S.OBSERVING),
        PhaseEnd.NOT_COMMITTED: (undo, _S.UNDOING),
        PhaseEnd.LOST: (end_lost, _S.IDLE),
    }
    _FINISHED: ClassVar[dict[object, Move]] = {PhaseEnd.FINISHED: (end_done, _S.IDLE)}
    _UNDONE: ClassVar[dict[object, Move]] = {PhaseEnd.UNDONE: (end_undone, _S.IDLE)}
    MOVES: ClassVar[Moves] = {
        (_S.IDLE, CONTROL, Adapt): (prepare, _S.PREPARING),
        (_S.IDLE, CONTROL, TakeUp): Choice(
            phase,
            {
                Phase.PREPARE: (wait, _S.PREPARING),
                Phase.COMMIT: (wait, _S.COMMITTING),
                Phase.FINISH: (wait, _S.FINISHING),
                Phase.UNDO: (wait, _S.UNDOING),
            },
        ),
        (_S.PREPARING, CONTROL, Progress): Choice(phase_end, _PREPARED),
        (_S.COMMITTING, CONTROL, Progress): Choice(phase_end, _COMMITTED),
        (_S.OBSERVING, CONTROL, DeadlinePassed): (finish, _S.FINISHING),
        # What is new may still fail: the runtime reports it as the failure of its commit.
        (_S.OBSERVING, CONTROL, Progress): Choice(phase_end, _COMMITTED),
        (_S.FINISHING, CONTROL, Progress): Choice(phase_end, _FINISHED | _COMMITTED),
        (_S.UNDOING, CONTROL, Progress): Choice(phase_end, _UNDONE),
    }
