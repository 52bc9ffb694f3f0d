"""The plan of every adaptation: a script without a problem that leads to exactly the graph that was wanted.

Every ordered pair of expressions, in every placement, led by either replica, under both recipes.
"""

from itertools import permutations
from typing import Final

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loops import for_each
from plans import CASES, RUNNABLE, Case

from aftbed.adapt.planner import APPLICATION, drains, leader_of, plan, target, updated
from aftbed.adapt.script_check import problems
from aftbed.core.errors import ConfigError
from aftbed.core.graph import PLACEMENTS, Graph
from aftbed.core.script import (
    RECIPES,
    Align,
    Destroy,
    Drain,
    Exchange,
    Freeze,
    Migrate,
    Resume,
    Retire,
    Stage,
    Suspend,
    Thaw,
    Transfer,
    after,
    flat,
)
from aftbed.ftm.compose import NONE, REPLICAS, STATEFUL, build, chain, replication_of
from aftbed.ftm.registry import KINDS

OURS: Final = [case for case in CASES if case.recipe == RECIPES[0]]
DUPLEX_PAIRS: Final = list(permutations([e for e in RUNNABLE if replication_of(e)], 2))
PARTS: Final = ("protocol", "before", "proceed", "after", "server", APPLICATION)


def meaning(graph: Graph) -> tuple[object, ...]:
    """All of a graph but the order in which its parts are listed."""
    nodes = {node: frozenset(bricks) for node, bricks in graph.nodes.items()}
    return graph.ftm, graph.placement, frozenset(graph.bricks), frozenset(graph.links), nodes


# -- every pair


@for_each(CASES)
def test_every_plan_is_sound_and_leads_where_it_should(case: Case) -> None:
    there = case.plan()
    assert problems(there.script) == []
    new = after(there.old, there.script, KINDS)
    assert new.problems(KINDS) == []
    assert meaning(new) == meaning(there.new)
    assert there.script.ftm == case.new and there.script.recipe == case.recipe


@for_each(CASES)
def test_the_way_back_leads_back(case: Case) -> None:
    there = case.plan()
    back = plan(there.new, there.old, case.recipe)
    assert meaning(after(there.new, back.script, KINDS)) == meaning(there.old)
    assert set(back.added) == set(there.removed) and set(back.removed) == set(there.added)
    assert set(back.replaced) == set(there.replaced) and set(back.kept) == set(there.kept)
    assert back.bricks_changed == there.bricks_changed and back.bricks_total == there.bricks_total


@for_each(CASES)
def test_the_names_of_a_plan_are_the_difference_of_its_graphs(case: Case) -> None:
    there = case.plan()
    old, new = ({b.name: b for b in graph.bricks} for graph in (there.old, there.new))
    assert set(there.added) == new.keys() - old.keys()
    assert set(there.removed) == old.keys() - new.keys()
    assert set(there.kept) | set(there.replaced) == old.keys() & new.keys()
    assert not set(there.kept) & set(there.replaced)
    assert all(old[name] == new[name] for name in there.kept)
    assert set(there.rebound) <= set(there.kept)
    changed = {name for name in old.keys() & new.keys() if old[name] != new[name]}
    assert changed <= set(there.replaced)
    if case.placement == PLACEMENTS[0]:
        assert changed == set(there.replaced), "in placement process no more than what differs"


@given(st.lists(st.sampled_from(RUNNABLE), min_size=2, max_size=5), st.sampled_from(PLACEMENTS))
def test_one_adaptation_after_the_other_leads_where_each_should(names: list[str], placement: str) -> None:
    """From the graph that `after` made, whose bricks are listed in another order than a built one's."""
    graph = build(names[0], placement)
    for name in names[1:]:
        if name == graph.ftm:
            continue
        there = plan(graph, target(graph, name))
        assert problems(there.script) == []
        graph = after(graph, there.script, KINDS)
        assert meaning(graph) == meaning(build(name, placement))


# -- the order


