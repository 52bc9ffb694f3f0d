"""Two runs side by side do not touch each other, and a command says which one it means."""

import signal

import pytest
from liveruns import ENDLESS, SHORT, Command, Home, aftbed, under_load, until
from rundirs import new_run

from aftbed.runtime.unix import control_client, run_directory

pytestmark = pytest.mark.process

LONG = 100_000  # requests: until it is stopped


def two_serve() -> bool:
    """Whether there are two runs, and each has answered a request."""
    runs = [run_directory.find(run) for run in run_directory.live()]
    counts = [control_client.ask(run, control_client.StatusQuery())["requests"] for run in runs]
    return len([count for count in counts if isinstance(count, dict) and count["answered"]]) == 2


def test_two_drives_at_once_both_pass(home: Home) -> None:
    fault = "crash primary at checkpoint.sent nth 60"
    drive = ("--scenario", SHORT, "--pace", "max")
    with Command(*drive, "--inject", fault) as first, Command(*drive) as second:
        hit, spared = first.done(), second.done()
    assert hit.code == 0, hit.out + hit.err
    assert spared.code == 0, spared.out + spared.err
    assert "failover" in hit.out
    assert "failover" not in spared.out


def test_a_crash_in_one_run_is_none_in_the_other(home: Home) -> None:
    with under_load(home, LONG) as one, Command("--load", f"{LONG}@200", "--json") as other:
        until(two_serve, "two runs that serve")
        seen = len(one.events)
        one.strike("a/server", signal.SIGKILL)
        one.wait_for("script.done", "new backup", after=seen)
        for run in run_directory.live():
            control_client.ask(run_directory.find(run), control_client.StopCommand())
        assert len(one.finish().verdict.failovers) == 1
        spared = other.done()
    assert spared.code == 0, spared.out + spared.err
    assert spared.verdict().failovers == []


def test_with_two_runs_alive_a_command_must_name_one(home: Home) -> None:
    with Command("--load", "100000@200") as first, Command("--load", "100000@200") as second:
        ids = {first.started(), second.started()}
        until(lambda: len(run_directory.live()) == 2, "two runs")
        for command in ("status", "ps", "graph", "stop"):
            refused = aftbed(command)
            assert refused.code == 2
            assert refused.err.startswith("aftbed: error: 2 runs are alive: name one with --run")
            assert all(run in refused.err for run in ids)
        for run in ids:
            named = aftbed("status", "--run", run)
            assert named.code == 0, named.err
            assert run in named.out
        assert aftbed("stop", "--run", ids.pop()).code == 0
        until(lambda: len(run_directory.live()) == 1, "one run to end")
        alone = aftbed("stop")
        assert alone.code == 0, alone.err
        for command in (first, second):
            done = command.done()
            assert done.code == 0, done.out + done.err
            assert "verdict: pass" in done.out


def test_the_directory_of_a_dead_run_is_no_run(home: Home) -> None:
    """What a crash of the machine may leave: a directory, and a socket without a server."""
    private = new_run()
    with pytest.raises(OSError, match=r"No such file|refused"):
        run_directory.connect(private)
    assert run_directory.live() == []
    assert aftbed("status").err.startswith("aftbed: error: no run is alive")
    run_directory.remove(private)


def test_the_directory_of_a_run_is_private(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        assert run.private.stat().st_mode & 0o777 == 0o700
        assert run_directory.root().stat().st_mode & 0o777 == 0o700
        assert run.stop().verdict.verdict == "pass"
