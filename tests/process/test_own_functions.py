"""Functions that are no Python, protected in real runs: they survive crashes, and their failures are told."""

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final

import psutil
import pytest
from liveruns import ENDLESS, Command, aftbed, home, until
from sampling import every

from aftbed.functions.library import HEADER

pytestmark = pytest.mark.process

__all__ = ["home"]

LIBRARY: Final = """
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "aft.h"

struct state { uint64_t sum, count; };

int aft_init(void **instance) { *instance = calloc(1, sizeof(struct state)); return AFT_OK; }

int aft_execute(void *instance, const uint8_t *request, size_t request_size, uint8_t *reply, size_t reply_max,
                size_t *reply_size) {
    struct state *state = instance;
    const char *once = getenv("FAIL_ONCE"), *how = getenv("FAIL");
    for (size_t i = 0; i < request_size; i++) state->sum = state->sum * 31 + request[i];
    if (++state->count == 40 && once && open(once, O_CREAT | O_EXCL, 0600) >= 0) {
        if (*how == 'c') {
            fprintf(stderr, "no gains\\n");
            raise(SIGSEGV);
        }
        while (*how == 'h') ;
        *reply_size = 1 << 20;
        return AFT_OK;
    }
    memcpy(reply, &state->sum, *reply_size = sizeof state->sum);
    return AFT_OK;
}

int64_t aft_state_size(void *instance) { return sizeof(struct state); }

int aft_capture(void *instance, uint8_t *state, size_t size) { memcpy(state, instance, size); return AFT_OK; }

int aft_restore(void *instance, const uint8_t *state, size_t size) {
    if (size != sizeof(struct state)) return AFT_REFUSED;
    memcpy(instance, state, size);
    return AFT_OK;
}
"""
PROGRAM: Final = """
import json, os, sys, time, zlib
value = count = 0
how, once = os.environ.get("FAIL"), os.environ.get("FAIL_ONCE")

def fails():
    try:
        os.close(os.open(once, os.O_CREAT | os.O_EXCL))
    except OSError:
        return False
    return True

for line in sys.stdin:
    asked = json.loads(line)
    answer = {"id": asked["id"]}
    if "describe" in asked:
        answer["describe"] = {"deterministic": True, "state_access": "exact"}
    elif "execute" in asked:
        count += 1
        value = zlib.crc32(bytes.fromhex(asked["execute"]), value)
        if count == 40 and once and fails():
            while how == "hang":
                time.sleep(9)
            much = json.dumps(answer | {"execute": "00" * 70000})
            print("\x1b[2Jnot today" if how == "garbage" else much, flush=True)
            continue
        answer["execute"] = (b"%08x" % value).hex()
    elif "capture" in asked:
        answer["capture"] = (b"%d" % value).hex()
    else:
        value, answer["restore"] = int(bytes.fromhex(asked["restore"])), None
    print(json.dumps(answer), flush=True)
"""
FTMS: Final = ("pbr", "lfr", "pbr+tr")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> str:
    compiler = next((one for one in ("cc", "gcc", "clang") if shutil.which(one)), None)
    if compiler is None:
        pytest.skip("there is no C compiler")
    source = tmp_path_factory.mktemp("library") / "sum.c"
    source.write_text(LIBRARY)
    built = source.with_suffix(".so")
    line = [compiler, "-shared", "-fPIC", "-I", HEADER.parent, "-o", built, source]
    subprocess.run(line, check=True, timeout=60)
    return str(built)


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("program") / "sum.py"
    path.write_text(PROGRAM)
    return shlex.join([sys.executable, "-I", "-S", str(path)])


def programs(command: str) -> list[int]:
    """The pids of those that run."""
    words = shlex.split(command)
    return [
        one.pid
        for one in psutil.process_iter(["cmdline"])
        if one.info["cmdline"] == words and one.status() != psutil.STATUS_ZOMBIE
    ]


@pytest.mark.parametrize(
    ("kind", "ftm", "event"),
    every(
        5,
        [
            (kind, ftm, event)
            for kind in ("library", "program")
            for ftm in FTMS
            for event in ("server.enter", "server.exit", "reply.sent")
        ],
    ),
)
def test_a_crash_loses_nothing(kind: str, ftm: str, event: str, request: pytest.FixtureRequest) -> None:
    app = request.getfixturevalue(kind)
    done = aftbed(
        "run", "--app", app, "--ftm", ftm, "--load", "120@400", "--inject", f"crash primary at {event} nth 50"
    )
    assert done.code == 0, done.out + done.err
    assert "120 sent, 120 answered, 0 lost" in done.out and f"  function   {app}" in done.out
    assert "failover   to epoch 2" in done.out and "  failed  " not in done.out


