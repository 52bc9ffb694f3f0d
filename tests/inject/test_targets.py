"""Whom a fault can be aimed at: what cannot happen in a graph is refused before the run, with what can."""

import re

import pytest
from requestpath import REQUEST_PATH

from aftbed.core.errors import ConfigError
from aftbed.core.events import Event
from aftbed.core.graph import PLACEMENTS, Graph
from aftbed.ftm.compose import DUPLEX, EXPRESSIONS, build
from aftbed.inject.channel import ChannelFault, Disturbance
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import BIT_MAX, Bit, BitBurst, BitPattern, Bits, Byte, StuckBit, Trigger
from aftbed.inject.model import Fault, parse
from aftbed.inject.slow import Slow
from aftbed.inject.targets import OTHERS, SUPERVISOR, Roles, emitters_in, emitting_node
from aftbed.inject.value import EXECUTED, ValueFlip, ValuePlace
from aftbed.vehicle.aeb.function import STATE_BYTES


def waits_in(fault: Fault, graph: Graph, leader: str, backup: str) -> str | None:
    return fault.action.waits_in(fault, Roles(graph, leader, backup))


def crash(target: str, trigger: Trigger | None = None) -> Fault:
    return Fault(Crash(), target, trigger or Trigger())


def bitflip(
    place: ValuePlace, target: str = "primary", event: str = "", nth: int = 1, bit: int | None = None
) -> Fault:
    return Fault(ValueFlip(place, Bit(bit)), target, Trigger(event, nth))


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_every_node_and_role_and_everything_beside_can_be_hit(placement: str) -> None:
    graph = build("pbr", placement)
    for target in ("primary", "backup", *graph.nodes, *OTHERS):
        crash(target).check(graph)


