"""`aftbed bench hops`: which pairs of notes are one hop apart, and the distribution of their delay.

No test depends on speed: it must hold on a busy machine.
"""

import itertools
import json
from typing import Final

import pytest
from liveruns import Home, aftbed

from aftbed.bench.cycle import PLACEMENT, NotePair, delays, single_hops, undisturbed
from aftbed.campaign.statistics import quantile
from aftbed.core.events import Event
from aftbed.ftm.compose import EXPRESSIONS, build

REQUESTS: Final = 1000
PBR_PAIRS: Final = [
    ("a/protocol request.received", "a/before before.exit"),
    ("a/before before.exit", "a/proceed proceed.enter"),
    ("a/proceed proceed.enter", "a/server server.enter"),
    ("a/server state.captured", "a/after checkpoint.sent"),
    ("a/protocol reply.stored", "proxy reply.accepted"),
    ("proxy reply.accepted", "client reply.delivered"),
]
PBR_BESIDE: Final = [("a/after checkpoint.sent", "a/protocol reply.stored")]


def pairs(ftm: str) -> tuple[NotePair, ...]:
    """Those that are used."""
    return single_hops(build(ftm, PLACEMENT))[0]


def beside(ftm: str) -> tuple[NotePair, ...]:
    """Those that are shown apart."""
    return single_hops(build(ftm, PLACEMENT))[1]


def named(found: tuple[NotePair, ...]) -> list[tuple[str, str]]:
    return [(str(source), str(sink)) for source, sink in found]


# -- which pairs


def test_the_pairs_of_pbr_are_those_of_the_table() -> None:
    assert named(pairs("pbr")) == PBR_PAIRS
    assert named(beside("pbr")) == PBR_BESIDE


def test_a_brick_that_sends_two_messages_in_a_step_is_beside() -> None:
    assert [source.event for source, _ in beside("lfr")] == [Event.BEFORE_EXIT, Event.FOLLOWER_NOTIFIED]
    assert beside("none") == ()


@pytest.mark.parametrize("ftm", EXPRESSIONS)
def test_a_link_leads_from_each_note_to_the_next(ftm: str) -> None:
    graph = build(ftm, PLACEMENT)
    links = {(graph.node_of(link.source), graph.node_of(link.sink)) for link in graph.links}
    assert len(pairs(ftm)) >= 2
    for source, sink in pairs(ftm) + beside(ftm):
        assert source.brick != sink.brick
        assert (graph.node_of(source.brick), graph.node_of(sink.brick)) in links


def test_what_is_noted_twice_is_left_out() -> None:
    events = {place.event for pair in pairs("tr") + beside("tr") for place in pair}
    assert Event.BEFORE_EXIT in events and Event.SERVER_ENTER not in events


# -- quantiles


def test_the_nearest_rank() -> None:
    ordered = [10, 20, 30, 40]
    assert [quantile(ordered, share) for share in (0.0, 0.25, 0.26, 0.5, 0.99, 1.0)] == [
        10,
        10,
        20,
        20,
        40,
        40,
    ]


# -- real runs


@pytest.mark.process
@pytest.mark.parametrize("ftm", ["pbr", "lfr+tr"])
def test_the_document(home: Home, ftm: str) -> None:
    done = aftbed("bench", "hops", "--ftm", ftm, "--count", str(REQUESTS), "--rounds", "2", "--json")
    assert done.code == 0, done.out + done.err
    found = json.loads(done.out)
    assert [(p["source"], p["sink"]) for p in found["pairs"]] == named(pairs(ftm))
    assert [(p["source"], p["sink"]) for p in found["beside"]] == named(beside(ftm))
    assert (found["ftm"], found["requests"]) == (ftm, REQUESTS)
    assert found["samples"] == REQUESTS * len(found["pairs"])
    assert [percent for percent, _ in found["percentiles_ns"]] == [*range(100), 99.9, 100]
    assert len(found["quantiles_ns"]) == 129
    for ascending in (
        found["quantiles_ns"],
        [delay_ns for _, delay_ns in found["percentiles_ns"]],
        list(found["hop_ns"].values()),
    ):
        assert ascending == sorted(ascending) and ascending[0] > 0
    least, greatest = found["quantiles_ns"][0], found["quantiles_ns"][-1]
    assert found["percentiles_ns"][0][1] == least and found["hop_ns"]["max"] == greatest
    assert found["quantiles_ns"][64] == found["hop_ns"]["p50"]
    assert all(least <= p["p50_ns"] <= greatest for p in found["pairs"])


@pytest.mark.process
def test_what_a_person_reads(home: Home) -> None:
    done = aftbed("bench", "hops", "--count", str(REQUESTS), "--rounds", "2")
    assert done.code == 0, done.out + done.err
    lines = done.out.splitlines()
    assert lines[0].split() == ["ftm", "pbr"]
    assert [line.split()[0] for line in lines[3:10]] == ["p1", "p10", "p50", "p90", "p99", "p99.9", "max"]
    shown = [line.partition(" us  ")[2].partition("  (")[0] for line in lines[10:-3]]
    assert [tuple(pair.split(" -> ")) for pair in shown] == PBR_PAIRS + PBR_BESIDE
    assert [line.split()[0] for line in lines[-3:]] == ["limit", "ratio", "machine"]


@pytest.mark.process
def test_the_hops_of_a_request_fit_into_its_cycle(home: Home) -> None:
    """Pairs that overlapped, or spanned more than they say, would add up to more than the whole."""
    record = undisturbed("pbr", REQUESTS)
    cycles: dict[int, int] = {}
    for event in record.history.events(Event.REQUEST_SENT, Event.REPLY_DELIVERED):
        cycles[event.request_id] = event.t_ns - cycles.get(event.request_id, 0)
    by_pair = [[one.us * 1e3 for one in delays(record, pair, 0)] for pair in pairs("pbr") + beside("pbr")]
    assert all(len(found) == REQUESTS for found in by_pair)
    for cycle_ns, hops_ns in zip(cycles.values(), zip(*by_pair, strict=True), strict=True):
        assert 0 < sum(hops_ns) < cycle_ns and min(hops_ns) > 0


def test_no_two_pairs_are_the_same() -> None:
    for ftm in EXPRESSIONS:
        assert all(a != b for a, b in itertools.combinations(pairs(ftm) + beside(ftm), 2))