@for_each(CASES)
def test_the_client_waits_from_the_first_step_to_the_last(case: Case) -> None:
    """The leader's Protocol is suspended first and resumed last; what is slow is done before."""
    there = case.plan()
    commit = list(flat(there.script.commit))
    leads = f"{case.leader}/protocol"
    if case.recipe == RECIPES[0]:
        assert commit[0] == Suspend(leads) and commit[-1] == Resume(leads)
        assert commit.count(Resume(leads)) == commit.count(Suspend(leads)) == 1
        assert not any(isinstance(v, Stage | Destroy | Freeze | Thaw) for v in commit)
    else:
        first = next(at for at, verb in enumerate(commit) if not isinstance(verb, Freeze))
        assert Freeze(leads) in commit[:first]
        assert {v.brick for v in commit if isinstance(v, Freeze)} >= {
            v.brick for v in commit if isinstance(v, Thaw)
        }
        assert Thaw(leads) in commit
        assert not any(isinstance(v, Suspend | Drain | Exchange | Align | Migrate) for v in commit)


@for_each(OURS)
def test_what_is_new_is_there_before_it_is_needed_and_what_is_old_until_it_is_not(case: Case) -> None:
    script = case.plan().script
    staged = {v.node for v in flat(script.prepare) if isinstance(v, Stage)}
    exchanged = {v.node for v in flat(script.commit) if isinstance(v, Exchange)}
    retired = [v.node for v in flat(script.finish) if isinstance(v, Retire)]
    assert exchanged <= staged and exchanged <= set(retired) and len(retired) == len(set(retired))
    migrated = {v.node for v in flat(script.commit) if isinstance(v, Migrate)}
    assert migrated <= exchanged


@for_each(OURS)
def test_who_must_not_read_yet_is_held_until_the_end(case: Case) -> None:
    """Whoever shares its channels with a predecessor, or gets a state first."""
    there = case.plan()
    born = {b.replica for b in there.new.bricks} - {b.replica for b in there.old.bricks}
    stages = [v for v in flat(there.script.prepare) if isinstance(v, Stage)]
    resumed = {v.brick for v in flat(there.script.commit) if isinstance(v, Resume)}
    for stage in stages:
        given = any(b.replica in born and b.part in STATEFUL for b in stage.bricks)
        assert stage.held == (stage.node in there.old.nodes or given), stage.node
        assert not stage.held or resumed & {b.name for b in stage.bricks}


@for_each(CASES)
def test_states_move_as_the_mechanisms_need_it(case: Case) -> None:
    """PBR to LFR hands the follower a state equal to the leader's; a replica that is new gets both."""
    there = case.plan()
    commit = list(flat(there.script.commit))
    both = replication_of(case.old), replication_of(case.new)
    (other,) = set(REPLICAS) - {case.leader}
    aligned = Align(f"{case.leader}/server", f"{other}/server") in commit
    transferred = [v for v in commit if isinstance(v, Transfer)]
    if case.recipe == RECIPES[0]:
        assert aligned == (all(both) and both[0] != both[1])
    born = bool(both[1]) and not both[0]
    wanted = [Transfer(f"{case.leader}/{p}", f"{other}/{p}") for p in ("protocol", "server")]
    assert transferred == (wanted if born else [])


@pytest.mark.parametrize("expression", [e for e in RUNNABLE if replication_of(e)])
@pytest.mark.parametrize("leader", REPLICAS)
def test_a_backup_is_drained_in_the_order_of_a_request(expression: str, leader: str) -> None:
    """From the brick that hears of the leader on: under LFR the whole chain, under PBR its After alone."""
    graph = build(expression, "process", leader)
    (backup,) = set(REPLICAS) - {leader}
    part = replication_of(expression)[0][0]
    path = [b for b in chain(graph, backup) if not b.endswith("/server")]
    assert drains(graph, updated(graph, "after", "x.py:X")) == path[path.index(f"{backup}/{part}") :]
    assert drains(graph, updated(graph, "app", "x.py:X")) == path[path.index(f"{backup}/{part}") :]


def test_a_backup_of_which_nothing_changes_that_requests_pass_is_not_drained() -> None:
    old, new = build("pbr", "process"), build("pbr+tr", "process")
    assert drains(old, new) == []
    assert drains(build("lfr", "process"), build("lfr+tr", "process")) != []


@pytest.mark.parametrize(("first", "second"), DUPLEX_PAIRS)
def test_the_backup_is_drained_alike_however_its_graph_came_about(first: str, second: str) -> None:
    wanted = build(second, "process")
    came = after(build(first, "process"), plan(build(first, "process"), wanted).script, KINDS)
    ours, theirs = (drains(g, updated(g, "after", "x.py:X")) for g in (came, wanted))
    assert ours == theirs != []


