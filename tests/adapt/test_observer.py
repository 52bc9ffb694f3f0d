"""When what is proposed: by hand, and against an oracle.

The oracle keeps the whole history and looks at all of it each time.
"""

from typing import Final

from hypothesis import given, settings
from hypothesis import strategies as st
from policies import ACTIONS, ADAPTABLE, COMPOSE, DECOMPOSE, TO_LFR, S, beyond_oracle, beyonds, levels

from aftbed.adapt.policy import (
    Action,
    Beyond,
    Burst,
    Condition,
    Declined,
    Measured,
    Observation,
    Observer,
    Policy,
    Proposal,
    Quiet,
    Rule,
    Running,
    Seen,
    conflict,
)

# -- by hand


def observer(*rules: tuple[Condition, Action], running: str = "pbr", dwell_s: int = 5) -> Observer:
    named = tuple(Rule(f"rules[{n}]", when, then) for n, (when, then) in enumerate(rules))
    return Observer(Policy(named, dwell_s * S), running, 0)


def load(value: float) -> Measured:
    return Measured({"cpu_load": value})


TWO_FAULTS: Final = Burst("value_fault", 2, 10 * S, 15 * S)
FAULT: Final = Seen("value_fault")
BUSY: Final = Beyond("cpu_load", True, 0.8, 0.5, 2 * S)


def test_two_value_faults_in_ten_seconds() -> None:
    loop = observer((TWO_FAULTS, COMPOSE))
    assert loop.step(FAULT, 1 * S) is None
    assert loop.step(Seen("crash"), 2 * S) is None
    assert loop.step(FAULT, 4 * S) == Proposal(
        "rules[0]", "2 value_fault within 10 s", "compose tr", "pbr", "pbr+tr", 1 * S, 4 * S
    )


def test_two_value_faults_too_far_apart() -> None:
    loop = observer((TWO_FAULTS, COMPOSE))
    assert loop.step(FAULT, 1 * S) is None
    assert loop.step(FAULT, 11 * S) is None
    assert loop.step(FAULT, 21 * S - 1) is not None


def test_a_burst_that_goes_on_began_with_its_first_event() -> None:
    loop = observer((TWO_FAULTS, COMPOSE))
    loop.step(FAULT, 1 * S)
    assert loop.step(FAULT, 2 * S) is not None
    assert [loop.step(FAULT, t * S) for t in (3, 4, 5)] == [None] * 3
    proposal = loop.wake(7 * S)
    assert proposal is not None and proposal.since_ns == 1 * S, "rolled back, and proposed again"


def test_when_a_burst_is_over_it_is_the_turn_of_those_below() -> None:
    loop = observer((TWO_FAULTS, Action("to", "pbr")), (Quiet("crash", 1 * S), TO_LFR))
    loop.step(FAULT, 1 * S)
    assert loop.step(FAULT, 1 * S) is None, "it holds, and pbr runs"
    assert loop.deadline_ns() == 1 * S + 1, "of the quiet"
    assert loop.wake(2 * S) is None, "the lower one would have lfr"
    assert loop.deadline_ns() == 16 * S + 1
    assert loop.wake(16 * S) is None
    proposal = loop.wake(16 * S + 1)
    assert proposal is not None and proposal.target == "lfr"


def test_a_load_must_last_and_is_over_where_the_rule_says() -> None:
    loop = observer((BUSY, Action("to", "pbr")), running="lfr")
    assert [loop.step(load(v), t * S) for t, v in ((0, 0.9), (1, 0.9), (1.5, 0.8))] == [None] * 3
    assert loop.step(load(0.9), 2 * S) is None, "it began anew"
    proposal = loop.step(load(0.85), 4 * S)
    assert proposal is not None and (proposal.since_ns, proposal.now_ns) == (2 * S, 4 * S)


def test_between_its_thresholds_a_rule_keeps_what_it_was() -> None:
    loop = observer((BUSY, Action("to", "pbr")), running="lfr", dwell_s=1)
    loop.step(load(0.9), 0)
    assert loop.step(load(0.9), 2 * S) is not None
    assert loop.step(load(0.51), 4 * S) is not None, "it holds, and lfr still runs"
    assert loop.step(load(0.5), 6 * S) is None
    assert loop.step(load(0.79), 8 * S) is None