@pytest.mark.parametrize("event", REQUEST_PATH)
@pytest.mark.parametrize("placement", PLACEMENTS)
def test_every_event_of_the_request_path_can_trigger(placement: str, event: Event) -> None:
    crash("primary", Trigger(event.label, 100)).check(build("pbr", placement))


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
            crash("primary", Trigger("state.captured")),  # there is a Server, but no brick asks for its state
            "event 'state.captured' cannot trigger a fault under --ftm none (one of: ",
        ),
    ],
)
def test_what_cannot_happen_is_refused_with_what_can(
    ftm: str, placement: str, fault: Fault, message: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        fault.check(build(ftm, placement))


def test_the_allowed_events_are_listed() -> None:
    with pytest.raises(ConfigError) as caught:
        crash("primary", Trigger("node.died")).check(build("none", "process"))
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
    assert emitting_node(Roles(build("pbr", placement), leader, backup), event) == node


# -- composed graphs


@pytest.mark.parametrize(
    ("ftm", "placement", "event", "node"),
    [
        ("pbr+tr", "process", "request.received", "a/protocol"),
        ("pbr+tr", "process", "before.exit", "a/before"),  # and not a/tr.before
        ("pbr+tr", "process", "proceed.enter", "a/tr.proceed"),
        ("pbr+tr", "process", "checkpoint.sent", "a/after"),  # and not a/tr.after, which stands before it
        ("pbr+assert", "process", "proceed.enter", "a/assert.proceed"),
        ("pbr+tr", "process", "reply.sent", "a/protocol"),
        ("lfr+tr", "process", "state.captured", "a/server"),
        ("tr", "process", "state.captured", "a/server"),
        ("tr", "replica", "server.exit", "a"),
        ("lfr", "process", "state.captured", None),
        ("lfr", "process", "state.restored", None),
        ("lfr+tr", "process", "state.restored", None),  # its Servers hand out states, and are handed none
        ("pbr+tr", "process", "state.restored", "b/server"),
        ("pbr+tr", "single", "before.exit", "single"),
        ("pbr+tr", "process", "vote.compared", "a/tr.after"),
        ("tr", "process", "vote.compared", "a/after"),
        ("pbr", "process", "vote.compared", None),
        ("lfr", "process", "checkpoint.sent", None),
        ("tr", "process", "checkpoint.sent", None),
        ("lfr+tr", "process", "follower.forwarded", "a/before"),
        ("lfr+assert", "process", "follower.notified", "a/after"),
        ("lfr", "process", "follower.diverged", "b/after"),
    ],
)
def test_the_outermost_emitter_is_meant(ftm: str, placement: str, event: str, node: str | None) -> None:
    assert emitting_node(Roles(build(ftm, placement), "a", "b"), event) == node


@pytest.mark.parametrize("ftm", EXPRESSIONS)
def test_a_fault_waits_in_a_brick_of_the_emitting_node(ftm: str) -> None:
    for placement in PLACEMENTS:
        graph = build(ftm, placement)
        for event in Event:
            node = emitting_node(Roles(graph, "a", "b"), event.label)
            brick = waits_in(crash("primary", Trigger(event.label)), graph, "a", "b")
            if node is None or node == SUPERVISOR:
                assert brick is None
            else:
                assert brick is not None and graph.node_of(brick) == node


@pytest.mark.parametrize(
    ("ftm", "placement", "event", "node", "count"),
    [
        ("pbr", "process", "before.exit", "a/before", 1),
        ("pbr", "replica", "server.exit", "a", 1),
        ("pbr+tr", "replica", "before.exit", "a", 2),
        ("lfr", "single", "server.exit", "single", 2),
    ],
)
def test_how_many_bricks_of_a_node_emit_an_event(
    ftm: str, placement: str, event: str, node: str, count: int
) -> None:
    assert emitters_in(build(ftm, placement), event, node) == count


# -- adaptations


@pytest.mark.parametrize("event", [e for e in Event if e.label.startswith("adapt.")])
def test_the_steps_of_an_adaptation_are_the_supervisors_and_the_rest_is_the_engines(event: Event) -> None:
    emitter = SUPERVISOR if event.label.startswith("adapt.step.") else "engine"
    for ftm in EXPRESSIONS:
        expected = None if ftm == "none" else emitter  # it has no Engine
        assert emitting_node(Roles(build(ftm, "process"), "a", ""), event.label) == expected
    crash("engine", Trigger(event.label, 3)).check(build("pbr", "process"))


def test_in_an_adaptation_the_nodes_of_any_mechanism_can_be_hit() -> None:
    graph = build("pbr", "process")
    crash("a/tr.proceed", Trigger("adapt.step.enter", 3)).check(graph)
    crash("a/tr.proceed'", Trigger("adapt.step.act", 3)).check(graph)
    with pytest.raises(ConfigError, match=r"unknown target 'a/tr\.proced'; did you mean 'a/tr\.proceed'\?"):
        crash("a/tr.proced", Trigger("adapt.step.enter", 3)).check(graph)
    with pytest.raises(ConfigError, match=r"unknown target 'a/tr\.proceed'"):
        crash("a/tr.proceed", Trigger("server.exit", 3)).check(graph)


# -- bitflips


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("ftm", EXPRESSIONS)
def test_a_bit_of_the_leader_can_be_flipped_under_every_mechanism(ftm: str, placement: str) -> None:
    graph = build(ftm, placement)
    for target in ("primary", "a", *(["b"] if ftm.startswith(DUPLEX) else [])):
        for place in EXECUTED:
            bitflip(place, target).check(graph)
            bitflip(place, target, "server.exit", 100, 511).check(graph)


@pytest.mark.parametrize(
    ("place", "pattern", "most"),
    [
        (ValuePlace.RESULT, Bit(512), "bytes 0 to 63 at most, bits 0 to 511"),
        (ValuePlace.LOG, StuckBit(512, 1), "bytes 0 to 63 at most, bits 0 to 511"),
        (ValuePlace.REQUEST, Byte(1024), "bytes 0 to 1023 at most, bits 0 to 8191"),
        (ValuePlace.STATE, BitBurst(2, 8 * STATE_BYTES - 1), f"bytes 0 to {STATE_BYTES - 1} at most"),
    ],
)
def test_bits_that_the_brake_never_has_are_refused_at_once(
    place: ValuePlace, pattern: BitPattern, most: str
) -> None:
    fault = Fault(ValueFlip(place, pattern), "primary", Trigger())
    with pytest.raises(ConfigError, match=f"{pattern} of {place.value}: the brake's has {most}"):
        fault.check(build("pbr", "process"))
    fault.check(build("pbr", "process", application="mine:Function"))  # its sizes are known to it alone


@pytest.mark.parametrize(
    ("ftm", "fault", "message"),
    [
        (
            "pbr",
            bitflip(ValuePlace.RESULT, "primry"),
            "unknown replica 'primry'; did you mean 'primary'? (one of: a, b, backup, primary)",
        ),
        ("pbr", bitflip(ValuePlace.RESULT, "a/server"), "unknown replica 'a/server'"),
        ("pbr", bitflip(ValuePlace.RESULT, "hub"), "unknown replica 'hub'"),
        ("tr", bitflip(ValuePlace.RESULT, "backup"), "unknown replica 'backup' (one of: a, primary)"),
        ("tr", bitflip(ValuePlace.RESULT, "b"), "unknown replica 'b'"),
        ("none", bitflip(ValuePlace.RESULT, "b"), "unknown replica 'b'"),
        ("pbr", bitflip(ValuePlace.RESULT, bit=-1), f"bit -1: 0 to {BIT_MAX} are allowed"),
        (
            "pbr",
            bitflip(ValuePlace.RESULT, bit=BIT_MAX + 1),
            f"bit {BIT_MAX + 1}: 0 to {BIT_MAX} are allowed",
        ),
        ("pbr", bitflip(ValuePlace.RESULT, nth=0), "nth 0: the first occurrence is nth 1"),
        ("pbr", bitflip(ValuePlace.RESULT, event="server.exits"), "did you mean 'server.exit'?"),
        (
            "pbr",
            bitflip(ValuePlace.RESULT, event="server.enter"),
            "unknown event for a bit of the result in primary: 'server.enter'; did you mean 'server.exit'?",
        ),
        ("pbr", bitflip(ValuePlace.STATE, event="server.enter"), "(one of: server.exit, state.captured)"),
        (
            "pbr",
            bitflip(ValuePlace.STATE, "b", "reply.sent"),
            "(one of: server.exit, state.captured, state.restored)",
        ),
        ("pbr", bitflip(ValuePlace.STATE, event="adapt.commit"), "unknown event for a bit of the state"),
        ("lfr", bitflip(ValuePlace.STATE, event="state.captured"), "(one of: server.exit)"),
        ("none", bitflip(ValuePlace.STATE, event="state.captured"), "(one of: server.exit)"),
        (
            "pbr",
            bitflip(ValuePlace.RESULT, "backup"),
            "bitflip result in backup: under --ftm pbr the Server of a backup executes nothing",
        ),
        ("pbr", bitflip(ValuePlace.STATE, "backup"), "'server.exit' (one of: state.restored)"),
    ],
)
def test_a_bit_that_cannot_be_flipped_is_refused_with_what_can(ftm: str, fault: Fault, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        fault.check(build(ftm, "process"))


@pytest.mark.parametrize(
    ("ftm", "fault", "leader", "brick"),
    [
        ("pbr", bitflip(ValuePlace.RESULT), "a", "a/server"),
        ("pbr", bitflip(ValuePlace.RESULT), "b", "b/server"),
        ("pbr", bitflip(ValuePlace.RESULT, "b"), "a", None),  # executes nothing until it leads
        ("pbr", bitflip(ValuePlace.RESULT, "b"), "b", "b/server"),
        ("pbr", bitflip(ValuePlace.STATE, "backup", "state.restored"), "a", "b/server"),
        ("pbr", bitflip(ValuePlace.STATE, "primary", "state.restored"), "a", None),
        ("lfr", bitflip(ValuePlace.RESULT, "backup"), "a", "b/server"),
        ("lfr+tr", bitflip(ValuePlace.STATE, "backup", "state.captured"), "b", "a/server"),
        ("tr", bitflip(ValuePlace.STATE), "a", "a/server"),
        ("none", bitflip(ValuePlace.RESULT, "a"), "a", "a/server"),
    ],
)
def test_a_bitflip_waits_in_the_server_that_it_hits(
    ftm: str, fault: Fault, leader: str, brick: str | None
) -> None:
    backup = "b" if leader == "a" else "a"
    assert waits_in(fault, build(ftm, "process"), leader, backup) == brick


def test_while_nobody_backs_up_no_bit_of_a_backup_can_be_flipped() -> None:
    assert waits_in(bitflip(ValuePlace.RESULT, "backup"), build("lfr", "process"), "a", "") is None
    assert waits_in(bitflip(ValuePlace.RESULT), build("lfr", "process"), "", "") is None


# -- the other values, channels, and who is slow


@pytest.mark.parametrize(
    ("ftm", "text", "leader", "brick"),
    [
        ("pbr", "bitflip request", "a", "a/server"),
        ("pbr", "bitflip request in backup", "a", None),
        ("lfr", "bitflip request in backup", "a", "b/server"),
        ("pbr", "bitflip checkpoint", "b", "b/after"),
        ("pbr", "bitflip checkpoint in b", "a", None),
        ("pbr+tr", "bitflip log", "a", "a/protocol"),
        ("pbr", "bitflip log in backup at checkpoint.applied", "a", "b/after"),
        ("pbr", "bitflip log in b at checkpoint.applied", "b", None),
        ("pbr", "omission pxy2pro", "a", "proxy"),
        ("pbr", "omission pxy2pro", "b", "proxy"),
        ("pbr", "omission pxy2pro in b", "a", None),
        ("pbr", "omission pxy2pro in b", "b", "proxy"),
        ("pbr", "omission pro2pxy", "b", "b/protocol"),
        ("pbr", "omission pro2pxy in a", "b", None),
        ("pbr", "omission aft2aft", "b", "b/after"),
        ("pbr", "omission srv2prd in b", "a", "b/server"),
        ("pbr", "omission aft2srv in backup", "b", "a/after"),
        ("lfr+tr", "omission bfr2bfr", "b", "b/before"),
        ("pbr+tr", "omission prd2aft", "a", "a/tr.proceed"),
        ("none", "omission clt2pxy", "a", "client"),
    ],
)
def test_a_fault_waits_in_the_brick_that_has_it_in_hand(
    ftm: str, text: str, leader: str, brick: str | None
) -> None:
    graph = build(ftm, "process")
    assert waits_in(parse(text), graph, leader, {"a": "b", "b": "a"}[leader]) == brick


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("ftm", EXPRESSIONS)
def test_every_channel_of_every_graph_can_be_disturbed(ftm: str, placement: str) -> None:
    graph = build(ftm, placement)
    for link in graph.links:
        parse(f"omission {link.name}").check(graph)


@pytest.mark.parametrize(
    ("ftm", "text", "message"),
    [
        ("pbr", "omission pxy2prro", "unknown channel 'pxy2prro'; did you mean 'pxy2pro'? (one of: aft2aft,"),
        ("pbr", "omission bfr2bfr", "unknown channel 'bfr2bfr'"),
        ("pbr", "omission aft2aft in c", "unknown replica 'c' (one of: a, b, backup, primary)"),
        ("none", "omission pxy2pro in backup", "unknown replica 'backup'"),
        ("pbr", "omission pxy2pro in backup", "under --ftm pbr backup sends nothing on pxy2pro"),
        ("pbr", "omission aft2aft in backup", "backup sends nothing on aft2aft"),
        ("pbr", "slow hub", "unknown target 'hub'"),
        ("pbr", "bitflip memory in hub", "unknown target 'hub'"),
        ("none", "bitflip memory in backup", "unknown target 'backup'"),
        ("none", "bitflip memory at checkpoint.sent", "cannot trigger a fault under --ftm none"),
        ("pbr", "slow b/after' at adapt.step.enter", 'unknown target "b/after\'"'),
        ("lfr", "bitflip checkpoint", "under --ftm lfr primary has none"),
        ("pbr", "bitflip checkpoint in backup", "under --ftm pbr backup has none"),
        ("pbr", "bitflip log in backup", "'reply.stored' (one of: checkpoint.applied)"),
        ("lfr", "bitflip log in backup", "under --ftm lfr backup has none"),
        ("pbr", "bitflip request in backup", "the Server of a backup executes nothing"),
        ("pbr", "bitflip request at server.exit", "(one of: server.enter)"),
    ],
)
def test_what_is_not_there_is_refused_with_what_is(ftm: str, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        parse(text).check(build(ftm, "process"))


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (Slow(0.0), "by 0ms: up to 500ms are allowed"),
        (Slow(501.0), "by 501ms: up to 500ms are allowed"),
        (ChannelFault(Disturbance.DELAY, "aft2aft", -1.0), "by -1ms: up to 3600000ms are allowed"),
        (ValueFlip(ValuePlace.RESULT, Bits(65)), "65 bits: 1 to 64 are allowed"),
        (ValueFlip(ValuePlace.RESULT, BitBurst(0, 3)), "0 bits: 1 to 64 are allowed"),
        (ValueFlip(ValuePlace.RESULT, BitBurst(3, -1)), "bit -1: 0 to 4294967295 are allowed"),
        (ValueFlip(ValuePlace.RESULT, Byte(-1)), "byte -1: 0 to 536870911 are allowed"),
        (
            ValueFlip(ValuePlace.RESULT, StuckBit(3, 2)),
            "stuck 3=2: a bit from 0 to 4294967295, and 0 or 1, are allowed",
        ),
    ],
)
def test_a_number_that_words_cannot_say_is_refused_too(
    action: Slow | ChannelFault | ValueFlip, message: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(message)):
        Fault(action, "primary", Trigger()).check(build("pbr", "process"))