# -- the smallest set of bricks


@pytest.mark.parametrize(
    ("old", "new", "changed", "total"),
    [
        ("pbr", "pbr+tr", 10, 22),  # paper, III-B: Proceed becomes Protocol, Before, Proceed, After
        ("pbr+tr", "pbr", 10, 22),
        ("lfr", "lfr+tr", 10, 22),
        ("pbr", "lfr", 4, 16),  # paper: a switch exchanges Before and After
        ("lfr+tr", "pbr+tr", 4, 22),
        ("pbr+tr", "pbr+assert", 16, 22),
        ("pbr", "tr", 9, 16),
    ],
)
def test_how_many_bricks_change(old: str, new: str, changed: int, total: int) -> None:
    there = Case(old, new).plan()
    assert (there.bricks_changed, there.bricks_total) == (changed, total)


def test_a_composition_stops_nothing_that_stays() -> None:
    there = Case("pbr", "pbr+tr").plan()
    assert there.replaced == ()
    assert there.removed == ("a/proceed", "b/proceed")
    assert {b.partition("/")[2] for b in there.added} == {
        "tr.protocol",
        "tr.before",
        "tr.proceed",
        "tr.after",
    }
    assert set(there.rebound) == {f"{r}/{part}" for r in "ab" for part in ("before", "after", "server")}
    assert there.script.purpose == "pbr to pbr+tr"


# -- updates


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("recipe", RECIPES)
def test_an_update_exchanges_that_brick_on_every_replica(part: str, placement: str, recipe: str) -> None:
    if recipe != RECIPES[0] and (placement != PLACEMENTS[0] or part == "protocol"):
        return
    old = build("pbr", placement)
    new = updated(old, part, "x.py:X")
    there = plan(old, new, recipe)
    name = "server" if part == APPLICATION else part
    assert problems(there.script) == []
    assert meaning(after(old, there.script, KINDS)) == meaning(new)
    wanted = {f"{replica}/{name}" for replica in REPLICAS}
    assert wanted <= set(there.replaced)
    assert placement != PLACEMENTS[0] or wanted == set(there.replaced)
    for brick in wanted:
        spec = new.brick(brick)
        assert (spec.application if part == APPLICATION else spec.source) == "x.py:X"
    assert there.script.purpose == f"update {name}" or placement != PLACEMENTS[0]


@pytest.mark.parametrize("part", PARTS)
def test_what_an_updated_brick_held_moves_to_its_successor(part: str) -> None:
    """Also where the old one had no state to speak of: the new class may make something of it."""
    old = build("lfr+tr", "process")
    name = "server" if part == APPLICATION else part
    script = plan(old, updated(old, part if part != "proceed" else "tr.proceed", "x.py:X")).script
    name = "tr.proceed" if part == "proceed" else name
    assert {v.node for v in flat(script.commit) if isinstance(v, Migrate)} == {
        f"{r}/{name}" for r in REPLICAS
    }


def test_the_paper_cannot_exchange_what_it_freezes() -> None:
    old = build("pbr", "process")
    script = plan(old, updated(old, "protocol", "x.py:X"), "paper").script
    assert any(p.startswith("changed while requests flow") for p in problems(script))


def test_a_brick_that_no_replica_has() -> None:
    with pytest.raises(
        ConfigError, match=r"unknown brick 'proced'; did you mean 'proceed'\? \(one of: after, app"
    ):
        updated(build("pbr", "process"), "proced", "x.py:X")
    with pytest.raises(ConfigError, match="unknown brick 'watchdog'"):
        updated(build("pbr", "process"), "watchdog", "x.py:X")
    with pytest.raises(ConfigError, match=r"unknown brick 'tr\.after'"):
        updated(build("pbr", "process"), "tr.after", "x.py:X")


def test_the_function_that_runs_is_no_update() -> None:
    for function in ("", "x.py:App"):
        with pytest.raises(
            ConfigError, match=f"{function} is what runs already, with the same content: nothing"
        ):
            updated(build("pbr", "process", application=function), APPLICATION, function)


def test_the_function_goes_with_its_server_into_another_mechanism() -> None:
    old = updated(build("pbr", "process"), APPLICATION, "x.py:App")
    new = target(old, "lfr+tr")
    assert {b.application for b in new.bricks if b.part == "server"} == {"x.py:App"}
    assert {f"{r}/server" for r in REPLICAS} <= set(plan(old, new).kept)


