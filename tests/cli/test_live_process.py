"""The commands of a second terminal against a live run, and the ways in which a run ends."""

import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from liveruns import RUN_SECONDS_MAX, SHORT, SHOWN_BYTES, Command, Home, Started, aftbed, ended, until
from terminal import Terminal

from aftbed.ftm.compose import build
from aftbed.runtime.unix import control_client, run_directory
from aftbed.runtime.unix.options import CarRun

pytestmark = pytest.mark.process

NODES = tuple(build("pbr", "process").nodes)


@pytest.fixture
def drive(home: Home) -> Iterator[Command]:
    """A car on a free road, in real time."""
    with Command("--scenario", "free-drive", "--pace", "real", "--ftm", "pbr") as command:
        command.started()
        command.wait_until_it_drives()
        yield command


def ended_well(command: Command, *words: str) -> None:
    """Stop the run: it passes, and its report has `words`."""
    stopped = aftbed("stop")
    assert stopped.code == 0, stopped.err
    assert stopped.out.endswith("stopping\n")
    done = command.done()
    assert done.code == 0, done.out + done.err
    assert "verdict: pass" in done.out
    assert "never braked" in done.out
    for word in words:
        assert word in done.out


def output(*arguments: str) -> str:
    """The output of a command that must succeed."""
    done = aftbed(*arguments)
    assert done.code == 0, done.err
    return done.out


def test_status_ps_and_graph_show_the_run(drive: Command) -> None:
    check_status()
    check_ps()
    check_graph()
    ended_well(drive)


def check_status() -> None:
    run = run_directory.live()[0]
    status = json.loads(output("status", "--json"))
    assert status["run"] == run
    assert (status["ftm"], status["placement"]) == ("pbr", "process")
    assert (status["leader"], status["backup"], status["epoch"]) == ("a", "b", 1)
    assert status["vehicle"]["speed_ms"] > 0
    assert status["requests"]["sent"] >= status["requests"]["answered"] > 0
    lines = {line[:10].strip(): line[11:] for line in reversed(output("status").splitlines())}
    assert lines["run"].startswith(f"{run}, for ")
    assert lines["mechanism"] == "pbr (process), 0 adaptations"
    assert lines["roles"] == "a leads, b backs up, epoch 1"
    assert lines["requests"].endswith(" us")
    assert "80.0 km/h  no target" in lines["car"]
    assert lines["bus"] == f"can0 at 127.0.0.1:{status['port']}, for clients of socketcand"
    assert lines["record"] == status["record"]
    assert "started: 16 nodes" in lines["events"]


def check_ps() -> None:
    """There are the seventeen processes of the paper."""
    rows = json.loads(output("ps", "--json"))
    nodes = [row for row in rows if row["node"]]
    assert [row["name"] for row in nodes] == ["supervisor", *NODES]
    roles = {row["name"]: row["role"] for row in nodes}
    assert roles["a/server"] == "primary"
    assert roles["b/server"] == "backup"
    assert roles["proxy"] == "proxy"
    assert {"hub", "vehicle", "zygote"} <= {row["name"] for row in rows if not row["node"]}
    for row in rows:
        assert Path(f"/proc/{row['pid']}").exists()
        assert 0 < row["pss_mb"] <= row["rss_mb"] < 200
    lines = output("ps").splitlines()
    assert lines[0].split() == ["NAME", "ROLE", "PID", "CPU%", "PSS", "MB"]
    assert lines[-1].startswith("17 processes, ")
    assert [line.split()[0] for line in lines[1:18]] == ["supervisor", *NODES]


def check_graph() -> None:
    """In every format."""
    text = output("graph")
    assert text == output("graph", "--ftm", "pbr", "--placement", "process")
    assert text.startswith("ftm pbr, placement process: 16 nodes\n")
    assert "aft2aft  a/after -> b/after" in text
    dot = output("graph", "--format", "dot")
    assert dot.startswith("digraph aftbed {")
    assert dot.rstrip().endswith("}")
    assert '"a/after" -> "b/after" [label="aft2aft"]' in dot
    mermaid = output("graph", "--format", "mermaid")
    assert mermaid.startswith("flowchart LR")
    assert "a_after -->|aft2aft| b_after" in mermaid


def test_inject_crash_of_the_primary(drive: Command) -> None:
    output("inject", "crash", "primary")
    drive.wait_for_line("script.done: new backup")
    status = json.loads(output("status", "--json"))
    assert (status["leader"], status["backup"], status["epoch"]) == ("b", "a", 2)
    roles = {row["name"]: row["role"] for row in json.loads(output("ps", "--json"))}
    assert (roles["a/server"], roles["b/server"]) == ("backup", "primary")
    ended_well(drive, "failover   to epoch 2", "crash primary: activated")


def test_inject_crash_of_others(drive: Command) -> None:
    beside, of_replicas = ("proxy", "a/watchdog", "engine"), ("backup", "a/before")
    for target in beside:
        output("inject", "crash", target)
        drive.wait_for_line(f"replaced: {target}")
    for nth, target in enumerate(of_replicas, 1):
        output("inject", "crash", target)
        drive.wait_for_line("script.done: new backup", nth)
    ended_well(drive, *(f"crash {target}: activated" for target in (*beside, *of_replicas)))


def test_inject_at_an_event_for_a_time_and_after_a_delay(drive: Command) -> None:
    output("inject", "hang", "engine", "--for", "50ms")
    assert json.loads(output("status", "--json"))["epoch"] == 1
    output("inject", "crash", "a/server", "--at", "checkpoint.sent", "--nth", "5")
    drive.wait_for_line("armed: crash a/server at checkpoint.sent nth 5")
    drive.wait_for_line("script.done: new backup")
    output("inject", "crash", "primary", "--after", "200ms")
    drive.wait_for_line("script.done: failover", nth=2)
    ended_well(
        drive,
        "hang engine for 50ms: activated",
        "crash a/server at checkpoint.sent nth 5: activated",
        "crash primary after 200ms: activated",
    )


