"""What stands beside the figures of a bench: the limit, the ratio of the rounds, and what the machine did.

Today's keys of each document are kept: `aftbed bench compare` reads them in every version.
"""

import json
from pathlib import Path
from typing import Any, Final

import msgspec
import pytest
from liveruns import Home, aftbed, forked

from aftbed.bench.rounds import Meanwhile, MeasuredLimit, Ratio

pytestmark = pytest.mark.process

QUANTILES: Final = {"p50", "p95", "p99", "max"}
START: Final = {"p50", "max"}
# In 50 of them there are few turns: on a busy machine a side may measure nothing in any of these.
IN_TURNS: Final = ("--count", "1001")
DEATH: Final = "SIGKILL to a pidfd readable elsewhere"


def document(*words: str) -> dict[str, Any]:
    done = aftbed("bench", *words, "--json")
    assert done.code == 0, done.err
    found = json.loads(done.out)
    machine = msgspec.convert(found["machine"], Meanwhile)
    assert machine.seconds > 0
    return found  # type: ignore[no-any-return]


def check_beside(found: dict[str, Any], name: str, rounds: int) -> None:
    limit, ratio = msgspec.convert(found["limit"], MeasuredLimit), msgspec.convert(found["ratio"], Ratio)
    assert limit.name == name and 0 < limit.p50 <= limit.p95 <= limit.p99 <= limit.max
    assert ratio.rounds == rounds
    for one in (ratio.p50, ratio.p99):
        assert 0 < one.q1 <= one.median <= one.q3 and one.all > 0
    assert ratio.p50.all <= ratio.p99.all


def test_a_cycle(home: Home) -> None:
    found = document("cycle", *IN_TURNS, "--rounds", "2", "--placement", "replica")
    check_beside(found, "bare ring of 4 hops and 1 to the backup", 2)
    assert (found["requests"], found["hops"], len(found["ratio_rounds"])) == (1001, 4, 2)
    assert (
        found["ratio_p50"] == found["ratio"]["p50"]["median"] and found["ratio_p50"] in found["ratio_rounds"]
    )
    assert set(found["cycle_us"]) == set(found["ring_us"]) == QUANTILES


def test_a_hop(home: Home) -> None:
    found = document("hops", *IN_TURNS, "--rounds", "2")
    check_beside(found, "hop of the bare ring of 12 hops and 1 to the backup", 2)


@pytest.mark.parametrize(
    ("words", "ftm", "placement"),
    [(("--beside", "none"), "none", "replica"), (("--beside-placement", "single"), "pbr", "single")],
)
def test_a_cycle_beside_another(words: tuple[str, ...], ftm: str, placement: str, home: Home) -> None:
    found = document("cycle", *IN_TURNS, "--rounds", "1", "--placement", "replica", *words)
    check_beside(found, f"cycle under {ftm}, {placement}", 1)
    assert (found["ftm"], found["placement"], found["requests"]) == ("pbr", "replica", 1001)
    assert (found["beside_ftm"], found["beside_placement"]) == (ftm, placement)
    assert set(found["cycle_us"]) == QUANTILES


@pytest.mark.parametrize(
    ("option", "reason"),
    [("--beside", "unknown FTM 'nope'"), ("--beside-placement", "unknown placement 'nope'")],
)
def test_nothing_is_measured_beside_what_there_is_none_of(option: str, reason: str) -> None:
    done = aftbed("bench", "cycle", option, "nope")
    assert done.code == 2 and reason in done.err and done.out == ""


def test_a_recovery(home: Home) -> None:
    found = document("recovery", "--kills", "2")
    check_beside(found, DEATH, 2)
    assert found["kills"] == 2
    assert set(found["parts_ms"]) == {"detection", "fencing", "promotion", "first_reply"}
    assert (
        set(found["recovery_ms"]) == set(found["after_detection_ms"]) == set(found["death_ms"]) == QUANTILES
    )
    assert found["death_ms"]["p50"] == found["limit"]["p50"]


