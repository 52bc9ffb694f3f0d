"""From an expression to a graph: the grammar, the paper's processes, and every way to get a graph wrong."""

import re
from collections import Counter
from collections.abc import Callable
from typing import Final

import msgspec
import pytest
from counting import Counting
from requestpath import REQUEST_PATH

from aftbed.core.brick import Brick
from aftbed.core.errors import ConfigError
from aftbed.core.graph import PLACEMENTS, BrickSpec, Graph, Kind, Link
from aftbed.ftm.compose import EXPRESSIONS, build, canonical, chain, parse, replication_of
from aftbed.ftm.registry import EMITTERS, KINDS, MECHANISMS, Setting, make

CHANNELS: Final = frozenset(  # the paper's names
    ("clt2pxy", "pxy2pro", "pro2bfr", "bfr2prd", "prd2srv")
    + ("prd2aft", "aft2srv", "aft2aft", "aft2pro", "pro2pxy")
)


def changed(**fields: object) -> Graph:
    """The graph of PBR with some fields replaced."""
    return msgspec.structs.replace(build("pbr", "process"), **fields)


@pytest.mark.parametrize(
    ("expression", "placement", "nodes"),
    [
        ("pbr", "process", 16),
        ("lfr", "process", 16),
        ("pbr+tr", "process", 22),
        ("lfr+tr", "process", 22),
        ("pbr+assert", "process", 22),
        ("lfr+assert", "process", 22),
        ("tr", "process", 10),
        ("assert", "process", 10),
        ("assert+tr", "process", 13),
        ("pbr+sup", "process", 22),
        ("pbr+assert+tr", "process", 28),
        ("pbr", "replica", 8),
        ("pbr+tr", "replica", 8),
        ("pbr+tr", "single", 7),
        ("tr", "replica", 6),
        ("none", "process", 3),
        ("none", "replica", 3),
    ],
)
def test_how_many_nodes_there_are(expression: str, placement: str, nodes: int) -> None:
    assert len(build(expression, placement).nodes) == nodes


@pytest.mark.parametrize("expression", ["pbr", "lfr"])
def test_with_the_supervisor_these_are_the_papers_17_processes(expression: str) -> None:
    graph = build(expression, "process")
    parts = Counter(brick.part for brick in graph.bricks)
    per_replica = ("protocol", "before", "proceed", "after", "server", "watchdog")
    assert parts == dict.fromkeys(per_replica, 2) | dict.fromkeys(
        ("client", "proxy", "recovery", "engine"), 1
    )
    assert len(graph.nodes) + 1 == 17


@pytest.mark.parametrize("outer", ["pbr", "lfr"])
def test_composed_with_tr_they_are_the_papers_23(outer: str) -> None:
    """Per replica, one brick (Proceed) is exchanged for four."""
    alone, composed = build(outer, "process"), build(f"{outer}+tr", "process")
    assert len(composed.nodes) + 1 == 23
    names = {b.name for b in alone.bricks}
    assert names - {b.name for b in composed.bricks} == {"a/proceed", "b/proceed"}
    inner = ("tr.protocol", "tr.before", "tr.proceed", "tr.after")
    assert {b.name for b in composed.bricks} - names == {f"{r}/{part}" for r in "ab" for part in inner}


# -- the grammar


def test_the_expressions_are_all_of_one_and_two_mechanisms_that_make_sense() -> None:
    assert EXPRESSIONS == (
        "none",
        "pbr",
        "lfr",
        "tr",
        "assert",
        "sup",
        "pbr+tr",
        "pbr+assert",
        "pbr+sup",
        "lfr+tr",
        "lfr+assert",
        "lfr+sup",
        "assert+tr",
    )


