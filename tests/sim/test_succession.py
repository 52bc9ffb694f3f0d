"""Updates of the function in simulated runs: which version served which request, though one was undone."""

from pathlib import Path
from typing import Final

import pytest
import versions
from sampling import sampled

from aftbed.core.events import Event
from aftbed.core.messages import Goal, Scheduled
from aftbed.functions.load import OWN_CODE
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault
from aftbed.judge.checks import wrong_replies
from aftbed.judge.reference import reference_run
from aftbed.judge.simulated import breaches
from aftbed.runtime.sim.world import Doom, Run, Setup, World
from aftbed.vehicle.aeb.function import default_application

pytestmark = pytest.mark.simulation

VERSIONS: Final = str(Path(versions.__file__).resolve())
ONE_WAY: Final = "aftbed.vehicle.aeb.variants:Cautious"  # the first version refuses its state
FIRST: Final = 4  # the request at which the update begins
EFFECTS: Final = 8  # of a brick: a request or two
DEATHS: Final = 16  # from the first step of a commit to a millisecond behind the last one
LATE_MS: Final = 100.0


def setup(
    ftm: str,
    placement: str,
    source: str,
    faults: tuple[Fault, ...] = (),
    dooms: tuple[Doom, ...] = (),
) -> Setup:
    """60 requests at 400 a second, with an update to `source`."""
    update = Scheduled(Goal(part="app", source=f"{VERSIONS}:{source}"), FIRST)
    return Setup(ftm, placement, count=60, rate_hz=400, faults=faults, dooms=dooms, adaptations=(update,))


def updated(ftm: str, placement: str, source: str, *faults: Fault) -> Run:
    return World(setup(ftm, placement, source, faults), code=OWN_CODE).run()


@pytest.mark.parametrize("ftm", ["pbr", "lfr", "pbr+tr", "tr"])
def test_an_update_is_compared_with_the_version_that_served(ftm: str) -> None:
    run = updated(ftm, "process", "Firm")
    assert [a.outcome for a in run.adaptations] == ["done"]
    assert breaches(run, OWN_CODE) == ()
    wrong = list(wrong_replies(run.history, reference_run(run.history, default_application())))
    assert wrong == list(range(wrong[0], 61)) and FIRST <= wrong[0] < FIRST + 8, "from the update to the end"


@pytest.mark.parametrize("target", ["primary", "backup", "a/server", "b/protocol"])
@pytest.mark.parametrize("source", ["Firm", "Closed"])
@pytest.mark.parametrize("placement", ["process", "replica"])
@pytest.mark.parametrize("ftm", ["pbr", "lfr"])
def test_an_update_that_is_undone_served_only_meanwhile(
    ftm: str, placement: str, source: str, target: str
) -> None:
    if placement == "replica":
        target = target.partition("/")[0]
    run = updated(ftm, placement, source, Fault(Crash(), target, Trigger(after_ms=60)))
    assert [a.outcome for a in run.adaptations] == ["rolled back"]
    assert breaches(run, OWN_CODE) == ()
    wrong = list(wrong_replies(run.history, reference_run(run.history, default_application())))
    assert wrong, "the second version served"
    if source == "Firm":  # else the first one goes on with the state that it had left
        assert wrong == list(range(wrong[0], wrong[-1] + 1)) and wrong[-1] < 60


@pytest.mark.parametrize(
    ("ftm", "brick"), sampled(("pbr", "lfr", "pbr+tr"), ("a/protocol", "a/before", "a/after"))
)
def test_wherever_in_a_request_the_leader_dies(ftm: str, brick: str) -> None:
    """What only the dead one had executed is done again by the first version; what the other knew is not."""
    undone = 0
    for effect in range(40, 40 + EFFECTS):
        run = World(setup(ftm, "process", "Firm", dooms=(Doom(brick, effect),)), code=OWN_CODE).run()
        undone += [a.outcome for a in run.adaptations] == ["rolled back"]
        assert breaches(run, OWN_CODE) == (), effect
    assert undone == EFFECTS


def one_way(ftm: str, placement: str, target: str, after_ms: float) -> Run:
    """An update to a version whose state the first one refuses, and a crash of `target`."""
    fault = Fault(Crash(), target, Trigger(after_ms=after_ms))
    update = Scheduled(Goal(part="app", source=ONE_WAY), FIRST)
    given = Setup(ftm, placement, count=60, rate_hz=400, faults=(fault,), adaptations=(update,))
    return World(given, code=OWN_CODE).run()


@pytest.mark.parametrize(
    ("ftm", "placement", "target"), sampled(("pbr", "lfr"), ("process", "replica"), ("primary", "backup"))
)
def test_where_the_first_version_takes_no_state_back_the_second_goes_on(
    ftm: str, placement: str, target: str
) -> None:
    """One death never costs the service, also while requests are just being let on: the last step."""
    late = one_way(ftm, placement, target, LATE_MS)
    armed_ms = late.history.events(Event.NODE_DIED)[0].t_ns / 1e6 - LATE_MS
    steps = late.history.events(Event.ADAPT_STEP_ENTER, Event.ADAPT_STEP_EXIT)
    staged_ns = min(step.t_ns for step in steps if step.event is Event.ADAPT_STEP_EXIT)
    begun, *_, last = (step.t_ns / 1e6 - armed_ms for step in steps if step.t_ns > staged_ns)
    over = last + 1
    during = [begun + n * (over - begun) / (DEATHS - 1) for n in range(DEATHS)]
    runs = [one_way(ftm, placement, target, after_ms) for after_ms in (*during, over + 15, over + 50)]
    for run in (*runs, late):
        assert not run.rest.lost
        assert breaches(run, OWN_CODE) == ()
    outcomes = [run.adaptations[0].outcome for run in runs]
    assert "rolled back" in outcomes and outcomes[-3:] == ["done"] * 3


def test_an_update_without_a_way_back_says_so_and_looks_like_no_failure() -> None:
    update = Scheduled(Goal(part="app", source=ONE_WAY), FIRST)
    run = World(Setup(count=60, rate_hz=400, adaptations=(update,)), code=OWN_CODE).run()
    assert [a.outcome for a in run.adaptations] == ["done"]
    told = [(event, text) for _, event, text in run.logged]
    assert "refused" not in dict(told)
    why = "the version of a/server before does not take the state of this one"
    assert told.count(("adapt", f"it cannot be undone any more: {why}")) == 1


def test_what_never_served_is_no_version() -> None:
    """It died before requests were let on again."""
    run = updated("pbr", "process", "Firm", Fault(Crash(), "a/protocol", Trigger("adapt.step.enter", 4)))
    assert [(a.outcome, a.opened_ns) for a in run.adaptations] == [("rolled back", 0)]
    assert breaches(run, OWN_CODE) == ()
    assert wrong_replies(run.history, reference_run(run.history, default_application())) == {}
