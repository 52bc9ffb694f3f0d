"""Adaptations by command: a run under load, changed from a second process, then judged."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from liveruns import WAIT_SECONDS_MAX, Command, Done, Home, adapted, aftbed, until

pytestmark = pytest.mark.process

CLOSED: Final = "aftbed.vehicle.aeb.variants:WithoutStateAccess"
CAUTIOUS: Final = "aftbed.vehicle.aeb.variants:Cautious"
BRICK: Final = """\
from aftbed.core.graph import Kind
from aftbed.ftm.chain import Compute

class Counting(Compute):
    KIND = Kind("counting", ("bfr2prd", "srv2prd"), ("prd2srv", "prd2aft"))

    def __init__(self, setting):
        super().__init__()
        self.count = 0

    def step(self, port, msg, now_ns):
        self.count += 1
        assert self.count < {limit}
        return super().step(port, msg, now_ns)
"""


@pytest.fixture
def run(home: Home) -> Iterator[Command]:
    """A run under load."""
    with Command("--load", "100000@200") as command:
        command.started()
        yield command


def done(*arguments: str | Path) -> dict[str, object]:
    """The outcome of an adaptation that must be done."""
    found = adapted(*arguments, "--json")
    assert found.code == 0, found.out + found.err
    outcome: dict[str, object] = json.loads(found.out)
    assert outcome["outcome"] == "done"
    return outcome


def history() -> list[dict[str, object]]:
    """What `adapt history` tells."""
    found = aftbed("adapt", "history", "--json")
    assert found.code == 0, found.err
    outcomes: list[dict[str, object]] = json.loads(found.out)["adaptations"]
    return outcomes


def status() -> dict[str, object]:
    """What `status` tells."""
    found: dict[str, object] = json.loads(aftbed("status", "--json").out)
    return found


def nodes() -> int:
    """How many processes the paper would count."""
    return sum(row["node"] for row in json.loads(aftbed("ps", "--json").out))


def offered(*words: str) -> list[str]:
    """What a shell offers behind `words`; where the run has no time to answer, that is not of it."""
    return aftbed("completion", "answer", "--", *words).out.splitlines()


def stopped(command: Command) -> Done:
    """Stop the run: it passes, and nothing was lost, doubled or wrong."""
    assert aftbed("stop").code == 0
    ended = command.done()
    assert ended.code == 0, ended.out + ended.err
    assert "verdict: pass" in ended.out
    assert "0 lost, 0 duplicated" in ended.out and "0 wrong" in ended.out
    return ended


def test_a_run_is_composed_switched_and_decomposed_by_command(run: Command) -> None:
    composed = done("compose", "pbr+tr")
    assert (composed["purpose"], composed["ftm"]) == ("pbr to pbr+tr", "pbr+tr")
    assert (composed["bricks_changed"], composed["bricks_total"]) == (10, 22)
    assert 0.0 < float(str(composed["blackout_ms"])) < float(str(composed["total_ms"]))
    assert status()["ftm"] == "pbr+tr" and nodes() == 23
    until(lambda: "a/tr.before" in offered("inject", "crash", "a/"), "the nodes that a shell is offered")
    assert done("switch", "lfr+tr")["bricks_changed"] == 4
    assert done("decompose")["ftm"] == "lfr"
    assert nodes() == 17
    assert [o["purpose"] for o in history()] == ["pbr to pbr+tr", "pbr+tr to lfr+tr", "lfr+tr to lfr"]
    assert [o["number"] for o in history()] == [1, 2, 3]
    shown = aftbed("adapt", "history").out.splitlines()
    assert shown[-1] == "3 adaptations" and shown[-2].endswith("lfr+tr to lfr: done")
    stopped(run)


def test_what_is_refused_leaves_the_run_as_it_was(run: Command, tmp_path: Path) -> None:
    bad = tmp_path / "bad.yaml"
    bad.write_text(aftbed("adapt", "plan", "lfr", "--yaml").out.replace("  - resume: a/protocol\n", ""))
    (tmp_path / "gone.py").write_text("import no.such.module\n")
    (tmp_path / "ports.py").write_text(
        BRICK.format(limit=10**9).replace('("bfr2prd", "srv2prd")', '("bfr2prd",)')
    )
    for arguments, words in (
        (("compose", "lfr+tr"), "aftbed adapt to lfr+tr, or switch lfr first"),
        (("to", "tr+pbr"), "innermost"),
        (("script", bad), "commit[0]: suspended, not resumed: a/protocol"),
        (("update", "app", "--to", CLOSED), "consistent: lfr, lfr+assert"),
        (("update", "proced", "--to", "m:C"), "did you mean 'proceed'"),
        (("update", "proceed", "--to", "no.such.module:C"), "no.such.module"),
        (("update", "proceed", "--to", tmp_path / "gone.py"), "names no class"),
        (("update", "proceed", "--to", f"{tmp_path}/gone.py:Gone"), "cannot be imported"),
        (
            ("update", "proceed", "--to", f"{tmp_path}/ports.py:Counting"),
            "its inputs are bfr2prd, wanted are",
        ),
    ):
        refused = aftbed("adapt", *arguments, "--may-fail")
        assert refused.code == 2, refused.out + refused.err
        assert refused.err.startswith("aftbed: error: ") and words in refused.err
    assert (status()["ftm"], status()["epoch"]) == ("pbr", 1)
    assert {o["outcome"] for o in history()} <= {"refused"}
    stopped(run)


def test_a_script_that_was_printed_is_carried_out(run: Command, tmp_path: Path) -> None:
    path = tmp_path / "lfr.yaml"
    path.write_text(aftbed("adapt", "plan", "lfr", "--yaml").out)
    assert done("script", path)["ftm"] == "lfr"
    assert status()["ftm"] == "lfr"
    again = aftbed("adapt", "script", path)
    assert again.code == 2, "it is a script for another graph"
    stopped(run)


def test_a_brick_written_while_the_run_goes_on_takes_its_place(run: Command, tmp_path: Path) -> None:
    (tmp_path / "counting.py").write_text(BRICK.format(limit=10**9))
    outcome = done("update", "proceed", "--to", f"{tmp_path}/counting.py:Counting")
    assert (outcome["purpose"], outcome["bricks_changed"]) == ("update proceed", 2)
    stopped(run)


def test_a_brick_that_dies_while_it_is_observed_is_rolled_back(home: Home, tmp_path: Path) -> None:
    """It passes the self-test, whose requests are few, and breaks a little later."""
    (tmp_path / "counting.py").write_text(BRICK.format(limit=80))
    with Command("--load", "100000@1000") as run:
        run.started()
        run.wait_for_line("roles: a leads, b backs up")
        source = f"{tmp_path}/counting.py:Counting"
        ended = aftbed("adapt", "update", "proceed", "--to", source, "--may-fail")
        assert ended.code == 1, ended.out + ended.err
        assert "update proceed: rolled back: " in ended.out
        assert history()[-1]["outcome"] == "rolled back"
        until(lambda: status()["backup"], "redundancy")
        stopped(run)


def test_the_function_loses_its_state_access(run: Command) -> None:
    """The example of the paper: under PBR that is refused; LFR first."""
    refused = aftbed("adapt", "update", "app", "--to", CLOSED)
    assert refused.code == 2 and "pbr needs state access" in refused.err
    done("switch", "lfr")
    updated = aftbed("adapt", "update", "app", "--to", CLOSED)
    assert "note: lfr without state access" in updated.err
    assert updated.code == 0, updated.out
    refused = aftbed("adapt", "compose", "lfr+tr")
    assert refused.code == 2 and "tr needs state access" in refused.err
    stopped(run)


def test_a_new_version_of_the_function_takes_over_where_the_old_one_stopped(run: Command) -> None:
    """It warns earlier, which is not what the bare server of the verdict does."""
    assert done("update", "app", "--to", CAUTIOUS)["purpose"] == "update server"


def test_the_recipe_of_the_paper_is_told_as_such(run: Command) -> None:
    """It may lose requests, so there is nothing to be said of the verdict."""
    assert done("switch", "lfr", "--recipe", "paper")["recipe"] == "paper"
    assert [o["recipe"] for o in history()] == ["paper"]
    refused = aftbed("adapt", "to", "pbr", "--recipe", "papr")
    assert refused.code == 2 and "did you mean 'paper'?" in refused.err
    aftbed("stop")
    assert run.done().code in (0, 1)


def test_adaptations_that_were_asked_for_beforehand(home: Home) -> None:
    """The second one 2 s behind the first: while that is under way it is refused."""
    adapt = ("--adapt", "switch lfr at request 60", "--adapt", "compose lfr+tr at request 460")
    ended = aftbed("run", "--load", "600@200", *adapt)
    assert ended.code == 0, ended.out + ended.err
    assert "adapted: 1: pbr to lfr: done" in ended.out
    assert "adapted: 2: lfr to lfr+tr: done" in ended.out
    assert "verdict: pass" in ended.out


def test_a_second_adaptation_is_refused_while_one_is_under_way(run: Command, tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text("import time\ntime.sleep(1.5)\n" + BRICK.format(limit=10**9))
    update = ("adapt", "update", "proceed", "--to", f"{tmp_path}/slow.py:Counting")
    with subprocess.Popen([sys.executable, "-m", "aftbed", *update], stdout=subprocess.DEVNULL) as first:
        run.wait_for_line("adapt: 1: update proceed")
        refused = aftbed("adapt", "to", "lfr")
        assert refused.code == 2
        assert "adaptation 1 (update proceed) is under way" in refused.err
        assert first.wait(WAIT_SECONDS_MAX) == 0
    assert [o["purpose"] for o in history()] == ["update proceed"]
    stopped(run)
