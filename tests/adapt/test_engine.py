"""The Adaptation Engine: the table of its phases, every illegal message, taking up what a dead one began."""

from itertools import product
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st
from plans import Case

from aftbed.adapt.engine import (
    DONE,
    REFUSED,
    ROLLED_BACK,
    WINDOW_NS,
    AdaptationEngine,
    EngineState,
)
from aftbed.core.brick import CONTROL, Effect, Note, Order, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import Adapt, Adapted, AnyMessage, Progress, Promotion, Rebound, TakeUp
from aftbed.core.script import Phase
from aftbed.ftm.compose import build

NUMBER: Final = 7
NOW_NS: Final = 1_000_000_000
PBR: Final = build("pbr", "process")
SCRIPT: Final = Case("pbr", "pbr+tr").plan().script
PHASES: Final = (Phase.PREPARE, Phase.COMMIT, Phase.FINISH, Phase.UNDO)
STATES: Final = {
    Phase.PREPARE: EngineState.PREPARING,
    Phase.COMMIT: EngineState.COMMITTING,
    Phase.FINISH: EngineState.FINISHING,
    Phase.UNDO: EngineState.UNDOING,
}


def order(phase: Phase) -> Order:
    return Order(SCRIPT, phase, NUMBER)


def ended(outcome: str, reason: str = "") -> Send:
    return Send(CONTROL, Adapted(NUMBER, outcome, reason))


def tell(engine: AdaptationEngine, message: AnyMessage) -> list[Effect]:
    return engine.step(CONTROL, message, NOW_NS)


def went(engine: AdaptationEngine, phase: Phase, failure: str = "") -> list[Effect]:
    return tell(engine, Progress(NUMBER, phase, failure))


def begun() -> AdaptationEngine:
    """An Engine that prepares."""
    engine = AdaptationEngine()
    tell(engine, Adapt(NUMBER, SCRIPT))
    return engine


def in_state(state: EngineState) -> AdaptationEngine:
    """An Engine on its way, there."""
    engine = AdaptationEngine() if state is EngineState.IDLE else begun()
    if state in (EngineState.COMMITTING, EngineState.OBSERVING, EngineState.FINISHING):
        went(engine, Phase.PREPARE)
    if state in (EngineState.OBSERVING, EngineState.FINISHING):
        went(engine, Phase.COMMIT)
    if state is EngineState.FINISHING:
        engine.wake(NOW_NS + WINDOW_NS)
    if state is EngineState.UNDOING:
        went(engine, Phase.PREPARE, "no room")
    assert engine.state is state
    return engine


# -- the table


def test_an_adaptation_that_goes_well() -> None:
    engine = AdaptationEngine()
    assert engine.quiescent()
    assert tell(engine, Adapt(NUMBER, SCRIPT)) == [
        Note(Event.ADAPT_PLAN, detail=NUMBER),
        order(Phase.PREPARE),
    ]
    assert not engine.quiescent()
    assert went(engine, Phase.PREPARE) == [order(Phase.COMMIT)]
    assert went(engine, Phase.COMMIT) == [Note(Event.ADAPT_COMMIT, detail=NUMBER)]
    assert engine.deadline_ns() == NOW_NS + WINDOW_NS
    assert engine.wake(NOW_NS + WINDOW_NS) == [order(Phase.FINISH)]
    assert engine.deadline_ns() is None
    assert went(engine, Phase.FINISH) == [ended(DONE)]
    assert engine.quiescent()


@pytest.mark.parametrize(
    ("state", "phase", "outcome"),
    [
        (EngineState.PREPARING, Phase.PREPARE, REFUSED),
        (EngineState.COMMITTING, Phase.COMMIT, ROLLED_BACK),
        (EngineState.OBSERVING, Phase.COMMIT, ROLLED_BACK),
    ],
)
def test_a_phase_that_fails_is_undone(state: EngineState, phase: Phase, outcome: str) -> None:
    engine = in_state(state)
    assert went(engine, phase, "it broke") == [Note(Event.ADAPT_ROLLBACK, detail=NUMBER), order(Phase.UNDO)]
    assert engine.state is EngineState.UNDOING and engine.deadline_ns() is None
    assert went(engine, Phase.UNDO) == [ended(outcome, "it broke")]
    assert engine.quiescent()


def test_what_cannot_be_undone_is_told_with_both_reasons() -> None:
    engine = in_state(EngineState.COMMITTING)
    went(engine, Phase.COMMIT, "it broke")
    assert went(engine, Phase.UNDO, "and this too") == [ended(ROLLED_BACK, "it broke; and this too")]


def test_what_serves_is_done_even_where_the_old_one_does_not_end() -> None:
    engine = in_state(EngineState.FINISHING)
    assert went(engine, Phase.FINISH, "a/proceed does not die") == [ended(DONE, "a/proceed does not die")]


def test_one_that_is_refused_leaves_no_trace_in_the_next() -> None:
    engine = in_state(EngineState.COMMITTING)
    went(engine, Phase.COMMIT, "it broke")
    went(engine, Phase.UNDO)
    tell(engine, Adapt(NUMBER, SCRIPT))
    went(engine, Phase.PREPARE, "no room")
    assert went(engine, Phase.UNDO) == [ended(REFUSED, "no room")]
    tell(engine, Adapt(NUMBER, SCRIPT))
    for phase in (Phase.PREPARE, Phase.COMMIT):
        went(engine, phase)
    engine.wake(NOW_NS)
    assert went(engine, Phase.FINISH) == [ended(DONE)]