@pytest.mark.parametrize(("typed", "meant"), [("PBR", "pbr"), ("Lfr + TR", "lfr+tr"), ("NONE", "none")])
def test_capitals_and_spaces_make_no_other_name(typed: str, meant: str) -> None:
    assert canonical(typed) == meant
    assert build(typed, "process") == build(meant, "process")


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("prb", "unknown FTM 'prb'; did you mean 'pbr'? (one of: assert, lfr, none, pbr, sup, tr)"),
        ("", "unknown FTM '' (one of: "),
        ("pbr+", "unknown FTM '' (one of: "),
        ("pbr,tr", "FTM 'pbr,tr': mechanisms are joined by '+', as 'pbr+tr'"),
        ("pbr+none", "unknown FTM 'none'"),
        ("tr+pbr", "tr+pbr: tr repeats the computation itself, so it can only be innermost (pbr+tr?)"),
        ("assert+lfr", "assert+lfr: lfr replicates, so it can only be outermost (lfr+assert?)"),
        ("pbr+lfr", "pbr+lfr: lfr replicates, so it can only be outermost (lfr?)"),
        ("pbr+tr+assert", "pbr+tr+assert: tr repeats the computation itself"),
        ("pbr+tr+assert", "(pbr+assert+tr?)"),
        ("assert+assert", "assert+assert: assert within assert adds nothing"),
    ],
)
def test_an_order_that_makes_no_sense_is_refused_with_its_reason(expression: str, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        parse(expression)


def test_a_mechanism_is_in_the_place_of_the_outer_ones_proceed_at_any_depth() -> None:
    graph = build("pbr+assert+tr", "process")
    assert chain(graph, "b") == tuple(
        f"b/{part}"
        for part in (
            *("protocol", "before"),
            *("assert.protocol", "assert.before"),
            *("tr.protocol", "tr.before", "tr.proceed", "tr.after"),
            *("assert.after", "after", "server"),
        )
    )
    ways = {(k.source, k.source_port): (k.sink, k.sink_port) for k in graph.links}
    assert ways["a/before", "bfr2prd"] == ("a/assert.protocol", "pxy2pro")
    assert ways["a/assert.before", "bfr2prd"] == ("a/tr.protocol", "pxy2pro")
    assert ways["a/tr.protocol", "pro2pxy"] == ("a/assert.after", "prd2aft")
    assert ways["a/assert.protocol", "pro2pxy"] == ("a/after", "prd2aft")
    assert ways["a/server", "srv2prd"] == ("a/tr.proceed", "srv2prd")


DEEP: Final = (*EXPRESSIONS, "pbr+assert+tr", "lfr+assert+tr")


@pytest.mark.parametrize("leader", ["a", "b"])
@pytest.mark.parametrize("expression", DEEP)
def test_a_graph_uses_every_port_of_its_bricks_that_its_mechanism_has(expression: str, leader: str) -> None:
    """Unbound are only ports of a Server that no brick captures, and of an alarm that no brick raises."""
    graph = build(expression, "process", leader)
    assert graph.problems(KINDS) == []
    bound = {end for link in graph.links for end in link.ends}
    names = parse(expression)
    unbound = {
        (b.part, port)
        for b in graph.bricks
        for port, side in _ports(KINDS[b.kind])
        if (b.name, port, side) not in bound and (b.part, port) not in replication_of(expression)
    }
    allowed = set()
    if "pbr" not in names:
        allowed |= {("server", "aft2srv"), ("server", "srv2aft")}
    if "tr" not in names:
        allowed |= {("server", "bfr2srv"), ("server", "srv2bfr")}
    if not replication_of(expression):
        allowed |= {("recovery", "wdg2rec.b"), ("recovery", "wdg2rec")}
    assert unbound <= allowed


def _ports(kind: Kind) -> list[tuple[str, str]]:
    return [(p, "in") for p in kind.inputs] + [(p, "out") for p in kind.outputs]


def test_every_kind_of_brick_is_used() -> None:
    used = {b.kind for expression in DEEP for b in build(expression, "process").bricks}
    assert used == set(KINDS)


@pytest.mark.parametrize("expression", DEEP)
def test_a_chain_is_in_the_order_of_a_request_whatever_the_order_of_the_bricks(expression: str) -> None:
    """After an adaptation the bricks are in another order, and the first of them are those that stayed."""
    graph = build(expression, "process")
    turned = msgspec.structs.replace(graph, bricks=graph.bricks[::-1], links=graph.links[::-1])
    assert chain(turned, "a") == chain(graph, "a")
    assert chain(graph, "a")[-1] == "a/server"
    assert set(chain(graph, "a")) == {b.name for b in graph.bricks if b.replica == "a"} - {"a/watchdog"}


def test_replication_goes_from_the_leader_to_the_other_by_the_same_ports() -> None:
    assert replication_of("none") == replication_of("assert+tr") == ()
    assert replication_of("pbr+tr") == (("after", "aft2aft"),)
    assert replication_of("lfr+tr") == (("before", "bfr2bfr"), ("after", "aft2aft"))
    for expression in DEEP:
        for leader, other in (("a", "b"), ("b", "a")):
            across = {
                (k.source, k.source_port, k.sink, k.sink_port)
                for k in build(expression, "process", leader).links
                if k.source[0] == leader and k.sink[:2] == f"{other}/"
            }
            assert across == {
                (f"{leader}/{part}", port, f"{other}/{part}", port)
                for part, port in replication_of(expression)
            }


def test_who_leads_is_who_the_proxy_is_bound_to() -> None:
    for expression in DEEP[1:]:
        graph = build(expression, "process", "b")
        bound = {k.sink for k in graph.links if k.source == "proxy" and not k.standby}
        assert bound == {"client", "b/protocol"}


def test_the_channels_have_the_papers_names() -> None:
    assert {link.name for link in build("pbr", "process").links} >= CHANNELS


def test_in_placement_replica_a_chain_shares_a_node_and_the_watchdog_does_not() -> None:
    graph = build("pbr", "replica")
    assert graph.nodes["a"] == ("a/protocol", "a/before", "a/proceed", "a/after", "a/server")
    assert graph.node_of("b/server") == "b" and graph.node_of("a/watchdog") == "a/watchdog"


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_bricks_and_links_do_not_depend_on_the_placement(expression: str, placement: str) -> None:
    graph = build(expression, placement)
    assert graph.problems(KINDS) == []
    assert (graph.bricks, graph.links) == (
        build(expression, "process").bricks,
        build(expression, "process").links,
    )


def test_the_backups_ways_to_the_proxy_stand_by() -> None:
    standby = {(k.source, k.sink) for k in build("pbr", "process").links if k.standby}
    assert standby == {("proxy", "b/protocol"), ("b/protocol", "proxy")}


@pytest.mark.parametrize(
    ("expression", "placement", "message"),
    [
        ("prb", "process", "unknown FTM 'prb'; did you mean 'pbr'?"),
        ("pbr", "proces", "unknown placement 'proces'; did you mean 'process'?"),
    ],
)
def test_an_unknown_name_is_refused_with_the_nearest_one(
    expression: str, placement: str, message: str
) -> None:
    with pytest.raises(ConfigError, match=message.replace("?", r"\?")):
        build(expression, placement)


def twice_named() -> Graph:
    return changed(bricks=(*build("pbr", "process").bricks, BrickSpec("proxy", "proxy")))


def of_no_kind() -> Graph:
    return changed(bricks=(*build("pbr", "process").bricks, BrickSpec("x", "teapot")))


def with_link(*link: str) -> Graph:
    return changed(links=(*build("pbr", "process").links, Link(*link)))


def without_link(name: str) -> Graph:
    return changed(links=tuple(k for k in build("pbr", "process").links if k.name != name))


def with_nodes(**nodes: tuple[str, ...]) -> Graph:
    return changed(nodes=build("pbr", "process").nodes | nodes)


@pytest.mark.parametrize(
    ("broken", "problem"),
    [
        (twice_named, "two bricks are called proxy"),
        (of_no_kind, "x: no such kind of brick: teapot"),
        (lambda: with_link("ghost", "p", "proxy", "clt2pxy"), "p: no brick is called ghost"),
        (lambda: with_link("client", "clt2pxy", "ghost", "p"), "clt2pxy: no brick is called ghost"),
        (lambda: with_link("proxy", "out", "client", "pxy2clt"), "out: proxy has no output port out"),
        (lambda: with_link("proxy", "pxy2clt", "client", "in"), "pxy2clt: client has no input port in"),
        (
            lambda: with_link("proxy", "clt2pxy", "client", "pxy2clt"),
            "proxy has no output port clt2pxy",
        ),
        (lambda: with_link("client", "clt2pxy", "proxy", "clt2pxy"), "client:clt2pxy is bound 2 times"),
        (lambda: without_link("clt2pxy"), "client:clt2pxy is not bound"),
        (lambda: without_link("pro2bfr"), "b/before:pro2bfr is not bound"),
        (lambda: with_nodes(proxy=()), "proxy is hosted by 0 nodes"),
        (lambda: with_nodes(two=("proxy",)), "proxy is hosted by 2 nodes"),
        (lambda: with_nodes(x=("ghost",)), "a node hosts ghost, which is not a brick"),
    ],
)
def test_each_thing_that_is_wrong_is_named(broken: Callable[[], Graph], problem: str) -> None:
    assert any(problem in found for found in broken().problems(KINDS))


def test_what_may_stay_unbound_may() -> None:
    assert without_link("aft2aft").problems(KINDS) == []


def test_a_name_that_is_not_in_the_graph() -> None:
    graph = build("pbr", "process")
    with pytest.raises(KeyError, match="ghost"):
        graph.brick("ghost")
    with pytest.raises(KeyError, match="ghost"):
        graph.node_of("ghost")


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "engine"])
def test_every_kind_of_brick_can_be_made_and_is_open_only_where_it_has_ports(kind: str) -> None:
    for leads in (False, True):
        brick: Brick = make(kind, Setting(1, 1, leads, Counting))
        beside = {"client": {"submit"}, "watchdog": {"sense"}}.get(kind, set())
        assert set(brick.open_ports()) <= set(KINDS[kind].inputs) | beside
        assert brick.quiescent()


def test_every_event_of_the_request_path_has_an_emitter() -> None:
    assert set(REQUEST_PATH) <= set(EMITTERS)


def test_an_emitter_is_a_part_or_a_kind_that_exists() -> None:
    words = {b.part.rpartition(".")[2] for b in build("pbr+tr", "process").bricks}
    assert {part for part, _ in EMITTERS.values()} <= words | set(KINDS)


def test_a_mechanism_names_kinds_of_the_catalog() -> None:
    for row in MECHANISMS.values():
        assert {row.before.name, row.proceed.name, row.after.name} <= set(KINDS)