def test_a_wrong_fault_is_refused_and_the_run_goes_on(drive: Command) -> None:
    for words, message in (
        (("crash", "primry"), "did you mean 'primary'?"),
        (("crash", "a/servr"), "did you mean 'a/server'?"),
        (("crash", "primary", "--at", "checkpoint.send"), "did you mean 'checkpoint.sent'?"),
        (("crash", "primary", "--nth", "3"), "'at EVENT nth 3' is allowed"),
        (("crash", "primary", "--at", "reply.sent", "--after", "5ms"), "one of them is allowed"),
        (("crash", "primary", "--at", "node.died"), "cannot trigger a fault under --ftm pbr"),
        (("hang", "primary", "--for", "50"), "as 50ms or 2s"),
    ):
        done = aftbed("inject", *words)
        assert done.code == 2, words
        assert done.err.startswith("aftbed: error: ")
        assert message in done.err
    ended_well(drive)


# -- how a run ends ------------------------------------------------------------------------------


@pytest.mark.parametrize("sig", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.deep)])
def test_an_interrupt_ends_the_run_with_its_verdict(home: Home, sig: signal.Signals) -> None:
    with Command("--scenario", "free-drive") as command:
        command.started()
        command.wait_until_it_drives()
        os.kill(command.pid, sig)
        done = command.done()
        assert done.code == 130, done.out + done.err
        assert "verdict: pass" in done.out
        assert "0 lost, 0 duplicated" in done.out
        assert home.left() == []


def test_an_interrupt_of_json_gives_the_document(home: Home) -> None:
    with Command("--load", "100000@200", "--json") as command:
        private = run_directory.root() / until(run_directory.live, "the run")[0]
        until(lambda: control_client.ask(private, control_client.StatusQuery())["backup"], "redundancy")
        os.kill(command.pid, signal.SIGINT)
        done = command.done()
    assert done.code == 130, done.out + done.err
    assert done.verdict().requests.lost == 0


def test_a_run_that_is_stopped_by_another_command_passes(home: Home) -> None:
    with Command("--load", "100000@200") as command:
        command.started()
        ended = aftbed("stop")
        assert ended.code == 0, ended.err
        done = command.done()
    assert done.code == 0, done.out + done.err


def test_check_of_a_record_equals_the_first_verdict(home: Home, tmp_path: Path) -> None:
    record = tmp_path / "record"
    fault = "crash primary at checkpoint.sent nth 60"
    drive = ("--scenario", SHORT, "--pace", "max", "--inject", fault, "--record", record)
    first = aftbed("run", *drive, "--json")
    assert first.code == 0, first.out + first.err
    again = aftbed("check", record, "--json")
    assert (again.code, again.out) == (0, first.out)
    names = {path.name for path in record.iterdir()}
    assert {"run.json", "journal", "bus.log", "end.json", "events.jsonl"} <= names
    assert "verdict: pass" in aftbed("check", record).out


def test_a_quiet_run_prints_its_verdict(home: Home, tmp_path: Path) -> None:
    record = tmp_path / "record"
    done = aftbed("run", "--scenario", SHORT, "--pace", "max", "--record", record, "--quiet")
    assert (done.code, done.out, done.err) == (0, "verdict: pass\n", "")
    assert aftbed("check", record, "--quiet").out == "verdict: pass\n"


def test_a_run_is_steered_by_keys(home: Home) -> None:
    """The whole way: on a terminal, by the command line's words, seen when it has happened."""

    def command() -> int:
        drive = ("--scenario", "free-drive", "--placement", "replica")
        os.execv(sys.executable, [sys.executable, "-m", "aftbed", "run", *drive])

    with Terminal(command, 100, 40) as terminal:
        before = terminal.before
        terminal.until_shown("pbr  a leads, b backs up, epoch 1")
        terminal.type("icrash primary\n")
        terminal.until_shown("pbr  b leads, a backs up, epoch 2")
        terminal.until(lambda: ": crash primary" in terminal.text, "the answer")
        terminal.type("ato nothing\n")
        terminal.until_shown("aftbed: error: ")
        terminal.type("ato lfr\n")
        terminal.until_shown("lfr  b leads, a backs up")
        terminal.type("q")
        assert terminal.code() == 0, terminal.raw[-SHOWN_BYTES:]
        assert b"verdict: pass" in terminal.raw
        assert terminal.modes == before


def test_a_run_can_end_while_its_command_is_suspended(home: Home, tmp_path: Path) -> None:
    """More is reported than fits, and nothing reads it; how it ended comes through."""
    drive = CarRun("free-drive", None, "latch", duration_ms=20_000)
    with Started(home, drive, ftm="none", placement="replica", record=tmp_path / "record") as run:
        assert ended(run.launched.supervisor, RUN_SECONDS_MAX)
        done = run.finish()
    assert run.launched.end is not None
    assert done.verdict.verdict == "pass", done.verdict.reasons


def test_a_run_without_a_terminal_prints_lines(home: Home) -> None:
    fault = "crash primary at checkpoint.sent nth 60"
    done = aftbed("run", "--scenario", SHORT, "--pace", "max", "--inject", fault)
    assert done.code == 0, done.err
    for words in ("started: 16 nodes", "km/h", "FULL", "script.done: failover", "stopped", "verdict: pass"):
        assert words in done.out
    assert done.err == ""