# -- illegal messages


def legal(state: EngineState, phase: Phase) -> bool:
    """Whether the end of `phase` is what an Engine in `state` waits for."""
    if state in (EngineState.OBSERVING, EngineState.FINISHING) and phase is Phase.COMMIT:
        return True
    return STATES.get(phase) is state


ANOTHER_PHASE: Final = [
    (state, Progress(NUMBER, phase, failure))
    for state, phase, failure in product(EngineState, (*PHASES, Phase.WHOLE), ("", "x"))
    if not legal(state, phase) and state is not EngineState.IDLE
]
ILLEGAL: Final = [
    *((EngineState.IDLE, Progress(NUMBER, phase, "")) for phase in PHASES),
    *((state, Progress(NUMBER + 1, phase, "")) for state, phase in product(EngineState, PHASES)),
    *((state, Adapt(NUMBER + 1, SCRIPT)) for state in EngineState if state is not EngineState.IDLE),
    *(
        (state, TakeUp(NUMBER, SCRIPT, Phase.COMMIT, False, ""))
        for state in EngineState
        if state is not EngineState.IDLE
    ),
    *((state, Promotion(2)) for state in EngineState),
]


def image(engine: AdaptationEngine) -> tuple[object, ...]:
    """All that an Engine remembers."""
    return tuple(vars(engine).items())


def refuses(state: EngineState, message: AnyMessage) -> None:
    engine = in_state(state)
    before = image(engine)
    with pytest.raises(PeerError, match=f"{type(message).__name__} on {CONTROL} while {state.name}"):
        tell(engine, message)
    assert image(engine) == before


@pytest.mark.parametrize(("state", "message"), ILLEGAL)
def test_an_illegal_message_is_refused_and_changes_nothing(state: EngineState, message: AnyMessage) -> None:
    refuses(state, message)


@pytest.mark.parametrize(("state", "message"), ANOTHER_PHASE)
def test_the_end_of_another_phase_is_refused(state: EngineState, message: AnyMessage) -> None:
    refuses(state, message)


@pytest.mark.parametrize("state", EngineState)
def test_it_does_not_mind_where_its_ports_lead(state: EngineState) -> None:
    engine = in_state(state)
    before = image(engine)
    assert tell(engine, Rebound("x", True, 2)) == []
    assert image(engine) == before and engine.open_ports() == ()


# -- taking up


@pytest.mark.parametrize("phase", PHASES)
def test_a_phase_under_way_is_waited_for(phase: Phase) -> None:
    engine = AdaptationEngine()
    assert tell(engine, TakeUp(NUMBER, SCRIPT, phase, False, "")) == []
    assert engine.state is STATES[phase]


@pytest.mark.parametrize("failure", ["", "it broke"])
@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("told", [False, True])
def test_a_new_engine_goes_on_as_the_dead_one_would_have(phase: Phase, failure: str, told: bool) -> None:
    """Whether the phase had ended when it died (`told` by TakeUp), or ends later."""
    new = AdaptationEngine()
    if told:
        found = tell(new, TakeUp(NUMBER, SCRIPT, phase, True, failure))
    else:
        tell(new, TakeUp(NUMBER, SCRIPT, phase, False, ""))
        found = went(new, phase, failure)
    if phase is Phase.UNDO:
        assert found == [ended(ROLLED_BACK, failure)]
        return
    old = in_state(STATES[phase])
    assert found == went(old, phase, failure)
    assert (new.state, new.number, new.script) == (old.state, old.number, old.script)
    assert new.deadline_ns() == old.deadline_ns()
    if new.state is EngineState.UNDOING:
        assert went(new, Phase.UNDO) == went(old, Phase.UNDO)


def test_one_that_died_while_it_observed_observes_again() -> None:
    engine = AdaptationEngine()
    assert tell(engine, TakeUp(NUMBER, SCRIPT, Phase.COMMIT, True, "")) == [
        Note(Event.ADAPT_COMMIT, detail=NUMBER)
    ]
    assert engine.deadline_ns() == NOW_NS + WINDOW_NS
    assert went(engine, Phase.COMMIT, "b is lost") == [
        Note(Event.ADAPT_ROLLBACK, detail=NUMBER),
        order(Phase.UNDO),
    ]


@given(st.lists(st.tuples(st.sampled_from(PHASES), st.booleans(), st.booleans()), max_size=12))
def test_however_often_it_dies_it_ends_once_and_only_as_the_table_says(
    fates: list[tuple[Phase, bool, bool]],
) -> None:
    """The runtime carries out what is ordered last; before each of its words the Engine may be a new one."""
    engine, ordered, ends = begun(), Phase.PREPARE, []
    failed = False
    for _, fails, dies in [*fates, *((Phase.PREPARE, False, False),) * 5]:
        if engine.quiescent():
            break
        if dies:
            engine = AdaptationEngine()
            tell(engine, TakeUp(NUMBER, SCRIPT, ordered, False, ""))
        failed = failed or (fails and ordered in (Phase.PREPARE, Phase.COMMIT))
        effects = went(engine, ordered, "it broke" if fails else "")
        if engine.state is EngineState.OBSERVING:
            effects = engine.wake(NOW_NS + WINDOW_NS)
        for effect in effects:
            if isinstance(effect, Order):
                ordered = effect.phase
            elif isinstance(effect, Send):
                assert isinstance(effect.message, Adapted)
                ends.append(effect.message.outcome)
    assert len(ends) == 1
    assert (ends[0] == DONE) == (not failed)