# -- who leads


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("leader", REPLICAS)
def test_the_leader_is_read_off_the_graph(placement: str, leader: str) -> None:
    assert leader_of(build("pbr", placement, leader)) == leader
    assert leader_of(target(build("pbr", placement, leader), "lfr+tr")) == leader


def test_a_graph_that_was_led_by_another_is_planned_alike() -> None:
    """After a failover it is the old graph, turned round."""
    turned = build("pbr", "process").led_by("b")
    assert meaning(turned) == meaning(build("pbr", "process", "b"))
    assert plan(turned, target(turned, "lfr")).script.commit[0] == Suspend("b/protocol")


# -- what is refused


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("pbr", "pbr", "pbr is what runs already"),
        ("pbr", "pbrr", "unknown FTM 'pbrr'; did you mean 'pbr'?"),
        ("pbr", "tr+pbr", "it can only be innermost"),
        ("pbr", NONE, "an adaptation neither starts nor ends there"),
        (NONE, "pbr", "an adaptation neither starts nor ends there"),
    ],
)
def test_where_there_is_no_way(old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        target(build(old, "process"), new)
    assert words in str(error.value)


@pytest.mark.parametrize("part", ["app", "after"])
def test_nothing_is_updated_without_a_mechanism(part: str) -> None:
    with pytest.raises(ConfigError, match="none has no engine, so nothing can be updated"):
        updated(build(NONE, "process"), part, "x.py:X")


def test_a_recipe_that_does_not_exist_or_does_not_fit() -> None:
    old, new = build("pbr", "process"), build("lfr", "process")
    with pytest.raises(ConfigError, match=r"unknown recipe 'papr'; did you mean 'paper'\?"):
        plan(old, new, "papr")
    replica = build("pbr", "replica"), build("lfr", "replica")
    with pytest.raises(ConfigError, match="placement process, not replica"):
        plan(*replica, "paper")


# -- scripts broken by hand


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"commit": slice(1, None)}, "resumed, not suspended: a/protocol"),
        ({"commit": slice(0, -1)}, "suspended, not resumed: a/protocol"),
        ({"prepare": slice(1, None)}, "nothing is staged to take the place of a/before"),
        ({"prepare": slice(0, 0)}, "resumed, not suspended: a/before"),
    ],
)
def test_a_plan_that_was_cut_is_refused(change: dict[str, slice], problem: str) -> None:
    script = Case("pbr", "lfr").plan().script
    cut = {phase: getattr(script, phase)[part] for phase, part in change.items()}
    assert problem in problems(msgspec.structs.replace(script, **cut))


def test_a_plan_with_a_step_too_many_is_refused() -> None:
    script = Case("pbr", "lfr").plan().script

    def spoilt(phase: str, verb: object) -> list[str]:
        return problems(msgspec.structs.replace(script, **{phase: (*getattr(script, phase), verb)}))

    assert spoilt("commit", Destroy("a/proceed")) == ["killed with a request inside: a/proceed"]
    assert spoilt("commit", Exchange("a/server"))[0].startswith("changed while requests flow: Exchange")
    assert spoilt("commit", Migrate("a/server"))[0].startswith("changed while requests flow: Migrate")
    assert spoilt("commit", Suspend("a/server")) == ["suspended, not resumed: a/server"]
    assert spoilt("prepare", Suspend("a/server"))[0].startswith("prepare touches what already serves")
    assert spoilt("finish", Suspend("a/server"))[0].startswith("finish only retires")
    assert spoilt("commit", Stage("a/x", ())) == ["spawned while the client waits: a/x"]


def test_a_graph_that_would_be_half_of_one_is_found() -> None:
    there = Case("pbr", "pbr+tr").plan()

    def led_to(phase: str, part: slice) -> list[str]:
        cut = msgspec.structs.replace(there.script, **{phase: getattr(there.script, phase)[part]})
        return after(there.old, cut, KINDS).problems(KINDS)

    assert "a/tr.before:pro2bfr is not bound" in led_to("prepare", slice(0, 8))
    assert "a/proceed:bfr2prd is not bound" in led_to("finish", slice(0, 0))
    assert led_to("prepare", slice(None)) == []