def test_an_adaptation(home: Home, tmp_path: Path) -> None:
    found = document("adapt", "--adaptations", "1")
    (tmp_path / "times.json").write_text(json.dumps(found))
    for one in (found, found["back"]):
        check_beside(one, DEATH, 1)
        assert set(one["prepare_ms"]) == set(one["blackout_ms"]) == set(one["total_ms"]) == QUANTILES
        steps = [times["p50"] for times in one["steps_ms"].values()]
        assert min(steps) > 0 and sum(steps) <= one["blackout_ms"]["p50"] + 0.01  # rounded
    assert list(found["steps_ms"]) == ["suspend", "bind", "resume"]
    assert list(found["back"]["steps_ms"]) == ["suspend", "bind+unbind", "resume"]
    assert (found["adaptations"], found["from"], found["to"]) == (2, "pbr", "pbr+tr")
    assert found["requests"]["lost"] == 0 and found["stuck"] == 0 and set(found["ring_us"]) == QUANTILES
    check_times_of_a_set(tmp_path / "times.json", found)


def check_times_of_a_set(path: Path, document: dict[str, Any]) -> None:
    """What the document has is taken from it, and the rest is measured."""
    done = forked(
        "ftm", "resilience", "--set", "pbr,tr", "--adaptations", "1", "--times", str(path), "--json"
    )
    assert done.code == 0, done.err
    found = {(one["from"], one["to"]): one for one in json.loads(done.out)["adaptations"]}
    assert found["pbr", "pbr+tr"]["blackout_ms"] == document["blackout_ms"]["p50"]
    sources = {pair: one["source"] for pair, one in found.items()}
    assert sources["pbr", "pbr+tr"] == sources["pbr+tr", "pbr"] == str(path)
    assert sources["pbr+tr", "tr"] == sources["tr", "pbr"] == sources["pbr", "tr"] == "measured"
    assert all(0 < one["blackout_ms"] < one["total_ms"] and one["of"] >= 1 for one in found.values())


def test_an_update(home: Home) -> None:
    found = document("adapt", "--update", "1000", "--adaptations", "1")
    for one in (found, found["back"]):
        check_beside(one, DEATH, 1)
        assert list(one["steps_ms"]) == ["suspend", "drain", "migrate", "exchange", "resume"]
        assert one["bricks_changed"] == 2  # the Servers
    assert (found["from"], found["to"], found["update_bytes"]) == ("pbr", "pbr", 1000)
    assert found["requests"]["lost"] == found["requests"]["wrong"] == 0


@pytest.mark.deep
def test_the_papers_recipe_goes_one_way(home: Home) -> None:
    found = document("adapt", "--adaptations", "2", "--recipe", "paper", "--rounds", "1")
    check_beside(found, DEATH, 1)
    assert "back" not in found and found["adaptations"] == 2


@pytest.mark.deep
def test_a_start(home: Home) -> None:
    found = document("launch", "--runs", "1")
    check_beside(found, "import of its libraries", 1)
    check_beside(found["help"], "import of typer", 1)
    for name in ("launch_ms", "graph_ms", "imports_ms"):
        assert set(found[name]) == START
    assert set(found["help"]["help_ms"]) == START


@pytest.mark.deep
@pytest.mark.parametrize(
    ("options", "limit"),
    [
        ((), "bare ring of 12 hops and 1 to the backup, memcpy of 100000 bytes through memfds"),
        (
            ("--tells-changes",),
            "bare ring of 12 hops and 1 to the backup, memcpy of 4096 bytes through memfds",
        ),
        (("--ftm", "lfr"), "bare ring of 10 hops and 2 to the backup"),
    ],
)
def test_a_state(home: Home, options: tuple[str, ...], limit: str) -> None:
    found = document("state", "--bytes", "100000", "--rounds", "1", *options)
    check_beside(found, limit, 1)
    for name in ("cycle_us", "beside_cycle_us", "blackout_ms", "beside_blackout_ms"):
        assert set(found[name]) == QUANTILES
    assert found["ratio_p50"] > 0 and found["blackout_ratio_p50"] > 0 and len(found["ratio_rounds"]) == 1


@pytest.mark.deep
def test_memory(home: Home) -> None:
    found = document("memory")
    assert found["pss_mb"] > 0 and found["processes"] == 17
