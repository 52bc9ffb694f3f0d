"""From an expression to a graph: the paper's processes, and every way in which a graph can be wrong."""

from collections import Counter
from collections.abc import Callable
from typing import Final

import msgspec
import pytest
from counting import Counting

from aftbed.core.brick import Brick
from aftbed.core.errors import ConfigError
from aftbed.core.event import REQUEST_PATH
from aftbed.core.graph import PLACEMENTS, BrickSpec, Graph, Link
from aftbed.ftm.catalog import EMITTERS, KINDS, Setting, make
from aftbed.ftm.mechanism import EXPRESSIONS, build

CHANNELS: Final = frozenset(  # the paper's names
    ("clt2pxy", "pxy2pro", "pro2bfr", "bfr2prd", "prd2srv")
    + ("prd2aft", "aft2srv", "aft2aft", "aft2pro", "pro2pxy")
)


def changed(**fields: object) -> Graph:
    """The graph of PBR with some fields replaced."""
    return msgspec.structs.replace(build("pbr", "process"), **fields)


@pytest.mark.parametrize(
    ("expression", "placement", "nodes"),
    [("pbr", "process", 16), ("pbr", "replica", 8), ("none", "process", 3), ("none", "replica", 3)],
)
def test_how_many_nodes_there_are(expression: str, placement: str, nodes: int) -> None:
    assert len(build(expression, placement).nodes) == nodes


def test_with_the_supervisor_these_are_the_papers_17_processes() -> None:
    graph = build("pbr", "process")
    parts = Counter(brick.part for brick in graph.bricks)
    per_replica = ("protocol", "before", "proceed", "after", "server", "watchdog")
    assert parts == dict.fromkeys(per_replica, 2) | dict.fromkeys(
        ("client", "proxy", "recovery", "engine"), 1
    )
    assert len(graph.nodes) + 1 == 17


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


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_brick_can_be_made_and_is_open_only_where_it_has_ports(kind: str) -> None:
    for leads in (False, True):
        brick: Brick = make(kind, Setting(1, 1, leads, Counting))
        beside = {"client": {"submit"}, "watchdog": {"sense"}}.get(kind, set())
        assert set(brick.open_ports()) <= set(KINDS[kind].inputs) | beside
        assert brick.quiescent()


def test_every_event_of_the_request_path_has_an_emitter() -> None:
    assert set(REQUEST_PATH) <= set(EMITTERS)