def test_nothing_is_proposed_within_the_dwell_time_and_it_is_said_when_to_look_again() -> None:
    loop = observer((TWO_FAULTS, COMPOSE), (BUSY, TO_LFR))
    loop.step(load(0.9), 0)
    assert loop.step(load(0.9), 2 * S) is not None
    loop.step(Running("lfr"), 3 * S)
    assert loop.deadline_ns() == 8 * S
    assert [loop.step(FAULT, t * S) for t in (4, 5)] == [None, None]
    assert loop.wake(8 * S - 1) is None
    proposal = loop.wake(8 * S)
    assert proposal is not None and (proposal.target, proposal.since_ns) == ("lfr+tr", 4 * S)


def test_what_runs_already_is_not_proposed() -> None:
    loop = observer((TWO_FAULTS, COMPOSE), running="pbr+tr")
    assert [loop.step(FAULT, t * S) for t in range(5)] == [None] * 5
    assert loop.step(Running("pbr"), 5 * S) is None
    assert loop.wake(10 * S) is not None, "somebody took it away, and the burst still holds"


def test_the_way_back_when_it_is_quiet() -> None:
    loop = observer((TWO_FAULTS, COMPOSE), (Quiet("value_fault", 60 * S), DECOMPOSE))
    loop.step(FAULT, 1 * S)
    assert loop.step(FAULT, 2 * S) is not None
    loop.step(Running("pbr+tr"), 2 * S)
    assert loop.wake(62 * S) is None
    assert loop.deadline_ns() == 62 * S + 1
    proposal = loop.wake(62 * S + 1)
    assert proposal is not None and (proposal.target, proposal.since_ns) == ("pbr", 2 * S)


def test_the_upper_rule_decides_where_two_that_conflict_hold() -> None:
    busy_wire = Beyond("traffic_kbit_s", True, 500, 400, 0)
    loop = observer((BUSY, Action("to", "pbr")), (busy_wire, TO_LFR), dwell_s=1)
    both = Measured({"cpu_load": 0.9, "traffic_kbit_s": 600})
    assert loop.step(both, 0) is not None, "the lower one holds first"
    loop.step(Running("lfr"), 0)
    proposal = loop.step(both, 2 * S)
    assert proposal is not None and proposal.target == "pbr"
    loop.step(Running("pbr"), 2 * S)
    assert loop.step(both, 9 * S) is None
    proposal = loop.step(Measured({"cpu_load": 0.1, "traffic_kbit_s": 600}), 10 * S)
    assert proposal is not None and proposal.target == "lfr", "the upper one has ended"


def test_a_rolled_back_adaptation_is_proposed_again_and_a_declined_one_is_not() -> None:
    loop = observer((BUSY, TO_LFR))
    loop.step(load(0.9), 0)
    assert loop.step(load(0.9), 2 * S) is not None
    assert loop.step(load(0.9), 7 * S) is not None
    loop.step(Declined(), 8 * S)
    assert loop.step(load(0.9), 20 * S) is None
    loop.step(load(0.1), 21 * S)
    loop.step(load(0.9), 22 * S)
    assert loop.step(load(0.9), 24 * S) is not None, "another time"


def test_what_was_not_measured_is_beyond_nothing() -> None:
    loop = observer((BUSY, TO_LFR))
    loop.step(load(0.9), 0)
    assert loop.step(Measured({}), 1 * S) is None
    assert loop.step(load(0.9), 2 * S) is None


def test_a_load_that_has_begun_ends_at_its_until_also_within_one_instant() -> None:
    loop = observer((Beyond("cpu_load", True, 0.8, 0.5, 0), TO_LFR))
    assert loop.step(Running("lfr"), 0) is None
    assert [loop.step(load(v), 0) for v in (0.9, 0.6)] == [None, None]
    assert loop.step(Running("pbr"), 1 * S) is None, "it dwells"
    assert loop.wake(6 * S) is not None, "0.6 is not back at 0.5"


def test_an_observation_that_comes_late_counts_as_of_now() -> None:
    loop = observer((TWO_FAULTS, COMPOSE))
    loop.step(FAULT, 20 * S)
    proposal = loop.step(FAULT, 1 * S)
    assert proposal is not None and (proposal.since_ns, proposal.now_ns) == (20 * S, 20 * S)


# -- against the oracle

