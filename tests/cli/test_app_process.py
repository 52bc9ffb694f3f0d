"""Commands in processes of their own: bad input, exit codes, the version, an interpreter that is refused."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from liveruns import Done, Home
from liveruns import forked as aftbed
from test_bad_input import DBC, MAP

from aftbed.runtime.unix.code_version import code_version

pytestmark = pytest.mark.process


def assert_refused(done: Done, home: Home) -> None:
    """One message, exit code 2, no traceback, nothing left."""
    assert done.code == 2, done.out + done.err
    assert done.err.startswith("aftbed: error: ")
    assert "Traceback" not in done.err
    assert done.out == ""
    assert home.left() == []


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "--inject", "crash primary at checkpoint.send"),
        ("run", "--replay", "absent.log", "--dbc", "absent.dbc", "--map", "toyota"),
        ("status",),
        ("inject", "crash", "primary"),
        ("check", "absent"),
    ],
)
def test_bad_input_ends_the_command(home: Home, arguments: tuple[str, ...]) -> None:
    assert_refused(aftbed(*arguments), home)


def test_a_port_in_use_ends_the_command(home: Home) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert_refused(aftbed("run", "--bus-port", str(taken.getsockname()[1])), home)


def test_a_refused_run_leaves_no_record(home: Home, tmp_path: Path) -> None:
    record = tmp_path / "record"
    assert_refused(aftbed("run", "--scenario", "ccrs50", "--record", record), home)
    assert not record.exists()


@pytest.mark.parametrize("arguments", [("--help",), ("run", "--load", "10"), ("status",)])
def test_an_interpreter_without_asserts_is_refused(home: Home, arguments: tuple[str, ...]) -> None:
    words = [sys.executable, "-O", "-m", "aftbed", *arguments]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode != 0
    assert "refusing to run under python -O" in done.stderr
    assert home.left() == []


def test_the_version_is_the_one_of_the_records() -> None:
    done = aftbed("--version")
    assert (done.code, done.out, done.err) == (0, f"aftbed {code_version()}\n", "")


@pytest.mark.parametrize("option", [("--seed", "x"), ("--unknown",)])
def test_usage_is_exit_code_2(home: Home, option: tuple[str, ...]) -> None:
    done = aftbed("run", *option)
    assert done.code == 2
    assert option[0] in done.err
    assert home.left() == []


@pytest.mark.parametrize("ending", ["log", "asc"])
def test_a_log_is_replayed_without_what_the_bus_does_not_carry(
    ending: str, home: Home, tmp_path: Path
) -> None:
    """And without damaged lines, as --skip-bad asks: both are counted; the frames around are replayed."""
    good = [f"(000000000{n}.000000) can0 210#{n:02X}00000000000000_F\n" for n in range(1, 6)]
    others = [f"(0000000004.500000) can0 {text}\n" for text in ("210##0", "00000210#", "210#R", "20000004#")]
    lines = [*good[:3], "garbage\n", "(0000000001.000000) can0 210#00\n", *good[3:4], *others, good[4]]
    log, dbc, mapped = tmp_path / "x.log", tmp_path / "x.dbc", tmp_path / "x.yaml"
    log.write_text("".join([*lines, good[4][:-9]]))
    if ending == "asc":
        log = tmp_path / "x.asc"
        assert aftbed("log", "convert", tmp_path / "x.log", log, "--skip-bad").code == 0
        log.write_text(log.read_text().replace("End", " 5.1 1  210  Rx  d 8 XX\nEnd"))
    dbc.write_text(DBC)
    mapped.write_text(MAP)
    words = ("run", "--replay", log, "--dbc", dbc, "--map", mapped, "--pace", "max", "--json")
    refused = aftbed(*words)
    assert refused.code == 2 and "--skip-bad leaves out such parts" in refused.err
    done = aftbed(*words, "--skip-bad")
    assert done.code == 0, done.out + done.err
    replay = json.loads(done.out)["replay"]
    kinds = ("CAN FD frame", "29-bit identifier", "remote frame", "error frame", "time runs backwards")
    torn = {"torn last line": 1} if ending == "log" else {}
    assert replay["log"]["left_out"] == torn | dict.fromkeys(kinds, 1)
    assert (replay["log"]["frames"], replay["log"]["skipped"], replay["played"]["sent"]) == (5, 1, 5)
    assert replay["gateway"]["accepted"] == 5