@pytest.mark.parametrize(
    ("kind", "how", "told"),
    every(
        2,
        [
            ("library", "crash", ": its process was killed by SIGSEGV; the log has before it: no gains"),
            ("library", "too much", ": aft_execute: *reply_size is 1048576, at most 61440 is allowed"),
            ("library", "hang", "] alarm: a: hang"),
            ("program", "too much", ": answered to execute: more than 126976 bytes in a line"),
            ("program", "hang", "] alarm: a: hang"),
            ("program", "garbage", r": answered to execute: b'\x1b[2Jnot today': JSON is malformed"),
        ],
    ),
)
def test_a_function_that_fails_by_itself_is_failed_over_and_told(
    kind: str,
    how: str,
    told: str,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In one replica only, at its 40th request. A hang is the Watchdog's to see, within 60 ms."""
    app = request.getfixturevalue(kind)
    monkeypatch.setenv("FAIL_ONCE", str(tmp_path / "failed"))
    monkeypatch.setenv("FAIL", how)
    done = aftbed("run", "--app", app, "--load", "120@400")
    assert done.code == 0, done.out + done.err
    assert (tmp_path / "failed").exists()
    assert "120 sent, 120 answered, 0 lost, 0 duplicated" in done.out and "0 wrong" in done.out
    assert "failover   to epoch 2" in done.out and told in done.out
    if told.startswith(":"):
        (failure,) = (line for line in done.out.splitlines() if line.startswith("  failed     "))
        assert told in failure and failure.split()[1] == "a/server:"
    assert programs(app) == []


def test_a_program_that_is_killed_is_failed_over_and_told(program: str) -> None:
    with Command("--app", program, "--load", f"{ENDLESS}@400") as run:
        run.wait_for_line("roles: a leads, b backs up")
        until(lambda: len(programs(program)) == 2, "both replicas run their program")
        os.kill(programs(program)[0], signal.SIGKILL)
        run.wait_for_line("script.done: new backup")
        assert aftbed("stop").code == 0
        done = run.done()
    assert done.code == 0, done.out + done.err
    assert " 0 lost, 0 duplicated, " in done.out and " 0 wrong" in done.out
    (failure,) = (line for line in done.out.splitlines() if line.startswith("  failed     "))
    assert "sum.py: was killed by SIGKILL" in failure and failure.endswith("nothing is on its stderr")
    assert failure.split()[1] in ("a/server:", "b/server:")
    assert programs(program) == []


SILENT: Final = """
import sys
sys.exit("it began\\n" + "x" * 1000 + "\\nnot today")
"""


@pytest.mark.parametrize("words", [("run", "--load", "10"), ("sim", "--count", "10"), ("app", "check")])
def test_a_program_that_cannot_begin_is_refused_with_all_that_it_told(
    words: tuple[str, ...], tmp_path: Path
) -> None:
    """Before anything starts."""
    (tmp_path / "silent.py").write_text(SILENT)
    app = f"{sys.executable} {tmp_path}/silent.py"
    named = (app,) if words == ("app", "check") else ("--app", app)
    done = aftbed(*words, *named)
    lines = done.err.splitlines()
    assert (done.code, done.out, len(lines)) == (2, "", 5), done.err
    assert lines[0] == f"aftbed: error: {app}: ended with exit code 1, asked to describe"
    assert (lines[2], lines[-1]) == ("it began", "not today")


@pytest.mark.deep
def test_the_cycle_of_a_function_is_measured_with_its_requests(library: str, tmp_path: Path) -> None:
    (tmp_path / "sent.csv").write_text("a:u8,b:u64\n1,2\n3,4\n")
    words = (
        "bench",
        "cycle",
        "--count",
        "100",
        "--rounds",
        "2",
        "--app",
        library,
        "--requests",
        tmp_path / "sent.csv",
        "--json",
    )
    done = aftbed(*words)
    assert done.code == 0, done.err
    assert json.loads(done.out)["requests"] >= 100 and json.loads(done.out)["ratio_p50"] > 1