conditions: Final = st.one_of(
    st.builds(
        lambda event, count, within: Burst(event, count, within, within + 4),
        st.sampled_from(("crash", "hang")),
        st.integers(1, 3),
        st.integers(1, 12),
    ),
    st.builds(Quiet, st.sampled_from(("crash", "hang")), st.integers(1, 30)),
    beyonds(),
)
policies: Final = st.lists(st.tuples(conditions, st.sampled_from(ACTIONS)), min_size=1, max_size=4).map(
    lambda found: Policy(tuple(Rule(f"rules[{n}]", w, t) for n, (w, t) in enumerate(found)), 4)
)
observations: Final = st.one_of(
    st.builds(Seen, st.sampled_from(("crash", "hang", "divergence"))),
    levels.map(lambda value: Measured({"cpus": value})),
    st.sampled_from(ADAPTABLE).map(Running),
    st.just(None),  # only time passes
)
histories: Final = st.lists(st.tuples(observations, st.integers(0, 9)), max_size=40)


def holds(when: Condition, past: list[tuple[Observation | None, int]], now: int) -> bool:
    """Whether `when` holds, by all that was ever observed."""
    if isinstance(when, Beyond):
        samples = [(t, o.values["cpus"]) for o, t in past if isinstance(o, Measured)]
        return bool(samples) and beyond_oracle(when, samples)[-1]
    seen = [t for o, t in past if isinstance(o, Seen) and o.event == when.event]
    if isinstance(when, Quiet):
        return now - (seen[-1] if seen else 0) > when.quiet_ns
    begun = False
    for index, t in enumerate(seen):
        if begun and t - seen[index - 1] > when.hold_ns:
            begun = False
        begun = begun or sum(t - s < when.within_ns for s in seen[: index + 1]) >= when.count
    return begun and now - seen[-1] <= when.hold_ns


def expected(policy: Policy, running: str, past: list[tuple[Observation | None, int]], now: int) -> str:
    """What should be proposed but for the dwell time, as `rule target`; "" for nothing."""
    held = [rule for rule in policy.rules if holds(rule.when, past, now)]
    for index, rule in enumerate(held):
        silent = any(conflict(above.then, rule.then) for above in held[:index])
        if not silent and rule.then.applied(running) != running:
            return f"{rule.key} {rule.then.applied(running)}"
    return ""


@given(policies, st.sampled_from(ADAPTABLE), histories, st.booleans())
@settings(max_examples=4 * settings.default.max_examples)
def test_what_is_proposed_is_what_the_whole_history_says(
    policy: Policy, running: str, history: list[tuple[Observation | None, int]], obeyed: bool
) -> None:
    loop, now, rest_until = Observer(policy, running, 0), 0, 0
    past: list[tuple[Observation | None, int]] = []
    for observation, later in history:
        now += later
        past.append((observation, now))
        if isinstance(observation, Running):
            rest_until = now + 4 if observation.expression != running else rest_until
            running = observation.expression
        proposal = loop.step(observation, now) if observation is not None else loop.wake(now)
        wanted = expected(policy, running, past, now) if now >= rest_until else ""
        assert (f"{proposal.rule} {proposal.target}" if proposal else "") == wanted
        if proposal is not None:
            assert proposal.running == running != proposal.target and proposal.since_ns <= now
            rest_until = now + 4
            if obeyed:
                running = proposal.target
                past.append((Running(running), now))
                assert loop.step(Running(running), now) is None


@given(policies, st.sampled_from(ADAPTABLE), histories)
@settings(max_examples=2 * settings.default.max_examples)
def test_whoever_wakes_it_at_its_deadlines_misses_nothing(
    policy: Policy, running: str, history: list[tuple[Observation | None, int]]
) -> None:
    """Woken each nanosecond, or only when it asked for it: the same proposals at the same times."""
    times = [sum(later for _, later in history[: n + 1]) for n in range(len(history))]
    due: dict[int, list[Observation]] = {}
    for (observation, _), t in zip(history, times, strict=True):
        if observation is not None:
            due.setdefault(t, []).append(observation)
    found: list[list[Proposal]] = []
    for patient in (False, True):
        loop, proposals = Observer(policy, running, 0), list[Proposal | None]()
        for now in range(max(times, default=0) + 40):
            deadline = loop.deadline_ns()
            assert deadline is None or deadline > now - 1
            for observation in due.get(now, []):
                proposals.append(loop.step(observation, now))
            if not patient or (deadline is not None and deadline <= now):
                proposals.append(loop.wake(now))
        found.append([p for p in proposals if p is not None])
    assert found[0] == found[1]
    gaps = [b.now_ns - a.now_ns for a, b in zip(found[0], found[0][1:], strict=False)]
    assert all(gap >= policy.dwell_ns for gap in gaps)
