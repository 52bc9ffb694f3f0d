"""Whom a fault can be aimed at: what cannot happen in a graph is refused before the run, with what can."""

import re

import pytest

from aftbed.core.errors import ConfigError
from aftbed.core.event import REQUEST_PATH, Event
from aftbed.core.fault import Act, Fault, Trigger
from aftbed.core.graph import PLACEMENTS
from aftbed.ftm.mechanism import build
from aftbed.runtime.targets import OTHERS, check, emitter


def crash(target: str, trigger: Trigger | None = None) -> Fault:
    return Fault(Act.CRASH, target, trigger or Trigger())


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_every_node_and_role_and_everything_beside_can_be_hit(placement: str) -> None:
    graph = build("pbr", placement)
    for target in ("primary", "backup", *graph.nodes, *OTHERS):
        check(crash(target), graph)


@pytest.mark.parametrize("event", REQUEST_PATH)
@pytest.mark.parametrize("placement", PLACEMENTS)
def test_every_event_of_the_request_path_can_trigger(placement: str, event: Event) -> None:
    check(crash("primary", Trigger(event.label, 100)), build("pbr", placement))


@pytest.mark.parametrize(
    ("ftm", "placement", "fault", "message"),
    [
        ("pbr", "process", crash("primry"), "unknown target 'primry'; did you mean 'primary'? (one of: "),
        ("pbr", "process", crash("a/afte"), "unknown target 'a/afte'; did you mean 'a/after'?"),
        ("pbr", "replica", crash("a/after"), "unknown target 'a/after'"),
        ("none", "process", crash("backup"), "unknown target 'backup'"),
        ("none", "process", crash("a/protocol"), "unknown target 'a/protocol'"),
        (
            "pbr",
            "process",
            crash("primary", Trigger("server.exit", 0)),
            "nth 0: the first occurrence is nth 1",
        ),
        ("pbr", "process", crash("primary", Trigger("server.exits")), "did you mean 'server.exit'?"),
        (
            "pbr",
            "process",
            crash("primary", Trigger("fault.applied")),
            "event 'fault.applied' cannot trigger a fault under --ftm pbr (one of: ",
        ),
        (
            "none",
            "process",
            crash("primary", Trigger("checkpoint.sent")),
            "event 'checkpoint.sent' cannot trigger a fault under --ftm none (one of: ",
        ),
        (
            "none",
            "process",
            crash("primary", Trigger("state.captured")),  # there is a Server, but nobody asks for its state
            "event 'state.captured' cannot trigger a fault under --ftm none (one of: ",
        ),
    ],
)
def test_what_cannot_happen_is_refused_with_what_can(
    ftm: str, placement: str, fault: Fault, message: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        check(fault, build(ftm, placement))


def test_the_allowed_events_are_listed() -> None:
    with pytest.raises(ConfigError) as caught:
        check(crash("primary", Trigger("node.died")), build("none", "process"))
    listed = str(caught.value).partition("(one of: ")[2].rstrip(")").split(", ")
    assert listed == sorted(listed)
    assert {"request.sent", "server.enter", "server.exit", "reply.delivered"} <= set(listed)
    missing = {"checkpoint.sent", "before.exit", "watchdog.suspect", "state.captured", "state.restored"}
    assert missing.isdisjoint(listed)


@pytest.mark.parametrize(
    ("placement", "event", "leader", "node"),
    [
        ("process", "checkpoint.sent", "a", "a/after"),
        ("process", "checkpoint.sent", "b", "b/after"),
        ("replica", "checkpoint.sent", "b", "b"),
        ("process", "checkpoint.applied", "a", "b/after"),
        ("process", "checkpoint.applied", "b", "a/after"),
        ("process", "reply.accepted", "b", "proxy"),
        ("process", "request.sent", "b", "client"),
        ("process", "watchdog.suspect", "a", "a/watchdog"),
        ("process", "node.died", "a", None),
    ],
)
def test_who_emits_an_event_depends_on_who_leads(
    placement: str, event: str, leader: str, node: str | None
) -> None:
    backup = "b" if leader == "a" else "a"
    assert emitter(build("pbr", placement), event, leader, backup) == node
